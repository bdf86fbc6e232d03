"""Control: the inner loop on attitude, the outer loop on position, and the mixer.

Everything that integrates takes the time that has really passed, so a late or skipped tick
changes how often the loops act, not what they compute.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from drone import airframe
from drone.airframe import GRAVITY_MPS2, HOVER_THRUST_N, INERTIA_KGM2, MASS_KG, MAX_THRUST_N
from drone.geometry import wrapped

if TYPE_CHECKING:
    from drone.course import Reference
    from drone.geometry import Vector

Thrusts = tuple[float, float, float, float]
OFF: Thrusts = (0.0, 0.0, 0.0, 0.0)

MAX_TILT_RAD = math.radians(30.0)
MIN_THRUST_N, MAX_COLLECTIVE_N = 0.8 * HOVER_THRUST_N, 0.85 * 4 * MAX_THRUST_N
IDLE_THRUST_N = 0.05 * MAX_THRUST_N

ANGLE_GAIN_PER_S = (7.0, 7.0, 3.0)
RATE_GAIN_PER_S = (22.0, 22.0, 8.0)
RATE_INTEGRAL_PER_S2 = (25.0, 25.0, 5.0)
MAX_RATE_RADPS = (4.0, 4.0, 1.5)
MAX_TRIM_RADPS2 = 12.0

POSITION_GAIN_PER_S2 = (6.0, 6.0, 9.0)
VELOCITY_GAIN_PER_S = (4.0, 4.0, 5.0)
POSITION_INTEGRAL_PER_S3 = (3.0, 3.0, 4.0)
MAX_TRIM_MPS2 = 2.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Setpoint:
    """What the outer loop asks of the inner one."""

    roll_rad: float
    pitch_rad: float
    yaw_rad: float
    thrust_n: float
    """Of all rotors together."""
    armed: bool = True

    def level(self) -> Setpoint:
        """Return the same thrust and heading, flying level."""
        return Setpoint(
            roll_rad=0.0,
            pitch_rad=0.0,
            yaw_rad=self.yaw_rad,
            thrust_n=self.thrust_n,
            armed=self.armed,
        )


DISARMED = Setpoint(roll_rad=0.0, pitch_rad=0.0, yaw_rad=0.0, thrust_n=0.0, armed=False)


def clamp(value: float, limit: float) -> float:
    """Return the value, no further from zero than a limit."""
    return max(-limit, min(value, limit))


def mix(thrust_n: float, torque_nm: Vector) -> Thrusts:
    """Share a thrust and a torque among the rotors.

    When a rotor would leave its range, staying upright comes before height, and both come
    before heading.
    """
    about_x, about_y, about_z = (
        torque_nm[0] / (4 * airframe.ARM_M),
        torque_nm[1] / (4 * airframe.ARM_M),
        torque_nm[2] / (4 * airframe.YAW_TORQUE_M),
    )
    tilting = [r.y_sign * about_x - r.x_sign * about_y for r in airframe.ROTORS]
    most = max(max(tilting), -min(tilting))
    if 2 * most > MAX_THRUST_N:
        tilting = [each * MAX_THRUST_N / (2 * most) for each in tilting]
        most = 0.5 * MAX_THRUST_N
    each_n = max(most, min(0.25 * thrust_n, MAX_THRUST_N - most))
    heading = clamp(about_z, min(each_n - most, MAX_THRUST_N - most - each_n))
    a, b, c, d = (
        each_n + tilt + rotor.yaw_sign * heading
        for tilt, rotor in zip(tilting, airframe.ROTORS, strict=True)
    )
    return (a, b, c, d)


class Stabiliser:
    """The inner loop: from attitude to rates to torque to thrusts.

    Thread: one.
    """

    def __init__(self) -> None:
        """Start without trim."""
        self._trim = [0.0, 0.0, 0.0]

    def reset(self) -> None:
        """Forget what was learnt about the trim."""
        self._trim = [0.0, 0.0, 0.0]

    def thrusts(self, angles: Vector, rates: Vector, setpoint: Setpoint, dt_s: float) -> Thrusts:
        """Return what each rotor should push [N].

        Args:
            angles: roll, pitch, yaw [rad].
            rates: angular velocity in the body's axes [rad/s].
            setpoint: the wanted attitude and thrust.
            dt_s: time since the previous call [s].
        """
        if not setpoint.armed:
            self.reset()
            return OFF
        errors = (
            setpoint.roll_rad - angles[0],
            setpoint.pitch_rad - angles[1],
            wrapped(setpoint.yaw_rad - angles[2]),
        )
        # On the ground the legs hold the attitude: there is no trim to learn there.
        flying = setpoint.thrust_n > MIN_THRUST_N
        torque = []
        for axis in range(3):
            wanted = clamp(ANGLE_GAIN_PER_S[axis] * errors[axis], MAX_RATE_RADPS[axis])
            error = wanted - rates[axis]
            if flying:
                trim = self._trim[axis] + RATE_INTEGRAL_PER_S2[axis] * error * dt_s
                self._trim[axis] = clamp(trim, MAX_TRIM_RADPS2)
            torque.append(INERTIA_KGM2[axis] * (RATE_GAIN_PER_S[axis] * error + self._trim[axis]))
        return mix(setpoint.thrust_n, (torque[0], torque[1], torque[2]))


def attitude_for(acceleration_mps2: Vector, yaw_rad: float) -> Setpoint:
    """Return the attitude and the thrust that accelerate the drone so, gravity added."""
    x, y, z = acceleration_mps2
    up = max(z + GRAVITY_MPS2, 0.3 * GRAVITY_MPS2)
    sideways, most = math.hypot(x, y), up * math.tan(MAX_TILT_RAD)
    if sideways > most:
        x, y = x * most / sideways, y * most / sideways
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    forward, left = cos * x + sin * y, cos * y - sin * x
    length = math.sqrt(forward * forward + left * left + up * up)
    return Setpoint(
        roll_rad=math.asin(-left / length),
        pitch_rad=math.atan2(forward, up),
        yaw_rad=yaw_rad,
        thrust_n=min(MASS_KG * length, MAX_COLLECTIVE_N),
    )


class PositionController:
    """The outer loop: PID on position, fed forward with the reference's own acceleration.

    Thread: one.
    """

    def __init__(self) -> None:
        """Start without trim."""
        self._trim: Vector = (0.0, 0.0, 0.0)

    def acceleration(
        self, reference: Reference, position_m: Vector, velocity_mps: Vector, dt_s: float
    ) -> Vector:
        """Return the acceleration that brings the drone to its reference [m/s^2].

        Args:
            reference: where the drone should be.
            position_m: where it is.
            velocity_mps: how it moves.
            dt_s: time since the previous call [s].
        """
        trim, result = [], []
        for axis in range(3):
            off_m = reference.position_m[axis] - position_m[axis]
            off_mps = reference.velocity_mps[axis] - velocity_mps[axis]
            learnt = self._trim[axis] + POSITION_INTEGRAL_PER_S3[axis] * clamp(off_m, 0.5) * dt_s
            trim.append(clamp(learnt, MAX_TRIM_MPS2))
            result.append(
                reference.acceleration_mps2[axis]
                + POSITION_GAIN_PER_S2[axis] * off_m
                + VELOCITY_GAIN_PER_S[axis] * off_mps
                + trim[axis]
            )
        self._trim = (trim[0], trim[1], trim[2])
        return (result[0], result[1], result[2])
