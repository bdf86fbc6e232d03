"""The hardware of this example: a MuJoCo quadrotor in a breeze.

Thread rules. One thread, the ESC's, owns `World` and steps it. Everyone else reads
`World.snapshot`, an immutable value that is replaced, never changed, after every advance: storing
one attribute is atomic, so readers need no lock and see either the old state or the new one.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import mujoco

from drone import airframe
from drone.airframe import TIMESTEP_S

if TYPE_CHECKING:
    from collections.abc import Sequence

    from drone.geometry import Quaternion, Vector

MAX_ADVANCE_S = 0.025
"""A pause of the whole process must not become a flight with the controllers blind."""
_MAX_STEPS = round(MAX_ADVANCE_S / TIMESTEP_S)

RECORD_EVERY_STEPS = 8
BREEZE_MPS = (2.5, 1.0, 0.0)
GUST_MPS = 4.0
"""How much the wind rises at the peak of the gust."""
GUST_BEGIN_S, GUST_LENGTH_S = 11.0, 3.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Snapshot:
    """One consistent state of the drone, as its sensors could feel it."""

    time_s: float
    rates_radps: Vector
    """Angular velocity in the body's axes."""
    specific_force_mps2: Vector
    """What an accelerometer feels, in the body's axes: 9.81 upward when standing."""
    attitude: Quaternion
    position_m: Vector
    velocity_mps: Vector


@dataclass(slots=True)
class Record:
    """What the physics engine itself says about the flight; the nodes never see it."""

    track: list[tuple[float, ...]] = field(default_factory=list)
    """Time [s], position [m] (3), speed [m/s], tilt [rad], thrust of each rotor [N] (4)."""
    digest: hashlib._Hash = field(default_factory=hashlib.sha256)


def wind_mps(time_s: float) -> Vector:
    """Return the wind at a time: a breeze, and one gust along it [m/s]."""
    phase = (time_s - GUST_BEGIN_S) / GUST_LENGTH_S
    if not 0.0 < phase < 1.0:
        return BREEZE_MPS
    rise = GUST_MPS * 0.5 * (1.0 - math.cos(math.tau * phase)) / math.hypot(*BREEZE_MPS)
    x, y, z = BREEZE_MPS
    return (x * (1 + rise), y * (1 + rise), z * (1 + rise))


class World:
    """Own the physics; step it, and publish a snapshot after every advance.

    Thread: the ESC's alone, except for the attribute `snapshot`.
    """

    def __init__(self) -> None:
        """Compile the model and stand on the ground."""
        self.model = mujoco.MjModel.from_xml_string(airframe.mjcf())
        self._data = mujoco.MjData(self.model)
        # The first step of a process takes several times as long: not in the first tick.
        mujoco.mj_step(self.model, self._data)
        mujoco.mj_resetData(self.model, self._data)
        mujoco.mj_forward(self.model, self._data)
        # Views into mjData are bound once: a lookup by name costs more than a physics step.
        self._qpos, self._qvel = self._data.qpos, self._data.qvel
        self._felt = self._data.sensordata
        self._ctrl, self._thrusts = self._data.ctrl, self._data.act
        self._wind = self.model.opt.wind
        self._owed_s = 0.0
        self._steps = 0
        self.record = Record()
        self.snapshot = self._take_snapshot()

    def advance(self, dt_s: float, thrusts_n: Sequence[float]) -> None:
        """Command the rotors and let physics follow the clock.

        Args:
            dt_s: time since the previous call [s]. A skipped release makes it longer and more
                steps are taken, so the drone falls and flies at its true speed; what exceeds
                `MAX_ADVANCE_S` is forgotten.
            thrusts_n: wanted thrust of each rotor, in the order of `airframe.ROTORS` [N].
        """
        self._ctrl[:] = thrusts_n
        self._owed_s += dt_s
        steps = min(round(self._owed_s / TIMESTEP_S), _MAX_STEPS)
        self._owed_s = max(-TIMESTEP_S, min(self._owed_s - steps * TIMESTEP_S, TIMESTEP_S))
        last = self._steps + steps
        while self._steps < last:
            until_record = RECORD_EVERY_STEPS - self._steps % RECORD_EVERY_STEPS
            if until_record == RECORD_EVERY_STEPS:
                self._wind[:] = wind_mps(self._data.time)
                self._note()
            # Many steps in one call: each call gives up the interpreter lock and waits for it.
            at_once = min(until_record, last - self._steps)
            mujoco.mj_step(self.model, self._data, at_once)
            self._steps += at_once
        self.snapshot = self._take_snapshot()

    def _take_snapshot(self) -> Snapshot:
        x, y, z, qw, qx, qy, qz = self._qpos.tolist()
        vx, vy, vz, p, q, r = self._qvel.tolist()
        ax, ay, az = self._felt.tolist()
        return Snapshot(
            time_s=self._data.time,
            rates_radps=(p, q, r),
            specific_force_mps2=(ax, ay, az),
            attitude=(qw, qx, qy, qz),
            position_m=(x, y, z),
            velocity_mps=(vx, vy, vz),
        )

    def _note(self) -> None:
        x, y, z, _, qx, qy, _ = self._qpos.tolist()
        speed_mps = math.hypot(*self._qvel[:3].tolist())
        tilt_rad = math.acos(max(-1.0, min(1.0 - 2.0 * (qx * qx + qy * qy), 1.0)))
        self.record.track.append(
            (self._data.time, x, y, z, speed_mps, tilt_rad, *self._thrusts.tolist())
        )
        self.record.digest.update(self._qpos.tobytes())
