"""What happened: the flight's own log, and the judgement of the flight."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from drone.airframe import REST_HEIGHT_M
from drone.course import CORNERS_M, COURSE, SIDES, START_M

if TYPE_CHECKING:
    from collections.abc import Callable

    from drone.geometry import Vector
    from drone.world import Record

FLOWN = "flown"
STALLED = "stalled"
FAILSAFE = "failsafe descent"
MOTORS_OFF = "motors off"
DISCONNECTED = "disconnected"
SENSORS = ("imu", "gps")

CORNER_M = 0.25
TRACKING_RMS_M, TRACKING_MAX_M = 0.15, 0.45
LANDING_M = 0.30
TOUCHDOWN_MPS = 0.8


@dataclass(frozen=True, slots=True, kw_only=True)
class Event:
    """One line of the flight log."""

    at_s: float
    node: str
    what: str
    detail: str = ""


@dataclass(slots=True)
class FlightLog:
    """Collect events and references from the nodes.

    Thread: any; appending to a list is atomic, and the log is read after the run.
    """

    clock: Callable[[], float]
    """The time of the physics [s]: what the log says and the picture shows are one timeline."""
    events: list[Event] = field(default_factory=list)
    references: list[tuple[float, str, Vector]] = field(default_factory=list)
    """Time [s], leg, and where the drone should have been [m]."""

    def add(self, node: str, what: str, detail: str = "") -> None:
        """Note that something happened, now."""
        self.events.append(Event(at_s=self.clock(), node=node, what=what, detail=detail))

    def add_reference(self, at_s: float, leg: str, position_m: Vector) -> None:
        """Note where the drone should be at a time of the sensors' clock [s]."""
        self.references.append((at_s, leg, position_m))

    def find(self, what: str) -> list[Event]:
        """Return the events of one kind, in the order they happened."""
        return [event for event in self.events if event.what == what]


@dataclass(frozen=True, slots=True, kw_only=True)
class Tracking:
    """How far the drone was from its reference, measured by the physics engine."""

    time_s: np.ndarray
    """(n,) float64 [s]."""
    commanded_m: np.ndarray
    """(n, 3) float64 [m]."""
    error_m: np.ndarray
    """(n,) float64 [m]."""
    leg: np.ndarray
    """(n,) str."""

    def errors(self, *legs: str) -> np.ndarray:
        """Return the errors during some legs, all if none is named."""
        return self.error_m[np.isin(self.leg, legs)] if legs else self.error_m


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """The flight in numbers; `failures` says what was promised and did not happen."""

    legs_flown: tuple[str, ...]
    corner_misses_m: tuple[float, ...]
    """How close the drone came to each corner of the square."""
    tracking: Tracking
    rms_m: float
    max_m: float
    square_rms_m: float
    square_max_m: float
    max_tilt_rad: float
    landed: bool
    landing_error_m: float
    touchdown_mps: float
    """Speed when the drone came down for the last time; nan if it did not."""
    thrust_at_end_n: float
    failsafe: bool
    shutdown_order: tuple[str, ...]
    trajectory_sha256: str

    @property
    def square_flown(self) -> bool:
        """Return whether every side was flown and every corner visited."""
        corners = all(miss_m < CORNER_M for miss_m in self.corner_misses_m)
        return corners and all(side in self.legs_flown for side in SIDES)

    @property
    def legs(self) -> str:
        """Return what was flown, in words."""
        return ", ".join(self.legs_flown) or "nothing"

    @property
    def motors_off_first(self) -> bool:
        """Return whether the motors were off before any sensor disconnected."""
        order = self.shutdown_order
        return all(sensor in order for sensor in SENSORS) and all(
            "esc" in order[: order.index(sensor)] for sensor in SENSORS
        )

    @property
    def failures(self) -> list[str]:
        """Return the promises that were broken, in words."""
        # What was never measured, because the drone never flew, is nan and exceeds nothing.
        promises = (
            (self.square_flown, f"the square was not flown, only: {self.legs}"),
            (not self.rms_m >= TRACKING_RMS_M, f"tracking error RMS {self.rms_m:.3f} m"),
            (not self.max_m >= TRACKING_MAX_M, f"tracking error up to {self.max_m:.3f} m"),
            (self.landed, "the drone does not stand on its legs"),
            (self.landing_error_m < LANDING_M, f"landed {self.landing_error_m:.2f} m off"),
            (
                not self.touchdown_mps >= TOUCHDOWN_MPS,
                f"touched down at {self.touchdown_mps:.2f} m/s",
            ),
            (not self.failsafe, "the ESC had to take over"),
            (self.thrust_at_end_n < 0.01, "the rotors still pushed at the end"),
            (self.motors_off_first, f"sensors before motors: {self.shutdown_order}"),
        )
        return [broken for kept, broken in promises if not kept]


def judge(log: FlightLog, record: Record) -> Outcome:
    """Compare what the nodes logged with what the physics engine recorded."""
    track = np.array(record.track).reshape(-1, 10)
    tracking = _tracking(log, track)
    square = tracking.errors(*SIDES)
    end = track[-1]
    flown = {event.detail.partition(",")[0] for event in log.find(FLOWN)}
    return Outcome(
        legs_flown=tuple(waypoint.name for waypoint in COURSE if waypoint.name in flown),
        corner_misses_m=tuple(
            float(np.linalg.norm(track[:, 1:4] - corner, axis=1).min()) for corner in CORNERS_M
        ),
        tracking=tracking,
        rms_m=_rms(tracking.error_m),
        max_m=_max(tracking.error_m),
        square_rms_m=_rms(square),
        square_max_m=_max(square),
        max_tilt_rad=float(track[:, 5].max()),
        landed=bool(abs(end[3] - REST_HEIGHT_M) < 0.02 and end[4] < 0.05 and end[5] < 0.05),
        landing_error_m=math.dist(end[1:3], START_M[:2]),
        touchdown_mps=_touchdown_mps(track),
        thrust_at_end_n=float(end[6:10].sum()),
        failsafe=bool(log.find(FAILSAFE)),
        shutdown_order=tuple(e.node for e in log.events if e.what in {MOTORS_OFF, DISCONNECTED}),
        trajectory_sha256=record.digest.hexdigest(),
    )


def _tracking(log: FlightLog, track: np.ndarray) -> Tracking:
    # Once the ESC brings the drone down, nobody follows the reference any more.
    taken_over = [event.at_s for event in log.find(FAILSAFE)]
    end_s = min(taken_over, default=math.inf)
    references = [entry for entry in log.references if entry[0] <= end_s]
    time_s = np.array([at_s for at_s, _, _ in references])
    commanded = np.array([where for _, _, where in references]).reshape(-1, 3)
    # The landing aims below the ground; to stand on it is what was asked for.
    commanded[:, 2] = np.maximum(commanded[:, 2], REST_HEIGHT_M)
    flown = np.column_stack([np.interp(time_s, track[:, 0], track[:, k]) for k in (1, 2, 3)])
    return Tracking(
        time_s=time_s,
        commanded_m=commanded,
        error_m=np.linalg.norm(flown - commanded, axis=1),
        leg=np.array([leg for _, leg, _ in references], dtype=str),
    )


def _rms(errors_m: np.ndarray) -> float:
    return float(np.sqrt(np.mean(errors_m**2))) if len(errors_m) else math.nan


def _max(errors_m: np.ndarray) -> float:
    return float(errors_m.max()) if len(errors_m) else math.nan


def _touchdown_mps(track: np.ndarray) -> float:
    """Return the speed at the last descent through a hand's breadth above standing height."""
    high = np.flatnonzero(track[:, 3] > REST_HEIGHT_M + 0.03)
    if not len(high) or high[-1] + 1 >= len(track):
        return math.nan
    return float(track[high[-1], 4])


def _in(unit: str, value: float) -> str:
    return f"{value:.3f} {unit}" if math.isfinite(value) else "none"


def report(log: FlightLog, outcome: Outcome) -> str:
    """Return the flight in words, for the terminal."""
    lines = ["Flight log"]
    lines += [
        f"  {event.at_s:7.3f} s  {event.node:<9} {event.what}"
        + (f": {event.detail}" if event.detail else "")
        for event in log.events
    ]
    corners = ", ".join(f"{miss_m:.3f}" for miss_m in outcome.corner_misses_m)
    rms, most = _in("m", outcome.rms_m), _in("m", outcome.max_m)
    square_rms, square_most = _in("m", outcome.square_rms_m), _in("m", outcome.square_max_m)
    lines += [
        "",
        f"square flown          {outcome.square_flown} (corners missed by {corners} m)",
        f"tracking error        RMS {rms}, max {most}",
        f"on the square         RMS {square_rms}, max {square_most}",
        f"greatest tilt         {math.degrees(outcome.max_tilt_rad):.1f} degrees",
        f"landed                {outcome.landed} (off by {outcome.landing_error_m:.3f} m)",
        f"touchdown             {_in('m/s', outcome.touchdown_mps)}",
        f"thrust at the end     {outcome.thrust_at_end_n:.3f} N",
        f"shutdown order        {' -> '.join(outcome.shutdown_order)}",
        f"trajectory sha256     {outcome.trajectory_sha256}",
    ]
    lines += [f"BROKEN PROMISE        {failure}" for failure in outcome.failures]
    return "\n".join(lines)
