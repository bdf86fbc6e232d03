"""The course: up, round a square, down; and the smooth reference between its waypoints."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from drone.airframe import REST_HEIGHT_M

if TYPE_CHECKING:
    from drone.geometry import Vector

SIDE_M = 4.0
HEIGHT_M = 2.0
BELOW_GROUND_M = 0.12
"""The landing aims below the ground, so that the drone settles on it and does not hover over it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Waypoint:
    """A place to fly to."""

    name: str
    """What the way there is called."""
    target_m: Vector
    duration_s: float
    pause_s: float = 0.3
    landing: bool = False


ARRIVED_M = 0.25
PREVIEW_S = 0.15
"""How long the drone takes to tilt: who asks for an acceleration now gets it so much later."""
RESTING_MPS = 0.12

STANDING = "standing"
"""What the time before the first waypoint is called; there is nowhere to arrive at."""

START_M: Vector = (0.0, 0.0, REST_HEIGHT_M)
CORNERS_M: tuple[Vector, ...] = (
    (0.0, 0.0, HEIGHT_M),
    (SIDE_M, 0.0, HEIGHT_M),
    (SIDE_M, SIDE_M, HEIGHT_M),
    (0.0, SIDE_M, HEIGHT_M),
)
COURSE: tuple[Waypoint, ...] = (
    Waypoint(name="takeoff", target_m=CORNERS_M[0], duration_s=2.2),
    Waypoint(name="side 1", target_m=CORNERS_M[1], duration_s=2.9),
    Waypoint(name="side 2", target_m=CORNERS_M[2], duration_s=2.9),
    Waypoint(name="side 3", target_m=CORNERS_M[3], duration_s=2.9),
    Waypoint(name="side 4", target_m=CORNERS_M[0], duration_s=2.9),
    Waypoint(
        name="landing",
        target_m=(0.0, 0.0, REST_HEIGHT_M - BELOW_GROUND_M),
        duration_s=3.6,
        landing=True,
    ),
)
SIDES = tuple(waypoint.name for waypoint in COURSE if waypoint.name.startswith("side"))


@dataclass(frozen=True, slots=True, kw_only=True)
class Reference:
    """Where the drone should be right now, and how it should move."""

    position_m: Vector
    velocity_mps: Vector
    acceleration_mps2: Vector
    """`PREVIEW_S` later."""


class Leg:
    """The way from one point to another: a straight line, from rest to rest.

    A polynomial of fifth degree starts and ends without speed and without acceleration, which
    a drone that has to tilt for every acceleration can really follow.
    """

    def __init__(self, start_m: Vector, target_m: Vector, duration_s: float) -> None:
        """Plan the way."""
        self._start, self._duration_s = start_m, duration_s
        dx, dy, dz = (b - a for a, b in zip(start_m, target_m, strict=True))
        self._way = (dx, dy, dz)

    def at(self, time_s: float) -> Reference:
        """Return the reference at a time after the start [s]."""
        t = max(0.0, min(time_s / self._duration_s, 1.0))
        share = t * t * t * (10.0 + t * (6.0 * t - 15.0))
        speed = 30.0 * t * t * (1.0 - t) ** 2 / self._duration_s
        soon = max(0.0, min((time_s + PREVIEW_S) / self._duration_s, 1.0))
        change = 60.0 * soon * (1.0 - soon) * (1.0 - 2.0 * soon) / self._duration_s**2
        x, y, z = self._start
        dx, dy, dz = self._way
        return Reference(
            position_m=(x + share * dx, y + share * dy, z + share * dz),
            velocity_mps=(speed * dx, speed * dy, speed * dz),
            acceleration_mps2=(change * dx, change * dy, change * dz),
        )


class Follower:
    """Keep track of where on the course the drone should be, and whether it got there.

    Thread: one.
    """

    def __init__(self) -> None:
        """Stand at the start."""
        self.waypoint: Waypoint | None = None
        self.landed = False
        self._leg = Leg(START_M, START_M, 1.0)
        self._since_s = 0.0
        self._resting_s = 0.0

    @property
    def name(self) -> str:
        """The name of the leg."""
        return STANDING if self.waypoint is None else self.waypoint.name

    @property
    def flying(self) -> bool:
        """Whether the motors are needed."""
        return self.waypoint is not None and not self.landed

    def take(self, waypoint: Waypoint) -> None:
        """Fly to a waypoint, from wherever the reference is."""
        start_m = self._leg.at(self._since_s).position_m
        self._leg = Leg(start_m, waypoint.target_m, waypoint.duration_s)
        self.waypoint, self._since_s, self._resting_s = waypoint, 0.0, 0.0

    def advance(self, dt_s: float) -> Reference:
        """Go on for a time [s]; return where the drone should be then."""
        self._since_s += dt_s
        return self._leg.at(self._since_s)

    @staticmethod
    def error_m(reference: Reference, position_m: Vector) -> float:
        """Return the distance of a position from the reference, above the ground [m]."""
        x, y, z = reference.position_m
        return math.dist((x, y, max(z, REST_HEIGHT_M)), position_m)

    def arrived(self, error_m: float, climb_mps: float, dt_s: float) -> bool:
        """Return whether the leg is over.

        Args:
            error_m: distance between drone and reference.
            climb_mps: vertical speed of the drone.
            dt_s: time since the previous call [s].
        """
        waypoint = self.waypoint
        if waypoint is None:
            return True
        if self._since_s < waypoint.duration_s:
            return False
        # Who aims below the ground has landed when he sinks no further.
        there = abs(climb_mps) < RESTING_MPS if waypoint.landing else error_m < ARRIVED_M
        self._resting_s = self._resting_s + dt_s if there else 0.0
        self.landed = self.landed or (waypoint.landing and self._resting_s >= waypoint.pause_s)
        return self._resting_s >= waypoint.pause_s
