"""The fault matrix: what follows in each class from each fault, under each policy.

Every test makes one node faulty in its first tick and keeps another one beside it, and
then tells everything that is different: counters, health, hooks, the reason to stop. In
virtual time where the fault allows it, in real time where a thread must be blocked.
"""

from __future__ import annotations

import asyncio
import time
from typing import Any

import pytest

from horus import Node, NodeError, Scheduler, ms

from .freezing import Freezer, await_health
from .helpers import PATIENCE_S, TRIGGER, run_until, running, wait_until

ON_MISS = ("warn", "skip", "safe_mode", "stop")
FAILURE = (None, "fatal", "restart", "skip", "ignore")
KINDS = ("BestEffort", "Event", "urgent Event", "async Event", "AsyncIo", "Rt", "Compute")
AWAITING = ("async Event", "AsyncIo")
FAULT_S = 0.13
"""Longer than the limit that is to be exceeded, shorter than the other one [s]."""

LIMITS: dict[str, dict[str, Any]] = {
    "overrun": {"budget": 0.08, "deadline": 0.19},
    "miss": {"budget": 0.19, "deadline": 0.08},
    "none": {},
}


class Robot:
    """A faulty node, and another one that must not notice."""

    def __init__(self, sched: Scheduler, kind: str, fault: str, **options: Any) -> None:
        self.sched = sched
        self.fault = fault
        self.freezer = Freezer()
        self.ticks = self.ended = self.inits = self.hooks = self.others = 0
        self.downs: list[str] = []
        limits = LIMITS.get(fault, {})
        on_loop = kind in ("BestEffort", "Event")
        schedule: dict[str, Any] = {
            "BestEffort": {},
            "Event": {"on": TRIGGER},
            "urgent Event": {"on": TRIGGER, "deadline": 30.0},
            "async Event": {"on": TRIGGER},
            "AsyncIo": {"rate": 5},
            "Rt": {"rate": 5},
            "Compute": {"rate": 5, "compute": True},
        }[kind]
        is_async = kind in AWAITING
        faulty = Node(
            "faulty",
            self._tick_async if is_async else self._tick,
            init=_async(self._init) if is_async else self._init,
            shutdown=_async(self._shutdown) if is_async else self._shutdown,
            safe_state=_async(self._hook) if is_async else self._hook,
            order=10,
            **{**schedule, **({} if on_loop else limits), **options},
        )
        self.other = Node("other", self._count, rate=50, order=20, shutdown=self._shutdown)
        sched.add(faulty).add(self.other)
        if on_loop and limits:
            # Limits that are written down would give the node a thread of its own.
            sched.set_tick_budget("faulty", limits["budget"] * 1e6)
        for index in range(3):
            sched.publish(TRIGGER, index)

    def stats(self) -> dict[str, Any]:
        return self.sched.get_node_stats("faulty")

    def went_down_in_order(self) -> bool:
        """Return whether `shutdown()` was called exactly once of each, in reverse order."""
        return self.downs == ["other", "faulty"]

    def _tick(self, node: Node) -> None:
        self.ticks += 1
        if self.ticks == 1:
            if self.fault in ("overrun", "miss"):
                time.sleep(FAULT_S)
            if self.fault.startswith("freeze"):
                self.freezer.tick(node)
            if self.fault in ("raise", "freeze and raise"):
                raise OSError("no echo")
        self.ended += 1

    async def _tick_async(self, node: Node) -> None:
        self.ticks += 1
        if self.ticks == 1:
            if self.fault in ("overrun", "miss"):
                await asyncio.sleep(FAULT_S)
            if self.fault.startswith("freeze"):
                await asyncio.sleep(1000.0)
            if self.fault == "raise":
                raise OSError("no echo")
        self.ended += 1

    def _init(self, node: Node) -> None:
        self.inits += 1

    def _hook(self, node: Node) -> None:
        self.hooks += 1

    def _shutdown(self, node: Node) -> None:
        self.downs.append(node.name)

    def _count(self, node: Node) -> None:
        self.others += 1


def _async(function: Any) -> Any:
    async def call(node: Node) -> None:
        function(node)

    return call


# -- limits exceeded -------------------------------------------------------------------------------


def check_limit_exceeded(robot: Robot, kind: str, policy: str) -> None:
    """Assert what follows from one tick beyond its limit; the run is over."""
    stats = robot.stats()
    # Whoever has no deadline of its own gets one from its budget, unless messages release it.
    both = kind == "BestEffort"
    assert stats["budget_overruns"] == (robot.fault == "overrun")
    assert stats["deadline_misses"] == (robot.fault == "miss" or both)
    assert stats["errors_count"] == stats["watchdog_expirations"] == stats["restarts"] == 0
    assert stats["health"] == "healthy"
    assert robot.hooks == (policy == "safe_mode")
    assert robot.inits == 1
    assert robot.went_down_in_order()
    reason = robot.sched.stop_reason or ""
    if policy == "stop":
        limit = "deadline" if robot.fault == "miss" or both else "budget"
        assert f"node 'faulty' exceeded its {limit} of 80.00 ms" in reason
        assert robot.ticks == 1
    else:
        assert "faulty" not in reason
        assert robot.others > 0


@pytest.mark.realtime
@pytest.mark.parametrize("policy", ON_MISS)
@pytest.mark.parametrize(
    ("kind", "fault"),
    [
        ("BestEffort", "overrun"),
        ("Event", "overrun"),
        ("urgent Event", "overrun"),
        ("urgent Event", "miss"),
        ("Rt", "overrun"),
        ("Rt", "miss"),
        ("Compute", "overrun"),
        ("Compute", "miss"),
    ],
)
def test_a_limit_that_is_exceeded(make, kind, fault, policy):
    """A tick beyond its budget or its deadline: exactly what its on_miss says, nothing else."""
    robot = Robot(make(), kind, fault, on_miss=policy)
    wanted = 2 if "Event" in kind and policy == "skip" else 3 if "Event" in kind else 2
    if policy == "stop":
        robot.sched.run(PATIENCE_S)
    else:
        run_until(robot.sched, lambda: robot.ticks >= wanted and robot.others >= 3)

    check_limit_exceeded(robot, kind, policy)
    if policy != "stop":
        # Exactly the next release is dropped: of three messages, the second.
        dropped = robot.stats()["skipped"]
        if kind == "BestEffort":  # 30 Hz: more releases went by meanwhile
            assert dropped >= (policy == "skip")
        else:
            assert dropped == (policy == "skip")
        if "Event" in kind:
            assert robot.ticks == wanted


@pytest.mark.parametrize("policy", ON_MISS)
@pytest.mark.parametrize(("kind", "fault"), [(k, f) for k in AWAITING for f in ("overrun", "miss")])
def test_a_limit_that_is_exceeded_in_virtual_time(make, kind, fault, policy):
    """The same for ticks that await for too long."""
    sched = make(tick_rate=100, deterministic=True)
    robot = Robot(sched, kind, fault, on_miss=policy)
    sched.run(1.0)

    check_limit_exceeded(robot, kind, policy)
    released = 3 if kind == "async Event" else 5
    assert robot.ticks == {"stop": 1, "skip": released - 1}.get(policy, released)
    assert robot.stats()["skipped"] == (policy == "skip")
    if policy != "stop":
        assert robot.others == 50


# -- ticks that raise ------------------------------------------------------------------------------


@pytest.mark.parametrize("on_miss", ["safe_mode", "stop"])
@pytest.mark.parametrize("policy", FAILURE)
@pytest.mark.parametrize("kind", KINDS)
def test_a_tick_that_raises(make, kind, policy, on_miss):
    """An exception is a matter of failure_policy alone: on_miss and the watchdog stay out of it."""
    sched = make(tick_rate=100, deterministic=True, watchdog_ms=50)
    robot = Robot(sched, kind, "raise", failure_policy=policy, on_miss=on_miss)
    if policy == "fatal":
        with pytest.raises(NodeError, match="faulty") as raised:
            sched.run(1.0)
        assert isinstance(raised.value.__cause__, OSError)
        assert "faulty" in sched.stop_reason
        assert (robot.ticks, robot.others) == (1, 0)
    else:
        sched.run(1.0)
        assert sched.stop_reason is None
        assert robot.others == 50
        # The back-off of 100 ms costs a node of 30 Hz two releases, messages wait for it.
        releases = {"BestEffort": 30}.get(kind, 3 if "Event" in kind else 5)
        lost = robot.stats()["skipped"]
        assert lost == (2 if policy == "restart" and kind == "BestEffort" else 0)
        assert robot.ticks == releases - lost

    stats = robot.stats()
    assert stats["errors_count"] == 1
    assert stats["restarts"] == (policy == "restart")
    assert robot.inits == 1 + (policy == "restart")
    assert stats["budget_overruns"] == stats["deadline_misses"] == 0
    assert stats["watchdog_expirations"] == robot.hooks == 0
    assert stats["health"] == "healthy"
    assert robot.went_down_in_order()


# -- ticks that freeze -----------------------------------------------------------------------------


def freeze(robot: Robot) -> dict[str, Any]:
    """Wait until the faulty node is isolated, then let it go on; return its stats before."""
    await_health(robot.sched, "faulty", "isolated")
    wait_until(lambda: robot.hooks)
    before = robot.others
    wait_until(lambda: robot.others >= before + 2)
    stats = robot.stats()
    robot.freezer.thaw()
    return stats


@pytest.mark.realtime
@pytest.mark.parametrize("policy", ON_MISS)
@pytest.mark.parametrize("kind", ["BestEffort", "Event", "urgent Event", "Rt", "Compute"])
def test_a_tick_that_freezes_and_then_ends(make, kind, policy):
    """It is isolated whatever its on_miss; its end is an exceeded limit like any other.

    The hook has been called by then: "safe_mode" does not call it again.
    """
    robot = Robot(make(), kind, "freeze", watchdog=60 * ms, on_miss=policy)
    robot.sched.set_tick_budget("faulty", 50_000)
    with running(robot.sched) as run, robot.freezer:
        stats = freeze(robot)
        assert stats["state"] == "safe_state"
        assert stats["total_ticks"] == stats["budget_overruns"] == 0
        wait_until(lambda: robot.stats()["budget_overruns"])
        if policy == "stop":
            run.join(PATIENCE_S)
        else:
            others = robot.others
            wait_until(lambda: robot.others >= others + 3)
            assert robot.sched.stop_reason is None
            assert robot.stats()["health"] == "isolated"

    stats = robot.stats()
    assert (stats["total_ticks"], stats["budget_overruns"]) == (1, 1)
    assert stats["watchdog_expirations"] == 1
    assert (robot.ticks, robot.hooks, robot.inits) == (1, 1, 1)
    assert stats["errors_count"] == 0
    assert ("'faulty'" in robot.sched.stop_reason) == (policy == "stop")
    assert robot.went_down_in_order()


@pytest.mark.realtime
@pytest.mark.parametrize("policy", FAILURE)
@pytest.mark.parametrize("kind", ["BestEffort", "Event", "urgent Event", "Rt", "Compute"])
def test_a_tick_that_freezes_and_then_raises(make, kind, policy):
    """It is isolated whatever its failure_policy, which applies when the exception comes."""
    robot = Robot(make(), kind, "freeze and raise", watchdog=60 * ms, failure_policy=policy)
    raised = None
    try:
        with running(robot.sched) as run, robot.freezer:
            freeze(robot)
            wait_until(lambda: robot.stats()["errors_count"])
            if policy == "fatal":
                run.join(PATIENCE_S)
            else:
                others = robot.others
                wait_until(lambda: robot.others >= others + 3)
                # Held: not even a restart brings it back before it is let go.
                assert robot.stats()["state"] == "safe_state"
                assert (robot.ticks, robot.inits) == (1, 1)
                wait_until(lambda: robot.sched.clear_safe_state() == [])
                wait_until(lambda: _ticks_again(robot))
    except NodeError as exc:
        raised = exc

    assert (raised is not None) == (policy == "fatal")
    stats = robot.stats()
    assert stats["errors_count"] == stats["watchdog_expirations"] == 1
    assert stats["restarts"] == (policy == "restart")
    assert robot.inits == 1 + (policy == "restart")
    assert robot.hooks == 1
    assert robot.went_down_in_order()


def _ticks_again(robot: Robot) -> bool:
    robot.sched.publish(TRIGGER, 9)
    return robot.ticks >= 2


@pytest.mark.parametrize("failure_policy", FAILURE)
@pytest.mark.parametrize("on_miss", ON_MISS)
@pytest.mark.parametrize("kind", AWAITING)
def test_an_awaiting_tick_that_freezes(make, kind, on_miss, failure_policy):
    """An async tick is cut short when it is isolated: no overrun, no failure, no policy fires."""
    sched = make(tick_rate=100, deterministic=True, watchdog_ms=100)
    robot = Robot(sched, kind, "freeze", on_miss=on_miss, failure_policy=failure_policy)
    sched.tick_for(1.0)

    stats = robot.stats()
    assert (stats["state"], stats["health"]) == ("safe_state", "isolated")
    assert (robot.ticks, robot.ended, robot.hooks, robot.inits) == (1, 0, 1, 1)
    assert stats["watchdog_expirations"] == 1
    assert stats["skipped"] == (2 if kind == "async Event" else 4)
    for counter in ("total_ticks", "errors_count", "budget_overruns", "deadline_misses"):
        assert stats[counter] == 0
    assert robot.others == 50
    assert sched.stop_reason is None
    sched.stop()
    assert robot.went_down_in_order()
