"""Two LiDARs and a depth camera, simulated by casting rays into the physics model.

Every sensor owns an `mjData`: it copies a snapshot's positions in, computes where the geoms
are, and casts its rays there, while the motor controller's thread goes on stepping the world.
Nothing is locked and nothing is shared but the model, which nobody writes to.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np

from agv import layout
from agv.world import GROUP_BUILDING, GROUP_FLOOR, GROUP_GOODS, Snapshot

MAX_RANGE_M = 12.0
LIDAR_HALF_FOV_RAD = math.radians(120.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Mount:
    """Where a sensor sits on the vehicle: [m] from its middle, [rad] from its axes."""

    forward_m: float
    height_m: float
    yaw_rad: float = 0.0
    pitch_rad: float = 0.0
    """Positive looks down."""


LIDAR_FRONT = Mount(forward_m=layout.CHASSIS_HALF_LENGTH_M, height_m=0.20)
LIDAR_REAR = Mount(forward_m=-layout.CHASSIS_HALF_LENGTH_M, height_m=0.20, yaw_rad=math.pi)
CAMERA = Mount(forward_m=0.35, height_m=0.60, pitch_rad=math.radians(28.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """One measurement along a fixed bundle of rays."""

    time_s: float
    x_m: float
    y_m: float
    yaw_rad: float
    """The vehicle's pose when the rays were cast; a localised sensor stamps its data so."""
    ranges_m: np.ndarray
    """(n_rays,) float64 [m]; inf where nothing was hit."""


class RayBundle:
    """Cast a fixed bundle of rays from a mount on the vehicle.

    Thread: the thread of the node that owns it.
    """

    def __init__(
        self, model: mujoco.MjModel, mount: Mount, directions: np.ndarray, *groups: int
    ) -> None:
        """Prepare the bundle.

        Args:
            model: the world's model; shared, read only.
            mount: where the sensor sits.
            directions: (n_rays, 3) float64, unit vectors in the vehicle's axes.
            groups: the geom groups that the rays can hit.
        """
        self._model, self._mount = model, mount
        self._data = mujoco.MjData(model)
        self._directions = directions
        self._groups = np.zeros(mujoco.mjNGROUP, dtype=np.uint8)
        self._groups[list(groups)] = 1
        self._geom_ids = np.empty(len(directions), dtype=np.int32)
        self._distances = np.empty(len(directions))
        self._agv_q = int(model.joint("agv").qposadr[0])
        self._body = model.body("agv").id

    def cast(
        self, snapshot: Snapshot, noise: np.random.Generator | None = None, sigma_m: float = 0.0
    ) -> View:
        """Return what the rays hit in the world of a snapshot, with normal noise if given."""
        model, data = self._model, self._data
        data.qpos[:] = snapshot.qpos
        mujoco.mj_kinematics(model, data)
        rotation = data.xmat[self._body].reshape(3, 3)
        origin = data.xpos[self._body] + rotation @ (
            self._mount.forward_m,
            0.0,
            self._mount.height_m - layout.WHEEL_RADIUS_M,
        )
        mujoco.mj_multiRay(
            model,
            data,
            origin,
            (self._directions @ rotation.T).ravel(),
            self._groups,
            True,
            -1,
            self._geom_ids,
            self._distances,
            None,
            len(self._distances),
            MAX_RANGE_M,
        )
        ranges_m = np.where(self._geom_ids >= 0, self._distances, np.inf)
        if noise is not None:
            ranges_m += noise.normal(0.0, sigma_m, len(ranges_m))
        ranges_m.flags.writeable = False
        return View(
            time_s=snapshot.time_s,
            x_m=float(data.xpos[self._body, 0]),
            y_m=float(data.xpos[self._body, 1]),
            yaw_rad=math.atan2(rotation[1, 0], rotation[0, 0]),
            ranges_m=ranges_m,
        )


def lidar_directions(mount: Mount) -> np.ndarray:
    """Return one unit vector per beam, (180, 3) float64, in the vehicle's axes: 240 degrees."""
    angles = mount.yaw_rad + np.linspace(-LIDAR_HALF_FOV_RAD, LIDAR_HALF_FOV_RAD, 180)
    return np.column_stack((np.cos(angles), np.sin(angles), np.zeros_like(angles)))


class Lidar(RayBundle):
    """A planar scanner of 180 beams that sees racks and goods above its scan plane."""

    def __init__(self, model: mujoco.MjModel, mount: Mount) -> None:
        """Sit on a mount of the vehicle in a model."""
        super().__init__(model, mount, lidar_directions(mount), GROUP_BUILDING, GROUP_GOODS)


IMAGE_WIDTH, IMAGE_HEIGHT = 32, 24
LOW_OBSTACLE_M = 0.05
CAMERA_REACH_M = 3.5


def camera_directions() -> np.ndarray:
    """Return one unit vector per pixel, (24 * 32, 3) float64, in the vehicle's axes."""
    tangent_x = np.linspace(math.tan(0.6), -math.tan(0.6), IMAGE_WIDTH)
    tangent_y = np.linspace(math.tan(0.45), -math.tan(0.45), IMAGE_HEIGHT)
    up, left = np.meshgrid(tangent_y, tangent_x, indexing="ij")
    rays = np.stack((np.ones_like(up), left, up), axis=-1).reshape(-1, 3)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    cos, sin = math.cos(CAMERA.pitch_rad), math.sin(CAMERA.pitch_rad)
    turned: np.ndarray = rays @ np.array(((cos, 0.0, -sin), (0.0, 1.0, 0.0), (sin, 0.0, cos)))
    return turned


class DepthCamera(RayBundle):
    """A 32 x 24 depth image by ray casts: offscreen rendering would need an OpenGL driver."""

    def __init__(self, model: mujoco.MjModel) -> None:
        """Sit at `CAMERA` on the vehicle in a model."""
        super().__init__(
            model, CAMERA, camera_directions(), GROUP_BUILDING, GROUP_FLOOR, GROUP_GOODS
        )


def to_map(view: View, mount: Mount, directions: np.ndarray) -> np.ndarray:
    """Return the points that a view's rays hit, (n_hits, 3) float64 [m], in the map's axes."""
    hit = np.isfinite(view.ranges_m)
    points = directions[hit] * view.ranges_m[hit, None]
    points += (mount.forward_m, 0.0, mount.height_m)
    cos, sin = math.cos(view.yaw_rad), math.sin(view.yaw_rad)
    x = view.x_m + points[:, 0] * cos - points[:, 1] * sin
    y = view.y_m + points[:, 0] * sin + points[:, 1] * cos
    return np.column_stack((x, y, points[:, 2]))


class CameraPipeline:
    """Turn depth images into obstacle and free floor points on the map."""

    def __init__(self) -> None:
        """Compute the directions of the pixels."""
        self._directions = camera_directions()

    def segment(self, view: View) -> tuple[np.ndarray, np.ndarray]:
        """Separate what stands on the floor from the floor.

        Returns:
            Obstacle points and floor points, (n, 2) float64 [m] each, in the map's axes.
        """
        points = to_map(view, CAMERA, self._directions)
        near = np.hypot(points[:, 0] - view.x_m, points[:, 1] - view.y_m) < CAMERA_REACH_M
        points = points[near]
        stands = points[:, 2] > LOW_OBSTACLE_M
        return points[stands, :2], points[~stands, :2]
