"""What the nodes say to each other: topics and the types that travel on them.

Frozen values pass by reference, so a scan is not copied for each of its readers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from agv import sensors
from horus import Pub, Sub
from horus.foxglove import FrameTransform, LaserScan, PointCloud, Pose

if TYPE_CHECKING:
    import numpy as np

    from agv import world

MOUNTS = {"front": sensors.LIDAR_FRONT, "rear": sensors.LIDAR_REAR}
SCAN_TOPICS = {name: f"scan.{name}" for name in MOUNTS}
# Control wants the newest measurement, not the queue of those it came too late for.
NEWEST_SCANS = [Sub(topic, capacity=1) for topic in SCAN_TOPICS.values()]
NEWEST_ODOM = Sub("odom", capacity=1)

# How a recording shows them in Foxglove: the vehicle moves on the map, its LiDARs move with it.
SCANS = {
    name: Pub(
        SCAN_TOPICS[name],
        foxglove=LaserScan(
            frame_id="agv",
            pose=Pose(x=mount.forward_m, z=mount.height_m, yaw=mount.yaw_rad),
            start_angle=-sensors.LIDAR_HALF_FOV_RAD,
            end_angle=sensors.LIDAR_HALF_FOV_RAD,
            ranges="ranges_m",
        ),
    )
    for name, mount in MOUNTS.items()
}
ODOM = Pub(
    "odom",
    foxglove=FrameTransform(
        parent_frame_id="map",
        child_frame_id="agv",
        pose=Pose(x="pose.x_m", y="pose.y_m", yaw="pose.yaw_rad"),
    ),
)
OBSTACLES = Pub(
    "obstacles", foxglove=PointCloud(frame_id="map", points="occupied", fields=("x", "y"))
)
PATH = Pub("path", foxglove=PointCloud(frame_id="map", points="", fields=("x", "y")))


@dataclass(frozen=True, slots=True, kw_only=True)
class Odometry:
    """What the motor controller knows about the vehicle."""

    pose: world.Pose
    state: str
    power_w: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Obstacles:
    """What the camera pipeline made of one image: points on the map, (n, 2) float64 [m]."""

    occupied: np.ndarray
    free: np.ndarray
