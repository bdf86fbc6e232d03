"""The protective field: when must the vehicle stop, and when may it go on?

Pure decisions on scan points and speed; the safety node feeds them and publishes the verdict.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from agv import layout
from agv.sensors import Mount, View, lidar_directions

BRAKE_MPS2 = 2.5
"""What the brakes are counted on for; they do better (`drive.EMERGENCY_MPS2`)."""
REACTION_S = 0.12
MARGIN_M = 0.25
STANDING_M = 0.08
BODY_GAP_M = 0.04
SIDE_GAP_M = 0.07
CREEP_MPS = 0.05
HOLD_S = 1.5
SILENCE_S = 0.3
FAR_M = 12.0


def field_length_m(speed_mps: float) -> float:
    """Return how far ahead of the bumper must be free to stop from a speed [m]."""
    if speed_mps < CREEP_MPS:
        return STANDING_M
    return MARGIN_M + REACTION_S * speed_mps + speed_mps**2 / (2 * BRAKE_MPS2)


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """What the protective field says right now."""

    ahead_m: float
    """Free distance from the front bumper, within the vehicle's width."""
    reason: str | None
    """Why the vehicle must stop; None when it may drive."""


class ProtectiveField:
    """Judge the latest scans of both LiDARs against the vehicle's outline and speed."""

    def __init__(self, mounts: dict[str, Mount]) -> None:
        """Judge scans of the LiDARs with these names and mounts."""
        self._mounts = mounts
        self._beams = {n: lidar_directions(mount)[:, :2] for n, mount in mounts.items()}
        self._ahead = dict.fromkeys(mounts, FAR_M)
        self._gap = dict.fromkeys(mounts, FAR_M)

    def update(self, name: str, view: View) -> None:
        """Take in a scan of the LiDAR of that name."""
        hit = np.isfinite(view.ranges_m)
        points = self._beams[name][hit] * view.ranges_m[hit, None]
        x, y = points[:, 0] + self._mounts[name].forward_m, points[:, 1]
        half_length, half_width = layout.CHASSIS_HALF_LENGTH_M, layout.CHASSIS_HALF_WIDTH_M
        corridor = (x > half_length) & (np.abs(y) < half_width + SIDE_GAP_M)
        self._ahead[name] = float(np.min(x[corridor], initial=FAR_M)) - half_length
        outside = np.hypot(
            np.maximum(np.abs(x) - half_length, 0.0), np.maximum(np.abs(y) - half_width, 0.0)
        )
        self._gap[name] = float(np.min(outside, initial=FAR_M))

    def judge(self, speed_mps: float) -> Verdict:
        """Return whether the vehicle may drive at that speed."""
        ahead, gap = min(self._ahead.values()), min(self._gap.values())
        reason = None
        if ahead < field_length_m(speed_mps):
            reason = f"obstacle {ahead:.2f} m ahead at {speed_mps:.2f} m/s"
        elif gap < BODY_GAP_M:
            reason = f"obstacle {gap:.2f} m beside the vehicle"
        return Verdict(ahead_m=ahead, reason=reason)


class StopLatch:
    """Hold a stop until the vehicle stands and has been free to go for a while."""

    def __init__(self) -> None:
        """Start released."""
        self.stopped = False
        self._free_since_s = 0.0

    def update(self, now_s: float, speed_mps: float, reason: str | None) -> str | None:
        """Take in a verdict; return "stop" or "clear" when that changed, else None."""
        standing = abs(speed_mps) < CREEP_MPS
        if reason is not None or not standing:
            self._free_since_s = now_s
        if reason is not None and not self.stopped:
            self.stopped = True
            return "stop"
        if self.stopped and now_s - self._free_since_s >= HOLD_S:
            self.stopped = False
            return "clear"
        return None
