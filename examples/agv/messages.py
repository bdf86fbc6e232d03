"""What the nodes say to each other: topics and the types that travel on them.

Frozen values pass by reference, so a scan is not copied for each of its readers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from agv import sensors
from horus import Sub

if TYPE_CHECKING:
    import numpy as np

    from agv.world import Pose

MOUNTS = {"front": sensors.LIDAR_FRONT, "rear": sensors.LIDAR_REAR}
SCAN_TOPICS = {name: f"scan.{name}" for name in MOUNTS}
# Control wants the newest measurement, not the queue of those it came too late for.
NEWEST_SCANS = [Sub(topic, capacity=1) for topic in SCAN_TOPICS.values()]
NEWEST_ODOM = Sub("odom", capacity=1)


@dataclass(frozen=True, slots=True, kw_only=True)
class Odometry:
    """What the motor controller knows about the vehicle."""

    pose: Pose
    state: str
    power_w: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Obstacles:
    """What the camera pipeline made of one image: points on the map, (n, 2) float64 [m]."""

    occupied: np.ndarray
    free: np.ndarray
