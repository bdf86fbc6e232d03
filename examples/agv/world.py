"""The hardware of this example: a MuJoCo model of the vehicle among the racks.

Thread rules. One thread, the motor controller's, owns `World` and steps it. Everyone else reads
`World.snapshot`, an immutable value that is replaced, never changed, after every step: storing
one attribute is atomic, so readers need no lock and see either the old state or the new one.
Sensors cast their rays in an `mjData` of their own (see `sensors.py`), posed from a snapshot.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import mujoco

from agv import layout

if TYPE_CHECKING:
    import numpy as np

TIMESTEP_S = 0.001
MAX_STEPS_PER_TICK = 20
"""A pause of the whole process must not become a jump of the vehicle with its sensors blind."""

RECORD_EVERY_STEPS = 10
DROP_HEIGHT_M = 0.30

# Geom groups: what a ray may hit is chosen by group.
GROUP_BUILDING, GROUP_FLOOR, GROUP_GOODS, GROUP_VEHICLE = 0, 1, 2, 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Pose:
    """Where the vehicle is and how fast it moves: [m], [rad], [m/s], [rad/s]."""

    time_s: float
    x_m: float
    y_m: float
    yaw_rad: float
    speed_mps: float
    turn_radps: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Snapshot:
    """One consistent state of the world; its array is never written again."""

    time_s: float
    qpos: np.ndarray


@dataclass(slots=True)
class Record:
    """What the physics engine itself says about the run; the nodes never see it."""

    track: list[tuple[float, ...]] = field(default_factory=list)
    """Time [s], x [m], y [m], yaw [rad], speed [m/s], clearance to the pallet [m or nan]."""
    min_clearance_m: float = math.inf
    contact_steps: int = 0
    dropped_at_s: float | None = None
    digest: hashlib._Hash = field(default_factory=hashlib.sha256)


def _box(
    rect: layout.Rect, z_min: float, z_max: float, rgba: str, group: int, extra: str = ""
) -> str:
    (x, y), (half_x, half_y) = rect.center, rect.half_size
    return (
        f'<geom type="box" pos="{x} {y} {(z_min + z_max) / 2}" '
        f'size="{half_x} {half_y} {(z_max - z_min) / 2}" rgba="{rgba}" group="{group}" {extra}/>'
    )


def _walls() -> str:
    floor, thick = layout.FLOOR, layout.WALL_THICKNESS_M
    sides = (
        layout.Rect(floor.x_min - thick, floor.y_min - thick, floor.x_max + thick, floor.y_min),
        layout.Rect(floor.x_min - thick, floor.y_max, floor.x_max + thick, floor.y_max + thick),
        layout.Rect(floor.x_min - thick, floor.y_min, floor.x_min, floor.y_max),
        layout.Rect(floor.x_max, floor.y_min, floor.x_max + thick, floor.y_max),
    )
    return "".join(_box(side, 0.0, 2.5, "0.7 0.7 0.7 1", GROUP_BUILDING) for side in sides)


def _wheel(name: str, y: float) -> str:
    return f"""
      <body name="{name}_wheel" pos="0 {y} 0">
        <joint name="{name}" type="hinge" axis="0 1 0" damping="0.05" armature="0.01"/>
        <geom type="ellipsoid" size="{layout.WHEEL_RADIUS_M} 0.03 {layout.WHEEL_RADIUS_M}"
              mass="3" friction="1.2 0.01 0.001" group="{GROUP_VEHICLE}"/>
      </body>"""


def mjcf() -> str:
    """Return the MuJoCo model of the warehouse, the vehicle, the pallet and the carton."""
    racks = "".join(_box(rack, 0.0, 2.0, "0.9 0.55 0.2 1", GROUP_BUILDING) for rack in layout.RACKS)
    carton = layout.Rect.around(*layout.CARTON_AT, *layout.CARTON_HALF_M)
    # The casters carry a little of the weight and slide freely; the driven wheels, on the
    # middle axis, carry the rest and give all of the grip.
    casters = "".join(
        f'<geom type="sphere" size="0.05" pos="{x} {y} -0.048" mass="0.5" '
        f'friction="0.001 0 0" priority="1" group="{GROUP_VEHICLE}"/>'
        for x in (-0.32, 0.32)
        for y in (-0.18, 0.18)
    )
    half_x, half_y = layout.PALLET_HALF_M
    return f"""
<mujoco model="warehouse">
  <option timestep="{TIMESTEP_S}" integrator="implicitfast" cone="elliptic" impratio="4"/>
  <worldbody>
    <geom name="floor" type="plane" pos="7 4.6 0" size="20 20 0.1" group="{GROUP_FLOOR}"/>
    <body name="building">
      {_walls()}{racks}
    </body>
    <body name="carton">
      {_box(carton, 0.0, layout.CARTON_HEIGHT_M, "0.7 0.5 0.3 1", GROUP_GOODS)}
    </body>
    <body name="pallet" pos="{layout.PALLET_PARKED[0]} {layout.PALLET_PARKED[1]} 0">
      <freejoint name="pallet"/>
      <geom type="box" size="{half_x} {half_y} 0.072" pos="0 0 0.072" mass="25"
            rgba="0.6 0.45 0.25 1" group="{GROUP_GOODS}"/>
      <geom type="box" size="{half_x - 0.03} {half_y - 0.03} 0.3" pos="0 0 0.444" mass="120"
            rgba="0.3 0.5 0.8 1" group="{GROUP_GOODS}"/>
    </body>
    <body name="agv" pos="{layout.START[0]} {layout.START[1]} {layout.WHEEL_RADIUS_M}">
      <freejoint name="agv"/>
      <geom name="chassis" type="box" pos="0 0 0.06" mass="60" group="{GROUP_VEHICLE}"
            size="{layout.CHASSIS_HALF_LENGTH_M} {layout.CHASSIS_HALF_WIDTH_M} 0.08"/>
      {casters}
      {_wheel("left", layout.HALF_TRACK_M)}
      {_wheel("right", -layout.HALF_TRACK_M)}
    </body>
  </worldbody>
  <actuator>
    <velocity name="left" joint="left" kv="25" forcerange="-40 40"/>
    <velocity name="right" joint="right" kv="25" forcerange="-40 40"/>
  </actuator>
  <sensor>
    <distance name="pallet_clearance" body1="agv" body2="pallet" cutoff="20"/>
    <contact name="hit_pallet" subtree1="agv" body2="pallet" num="1" data="found"/>
    <contact name="hit_carton" subtree1="agv" body2="carton" num="1" data="found"/>
    <contact name="hit_building" subtree1="agv" body2="building" num="1" data="found"/>
  </sensor>
</mujoco>"""


class World:
    """Own the physics; step it, and publish a snapshot after every step.

    Thread: the motor controller's alone, except for the attribute `snapshot`.
    """

    def __init__(self) -> None:
        """Compile the model and stand at the start."""
        self.model = mujoco.MjModel.from_xml_string(mjcf())
        self._data = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, self._data)
        # Views into mjData are bound once: a lookup by name costs more than a physics step.
        self._qpos, self._qvel = self._data.qpos, self._data.qvel
        self._ctrl, self._sensors = self._data.ctrl, self._data.sensordata
        self._actuator_force = self._data.actuator_force
        agv, pallet = self.model.joint("agv"), self.model.joint("pallet")
        self._agv_q, self._agv_v = int(agv.qposadr[0]), int(agv.dofadr[0])
        self._pallet_q, self._pallet_v = int(pallet.qposadr[0]), int(pallet.dofadr[0])
        self._wheel_v = [int(self.model.joint(n).dofadr[0]) for n in ("left", "right")]
        self._owed_s = 0.0
        self._steps = 0
        self.record = Record()
        self.snapshot = Snapshot(time_s=0.0, qpos=self._qpos.copy())

    def advance(self, dt_s: float, left_radps: float, right_radps: float) -> int:
        """Command the wheels and let physics follow the clock.

        Args:
            dt_s: time since the previous call [s]. A skipped release makes it longer and more
                steps are taken, so the vehicle moves at its true speed; at exactly one
                timestep per call, as in deterministic mode, exactly one step is taken.
            left_radps: wanted speed of the left wheel [rad/s].
            right_radps: wanted speed of the right wheel [rad/s].

        Returns:
            The number of physics steps taken.
        """
        self._ctrl[0], self._ctrl[1] = left_radps, right_radps
        self._owed_s += dt_s
        steps = min(round(self._owed_s / TIMESTEP_S), MAX_STEPS_PER_TICK)
        for _ in range(steps):
            mujoco.mj_step(self.model, self._data)
            self._observe()
        # What the cap cut off is forgotten, not caught up with later.
        self._owed_s = max(-TIMESTEP_S, min(self._owed_s - steps * TIMESTEP_S, TIMESTEP_S))
        self.snapshot = Snapshot(time_s=self._data.time, qpos=self._qpos.copy())
        return steps

    def pose(self) -> Pose:
        """Return the vehicle's pose; stands in for wheel encoders and localisation."""
        q, v = self._agv_q, self._agv_v
        x, y, _, qw, qx, qy, qz = self._qpos[q : q + 7].tolist()
        vx, vy, _, _, _, turn = self._qvel[v : v + 6].tolist()
        yaw = math.atan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz))
        return Pose(
            time_s=self._data.time,
            x_m=x,
            y_m=y,
            yaw_rad=yaw,
            speed_mps=vx * math.cos(yaw) + vy * math.sin(yaw),
            turn_radps=turn,
        )

    def motor_power_w(self) -> float:
        """Return the mechanical power at the wheels [W]."""
        left, right = (float(self._qvel[v]) for v in self._wheel_v)
        force = self._actuator_force
        return abs(left * float(force[0])) + abs(right * float(force[1]))

    def _observe(self) -> None:
        """Keep the record of the run, and drop the pallet when its moment has come."""
        record, sensors = self.record, self._sensors
        if sensors[1] or sensors[2] or sensors[3]:
            record.contact_steps += 1
        clearance_m = math.nan
        if record.dropped_at_s is not None:
            clearance_m = float(sensors[0])
            record.min_clearance_m = min(record.min_clearance_m, clearance_m)
        elif self._qpos[self._agv_q] >= layout.DROP_TRIGGER_X_M:
            self._drop_pallet()
        self._steps += 1
        if self._steps % RECORD_EVERY_STEPS == 0:
            pose = self.pose()
            record.track.append(
                (pose.time_s, pose.x_m, pose.y_m, pose.yaw_rad, pose.speed_mps, clearance_m)
            )
            record.digest.update(self._qpos.tobytes())

    def _drop_pallet(self) -> None:
        q, v = self._pallet_q, self._pallet_v
        self._qpos[q : q + 7] = (*layout.DROP_AT, DROP_HEIGHT_M, 1.0, 0.0, 0.0, 0.0)
        self._qvel[v : v + 6] = 0.0
        self.record.dropped_at_s = self._data.time
