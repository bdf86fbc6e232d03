"""The quadrotor on paper: its dimensions, its limits and the MuJoCo model made of them.

The controllers are tuned for the same constants, so the model and they can never disagree.
"""

from __future__ import annotations

from dataclasses import dataclass

GRAVITY_MPS2 = 9.81
TIMESTEP_S = 0.00125
"""Two physics steps make one period of the 400 Hz control loop."""

ARM_M = 0.13
"""How far each rotor is from the middle, along x and along y."""
FRAME_HALF_M = (0.09, 0.09, 0.03)
FRAME_KG, ROTOR_KG = 0.60, 0.08
MASS_KG = FRAME_KG + 4 * ROTOR_KG
REST_HEIGHT_M = 0.10
"""Height of the middle of the frame when the legs stand on the ground."""
FOOT_RADIUS_M = 0.02

MAX_THRUST_N = 5.5
HOVER_THRUST_N = MASS_KG * GRAVITY_MPS2 / 4
MOTOR_LAG_S = 0.03
"""Time constant with which a rotor's thrust follows its command."""
YAW_TORQUE_M = 0.016
"""Drag torque of a rotor for each newton of its thrust [N m / N]."""


def _inertia() -> tuple[float, float, float]:
    x, y, z = FRAME_HALF_M
    rotors = 4 * ROTOR_KG * ARM_M**2
    return (
        FRAME_KG / 3 * (y * y + z * z) + rotors,
        FRAME_KG / 3 * (x * x + z * z) + rotors,
        FRAME_KG / 3 * (x * x + y * y) + 2 * rotors,
    )


INERTIA_KGM2 = _inertia()
"""Principal moments of a box and four point masses."""


@dataclass(frozen=True, slots=True)
class Rotor:
    """Where a rotor sits, in front (+x) or behind, left (+y) or right, and how it turns."""

    name: str
    x_sign: int
    y_sign: int
    yaw_sign: int
    """The sign of the torque about z that its drag puts on the frame."""


ROTORS = (
    Rotor("front_left", 1, 1, -1),
    Rotor("front_right", 1, -1, 1),
    Rotor("rear_right", -1, -1, -1),
    Rotor("rear_left", -1, 1, 1),
)


def _rotor_geoms(rotor: Rotor) -> str:
    x, y = rotor.x_sign * ARM_M, rotor.y_sign * ARM_M
    foot_z = FOOT_RADIUS_M - REST_HEIGHT_M
    # Discs, arms and legs have no mass of their own: the inertia stays that of `_inertia`.
    return f"""
      <geom type="cylinder" size="0.012 0.012" pos="{x} {y} 0" mass="{ROTOR_KG}"/>
      <geom type="cylinder" size="0.1 0.004" pos="{x} {y} 0.02" mass="0" contype="0"
            conaffinity="0" rgba="0.2 0.5 0.8 0.4"/>
      <geom type="capsule" size="0.008" fromto="0 0 0 {x} {y} 0" mass="0"/>
      <geom type="sphere" size="{FOOT_RADIUS_M}" pos="{x} {y} {foot_z}" mass="0"
            friction="0.8 0.02 0.001"/>
      <site name="{rotor.name}" pos="{x} {y} 0"/>"""


def _motor(rotor: Rotor) -> str:
    return (
        f'<general name="{rotor.name}" site="{rotor.name}" '
        f'gear="0 0 1 0 0 {rotor.yaw_sign * YAW_TORQUE_M}" ctrlrange="0 {MAX_THRUST_N}" '
        f'dyntype="filterexact" dynprm="{MOTOR_LAG_S}"/>'
    )


def mjcf() -> str:
    """Return the MuJoCo model of the quadrotor over a field, in air that can move."""
    half_x, half_y, half_z = FRAME_HALF_M
    return f"""
<mujoco model="quadrotor">
  <option timestep="{TIMESTEP_S}" integrator="implicitfast" gravity="0 0 {-GRAVITY_MPS2}"
          density="1.2" viscosity="1.8e-5"/>
  <worldbody>
    <geom type="plane" size="20 20 0.1"/>
    <body name="drone" pos="0 0 {REST_HEIGHT_M}">
      <freejoint name="drone"/>
      <geom type="box" size="{half_x} {half_y} {half_z}" mass="{FRAME_KG}"/>
      <site name="imu"/>
      {"".join(_rotor_geoms(rotor) for rotor in ROTORS)}
    </body>
  </worldbody>
  <actuator>{"".join(_motor(rotor) for rotor in ROTORS)}</actuator>
  <sensor>
    <accelerometer site="imu"/>
  </sensor>
</mujoco>"""
