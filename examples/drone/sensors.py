"""The sensors: a nine-axis IMU and a GPS receiver with RTK corrections, with their faults."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from drone.geometry import roll_pitch_yaw

if TYPE_CHECKING:
    from drone.geometry import Vector
    from drone.world import Snapshot

GYRO_NOISE_RADPS = 0.004
GYRO_BIAS_RADPS = 0.02
ACCELEROMETER_NOISE_MPS2 = 0.08
ACCELEROMETER_BIAS_MPS2 = 0.05
HEADING_NOISE_RAD = math.radians(1.5)
GPS_POSITION_NOISE_M = (0.015, 0.015, 0.025)
GPS_VELOCITY_NOISE_MPS = 0.04


@dataclass(frozen=True, slots=True, kw_only=True)
class RawImu:
    """What the IMU says: the truth, its biases and noise."""

    time_s: float
    """When it was measured, by the device's own clock."""
    rates_radps: Vector
    specific_force_mps2: Vector
    heading_rad: float
    """From the magnetometer."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GpsFix:
    """What the GPS receiver says."""

    position_m: Vector
    velocity_mps: Vector


class Imu:
    """Gyroscope, accelerometer and magnetometer.

    Thread: one.
    """

    def __init__(self, seed: int) -> None:
        """Draw the biases that this device has for the whole flight."""
        self._random = np.random.default_rng((seed, 0))
        spread = [GYRO_BIAS_RADPS] * 3 + [ACCELEROMETER_BIAS_MPS2] * 3 + [0.0]
        self._bias = self._random.normal(0.0, spread)
        self._sigma = np.array(
            [GYRO_NOISE_RADPS] * 3 + [ACCELEROMETER_NOISE_MPS2] * 3 + [HEADING_NOISE_RAD]
        )

    def read(self, state: Snapshot) -> RawImu:
        """Measure a state."""
        off = (self._bias + self._sigma * self._random.standard_normal(7)).tolist()
        p, q, r = state.rates_radps
        x, y, z = state.specific_force_mps2
        return RawImu(
            time_s=state.time_s,
            rates_radps=(p + off[0], q + off[1], r + off[2]),
            specific_force_mps2=(x + off[3], y + off[4], z + off[5]),
            heading_rad=roll_pitch_yaw(state.attitude)[2] + off[6],
        )


class Gps:
    """A receiver that knows its position to about two centimetres.

    Thread: one.
    """

    def __init__(self, seed: int) -> None:
        """Start with a noise of its own."""
        self._random = np.random.default_rng((seed, 1))
        self._sigma = np.array([*GPS_POSITION_NOISE_M, *[GPS_VELOCITY_NOISE_MPS] * 3])

    def read(self, state: Snapshot) -> GpsFix:
        """Measure a state."""
        off = (self._sigma * self._random.standard_normal(6)).tolist()
        x, y, z = state.position_m
        vx, vy, vz = state.velocity_mps
        return GpsFix(
            position_m=(x + off[0], y + off[1], z + off[2]),
            velocity_mps=(vx + off[3], vy + off[4], vz + off[5]),
        )
