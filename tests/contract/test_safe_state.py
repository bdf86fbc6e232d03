"""The system-wide safe state: what happens when a critical node freezes."""

from __future__ import annotations

import asyncio
import ctypes
import os
import threading
import time

import pytest

from horus import Node, ms

from .freezing import (
    MARKER,
    ON_LOOP,
    WAYS,
    Freezer,
    Witness,
    await_health,
    cleared,
    expirations,
    freezing_node,
    in_safe_state,
    remaining,
    reports,
)
from .helpers import (
    PATIENCE_S,
    TRIGGER,
    all_have_ticked,
    as_async,
    node_of,
    nothing,
    run_program,
    running,
    wait_until,
)

pytestmark = pytest.mark.realtime

TIMEOUT_MS = 100


# -- entering --------------------------------------------------------------------------------------


@pytest.mark.parametrize("way", WAYS)
def test_a_critical_node_that_freezes_puts_the_whole_system_in_its_safe_state(make, way, caplog):
    """A critical node that exceeds its timeout: enter_safe_state() is called on all nodes."""
    sched = make()
    witness, freezer = Witness(sched), Freezer(armed=False)
    witness.add("Rt", "motor", order=10)
    witness.add("Compute", "planner", order=30)
    witness.add("Rt", "reporter", order=40, hook=False)
    sched.add(freezing_node(way, freezer, "critical", order=20))
    sched.add_critical_node("critical", timeout_ms=TIMEOUT_MS)
    with running(sched), freezer:
        wait_until(lambda: witness.all_tick())
        freezer.freeze()
        sched.publish(TRIGGER, 1)
        wait_until(lambda: in_safe_state(sched))
        wait_until(lambda: len(witness.names("hook")) == 2 and freezer.hook_threads)

        # In shutdown order: the last to run is the first to be made safe.
        assert witness.names("hook") == ["planner", "motor"]
        assert len(freezer.hook_threads) == 1
        assert "critical" in sched.safety_stats()["safe_state_reason"]
        wait_until(lambda: [r for r in caplog.records if r.levelname == "CRITICAL"])
        (record,) = [r for r in caplog.records if r.levelname == "CRITICAL"]
        assert "safe state entered: critical node critical" in record.getMessage()
        wait_until(lambda: reports(caplog, "critical"))
        assert MARKER in reports(caplog, "critical")[0][2]


def test_nodes_with_a_hook_are_held_and_nodes_without_tick_on(make, loop):
    """Nodes that have a hook do not tick until clear_safe_state(); others keep reporting."""
    sched = make(loop=loop)
    witness, freezer = Witness(sched), Freezer(armed=False)
    kinds = ("BestEffort", "Event", "AsyncIo", "Rt", "Compute")
    for kind in kinds:
        witness.add(kind, f"{kind}_held")
        witness.add(kind, f"{kind}_free", hook=False)
    sched.add(freezing_node("Rt", freezer, "critical", order=0, watchdog=60.0))
    sched.add_critical_node("critical", timeout_ms=TIMEOUT_MS)
    with running(sched), freezer:
        wait_until(lambda: witness.all_tick())
        freezer.freeze()
        wait_until(lambda: len(witness.names("hook")) == 5)
        # A tick that was under way when the gate was closed has ended by now.
        before = {info["name"]: info for info in sched.get_all_nodes()}
        ticks = dict(witness.ticks)

        def goes_on(name: str) -> bool:
            sched.publish(TRIGGER, 1)
            if name.endswith("_free"):
                return witness.ticks[name] >= ticks[name] + 3
            return sched.get_node_stats(name)["skipped"] >= before[name]["skipped"] + 3

        for name in witness.ticks:
            wait_until(lambda name=name: goes_on(name))
        for kind in kinds:
            assert witness.ticks[f"{kind}_held"] == ticks[f"{kind}_held"]
            assert sched.get_node_stats(f"{kind}_held")["state"] == "safe_state"
            assert sched.get_node_stats(f"{kind}_held")["health"] == "healthy"
            assert sched.get_node_stats(f"{kind}_free")["state"] == "running"
        assert sorted(witness.names("hook")) == sorted(f"{kind}_held" for kind in kinds)


def test_the_timeout_of_a_critical_node_is_its_own(make):
    """This is stricter than the global watchdog: 100 ms for the motor, a minute for others."""
    sched = make(watchdog_ms=60_000)
    critical, other = Freezer(), Freezer()
    sched.add(freezing_node("Compute", other, "other"))
    sched.add(freezing_node("Rt", critical, "critical", watchdog=60.0))
    sched.add_critical_node("critical", timeout_ms=TIMEOUT_MS)
    with running(sched), critical, other:
        wait_until(lambda: in_safe_state(sched))
        wait_until(lambda: critical.hook_threads and other.hook_threads)

        assert sched.get_node_stats("critical")["health"] == "warning"
        assert sched.get_node_stats("other")["health"] == "healthy"
        assert sched.safety_stats()["watchdog_expirations"] == 1


def test_an_ordinary_node_that_freezes_is_isolated_alone(make):
    """A regular node that freezes gets isolated; only a critical one concerns the system."""
    sched = make(watchdog_ms=TIMEOUT_MS)
    witness, freezer = Witness(sched), Freezer()
    witness.add("Rt", "motor")
    sched.add(freezing_node("Compute", freezer))
    with running(sched), freezer:
        await_health(sched, "frozen", "isolated")
        wait_until(lambda: freezer.hook_threads)
        before = witness.ticks["motor"]
        wait_until(lambda: witness.ticks["motor"] >= before + 3)

        assert not in_safe_state(sched)
        assert sched.safety_stats()["safe_state_reason"] is None
        assert witness.names("hook") == []


def test_a_critical_node_is_critical_even_if_another_one_has_its_thread(make):
    """Its motor is not controlled: a critical node that cannot begin counts all the same."""
    sched = make(watchdog_ms=60_000)
    witness, blocker = Witness(sched), Freezer(armed=False)
    sched.add(freezing_node("BestEffort", blocker, "blocker", order=0))
    witness.add("BestEffort", "critical", order=1)
    sched.add_critical_node("critical", timeout_ms=TIMEOUT_MS)
    with running(sched), blocker:
        wait_until(lambda: witness.all_tick())
        blocker.freeze()
        wait_until(lambda: witness.names("hook") == ["critical"])

        assert "because of blocker" in sched.safety_stats()["safe_state_reason"]


def test_a_critical_node_that_keeps_its_timeout_changes_nothing(make):
    """Idle or busy, a critical node that is in time leaves the system alone."""
    sched = make()
    witness = Witness(sched)
    witness.add("Rt", "motor")
    sched.add(Node("slow", lambda: time.sleep(20 * ms), rate=10))
    sched.add(Node("rare", nothing, rate=1))
    sched.add(Node("silent", nothing, on="silence"))
    for name in ("motor", "slow", "rare", "silent"):
        sched.add_critical_node(name, timeout_ms=2 * TIMEOUT_MS)
    with running(sched):
        wait_until(lambda: sched.get_node_stats("slow")["total_ticks"] >= 8)

    assert sched.safety_stats()["watchdog_expirations"] == 0
    assert witness.names("hook") == []


# -- hooks that misbehave --------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["Rt", "AsyncIo"])
def test_a_hook_that_raises_or_hangs_does_not_stop_the_others(make, kind, caplog):
    """Each hook is bounded in time and contained; one that hangs is named with its stack."""
    sched = make()
    witness, freezer, stuck = Witness(sched), Freezer(armed=False), Freezer()
    thawed = threading.Event()

    def fail(node):
        raise OSError("brake is stuck")

    async def hang_async(node):
        while not thawed.is_set():  # noqa: ASYNC110
            await asyncio.sleep(0.002)

    def hang(node):
        stuck.stuck_in_the_driver()

    witness.add("Rt", "last", order=10)
    raising = as_async(nothing) if kind == "AsyncIo" else nothing
    hanging = hang_async if kind == "AsyncIo" else hang
    failing = as_async(fail) if kind == "AsyncIo" else fail
    sched.add(Node("hangs", raising, rate=50, order=30, safe_state=hanging))
    sched.add(Node("raises", raising, rate=50, order=20, safe_state=failing))
    sched.add(freezing_node("Rt", freezer, "critical", order=0, hook=False, watchdog=60.0))
    sched.add_critical_node("critical", timeout_ms=TIMEOUT_MS)
    with running(sched), freezer, stuck:
        try:
            wait_until(lambda: witness.all_tick())
            freezer.freeze()
            wait_until(lambda: witness.names("hook") == ["last"])
            assert sched.get_node_stats("raises")["errors_count"] == 1
            wait_until(lambda: any("has not returned" in r.getMessage() for r in caplog.records))
            assert any("brake is stuck" in r.getMessage() for r in caplog.records)
            freezer.thaw()
            wait_until(lambda: sched.get_node_stats("critical")["health"] == "healthy")
            # Nobody must tick against its own hook.
            wait_until(lambda: remaining(sched) == ["hangs"])
            assert sched.get_node_stats("hangs")["state"] == "safe_state"
        finally:
            thawed.set()
            stuck.thaw()
        wait_until(lambda: cleared(sched))
        wait_until(lambda: sched.get_node_stats("hangs")["state"] == "running")


@pytest.mark.parametrize("way", ["Rt", *ON_LOOP])
def test_async_hooks_run_on_the_loop_when_it_is_free_and_elsewhere_when_it_is_blocked(make, way):
    """The hook of an async node has its loop if it can have it, and is called in any case."""
    sched = make()
    witness, freezer = Witness(sched), Freezer(armed=False)
    loop_threads = []

    async def tick(node):
        loop_threads.append(threading.get_ident())

    async def hook(node):
        await asyncio.sleep(0.001)
        witness.hook(node)

    sched.add(Node("uploader", tick, rate=50, order=10, safe_state=hook))
    sched.add(freezing_node(way, freezer, "critical", order=0))
    sched.add_critical_node("critical", timeout_ms=TIMEOUT_MS)
    with running(sched), freezer:
        wait_until(lambda: loop_threads)
        freezer.freeze()
        sched.publish(TRIGGER, 1)
        wait_until(lambda: witness.names("hook") == ["uploader"])

        on_loop = witness.hook_threads["uploader"] == loop_threads[0]
        assert on_loop == (way not in ON_LOOP)


def test_a_hook_that_spins_does_not_keep_the_nodes_from_running(make):
    """Below supervision and above the nodes: once it has had its time, a hook is below them."""
    if not make(rt=True).capabilities()["rt_scheduling"]:
        pytest.skip("SCHED_FIFO is not permitted")
    sched = make(rt=True)
    freezer = Freezer(armed=False)
    policies, over = [], threading.Event()

    def hook(node):
        while not over.wait(0.001):
            policies.append(os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK)

    sched.add(Node("hangs", nothing, rate=50, safe_state=hook))
    sched.add(freezing_node("Rt", freezer, "critical", order=0, hook=False, watchdog=60.0))
    sched.add_critical_node("critical", timeout_ms=TIMEOUT_MS)
    with running(sched), freezer:
        try:
            freezer.freeze()
            wait_until(lambda: policies and policies[-1] == os.SCHED_OTHER)
            assert policies[0] == os.SCHED_FIFO
        finally:
            over.set()


def test_a_hook_of_an_earlier_run_that_still_hangs_has_no_say_in_the_next(make):
    """What a hook from before does when it returns at last does not end the next one's episode."""
    sched = make()
    freezer = Freezer(armed=False)
    hooks, first, second = [], threading.Event(), threading.Event()

    def hook(node):
        hooks.append(1)
        (first if len(hooks) == 1 else second).wait(PATIENCE_S)

    sched.add(Node("motor", nothing, rate=50, safe_state=hook))
    sched.add(freezing_node("Rt", freezer, "critical", order=0, hook=False, watchdog=60.0))
    sched.add_critical_node("critical", timeout_ms=TIMEOUT_MS)
    try:
        for episode in (1, 2):
            with running(sched), freezer:
                wait_until(lambda: all_have_ticked(sched))
                freezer.freeze()
                wait_until(lambda episode=episode: len(hooks) == episode)
                if episode == 2:
                    freezer.thaw()
                    first.set()
                    wait_until(lambda: remaining(sched) is not None)
                    assert remaining(sched) == ["motor"]
                    second.set()
                    wait_until(lambda: cleared(sched))
    finally:
        first.set()
        second.set()


def test_hooks_are_called_even_if_the_process_can_have_no_more_threads():
    """The last resort: without a thread of its own, a hook runs where it is asked for."""
    done = run_program(
        """
        import os, resource, threading, time
        from horus import Node, Scheduler

        blocked, hooks = [], []

        def block(node):
            if blocked:
                blocked.clear()
                time.sleep(0.5)

        sched = Scheduler()
        sched.add(Node("motor", lambda node: None, rate=100, safe_state=hooks.append))
        sched.add(Node("critical", block, rate=20))
        sched.add_critical_node("critical", timeout_ms=100)

        def exhaust():
            time.sleep(0.3)
            resource.setrlimit(resource.RLIMIT_NPROC, (1, 1))
            try:
                threading.Thread(target=print).start()
            except RuntimeError:
                pass
            else:
                print("there are threads")
            blocked.append(1)

        exhausting = threading.Thread(target=exhaust)
        os.setgid(65534)
        os.setuid(65534)
        exhausting.start()
        sched.run(duration=1.5)
        print(sched.safety_stats()["safe_state"], [node.name for node in hooks])
        """,
        HORUS_HOME="/proc/self/none",
    )
    assert done.stdout.splitlines() == ["True ['motor']"]


# -- the last command ------------------------------------------------------------------------------


def test_a_hook_follows_the_tick_in_progress_and_delays_no_other(make):
    """A healthy tick in progress ends before its hook begins; the others do not wait for it."""
    sched = make()
    freezer = Freezer(armed=False)
    journal, wanted, begun = [], threading.Event(), threading.Event()

    def slow(node):
        if wanted.is_set() and not begun.is_set():
            begun.set()
            wait_until(lambda: "hook of motor" in journal)
            time.sleep(30 * ms)
            journal.append("command")

    def hook(node):
        journal.append(f"hook of {node.name}")

    sched.add(Node("arm", slow, rate=200, compute=True, order=20, safe_state=hook))
    sched.add(Node("motor", nothing, rate=50, order=10, safe_state=hook))
    sched.add(freezing_node("Rt", freezer, "critical", order=0, hook=False, watchdog=60.0))
    sched.add_critical_node("critical", timeout_ms=60)
    with running(sched), freezer:
        wanted.set()
        assert begun.wait(5)
        freezer.freeze()
        wait_until(lambda: len(journal) == 3)

    assert journal == ["hook of motor", "command", "hook of arm"]


def test_a_removed_node_is_shut_down_after_its_hook(make):
    """remove_node() in the safe state: first the hook ends, then shutdown() is called."""
    sched = make()
    freezer = Freezer(armed=False)
    journal, in_hook = [], threading.Event()

    def hook(node):
        in_hook.set()
        time.sleep(50 * ms)
        journal.append("hook")

    sched.add(
        Node(
            "motor", nothing, rate=50, safe_state=hook, shutdown=lambda: journal.append("shutdown")
        )
    )
    sched.add(freezing_node("Rt", freezer, "critical", order=0, hook=False, watchdog=60.0))
    sched.add_critical_node("critical", timeout_ms=TIMEOUT_MS)
    with running(sched), freezer:
        wait_until(lambda: all_have_ticked(sched))
        freezer.freeze()
        assert in_hook.wait(PATIENCE_S)
        sched.remove_node("motor")
        assert journal == ["hook", "shutdown"]


# -- what nobody could see -------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["BestEffort", "AsyncIo", "Rt", "Compute"])
def test_a_critical_tick_that_ends_too_late_counts_even_if_nobody_could_look(make, kind, caplog):
    """An extension holds the interpreter: supervision stood still, and so did the motor."""
    sched = make()
    hooks, armed = [], []

    def hold(node):
        if armed:
            armed.clear()
            ctypes.PyDLL(None).usleep(400_000)

    sched.add(Node("vision", hold, rate=20, compute=True, order=50))
    sched.add(node_of(kind, "motor", rate=100, safe_state=hooks.append))
    sched.add_critical_node("motor", timeout_ms=TIMEOUT_MS)
    with running(sched):
        for episode in (1, 2, 3):
            before = sched.get_node_stats("motor")["total_ticks"]
            wait_until(lambda before=before: sched.get_node_stats("motor")["total_ticks"] > before)
            armed.append(1)
            wait_until(lambda episode=episode: in_safe_state(sched) and len(hooks) == episode)
            wait_until(lambda: cleared(sched))

    assert caplog.text.count("safe state entered: critical node motor") == 3
    assert expirations(sched, "motor") >= 3  # both who ticks and who looks may have seen one


def test_a_backlog_of_a_critical_node_is_owed_one_message_after_another(make):
    """Messages that wait behind another one's tick do not make a critical node late."""
    sched = make()
    done = []

    def tick(node):
        time.sleep(40 * ms)
        done.append(1)

    sched.add(Node("estop", tick, on=TRIGGER))
    sched.add_critical_node("estop", timeout_ms=2 * TIMEOUT_MS)
    with running(sched):
        for index in range(8):
            sched.publish(TRIGGER, index)
        wait_until(lambda: len(done) == 8)

    assert not in_safe_state(sched)
    assert expirations(sched, "estop") == 0
