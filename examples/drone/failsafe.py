"""The ESC board's own way down, for when nobody sends motor commands any more.

A drone must not fly on with stale motor commands, and must not fall out of the sky either. The
board carries small sensors of its own, here perfect ones, and comes down with the wind.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from drone.airframe import MOTOR_LAG_S, REST_HEIGHT_M
from drone.control import OFF, Stabiliser, attitude_for
from drone.geometry import roll_pitch_yaw

if TYPE_CHECKING:
    from drone.control import Thrusts
    from drone.world import Snapshot, World

SINK_MPS = 1.0
FLARE_MPS = 0.3
FLARE_BELOW_M = 0.4
BRAKE_PER_S = 1.2
SINK_GAIN_PER_S = 4.0
MAX_BRAKE_MPS2 = 3.0
TOUCH_M = 0.01

STEP_S = 0.0025
LONGEST_S = 10.0
SPIN_DOWN_S = 10 * MOTOR_LAG_S


class Descent:
    """Level out, shed the speed, sink, and cut the motors on the ground.

    Thread: one.
    """

    def __init__(self) -> None:
        """Take over whatever the drone is doing."""
        self.down = False
        self._stabiliser = Stabiliser()
        self._yaw_rad: float | None = None

    def thrusts(self, state: Snapshot, dt_s: float) -> Thrusts:
        """Return what each rotor should push [N] in a state of the drone."""
        angles = roll_pitch_yaw(state.attitude)
        if self._yaw_rad is None:
            self._yaw_rad = angles[2]
        height_m = state.position_m[2] - REST_HEIGHT_M
        vx, vy, vz = state.velocity_mps
        # Standing or rolled over: either way there is nothing left to fly.
        self.down = self.down or (height_m < TOUCH_M and abs(vz) < FLARE_MPS)
        if self.down:
            return OFF
        speed_mps = math.hypot(vx, vy)
        gain = min(BRAKE_PER_S, MAX_BRAKE_MPS2 / max(speed_mps, 1e-6))
        sink_mps = SINK_MPS if height_m > FLARE_BELOW_M else FLARE_MPS
        setpoint = attitude_for(
            (-gain * vx, -gain * vy, SINK_GAIN_PER_S * (-sink_mps - vz)), self._yaw_rad
        )
        return self._stabiliser.thrusts(angles, state.rates_radps, setpoint, dt_s)


def stop_motors(world: World, descent: Descent | None) -> None:
    """Bring the drone down if it is flying, cut the motors and wait until they stand.

    Args:
        world: the drone; the caller's thread owns it.
        descent: the way down, begun already or not; None if there is none to go.
    """
    if descent is not None:
        for _ in range(round(LONGEST_S / STEP_S)):
            if descent.down:
                break
            world.advance(STEP_S, descent.thrusts(world.snapshot, STEP_S))
    for _ in range(round(SPIN_DOWN_S / STEP_S)):
        world.advance(STEP_S, OFF)
