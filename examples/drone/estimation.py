"""Estimation: attitude by a complementary filter, position by dead reckoning and GPS."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from drone.airframe import GRAVITY_MPS2, REST_HEIGHT_M
from drone.geometry import (
    NOTHING,
    difference,
    inverse,
    moved,
    roll_pitch_yaw,
    to_world,
    turned,
    wrapped,
)

if TYPE_CHECKING:
    from drone.geometry import Quaternion, Vector
    from drone.sensors import GpsFix, RawImu

CALIBRATION_S = 0.5
TILT_GAIN_PER_S = 0.3
HEADING_GAIN_PER_S = 0.5
BIAS_GAIN_PER_S2 = 0.01

# Per fix, at 10 Hz.
POSITION_FROM_POSITION = 0.35
VELOCITY_FROM_POSITION_PER_S = 0.5
VELOCITY_FROM_VELOCITY = 0.35
DRIFT_FROM_VELOCITY_PER_S = 0.35


class AttitudeFilter:
    """Fuse gyroscope, accelerometer and magnetometer into an attitude.

    The gyroscope gives the quick changes; gravity and the magnetic field, slowly, the level and
    the heading. In flight an accelerometer alone cannot tell a tilt from a manoeuvre: there the
    level comes from the drift that `Navigator` learnt, which is what gravity does to dead
    reckoning on a horizon that is off.
    """

    def __init__(self) -> None:
        """Stand still, and learn the gyroscope's bias and the level first."""
        self.attitude: Quaternion = (1.0, 0.0, 0.0, 0.0)
        self.calibrated = False
        self._bias: Vector = NOTHING
        self._gravity: Vector = NOTHING
        self._standing_s = 0.0

    def update(self, raw: RawImu, dt_s: float, drift_mps2: Vector) -> Vector:
        """Take in a measurement; return the body rates without bias [rad/s].

        Args:
            raw: the measurement.
            dt_s: time since the previous one [s].
            drift_mps2: the acceleration in the world's axes by which dead reckoning is off.
        """
        if not self.calibrated:
            self._calibrate(raw, dt_s)
            return NOTHING
        heading_rad = roll_pitch_yaw(self.attitude)[2]
        off = (
            TILT_GAIN_PER_S * drift_mps2[1] / GRAVITY_MPS2,
            -TILT_GAIN_PER_S * drift_mps2[0] / GRAVITY_MPS2,
            HEADING_GAIN_PER_S * wrapped(raw.heading_rad - heading_rad),
        )
        correction = to_world(inverse(self.attitude), off)
        self._bias = moved(self._bias, -BIAS_GAIN_PER_S2 * dt_s, correction)
        rates = difference(raw.rates_radps, self._bias)
        self.attitude = turned(self.attitude, moved(rates, 1.0, correction), dt_s)
        return rates

    def acceleration_mps2(self, raw: RawImu) -> Vector:
        """Return the measured acceleration in the world's axes, gravity taken out."""
        x, y, z = to_world(self.attitude, raw.specific_force_mps2)
        return (x, y, z - GRAVITY_MPS2)

    def _calibrate(self, raw: RawImu, dt_s: float) -> None:
        self._standing_s += dt_s
        newest = dt_s / self._standing_s
        self._bias = moved(self._bias, newest, difference(raw.rates_radps, self._bias))
        felt = difference(raw.specific_force_mps2, self._gravity)
        self._gravity = moved(self._gravity, newest, felt)
        if self._standing_s >= CALIBRATION_S:
            x, y, z = self._gravity
            pitch_rad, roll_rad = math.atan2(-x, math.hypot(y, z)), math.atan2(y, z)
            level = turned((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, raw.heading_rad), 1.0)
            level = turned(level, (0.0, pitch_rad, 0.0), 1.0)
            self.attitude = turned(level, (roll_rad, 0.0, 0.0), 1.0)
            self.calibrated = True


class Navigator:
    """Know the position between GPS fixes, by what the accelerometer felt since.

    What the fixes keep correcting into the same direction is learnt as a drift.
    """

    def __init__(self) -> None:
        """Stand at the origin."""
        self.position_m: Vector = (0.0, 0.0, REST_HEIGHT_M)
        self.velocity_mps: Vector = NOTHING
        self.drift_mps2: Vector = NOTHING

    def predict(self, gained_mps: Vector, dt_s: float) -> None:
        """Go on for a time, in which the accelerometer felt a gain of velocity."""
        before = self.velocity_mps
        self.velocity_mps = moved(moved(before, 1.0, gained_mps), -dt_s, self.drift_mps2)
        passed = moved(before, 1.0, self.velocity_mps)
        self.position_m = moved(self.position_m, 0.5 * dt_s, passed)

    def correct(self, fix: GpsFix) -> None:
        """Move toward what GPS says."""
        ahead_m = difference(fix.position_m, self.position_m)
        faster_mps = difference(fix.velocity_mps, self.velocity_mps)
        self.position_m = moved(self.position_m, POSITION_FROM_POSITION, ahead_m)
        velocity = moved(self.velocity_mps, VELOCITY_FROM_VELOCITY, faster_mps)
        self.velocity_mps = moved(velocity, VELOCITY_FROM_POSITION_PER_S, ahead_m)
        self.drift_mps2 = moved(self.drift_mps2, -DRIFT_FROM_VELOCITY_PER_S, faster_mps)
