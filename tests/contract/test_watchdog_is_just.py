"""The watchdog is just: idle, waiting and slow nodes are not frozen ones."""

from __future__ import annotations

import asyncio
import threading
import time

import pytest

from horus import Node, ms

from .freezing import (
    MARKER,
    ON_LOOP,
    Freezer,
    await_health,
    expirations,
    freezing_node,
    reports,
)
from .helpers import (
    TRIGGER,
    as_async,
    node_of,
    nothing,
    run_async,
    run_program,
    running,
    until,
    wait_until,
)

pytestmark = pytest.mark.realtime

TIMEOUT_MS = 100


async def nothing_async(node: Node) -> None:
    """Do nothing, on the event loop."""


# -- idleness ------------------------------------------------------------------------------------


def test_idle_nodes_are_never_frozen(make):
    """The watchdog never measures idleness: slow and silent nodes of every class are healthy."""
    sched = make(watchdog_ms=TIMEOUT_MS)
    for kind in ("AsyncIo", "Rt", "Compute"):
        sched.add(node_of(kind, kind, rate=1))
    sched.add(Node("event", nothing, on="silence"))
    sched.add(Node("urgent_event", nothing, on="silence", deadline=30.0))
    sched.add(Node("async_event", nothing_async, on="silence"))
    with running(sched):
        wait_until(lambda: sched.get_node_stats("Rt")["total_ticks"] >= 2)

    assert set(sched.safety_stats()["health_states"].values()) == {"healthy"}
    assert sched.safety_stats()["watchdog_expirations"] == 0


@pytest.mark.parametrize("way", ["Event", "urgent Event", "async Event"])
def test_a_backlog_of_messages_is_not_a_frozen_tick(make, way):
    """Messages that wait behind others are owed one after another, not all since they came."""
    sched = make(watchdog_ms=2 * TIMEOUT_MS)
    done = []

    def tick(node):
        time.sleep(TIMEOUT_MS / 2 * ms)
        done.append(1)

    async def tick_async(node):
        await asyncio.sleep(TIMEOUT_MS / 2 * ms)
        done.append(1)

    options = {"deadline": 30.0} if way == "urgent Event" else {}
    callback = tick_async if way == "async Event" else tick
    sched.add(Node("event", callback, on=TRIGGER, **options))
    with running(sched):
        # The last one waits for longer than would isolate a frozen node.
        for index in range(14):
            sched.publish(TRIGGER, index)
        wait_until(lambda: len(done) == 14)

    assert expirations(sched, "event") == 0


@pytest.mark.parametrize("way", ["Event", "urgent Event", "async Event"])
def test_messages_that_waited_between_two_runs_are_not_a_frozen_tick(make, way):
    """A backlog that outlives a tick_for() is not owed while nothing runs."""
    sched = make(watchdog_ms=TIMEOUT_MS)
    ticks = []

    def tick(node):
        ticks.append(1)
        time.sleep(20 * ms)

    options = {"deadline": 30.0} if way == "urgent Event" else {}
    callback = as_async(tick) if way == "async Event" else tick
    sched.add(Node("event", callback, on=TRIGGER, order=0, **options))
    for index in range(20):
        sched.add(Node(f"n{index}", nothing, rate=10, watchdog=60.0))
    sched.add(
        Node("source", lambda node: [node.send(TRIGGER, 1) for _ in range(50)], rate=0.5, order=1)
    )
    sched.tick_for(0.1)
    seen = len(ticks)
    assert seen < 50
    time.sleep(3.5 * TIMEOUT_MS * ms)
    sched.tick_for(0.1)

    assert len(ticks) > seen
    assert expirations(sched, "event") == 0
    assert sched.get_node_stats("event")["health"] == "healthy"


# -- waiting for others ----------------------------------------------------------------------------


@pytest.mark.parametrize("way", ON_LOOP)
def test_nodes_that_wait_behind_a_frozen_one_are_not_blamed(make, way):
    """A node that cannot begin because another's tick has the event loop stays healthy."""
    sched = make(watchdog_ms=TIMEOUT_MS)
    freezer = Freezer(armed=False)
    ticks = dict.fromkeys(("BestEffort", "AsyncIo", "Compute", "event"), 0)

    def count(node):
        ticks[node.name] += 1

    def all_have_ticked_more(than):
        sched.publish("other", 1)
        return all(ticks[name] > than[name] for name in ticks)

    sched.add(freezing_node(way, freezer, order=0))
    for kind in ("BestEffort", "AsyncIo", "Compute"):
        sched.add(node_of(kind, kind, count, rate=50, order=1))
    sched.add(Node("event", count, on="other", order=1))
    with running(sched), freezer:
        wait_until(lambda: all_have_ticked_more(dict.fromkeys(ticks, 0)))
        freezer.freeze()
        sched.publish(TRIGGER, 1)
        wait_until(lambda: freezer.frozen_thread is not None)
        sched.publish("other", 1)
        await_health(sched, "frozen", "isolated")
        assert {sched.get_node_stats(name)["health"] for name in ticks} == {"healthy"}
        freezer.thaw()
        before = dict(ticks)
        wait_until(lambda: all_have_ticked_more(before))

        assert {name: expirations(sched, name) for name in ticks} == dict.fromkeys(ticks, 0)
        assert expirations(sched) == 1


def test_an_application_that_blocks_its_own_loop_has_no_node_isolated(make, loop, caplog):
    """Nobody is there to blame: its nodes become unhealthy, and tick on when the loop is free."""
    sched = make(watchdog_ms=TIMEOUT_MS, loop=loop)
    hooks, ticks = [], []
    for kind in ("BestEffort", "AsyncIo"):
        sched.add(node_of(kind, kind, ticks.append, rate=50, safe_state=hooks.append))

    async def application():
        run = asyncio.ensure_future(sched.arun())
        await until(lambda: len(ticks) >= 6)
        time.sleep(6 * TIMEOUT_MS * ms)  # noqa: ASYNC251 - the application's mistake
        stats = sched.safety_stats()
        before = len(ticks)
        await until(lambda: len(ticks) >= before + 6)
        sched.stop()
        await run
        return stats["health_states"]

    health = run_async(application(), loop)

    assert health == {"BestEffort": "unhealthy", "AsyncIo": "unhealthy"}
    assert hooks == []
    assert set(sched.safety_stats()["health_states"].values()) == {"healthy"}
    assert "cannot begin" in caplog.text
    assert "time.sleep(6 * TIMEOUT_MS * ms)" in caplog.text


def test_an_async_tick_in_progress_is_not_blamed_for_a_blocked_loop(make):
    """An async tick that could go on if only the loop were free stays healthy."""
    sched = make(watchdog_ms=TIMEOUT_MS)
    freezer = Freezer(armed=False)
    begun, ended = [], []

    async def tick(node):
        begun.append(1)
        await asyncio.sleep(50 * ms)
        ended.append(1)

    sched.add(freezing_node("BestEffort", freezer, order=0))
    sched.add(Node("waits", tick, rate=10, order=1))
    with running(sched), freezer:
        wait_until(lambda: begun)
        freezer.freeze()
        await_health(sched, "frozen", "isolated")
        freezer.thaw()
        wait_until(lambda: len(ended) >= 2)

        assert expirations(sched, "waits") == 0


def test_nodes_that_wait_for_slow_predecessors_are_not_frozen(make):
    """Rt nodes pass the baton: the last of five 60 ms ticks is due for longer than a timeout."""
    sched = make(watchdog_ms=2 * TIMEOUT_MS)
    for order in range(5):
        sched.add(Node(f"n{order}", lambda node: time.sleep(0.06), rate=1, order=order))
    with running(sched):
        wait_until(lambda: sched.get_node_stats("n4")["total_ticks"] >= 1)

    assert sched.safety_stats()["order_violations"] == 0
    assert sched.safety_stats()["watchdog_expirations"] == 0


def test_a_critical_node_may_wait_for_slow_predecessors(make):
    """How long it waits is part of the schedule; its limit is for what it does itself."""
    sched = make(watchdog_ms=1000)
    sched.add(Node("slow", lambda node: time.sleep(0.2), rate=2, budget=0.4, order=0))
    sched.add(Node("critical", nothing, rate=2, deadline=0.45, order=1))
    sched.add_critical_node("critical", timeout_ms=TIMEOUT_MS)
    with running(sched):
        wait_until(lambda: sched.get_node_stats("critical")["total_ticks"] >= 3)
        stats = sched.safety_stats()

    assert stats["safe_state"] is False
    assert expirations(sched, "critical") == stats["order_violations"] == 0


@pytest.mark.parametrize("way", ["Rt", "Compute", "AsyncIo", "urgent Event"])
def test_the_other_nodes_tick_on_beside_a_frozen_one(make, way):
    """A frozen node that does not block the loop is isolated, not contagious."""
    sched = make(watchdog_ms=TIMEOUT_MS)
    freezer = Freezer()
    ticks = dict.fromkeys(("BestEffort", "AsyncIo", "Rt", "Compute"), 0)

    def count(node):
        ticks[node.name] += 1

    sched.add(freezing_node(way, freezer, order=0))
    for kind in ticks:
        sched.add(node_of(kind, kind, count, rate=50, order=1))
    with running(sched), freezer:
        sched.publish(TRIGGER, 1)
        await_health(sched, "frozen", "unhealthy")
        meanwhile = dict(ticks)
        await_health(sched, "frozen", "isolated")
        before = dict(ticks)
        wait_until(lambda: all(ticks[kind] >= before[kind] + 3 for kind in ticks))

        assert min(meanwhile.values()) >= 2
        assert {kind: expirations(sched, kind) for kind in ticks} == dict.fromkeys(ticks, 0)


def test_a_process_that_was_suspended_has_no_frozen_nodes():
    """Ctrl+Z, a debugger or a paused virtual machine stops the watchdog, too: nobody is blamed."""
    done = run_program(
        """
        import os, subprocess
        from horus import Node, Scheduler

        def nothing(node): pass
        async def nothing_async(node): pass

        sched = Scheduler(watchdog_ms=100)
        sched.add(Node("best_effort", nothing))
        sched.add(Node("async", nothing_async, rate=100))
        sched.add(Node("compute", nothing, rate=100, compute=True))
        sched.add(Node("event", nothing, on="go"))
        sched.add(Node("urgent", nothing, on="go", deadline=30.0))
        sched.add(Node("rt", lambda node: node.send("go", 1), rate=100))
        me = os.getpid()
        stop_and_go = f"sleep 0.2; kill -STOP {me}; sleep 0.8; kill -CONT {me}"
        stopper = subprocess.Popen(["sh", "-c", stop_and_go])
        while stopper.poll() is None:
            sched.tick_for(0.3)
        sched.stop()
        print(sched.safety_stats()["watchdog_expirations"], sched.safety_stats()["skipped"] > 0)
        """
    )
    assert done.stdout == "0 True\n", done.stderr


# -- other callbacks -------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["BestEffort", "Event", "AsyncIo", "Rt", "Compute"])
def test_an_init_that_hangs_during_a_restart_is_a_frozen_tick(make, kind, caplog):
    """failure_policy="restart": a tick that is due and whose init() hangs is isolated."""
    sched = make(watchdog_ms=TIMEOUT_MS, tick_rate=100)
    inits, hooks = [], []
    thawed = threading.Event()

    def stuck_in_the_driver():
        thawed.wait(20.0)

    def init(node):
        inits.append(1)
        if len(inits) > 1:
            stuck_in_the_driver()

    def fail(node):
        raise OSError("no echo")

    sched.add(
        node_of(
            kind,
            "frozen",
            fail,
            failure_policy="restart",
            init=init,
            safe_state=lambda node: hooks.append(1),
        )
    )
    with running(sched):
        for index in range(3):
            sched.publish(TRIGGER, index)
        try:
            await_health(sched, "frozen", "isolated")
            wait_until(lambda: hooks and len(reports(caplog)) == 3)
        finally:
            thawed.set()
        assert all(MARKER in message for _, _, message in reports(caplog))

    assert hooks == [1]
    assert len(inits) == 2
    assert expirations(sched) == 1


@pytest.mark.parametrize("kind", ["BestEffort", "Event", "AsyncIo", "Rt", "Compute"])
def test_waiting_for_a_restart_is_not_frozen(make, kind):
    """The back-off of a restart is no tick that does not end, however long a message waits."""
    sched = make(watchdog_ms=TIMEOUT_MS, tick_rate=100)
    ticks = []

    def tick(node):
        ticks.append(1)
        if len(ticks) <= 2:  # a back-off of 100 ms, then one of 200 ms
            raise OSError("no echo")

    def init(node):
        if ticks:
            # Whatever changes a timeout lets supervision look at once.
            sched.add_critical_node("source", timeout_ms=60_000)
            time.sleep(20 * ms)

    sched.add(node_of(kind, "node", tick, init=init, failure_policy="restart"))
    sched.add(Node("source", lambda node: [node.send(TRIGGER, 1) for _ in range(3)], rate=0.5))
    with running(sched):
        wait_until(lambda: len(ticks) >= 3)

    assert expirations(sched, "node") == 0
