"""The drive: pure pursuit along a path, and wheel speeds that a motor can follow."""

from __future__ import annotations

import math
from enum import StrEnum
from typing import TYPE_CHECKING

from agv import layout
from agv.planner import CRUISE_MPS

if TYPE_CHECKING:
    from agv.world import Pose

ACCELERATION_MPS2 = 1.2
EMERGENCY_MPS2 = 3.5
TURN_ACCELERATION_RADPS2 = 5.0
MAX_TURN_RADPS = 1.7
TURN_GAIN = 3.0
GOVERNOR_MPS2 = 1.0
GOVERNOR_MARGIN_M = 0.45
"""Above the protective field's margin, so that known obstacles slow and never stop the vehicle."""
TURN_IN_PLACE_RAD = math.radians(50.0)
ALIGNED_RAD = math.radians(12.0)
ARRIVED_M = 0.08
STANDING_MPS = 0.01


class DriveState(StrEnum):
    """What the drive is doing."""

    WAITING = "waiting"
    """No path yet, or no way to the goal."""
    DRIVING = "driving"
    EMERGENCY = "e-stop"
    ARRIVED = "arrived"


class Drive:
    """Turn a path into wheel speeds: steer at 100 Hz, ramp at 1 kHz.

    Thread: the motor controller's.
    """

    def __init__(self, acceleration_mps2: float = ACCELERATION_MPS2) -> None:
        """Stand, and wait for a path; speed up and slow down at most so much [m/s²]."""
        self.state = DriveState.WAITING
        self.speed_limit_mps = CRUISE_MPS
        self._acceleration_mps2 = acceleration_mps2
        self._path: list[list[float]] = []
        self._nearest = 0
        self._turning = False
        self._wanted = (0.0, 0.0)
        self._speed = 0.0
        self._turn = 0.0

    def follow(self, path: list[list[float]]) -> None:
        """Follow a new path of [x, y, allowed speed] points; an empty one means wait."""
        self._path, self._nearest = path, 0
        if self.state in {DriveState.WAITING, DriveState.DRIVING}:
            self.state = DriveState.DRIVING if path else DriveState.WAITING

    def emergency_stop(self) -> None:
        """Brake as hard as the wheels allow and forget the path."""
        if self.state is not DriveState.ARRIVED:
            self.state = DriveState.EMERGENCY
        self._path = []

    def release(self) -> None:
        """Leave the emergency stop; the next path moves the vehicle again."""
        if self.state is DriveState.EMERGENCY:
            self.state = DriveState.WAITING

    def keep_clear(self, ahead_m: float) -> None:
        """Limit the speed to what can be shed comfortably within the free distance ahead."""
        room = max(ahead_m - GOVERNOR_MARGIN_M, 0.0)
        self.speed_limit_mps = min(CRUISE_MPS, 0.12 + math.sqrt(2 * GOVERNOR_MPS2 * room))

    def steer(self, pose: Pose) -> None:
        """Decide the wanted speed and turn rate by pure pursuit."""
        self._wanted = (0.0, 0.0)
        if self.state is not DriveState.DRIVING:
            return
        goal_x, goal_y, _ = self._path[-1]
        to_goal = math.hypot(goal_x - pose.x_m, goal_y - pose.y_m)
        if to_goal < ARRIVED_M:
            self.state = DriveState.ARRIVED
            return
        lookahead = 0.3 + 0.35 * abs(pose.speed_mps)
        near, target = self._look_ahead(pose, lookahead)
        bearing = math.atan2(target[1] - pose.y_m, target[0] - pose.x_m)
        off = math.remainder(bearing - pose.yaw_rad, math.tau)
        self._turning = abs(off) > (ALIGNED_RAD if self._turning else TURN_IN_PLACE_RAD)
        if self._turning:
            turn = TURN_GAIN * off
            self._wanted = (0.0, max(-MAX_TURN_RADPS, min(turn, MAX_TURN_RADPS)))
            return
        reach = max(math.hypot(target[0] - pose.x_m, target[1] - pose.y_m), ARRIVED_M)
        curvature = 2 * math.sin(off) / reach
        speed = min(near[2], self.speed_limit_mps, 0.05 + math.sqrt(1.6 * to_goal))
        if abs(curvature) * speed > MAX_TURN_RADPS:
            speed = MAX_TURN_RADPS / abs(curvature)
        self._wanted = (speed, curvature * speed)

    def ramp(self, dt_s: float) -> tuple[float, float]:
        """Move the commanded speeds toward the wanted ones; return left and right [rad/s]."""
        emergency = self.state is DriveState.EMERGENCY
        speed, turn = (0.0, 0.0) if emergency else self._wanted
        speed_step = dt_s * (EMERGENCY_MPS2 if emergency else self._acceleration_mps2)
        turn_step = dt_s * TURN_ACCELERATION_RADPS2
        self._speed += max(-speed_step, min(speed - self._speed, speed_step))
        self._turn += max(-turn_step, min(turn - self._turn, turn_step))
        side = self._turn * layout.HALF_TRACK_M
        return (
            (self._speed - side) / layout.WHEEL_RADIUS_M,
            (self._speed + side) / layout.WHEEL_RADIUS_M,
        )

    def _look_ahead(self, pose: Pose, reach_m: float) -> tuple[list[float], list[float]]:
        """Return the path's point nearest to the vehicle and the one to steer for."""
        path, here = self._path, (pose.x_m, pose.y_m)
        # A path starts at the vehicle, so its nearest point only ever moves forward.
        nearest, distance = self._nearest, math.dist(here, path[self._nearest][:2])
        for index in range(nearest + 1, len(path)):
            further = math.dist(here, path[index][:2])
            if further > distance:
                break
            nearest, distance = index, further
        self._nearest = nearest
        for point in path[nearest:]:
            if math.dist(here, point[:2]) >= reach_m:
                return path[nearest], point
        return path[nearest], path[-1]
