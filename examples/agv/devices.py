"""The sensor nodes: two LiDARs and the camera pipeline."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

import horus
from agv import sensors
from agv.messages import MOUNTS, OBSTACLES, SCAN_TOPICS, SCANS, Obstacles
from agv.mission import DISCONNECTED, MissionLog
from horus import Node

if TYPE_CHECKING:
    from agv.world import World

LIDAR_NOISE_M = 0.004


class LidarNode(Node):
    """Read one LiDAR: cast its beams into a snapshot of the world."""

    def __init__(self, side: str, order: int, world: World, log: MissionLog) -> None:
        """Serve the LiDAR of a side, "front" or "rear"."""
        super().__init__(f"lidar_{side}", rate=40, order=order, pubs=[SCANS[side]])
        self._side, self._world, self._log = side, world, log
        self._lidar: sensors.Lidar | None = None

    def init(self) -> None:
        """Connect to the device."""
        self._lidar = sensors.Lidar(self._world.model, MOUNTS[self._side])

    def tick(self) -> None:
        """Take one scan."""
        if self._lidar is not None:
            # Noise from the framework's random numbers repeats itself in deterministic mode.
            noise = np.random.default_rng(int(horus.rng_float() * 2**53))
            view = self._lidar.cast(self._world.snapshot, noise, LIDAR_NOISE_M)
            self.send(SCAN_TOPICS[self._side], view)

    def shutdown(self) -> None:
        """Disconnect from the device."""
        self._lidar = None
        self._log.add(self.name, DISCONNECTED)


class CameraNode(Node):
    """Take depth images and segment them into what stands on the floor and the floor."""

    def __init__(self, world: World, log: MissionLog) -> None:
        """Look into a world; note the disconnection in a log."""
        super().__init__("camera", rate=10, order=20, pubs=[OBSTACLES])
        self._world, self._log = world, log
        self._pipeline = sensors.CameraPipeline()
        self._camera: sensors.DepthCamera | None = None

    def init(self) -> None:
        """Connect to the device."""
        self._camera = sensors.DepthCamera(self._world.model)

    def tick(self) -> None:
        """Take and segment one image."""
        if self._camera is not None:
            occupied, free = self._pipeline.segment(self._camera.cast(self._world.snapshot))
            self.send("obstacles", Obstacles(occupied=occupied, free=free))

    def shutdown(self) -> None:
        """Disconnect from the device."""
        self._camera = None
        self._log.add(self.name, DISCONNECTED)
