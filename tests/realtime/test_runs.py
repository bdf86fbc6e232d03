"""Real time: the few promises that only a running clock can keep."""

from __future__ import annotations

import asyncio
import itertools
import threading
import time

import pytest

import horus
from horus import Node, Scheduler

pytestmark = [pytest.mark.realtime, pytest.mark.usefixtures("leaves_nothing_behind")]
LOOPS = ("uvloop", "asyncio")


def nothing() -> None:
    """Do nothing."""


async def breathe() -> None:
    """Let go of the loop for a moment."""
    await asyncio.sleep(0.001)


def mixed(scheduler: Scheduler) -> Scheduler:
    """Add a node of every class."""
    for node in (
        Node("rt", lambda node: node.send("t", 1), rate=200, pubs="t"),
        Node("best", nothing),
        Node("event", nothing, on="t"),
        Node("urgent", nothing, on="t", budget=0.1),
        Node("async", breathe, rate=50),
        Node("compute", nothing, rate=50, compute=True),
    ):
        scheduler.add(node)
    return scheduler


@pytest.mark.parametrize("loop", LOOPS)
def test_a_hundred_runs_leave_nothing_behind(loop: str) -> None:
    """Starting and stopping mixed classes again and again costs no thread or descriptor."""
    scheduler = mixed(Scheduler(loop=loop))
    for _ in range(100):
        scheduler.run(0.002)
    assert scheduler.get_node_stats("rt")["total_ticks"] > 0


@pytest.mark.parametrize("loop", LOOPS)
def test_every_class_keeps_its_rate(loop: str) -> None:
    """Idle nodes of every class tick at nine in ten releases at least, and never more."""
    scheduler = mixed(Scheduler(loop=loop))
    scheduler.run(1.0)
    for name, releases in (("rt", 200), ("best", 30), ("async", 50), ("compute", 50)):
        ticks = scheduler.get_node_stats(name)["total_ticks"]
        assert 0.7 * releases <= ticks <= releases, name
    rt = scheduler.get_node_stats("rt")
    # Every release is either run or counted as skipped; a stop may cost the last.
    assert 198 <= rt["total_ticks"] + rt["skipped"] <= 200
    for name in ("event", "urgent"):
        assert scheduler.get_node_stats(name)["total_ticks"] >= 0.95 * rt["total_ticks"]


def test_a_slow_node_keeps_its_phase() -> None:
    """Releases are absolute: a late tick does not move the ones after it."""
    starts: list[float] = []

    def tick() -> None:
        starts.append(time.monotonic())
        if len(starts) == 3:
            time.sleep(0.13)

    scheduler = Scheduler()
    scheduler.add(Node("slow", tick, rate=20))
    scheduler.run(0.98)
    offsets = [(start - starts[0]) / 0.05 for start in starts]
    on_grid = [offset for offset in offsets if abs(offset - round(offset)) < 0.4]
    assert len(on_grid) >= len(offsets) - 3
    stats = scheduler.get_node_stats("slow")
    assert stats["skipped"] >= 1
    assert stats["total_ticks"] + stats["skipped"] == 20


def test_an_idle_loop_sleeps() -> None:
    """Ten 10 Hz BestEffort-like nodes wake the loop for releases only, not for every cycle."""
    scheduler = Scheduler(tick_rate=1000)
    for index in range(10):
        scheduler.add(Node(f"n{index}", breathe, rate=10))
    before = time.process_time()
    scheduler.run(2.0)
    assert time.process_time() - before < 0.4


def test_an_urgent_event_node_does_not_wait_for_the_loop() -> None:
    """An emergency stop with a deadline reacts while a BestEffort node blocks the loop."""
    sent: list[float] = []
    handled: list[float] = []
    blocking = threading.Event()

    def block() -> None:
        blocking.set()
        time.sleep(0.3)
        blocking.clear()

    def estop(node: Node) -> None:
        node.recv("estop")
        handled.append(time.monotonic())
        assert blocking.is_set()

    scheduler = Scheduler()
    scheduler.add(Node("blocker", block)).add(Node("estop", estop, on="estop", deadline=0.05))

    def press() -> None:
        blocking.wait(5.0)
        sent.append(time.monotonic())
        scheduler.publish("estop", True)

    presser = threading.Thread(target=press)
    presser.start()
    scheduler.run(0.5)
    presser.join()
    assert len(handled) == 1
    assert handled[0] - sent[0] < 0.1
    assert scheduler.get_node_stats("estop")["errors_count"] == 0


def test_a_run_works_in_a_thread_that_is_not_the_main_one() -> None:
    """`run()` in a worker thread ticks, stops from outside and leaves signals alone."""
    scheduler = mixed(Scheduler())
    runner = threading.Thread(target=scheduler.run)
    runner.start()
    time.sleep(0.2)
    scheduler.stop("enough")
    runner.join(5.0)
    assert not runner.is_alive()
    assert scheduler.stop_reason == "enough"
    assert scheduler.get_node_stats("rt")["total_ticks"] > 5


def test_two_schedulers_share_a_process() -> None:
    """Two schedulers run side by side, each with its own nodes, topics and cycle count."""

    async def main() -> list[int]:
        first, second = mixed(Scheduler(name="first")), mixed(Scheduler(name="second"))
        await asyncio.gather(first.arun(0.3), second.arun(0.3))
        return [s.get_node_stats("rt")["total_ticks"] for s in (first, second)]

    assert all(ticks > 30 for ticks in asyncio.run(main()))


def test_the_clock_functions_agree() -> None:
    """In a tick, dt is the time between starts, and now follows the wall clock."""
    seen: list[tuple[float, float, float]] = []
    scheduler = Scheduler()
    scheduler.add(
        Node("n", lambda: seen.append((time.monotonic(), horus.dt(), horus.now())), rate=50)
    )
    before = time.time()
    scheduler.run(0.5)
    for (earlier, _, _), (later, dt, now) in itertools.pairwise(seen):
        assert abs((later - earlier) - dt) < 0.02
        assert before - 0.1 < now < before + 5.0
