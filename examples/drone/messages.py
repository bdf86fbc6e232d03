"""What the nodes say to each other: topics and the types that travel on them.

Frozen values pass by reference, so none is copied for each of its readers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from horus import Sub

if TYPE_CHECKING:
    from drone.geometry import Vector

# Control wants the newest value, not the queue of those it came too late for.
NEWEST_IMU = Sub("imu", capacity=1)
NEWEST_GPS = Sub("gps", capacity=1)
NEWEST_NAV = Sub("nav", capacity=1)


@dataclass(frozen=True, slots=True, kw_only=True)
class Imu:
    """What the IMU and its filter know."""

    time_s: float
    """When it was measured, by the device's own clock."""
    angles_rad: Vector
    """Roll, pitch and yaw."""
    rates_radps: Vector
    gained_mps: Vector
    """Velocity felt since the start, gravity taken out, in the world's axes.

    The sum instead of the acceleration: a reader at any rate that skipped some messages gets
    from the difference of two all that happened in between.
    """
    calibrated: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Navigation:
    """Where the drone is, and how far on its course."""

    leg: str
    arrived: bool
    """Whether the leg is over: for the landing, whether the motors have been disarmed."""
    position_m: Vector
    velocity_mps: Vector
    drift_mps2: Vector
    error_m: float
    """Distance from the reference, as far as the drone itself knows."""
