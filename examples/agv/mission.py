"""What happened: the mission's own log, and the judgement of the run."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from agv import layout

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np

    from agv.world import Pose, Record

MOTORS_HALTED = "motors halted"
DISCONNECTED = "disconnected"
EMERGENCY_STOP = "emergency stop"
STANDING = "standing"
RELEASED = "released"
ARRIVED = "arrived"
SENSORS = ("lidar_front", "lidar_rear", "camera")


@dataclass(frozen=True, slots=True, kw_only=True)
class Event:
    """One line of the mission log."""

    at_s: float
    node: str
    what: str
    detail: str = ""
    place: tuple[float, float] | None = None


@dataclass(slots=True)
class MissionLog:
    """Collect events, plans and counts from the nodes.

    Thread: any; appending to a list is atomic, and the log is read after the run.
    """

    clock: Callable[[], float]
    """The time of the physics [s]: what the log says and the picture shows are one timeline."""
    events: list[Event] = field(default_factory=list)
    plans: list[tuple[float, np.ndarray]] = field(default_factory=list)
    delivered: int = 0

    def add(self, node: str, what: str, detail: str = "", pose: Pose | None = None) -> None:
        """Note that something happened, now."""
        place = None if pose is None else (pose.x_m, pose.y_m)
        event = Event(at_s=self.clock(), node=node, what=what, detail=detail, place=place)
        self.events.append(event)

    def add_plan(self, path: np.ndarray) -> None:
        """Note what was planned, now."""
        self.plans.append((self.clock(), path))

    def find(self, what: str) -> list[Event]:
        """Return the events of one kind, in the order they happened."""
        return [event for event in self.events if event.what == what]


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """The run in numbers; `failures` says what was promised and did not happen."""

    goal_reached: bool
    goal_error_m: float
    emergency_stops: int
    stop_distance_m: float
    min_clearance_m: float
    contact_steps: int
    halted_at_shutdown_mps: float
    shutdown_order: tuple[str, ...]
    reports_delivered: int
    trajectory_sha256: str

    @property
    def motors_halted_first(self) -> bool:
        """Return whether the motors stood before any sensor disconnected."""
        order = self.shutdown_order
        return all(sensor in order for sensor in SENSORS) and all(
            "motor" in order[: order.index(sensor)] for sensor in SENSORS
        )

    @property
    def failures(self) -> list[str]:
        """Return the promises that were broken, in words."""
        promises = (
            (self.goal_reached, f"the goal was missed by {self.goal_error_m:.2f} m"),
            (self.emergency_stops > 0, "no emergency stop"),
            (self.contact_steps == 0, f"contact during {self.contact_steps} physics steps"),
            (self.min_clearance_m > 0.0, "the pallet was touched"),
            (self.halted_at_shutdown_mps < 0.01, "the vehicle still moved after shutdown"),
            (self.motors_halted_first, f"sensors before motors: {self.shutdown_order}"),
            (self.reports_delivered > 0, "the fleet server received nothing"),
        )
        return [broken for kept, broken in promises if not kept]


def judge(log: MissionLog, record: Record, pose: Pose) -> Outcome:
    """Compare what the nodes logged with what the physics engine recorded."""
    error_m = math.dist((pose.x_m, pose.y_m), layout.GOAL)
    stops, halts = log.find(EMERGENCY_STOP), log.find(STANDING)
    stop_distance_m = math.nan
    if stops and halts and stops[0].place is not None and halts[0].place is not None:
        stop_distance_m = math.dist(stops[0].place, halts[0].place)
    return Outcome(
        goal_reached=error_m < 0.15,
        goal_error_m=error_m,
        emergency_stops=len(stops),
        stop_distance_m=stop_distance_m,
        min_clearance_m=record.min_clearance_m,
        contact_steps=record.contact_steps,
        halted_at_shutdown_mps=abs(pose.speed_mps),
        shutdown_order=tuple(e.node for e in log.events if e.what in {MOTORS_HALTED, DISCONNECTED}),
        reports_delivered=log.delivered,
        trajectory_sha256=record.digest.hexdigest(),
    )


def _metres(distance_m: float) -> str:
    return f"{distance_m:.3f} m" if math.isfinite(distance_m) else "none"


def report(log: MissionLog, outcome: Outcome) -> str:
    """Return the run in words, for the terminal."""
    lines = ["Mission log"]
    lines += [
        f"  {event.at_s:7.3f} s  {event.node:<12} {event.what}"
        + (f": {event.detail}" if event.detail else "")
        for event in log.events
    ]
    lines += [
        "",
        f"goal reached          {outcome.goal_reached} (off by {outcome.goal_error_m:.3f} m)",
        f"emergency stops       {outcome.emergency_stops}",
        f"stopping distance     {_metres(outcome.stop_distance_m)}",
        f"least clearance       {_metres(outcome.min_clearance_m)} to the pallet",
        f"contacts              {outcome.contact_steps} physics steps with any contact",
        f"shutdown order        {' -> '.join(outcome.shutdown_order)}",
        f"fleet reports         {outcome.reports_delivered} delivered",
        f"trajectory sha256     {outcome.trajectory_sha256}",
    ]
    lines += [f"BROKEN PROMISE        {failure}" for failure in outcome.failures]
    return "\n".join(lines)
