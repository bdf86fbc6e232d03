"""Shutdown: ordered, complete and the same on every path."""

from __future__ import annotations

import asyncio
import inspect
import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable

import anyio
import pytest

import horus
from horus import Node, NodeError, Scheduler, ms

from .helpers import (
    KINDS,
    PATIENCE_S,
    TRIGGER,
    all_have_ticked,
    as_async,
    node_of,
    nothing,
    run_async,
    run_program,
    run_until,
    running,
    until,
    wait_until,
)


def when_all_have_ticked(sched: Scheduler, act: Callable[[], object]) -> threading.Thread:
    """Call `act` from another thread once every node has ticked."""

    def wait_and_act() -> None:
        wait_until(lambda: all_have_ticked(sched))
        act()

    thread = threading.Thread(target=wait_and_act, daemon=True)
    thread.start()
    return thread


def when_told(sched: Scheduler, act: Callable[[Node], object], **options) -> Node:
    """Return a node that calls `act` once every other node has ticked."""

    def tick(node: Node) -> None:
        others = (info for info in sched.get_all_nodes() if info["name"] != node.name)
        if all(info["total_ticks"] > 0 for info in others):
            act(node)

    return Node("trigger", tick, order=50, **options)


def end_by_duration(sched: Scheduler, loop: str) -> None:
    """Let the time of a run be over."""
    sched.run(duration=0.1)


def end_by_stop_from_another_thread(sched: Scheduler, loop: str) -> None:
    """Call stop() on another thread."""
    thread = when_all_have_ticked(sched, sched.stop)
    sched.run()
    thread.join()


def end_by_stop_in_a_tick(sched: Scheduler, loop: str) -> None:
    """Call stop() inside a tick."""
    sched.add(when_told(sched, lambda node: sched.stop()))
    sched.run()


def end_by_request_stop(sched: Scheduler, loop: str) -> None:
    """Call node.request_stop()."""
    sched.add(when_told(sched, lambda node: node.request_stop()))
    sched.run()


def end_by_ctrl_c(sched: Scheduler, loop: str) -> None:
    """Send SIGINT to the process."""
    thread = when_all_have_ticked(sched, lambda: os.kill(os.getpid(), signal.SIGINT))
    sched.run()
    thread.join()


def end_by_sigterm(sched: Scheduler, loop: str) -> None:
    """Send SIGTERM to the process."""
    thread = when_all_have_ticked(sched, lambda: os.kill(os.getpid(), signal.SIGTERM))
    sched.run()
    thread.join()


def end_by_fatal_error(sched: Scheduler, loop: str) -> None:
    """Raise in the tick of a node whose failure policy is fatal."""

    def fail(node: Node) -> None:
        raise RuntimeError("broken")

    sched.add(when_told(sched, fail, failure_policy="fatal"))
    with pytest.raises(NodeError, match="trigger"):
        sched.run()


def end_by_missed_budget(sched: Scheduler, loop: str) -> None:
    """Exceed a limit under on_miss="stop"."""
    sched.add(
        when_told(sched, lambda node: time.sleep(20 * ms), budget=10 * ms, on_miss="stop", rate=20)
    )
    sched.run()


def end_by_cancellation(sched: Scheduler, loop: str) -> None:
    """Cancel the task that awaits arun()."""

    async def main() -> None:
        task = asyncio.ensure_future(sched.arun())
        await until(lambda: all_have_ticked(sched))
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    run_async(main(), loop)


def end_by_time_limit(sched: Scheduler, loop: str) -> None:
    """Let a time limit around arun() run out."""

    async def main() -> None:
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.15):
                await sched.arun()

    run_async(main(), loop)


def end_by_an_anyio_scope(sched: Scheduler, loop: str) -> None:
    """Cancel arun() by an anyio cancel scope, as structured applications do."""

    async def main() -> None:
        async with anyio.create_task_group() as group:
            group.start_soon(sched.arun)
            await until(lambda: all_have_ticked(sched))
            group.cancel_scope.cancel()

    run_async(main(), loop)


def end_by_leaving_the_context(sched: Scheduler, loop: str) -> None:
    """Leave the `with` block while another thread runs the scheduler."""
    with sched:
        thread = threading.Thread(target=sched.run)
        thread.start()
        wait_until(lambda: all_have_ticked(sched))
    thread.join(PATIENCE_S)


def end_by_leaving_the_async_context(sched: Scheduler, loop: str) -> None:
    """Leave the `async with` block."""

    async def main() -> None:
        async with sched:
            await until(lambda: all_have_ticked(sched))

    run_async(main(), loop)


WAYS_TO_END = (
    end_by_duration,
    end_by_stop_from_another_thread,
    end_by_stop_in_a_tick,
    end_by_request_stop,
    end_by_ctrl_c,
    end_by_sigterm,
    end_by_fatal_error,
    end_by_missed_budget,
    end_by_cancellation,
    end_by_time_limit,
    end_by_an_anyio_scope,
    end_by_leaving_the_context,
    end_by_leaving_the_async_context,
)


@pytest.mark.realtime
@pytest.mark.parametrize("end", WAYS_TO_END, ids=lambda end: end.__name__)
def test_shutdown_runs_once_in_reverse_order_across_all_classes_on_every_exit_path(make, loop, end):
    """shutdown() is called on every node in reverse order, exactly once, on every path."""
    journal = []
    sched = make(tick_rate=100, loop=loop)
    orders = {"Rt": 10, "BestEffort": 30, "Compute": 20, "Event": 0, "AsyncIo": 40}
    for kind, order in orders.items():
        sched.add(node_of(kind, kind, order=order, shutdown=lambda node: journal.append(node.name)))
    sched.publish(TRIGGER, 1)

    end(sched, loop)

    assert journal == ["AsyncIo", "BestEffort", "Compute", "Rt", "Event"]
    assert sched.status() == "stopped"
    assert {info["state"] for info in sched.get_all_nodes()} == {"stopped"}


@pytest.mark.parametrize(
    "end",
    # In virtual time a plain tick takes none, so it cannot exceed its budget.
    [end for end in WAYS_TO_END if end is not end_by_missed_budget],
    ids=lambda end: end.__name__,
)
def test_a_simulation_shuts_down_in_the_same_order_on_every_exit_path(make, end):
    """In deterministic mode too: every node once, in reverse order, on every exit path."""
    journal = []
    sched = make(tick_rate=100, deterministic=True)
    orders = {"Rt": 10, "BestEffort": 30, "Compute": 20, "Event": 0, "AsyncIo": 40}
    for kind, order in orders.items():
        sched.add(node_of(kind, kind, order=order, shutdown=lambda node: journal.append(node.name)))
    sched.publish(TRIGGER, 1)

    end(sched, "asyncio")

    assert journal == ["AsyncIo", "BestEffort", "Compute", "Rt", "Event"]
    assert sched.status() == "stopped"


@pytest.mark.realtime
@pytest.mark.parametrize("end", WAYS_TO_END, ids=lambda end: end.__name__)
def test_the_main_loop_exits_before_shutdown_begins(make, end):
    """The main loop exits first: no node ticks once the first shutdown() has begun."""
    journal = []
    sched = make(tick_rate=100)
    for kind in KINDS:
        sched.add(
            node_of(
                kind,
                kind,
                lambda node: journal.append("tick"),
                shutdown=lambda node: (journal.append("shutdown"), time.sleep(15 * ms)),
            )
        )
    sched.publish(TRIGGER, 1)

    end(sched, "uvloop")

    first_shutdown = journal.index("shutdown")
    assert journal[first_shutdown:] == ["shutdown"] * len(KINDS)
    assert journal[:first_shutdown] == ["tick"] * first_shutdown


def test_reverse_order_means_last_added_first(make, deterministic):
    """In reverse order, last-added first, where orders are equal."""
    journal = []
    sched = make(tick_rate=100, deterministic=deterministic)
    for name, order in (("a", 5), ("b", 5), ("c", 1), ("d", 5)):
        sched.add(
            Node(name, nothing, rate=100, order=order, shutdown=lambda n: journal.append(n.name))
        )

    sched.run(duration=0.05)

    assert journal == ["d", "b", "a", "c"]


@pytest.mark.realtime
def test_the_motor_controller_shuts_down_before_the_sensor_that_feeds_it(make, loop):
    """The motor controller (order 20) shuts down before the sensor (order 10)."""
    journal = []
    sched = make(tick_rate=100, loop=loop)

    def halt(node):
        node.send("wheels", 0.0)
        journal.append("motor halts")

    sched.add(Node("motor", nothing, rate=100, order=20, shutdown=halt, pubs=["wheels"]))
    sched.add(
        Node(
            "sensor",
            nothing,
            rate=50,
            order=10,
            shutdown=lambda node: journal.append("sensor disconnects"),
        )
    )

    sched.run(duration=0.05)

    assert journal == ["motor halts", "sensor disconnects"]


@pytest.mark.realtime
def test_a_raising_shutdown_does_not_skip_that_of_others(make, loop, kind, caplog):
    """An exception in one node's shutdown() is logged and skips nobody else's."""
    journal = []

    def fail(node):
        journal.append(node.name)
        raise OSError("port is gone")

    sched = make(tick_rate=100, loop=loop)
    sched.add(Node("before", nothing, order=0, shutdown=lambda n: journal.append(n.name)))
    sched.add(node_of(kind, "broken", order=1, shutdown=fail))
    sched.add(Node("after", nothing, order=2, shutdown=lambda n: journal.append(n.name)))

    sched.run(duration=0.05)

    assert journal == ["after", "broken", "before"]
    assert any("port is gone" in record.getMessage() for record in caplog.records)


@pytest.mark.realtime
@pytest.mark.parametrize(
    ("kind", "error"),
    [
        *((kind, error) for kind in KINDS for error in (SystemExit, ValueError)),
        # On the main thread a KeyboardInterrupt is the user's Ctrl+C.
        ("Rt", KeyboardInterrupt),
        ("Compute", KeyboardInterrupt),
    ],
)
@pytest.mark.parametrize("phase", ["init", "tick", "shutdown"])
def test_no_exception_in_a_callback_takes_the_process_down(make, kind, phase, error):
    """Exceptions in any callback of any class, in any phase, never take the process down."""
    journal = []

    def fail(node):
        journal.append(phase)
        raise error("on purpose")

    sched = make(tick_rate=100)
    sched.add(Node("other", nothing, order=0, shutdown=lambda n: journal.append("other shutdown")))
    node = (
        node_of(kind, "broken", fail)
        if phase == "tick"
        else node_of(kind, "broken", **{phase: fail})
    )
    sched.add(node)
    sched.publish(TRIGGER, 1)

    run_until(
        sched,
        lambda: (
            sched.get_node_stats("other")["total_ticks"]
            and (phase == "shutdown" or phase in journal)
        ),
    )

    assert phase in journal
    assert journal[-1] == "other shutdown"
    assert sched.get_node_stats("broken")["errors_count"] == journal.count(phase)


@pytest.mark.realtime
@pytest.mark.parametrize("stuck_kind", ["Rt", "Compute"])
def test_stalled_threads_are_detached_and_named(make, loop, stuck_kind, caplog):
    """RT threads are given a time to exit; stalled threads are detached, and named."""
    let_go = threading.Event()
    journal = []
    sched = make(tick_rate=100, loop=loop, shutdown_timeout=0.2)

    def freeze(node):
        journal.append("frozen")
        let_go.wait(PATIENCE_S)

    sched.add(
        node_of(stuck_kind, "stuck", freeze, order=0, shutdown=lambda n: journal.append(n.name))
    )
    sched.add(Node("other", nothing, order=1, shutdown=lambda n: journal.append(n.name)))

    try:
        run_until(sched, lambda: journal)
        assert journal == ["frozen", "other", "stuck"]
        assert any(
            record.levelname == "ERROR" and "stuck" in record.getMessage()
            for record in caplog.records
        )
    finally:
        let_go.set()


@pytest.mark.realtime
def test_an_async_tick_that_refuses_to_end_does_not_cost_its_shutdown(make, loop):
    """An async tick that ignores its cancellation is left behind; its shutdown() still runs."""
    journal, started = [], []

    async def stubborn(node):
        started.append(True)
        try:
            await asyncio.sleep(3600)
        except asyncio.CancelledError:
            journal.append("ignored")
            await asyncio.sleep(3600)

    async def shutdown(node):
        await asyncio.sleep(0)
        journal.append("shutdown")

    sched = make(loop=loop, shutdown_timeout=0.2)
    sched.add(Node("stubborn", stubborn, rate=50, shutdown=shutdown))

    run_until(sched, lambda: started)

    assert journal == ["ignored", "shutdown"]


def test_threads_are_given_3_seconds_by_default():
    """RT threads are given 3 seconds to exit, unless shutdown_timeout says otherwise."""
    parameters = inspect.signature(Scheduler).parameters
    assert parameters["shutdown_timeout"].default == 3.0


@pytest.mark.realtime
@pytest.mark.parametrize("slow_kind", ["Rt", "Compute", "BestEffort"])
def test_a_tick_in_progress_ends_before_its_node_shuts_down(make, loop, slow_kind):
    """A tick in progress is not cut off: shutdown() follows when it has returned."""
    journal = []
    sched = make(tick_rate=100, loop=loop)

    def slow(node):
        journal.append("begin")
        sched.stop()
        time.sleep(50 * ms)
        journal.append("end")

    sched.add(node_of(slow_kind, "slow", slow, shutdown=lambda node: journal.append("shutdown")))

    sched.run()

    assert journal == ["begin", "end", "shutdown"]


@pytest.mark.realtime
@pytest.mark.parametrize("stuck_kind", ["Rt", "Compute", "AsyncIo"])
def test_a_shutdown_that_hangs_does_not_hold_up_the_others(make, stuck_kind, caplog):
    """Each node's shutdown() is bounded in time; the others are shut down all the same."""
    let_go = threading.Event()
    journal = []

    async def hang_async(node):
        journal.append("hangs")
        await asyncio.sleep(PATIENCE_S)

    def hang(node):
        journal.append("hangs")
        let_go.wait(PATIENCE_S)

    sched = make(tick_rate=100, shutdown_timeout=0.2)
    sched.add(Node("other", nothing, order=0, shutdown=lambda n: journal.append(n.name)))
    sched.add(
        node_of(
            stuck_kind,
            "stuck",
            order=1,
            shutdown=hang_async if stuck_kind == "AsyncIo" else hang,
        )
    )

    try:
        sched.run(duration=0.05)
        assert journal == ["hangs", "other"]
        assert any("0.2 s" in record.getMessage() for record in caplog.records)
    finally:
        let_go.set()


@pytest.mark.realtime
def test_sleeps_end_at_shutdown(make, loop):
    """An async tick that sleeps for an hour does not delay the end of the run."""
    journal, asleep = [], []

    async def tick(node):
        asleep.append(True)
        try:
            await asyncio.sleep(3600)
        except asyncio.CancelledError:
            journal.append("woken")
            raise

    sched = make(loop=loop)
    sched.add(Node("sleeper", tick, rate=10, shutdown=as_async(lambda n: journal.append("down"))))
    begun = time.monotonic()

    run_until(sched, lambda: asleep)

    assert journal == ["woken", "down"]
    assert time.monotonic() - begun < 2.5
    assert sched.get_node_stats("sleeper")["errors_count"] == 0


@pytest.mark.realtime
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_run_owns_the_signals_and_restores_what_was_there(make, loop, number):
    """run() owns SIGINT and SIGTERM while it runs and restores what was there."""
    calls = []

    def mine(*_):
        calls.append("mine")

    before = signal.signal(number, mine)
    try:
        during = []
        sched = make(loop=loop)
        sched.add(Node("node", lambda: during.append(signal.getsignal(number))))
        thread = when_all_have_ticked(sched, lambda: os.kill(os.getpid(), number))
        sched.run()
        thread.join()

        assert mine not in during
        assert signal.getsignal(number) is mine
        assert calls == []
        assert signal.Signals(number).name in sched.stop_reason
    finally:
        signal.signal(number, before)


@pytest.mark.realtime
def test_ctrl_c_ends_a_run_whose_loop_is_busy_in_a_node(make, loop):
    """Ctrl+C is not lost while a node's own code keeps the event loop busy."""
    journal = []

    def tick(node):
        os.kill(os.getpid(), signal.SIGINT)
        end = time.monotonic() + 30 * ms
        while time.monotonic() < end:
            pass
        journal.append("tick done")

    sched = make(loop=loop)
    sched.add(Node("busy", tick, shutdown=lambda node: journal.append("shutdown")))

    sched.run()

    assert journal == ["tick done", "shutdown"]
    assert "SIGINT" in sched.stop_reason


@pytest.mark.realtime
def test_ctrl_c_does_not_force_exit_while_the_shutdown_takes_its_time(make):
    """One Ctrl+C is enough and stays ordered: a shutdown() of 2.2 s is not cut off."""
    journal = []

    def slow_shutdown(node):
        time.sleep(2.2)
        journal.append("parked")

    sched = make()
    sched.add(Node("arm", nothing, rate=50, shutdown=slow_shutdown))
    thread = when_all_have_ticked(sched, lambda: os.kill(os.getpid(), signal.SIGINT))

    sched.run()

    thread.join()
    assert journal == ["parked"]


@pytest.mark.realtime
def test_a_second_scheduler_can_own_ctrl_c_as_well(make, loop):
    """A second scheduler, after the first has run, is stopped by Ctrl+C just the same."""
    for _ in range(2):
        sched = make(loop=loop)
        sched.add(Node("node", nothing))
        thread = when_all_have_ticked(sched, lambda: os.kill(os.getpid(), signal.SIGINT))
        sched.run()
        thread.join()
        assert "SIGINT" in sched.stop_reason


@pytest.mark.realtime
def test_two_schedulers_run_at_once_and_ctrl_c_stops_the_one_in_the_main_thread(make):
    """Schedulers on other threads leave the signals to the one in the main thread."""
    background, main = make(), make()
    background.add(Node("a", nothing))
    main.add(Node("b", nothing))
    with running(background):
        thread = when_all_have_ticked(main, lambda: os.kill(os.getpid(), signal.SIGINT))
        main.run()
        thread.join()
        assert main.status() == "stopped"
        assert background.is_running()
    assert background.status() == "stopped"


@pytest.mark.realtime
def test_a_run_on_another_thread_leaves_the_signals_alone(make):
    """Only the main thread can own signals; a run elsewhere works without."""
    handlers = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    sched = make()
    sched.add(Node("node", nothing))
    with running(sched):
        assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == handlers


@pytest.mark.realtime
def test_arun_touches_no_signals(make, loop):
    """arun() leaves the signals to the application."""
    during = []
    sched = make()
    sched.add(Node("node", lambda: during.append(signal.getsignal(signal.SIGINT))))

    async def main():
        before = signal.getsignal(signal.SIGINT)
        async with sched:
            await until(lambda: during)
        return before

    before = run_async(main(), loop)

    assert set(during) == {before}


SECOND_SIGNAL = """
    import signal, sys, time
    from horus import Node, run

    def shutdown(node):
        print("stopping", flush=True)
        time.sleep(60)

    def tick(node):
        print("ticking", flush=True)

    run(Node("node", tick, shutdown=shutdown))
"""


@pytest.mark.realtime
def test_a_second_signal_forces_exit():
    """The first signal stops in order, a second one forces exit."""
    program = [sys.executable, "-c", textwrap.dedent(SECOND_SIGNAL)]
    with subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        try:
            assert process.stdout.readline() == b"ticking\n"
            process.send_signal(signal.SIGINT)
            while process.stdout.readline() != b"stopping\n":
                pass
            process.send_signal(signal.SIGINT)
            _, stderr = process.communicate(timeout=PATIENCE_S)
        finally:
            process.kill()
    assert process.returncode == 128 + signal.SIGINT
    assert b"SIGINT" in stderr, "what was logged before the exit was lost"


@pytest.mark.realtime
def test_a_stuck_thread_does_not_keep_the_process_from_ending():
    """Stalled threads are detached: the process still exits by itself."""
    program = """
        import threading
        from horus import Node, Scheduler

        sched = Scheduler(shutdown_timeout=0.1)
        sched.add(Node("stuck", lambda node: threading.Event().wait(), rate=100))
        sched.add(Node("other", lambda node: None, shutdown=lambda node: print("down")))
        sched.run(duration=0.1)
    """
    done = run_program(program)
    assert done.stdout == "down\n"
    assert "stuck" in done.stderr


@pytest.mark.realtime
def test_shared_memory_is_cleaned_up(make):
    """Shared memory is cleaned up: a run leaves none behind."""
    before = set(os.listdir("/dev/shm"))
    sched = make()
    sched.add(Node("a", lambda n: n.send("x", b"x" * 100_000), rate=100, pubs=["x"]))
    sched.add(Node("b", lambda n: n.recv_all("x"), rate=100, compute=True, subs=["x"]))

    sched.run(duration=0.05)

    assert not {name for name in os.listdir("/dev/shm") if "horus" in name} - before


@pytest.mark.realtime
@pytest.mark.parametrize(
    ("end", "words"),
    [
        (end_by_duration, None),
        (end_by_stop_from_another_thread, "stop()"),
        (end_by_request_stop, "trigger"),
        (end_by_ctrl_c, "SIGINT"),
        (end_by_sigterm, "SIGTERM"),
        (end_by_fatal_error, "broken"),
        (end_by_missed_budget, "trigger"),
    ],
    ids=lambda value: getattr(value, "__name__", str(value)),
)
def test_the_stop_reason_says_why_the_run_ended(make, end, words):
    """sched.stop_reason names what ended the run; None if its time was simply over."""
    sched = make(tick_rate=100)
    sched.add(Node("node", nothing, rate=100))

    end(sched, "uvloop")

    if words is None:
        assert sched.stop_reason is None
    else:
        assert words in sched.stop_reason


def test_the_reason_given_to_stop_is_the_one_reported(make, deterministic):
    """stop(reason) and request_stop(reason) are quoted in stop_reason; the first one counts."""
    sched = make(tick_rate=100, deterministic=deterministic)

    def tick(node):
        node.request_stop("battery is empty")
        sched.stop("second thoughts")

    sched.add(Node("battery", tick, rate=100))

    sched.run(duration=PATIENCE_S)

    assert sched.stop_reason == "battery is empty"
    sched.remove_node("battery")
    sched.run(duration=0.01)
    assert sched.stop_reason is None


@pytest.mark.realtime
def test_stop_returns_at_once_and_can_be_called_by_anyone_any_number_of_times(make, loop, kind):
    """stop() and request_stop() never wait, so a callback of any class may call them."""
    took = []
    sched = make(tick_rate=100, loop=loop)

    def tick(node):
        begun = time.monotonic()
        for _ in range(3):
            sched.stop()
            node.request_stop()
        took.append(time.monotonic() - begun)

    sched.add(node_of(kind, "node", tick))
    sched.publish(TRIGGER, 1)

    sched.run()

    assert len(took) == 1
    assert took[0] < 1.0


@pytest.mark.realtime
@pytest.mark.parametrize("phase", ["init", "shutdown"])
def test_stopping_from_init_or_shutdown_is_in_order(make, loop, phase):
    """A stop requested in init() or shutdown() ends the run without a deadlock."""
    journal = []
    sched = make(loop=loop)

    def stop(node):
        journal.append("stop")
        sched.stop("enough")

    sched.add(Node("first", nothing, order=0, shutdown=lambda n: journal.append("first down")))
    sched.add(Node("stopper", nothing, rate=50, order=1, **{phase: stop}))

    sched.run(duration=None if phase == "init" else 0.05)

    assert journal == ["stop", "first down"]


@pytest.mark.realtime
def test_a_stop_during_startup_is_not_lost(make):
    """stop() works from anywhere, also in the instant in which run() starts."""
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        for _ in range(150):
            sched = make(loop="asyncio")
            sched.add(Node("node", nothing))
            thread = threading.Thread(target=sched.run)
            thread.start()
            while not sched.is_running() and sched.status() != "stopped":
                pass
            sched.stop()
            thread.join(2.0)
            lost = thread.is_alive()
            sched.stop()
            thread.join(PATIENCE_S)
            assert not lost, "stop() right after is_running() became true was lost"
    finally:
        sys.setswitchinterval(interval)


@pytest.mark.realtime
def test_cancelling_arun_again_does_not_cut_the_ordered_shutdown_short(make, loop):
    """Cancellation is stop; the ordered shutdown is shielded, then it is re-raised."""
    journal = []

    async def slow_shutdown(node):
        journal.append("begin")
        await asyncio.sleep(50 * ms)
        journal.append("end")

    sched = make()
    sched.add(Node("a", as_async(nothing), rate=50, order=0, shutdown=slow_shutdown))
    sched.add(Node("b", as_async(nothing), rate=50, order=1, shutdown=slow_shutdown))

    async def main():
        task = asyncio.ensure_future(sched.arun())
        await until(lambda: all_have_ticked(sched))
        task.cancel()
        await asyncio.sleep(20 * ms)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    run_async(main(), loop)

    assert journal == ["begin", "end"] * 2


def test_the_framework_clock_answers_in_shutdown(make, deterministic):
    """Inside shutdown() the framework clock still tells the scheduler's time."""
    seen = []
    sched = make(tick_rate=100, deterministic=deterministic)
    sched.add(
        Node(
            "node", nothing, rate=100, shutdown=lambda: seen.append((horus.now(), horus.elapsed()))
        )
    )

    sched.run(duration=0.05)

    now, elapsed = seen[0]
    assert elapsed >= 0.0399
    assert now == pytest.approx(0.05) if deterministic else now > 1e9
