"""Order across Rt threads: the safety monitor runs before the motors, every cycle."""

from __future__ import annotations

import os
import time
from typing import Any

import pytest

import horus
from horus import Node, Scheduler, clock
from horus.loop.cycle import GIVE_WAY_NS

pytestmark = [pytest.mark.realtime, pytest.mark.usefixtures("leaves_nothing_behind")]


class Watch:
    """Two nodes that tell whether the second ever ran before the first."""

    def __init__(self, freeze_at: int | None = None) -> None:
        self.safety_cycle = -1
        self.motor_ticks = 0
        self.out_of_order = 0
        self._freeze_at = freeze_at

    def safety(self) -> None:
        if self._freeze_at is not None and horus.tick() >= self._freeze_at:
            self._freeze_at = None
            time.sleep(0.4)
        self.safety_cycle = horus.tick()

    def motor(self) -> None:
        self.motor_ticks += 1
        self.out_of_order += self.safety_cycle < horus.tick()

    def run(self, *others: Node, rt: bool = False) -> Scheduler:
        scheduler = Scheduler(rt=rt)
        # Added in the wrong order: `order` decides.
        scheduler.add(Node("motor", self.motor, rate=500, order=20))
        scheduler.add(Node("safety", self.safety, rate=500, order=0))
        for node in others:
            scheduler.add(node)
        scheduler.run(1.5)
        return scheduler


def burn() -> None:
    """Compute for 40 ms of CPU time."""
    end = time.thread_time() + 0.04
    while time.thread_time() < end:
        sum(range(100))


@pytest.mark.parametrize("rt", [False, True])
@pytest.mark.parametrize("busy", [False, True])
def test_nodes_released_together_run_in_order(rt: bool, busy: bool) -> None:
    """Rt nodes due at one instant tick in `order`, though each has its own thread."""
    watch = Watch()
    planner = [Node("planner", burn, rate=10, compute=True)] if busy else []
    scheduler = watch.run(*planner, rt=rt)
    violations = scheduler.safety_stats()["order_violations"]
    assert watch.motor_ticks > 200
    # Whatever a noisy machine does, nothing happens out of order uncounted. Without
    # the baton, every other tick would.
    assert watch.out_of_order <= violations
    assert watch.out_of_order < 0.25 * watch.motor_ticks


def test_a_slow_predecessor_costs_a_fast_node_no_release() -> None:
    """A LiDAR that works 10 ms, within its budget, does not starve the motor after it."""
    ticks = []
    scheduler = Scheduler()
    scheduler.add(Node("lidar", lambda: time.sleep(0.01), rate=40, order=10))
    scheduler.add(Node("motor", lambda: ticks.append(1), rate=500, order=70))
    scheduler.run(1.0)
    stats = scheduler.get_node_stats("motor")
    assert len(ticks) > 400
    # The 20 releases that the two share: the motor cannot wait that long for the LiDAR.
    assert 10 <= stats["order_violations"] <= 20


def test_a_frozen_predecessor_is_isolated_not_contagious() -> None:
    """A node waits for its predecessor until that one's deadline, then runs, and says so."""
    watch = Watch(freeze_at=200)
    scheduler = watch.run()
    stats = scheduler.get_node_stats("motor")
    assert watch.motor_ticks > 350
    # The predecessor was away for some 200 of the motor's releases.
    assert 100 <= stats["order_violations"] <= 400
    assert watch.out_of_order <= stats["order_violations"]


def report(node: Node) -> None:
    """Tell for which cycle this is, and of which one the newest scan is."""
    scans = node.recv_all("scan")
    node.send("map", (horus.tick(), scans[-1] if scans else None))


async def report_later(node: Node) -> None:
    """Do the same as an async node."""
    report(node)


FOLLOWERS: dict[str, dict[str, Any]] = {
    "BestEffort": {"tick": report},
    "AsyncIo": {"tick": report_later, "rate": 30},
    "Compute": {"tick": report, "rate": 30, "compute": True},
    "Compute in a process": {"tick": report, "rate": 30, "compute": "process"},
}


def follow_lidar(
    follower: dict[str, Any], order: int, work_s: float, freeze_s: float = 0.0
) -> tuple[list[tuple[int, int | None]], Scheduler]:
    """Run a node beside an Rt LiDAR of order 10; return its reports."""
    reports: list[tuple[int, int | None]] = []

    def scan(node: Node) -> None:
        scans.append(horus.tick())
        time.sleep(freeze_s if len(scans) == 15 and freeze_s else work_s)
        node.send("scan", scans[-1])

    scans: list[int] = []
    scheduler = Scheduler(tick_rate=1000.0)
    ports: dict[str, Any] = {"subs": ["scan"], "pubs": ["map"]}
    scheduler.add(Node("follower", order=order, **ports, **follower))
    scheduler.add(Node("lidar", scan, rate=30, order=10, pubs=["scan"]))
    scheduler.add(Node("log", lambda node: reports.extend(node.recv_all("map")), on="map"))
    scheduler.run(1.5)
    return reports, scheduler


@pytest.mark.parametrize("follower", FOLLOWERS.values(), ids=FOLLOWERS)
def test_nodes_without_a_thread_in_the_baton_run_after_rt_nodes_before_them(
    follower: dict[str, Any],
) -> None:
    """However long the LiDAR takes, within reason: the map is of the same cycle's scan."""
    reports, scheduler = follow_lidar(follower, order=20, work_s=0.005)
    violations = scheduler.get_node_stats("follower")["order_violations"]
    assert len(reports) > 20
    out_of_order = sum(scanned != cycle for cycle, scanned in reports)
    # Whatever a noisy machine does, nothing happens out of order uncounted.
    assert out_of_order <= violations
    assert out_of_order < 0.25 * len(reports)


def test_nodes_without_a_thread_do_not_wait_for_rt_nodes_after_them() -> None:
    """A message then arrives a cycle later, as the order asks for."""
    reports, scheduler = follow_lidar(FOLLOWERS["BestEffort"], order=5, work_s=0.005)
    assert scheduler.get_node_stats("follower")["order_violations"] == 0
    assert sum(scanned == cycle for cycle, scanned in reports) < 0.25 * len(reports)


@pytest.mark.parametrize("follower", FOLLOWERS.values(), ids=FOLLOWERS)
def test_nodes_without_a_thread_do_not_freeze_with_an_rt_node(follower: dict[str, Any]) -> None:
    """They run when they can wait no longer, and that is counted."""
    reports, scheduler = follow_lidar(follower, order=20, work_s=0.0, freeze_s=0.4)
    stats = scheduler.get_node_stats("follower")
    assert len(reports) > 30
    assert 8 <= stats["order_violations"] <= 20


def test_the_loop_gives_way_to_rt_nodes() -> None:
    """Woken at the same instant, it would take the interpreter from them."""
    late_ns: list[int] = []

    def log() -> None:
        context = clock.current.get()
        assert context is not None
        late_ns.append(time.monotonic_ns() - context.release_ns)

    scheduler = Scheduler()
    scheduler.add(Node("logger", log))
    scheduler.add(Node("motor", lambda: None, rate=100))
    scheduler.run(0.5)

    assert len(late_ns) > 5
    assert min(late_ns[1:]) >= GIVE_WAY_NS  # the first one may be asked for before there is a motor


def test_who_hands_over_to_a_higher_priority_has_its_own_again_in_its_next_tick() -> None:
    """Priority inheritance ends with the hand-over; nobody preempts a thread on its way to it."""
    priorities: list[int] = []
    after: list[int] = []
    scheduler = Scheduler(rt=True)
    if not scheduler.capabilities()["rt_scheduling"]:
        pytest.skip("SCHED_FIFO is not permitted")

    def track() -> None:
        priorities.append(os.sched_getparam(0).sched_priority)

    def drive() -> None:
        after.append(os.sched_getparam(0).sched_priority)

    scheduler.add(Node("tracker", track, rate=50, order=0))
    scheduler.add(Node("motor", drive, rate=500, order=1))
    scheduler.run(0.5)

    assert len(priorities) > 10
    assert max(priorities) == min(priorities) < min(after)
