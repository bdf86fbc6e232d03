"""The drone flight controller: flown in virtual time, disturbed, and cut off in the air."""

from __future__ import annotations

import importlib
import math
import random
import re
import subprocess
import sys
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest import mock

import pytest

import horus

EXAMPLE = Path(__file__).parents[2] / "examples" / "drone_flight_controller.py"
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
FLIGHT_TIMEOUT_S = 100

# Measured: 0.030 m RMS and 0.054 m at most; over other seeds up to 0.035 m and 0.077 m.
TRACKING_RMS_M, TRACKING_MAX_M = 0.06, 0.15

pytest.importorskip("mujoco", reason="the example's physics engine is in the extra 'examples'")
pytestmark = pytest.mark.timeout(2 * FLIGHT_TIMEOUT_S)


def _start(*arguments: str, cwd: Path) -> subprocess.Popen[str]:
    """Run the example as a user would."""
    return subprocess.Popen(
        [sys.executable, str(EXAMPLE), *arguments],
        cwd=cwd,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def _printed(example: subprocess.Popen[str], *, exit_code: int) -> str:
    """Wait for a run to end and return what it printed."""
    try:
        printed, _ = example.communicate(timeout=FLIGHT_TIMEOUT_S)
    finally:
        example.kill()
    assert example.returncode == exit_code, printed
    return printed


def _value(name: str, printed: str) -> str:
    found = re.search(rf"^{name}\s{{2,}}(.*)$", printed, re.MULTILINE)
    assert found is not None, f"{name!r} is not in:\n{printed}"
    return found[1]


def _rms_and_max_m(line: str) -> tuple[float, float]:
    rms_m, max_m = re.findall(r"(\d+\.\d+) m", line)
    return float(rms_m), float(max_m)


@pytest.fixture(scope="module")
def flights(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str, Path]:
    """Fly the deterministic flight twice; return both outputs and the first one's picture."""
    folder = tmp_path_factory.mktemp("drone")
    # Side by side: whatever depended on the wall clock would come out differently.
    runs = [
        _start("--deterministic", cwd=folder),
        _start("--deterministic", "--out", "second.png", cwd=folder),
    ]
    first, second = [_printed(run, exit_code=0) for run in runs]
    return first, second, folder / "drone.png"


@pytest.fixture
def example(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Import the example, its nodes to be changed by a test."""
    monkeypatch.syspath_prepend(str(EXAMPLE.parent))
    return importlib.import_module("drone_flight_controller")


def _fly(example: ModuleType, *arguments: str, duration_s: float = 60.0) -> Any:
    args = example.parser().parse_args(arguments)
    return example.fly(example.policies(args), deterministic=True, duration_s=duration_s)


def test_the_square_is_flown(flights: tuple[str, str, Path]) -> None:
    """Takes off, visits every corner of the square, lands where it started, and ends itself."""
    printed = flights[0]
    assert _value("square flown", printed).startswith("True")
    assert _value("landed", printed).startswith("True")
    assert float(_value("touchdown", printed).split()[0]) < 0.7
    assert _value("stopped", printed) == "landed"
    assert "BROKEN PROMISE" not in printed


def test_the_drone_is_where_it_should_be(flights: tuple[str, str, Path]) -> None:
    """The tracking error, by the physics engine's own account, stays within centimetres."""
    for line in ("tracking error", "on the square"):
        rms_m, max_m = _rms_and_max_m(_value(line, flights[0]))
        assert rms_m < TRACKING_RMS_M
        assert max_m < TRACKING_MAX_M


def test_tracking_errors_are_printed_along_the_way(flights: tuple[str, str, Path]) -> None:
    """Prints a line a second with the error of the moment, and one per leg with the leg's."""
    printed = flights[0]
    assert len(re.findall(r"^ *\d+\.\d\d s  .*error \d\.\d{3} m$", printed, re.MULTILINE)) > 15
    for leg in ("takeoff", "side 1", "side 2", "side 3", "side 4", "landing"):
        assert re.search(rf"flown {leg}, off by RMS \d\.\d+ m, max \d\.\d+ m", printed)


def test_motors_halt_before_sensors_disconnect(flights: tuple[str, str, Path]) -> None:
    """Shutdown runs in reverse order: first the motors are off, then the sensors disconnect."""
    assert _value("shutdown order", flights[0]) == "esc -> gps -> imu"
    assert float(_value("thrust at the end", flights[0]).split()[0]) < 0.01


def test_two_flights_take_the_same_trajectory(flights: tuple[str, str, Path]) -> None:
    """The same nodes in virtual time fly the same way to the last bit, every time."""
    first, second, _ = flights
    trajectory = _value("trajectory sha256", first)
    assert re.fullmatch(r"[0-9a-f]{64}", trajectory)
    assert trajectory == _value("trajectory sha256", second)


def test_the_picture_is_drawn(flights: tuple[str, str, Path]) -> None:
    """The flight is written as a PNG."""
    assert flights[2].read_bytes().startswith(PNG_SIGNATURE)


def test_a_run_that_ends_in_the_air_is_brought_down(tmp_path: Path) -> None:
    """Cut off at 2 m by `--duration`, the ESC lands and stops the motors before sensors go."""
    cut_off = _start("--deterministic", "--duration", "8", cwd=tmp_path)
    printed = _printed(cut_off, exit_code=1)
    assert re.search(r"failsafe descent: the run ended in the air, [12]\.\d+ m up", printed)
    assert _value("landed", printed).startswith("True")
    assert float(_value("touchdown", printed).split()[0]) < 0.7
    assert float(_value("thrust at the end", printed).split()[0]) < 0.01
    assert _value("shutdown order", printed) == "esc -> gps -> imu"
    assert "the square was not flown, only: takeoff, side 1" in printed


def test_strict_ends_the_run_at_the_first_late_esc_tick(tmp_path: Path) -> None:
    """With `--strict`, one missed ESC deadline stops the scheduler, motors first."""
    # A microsecond: late on any machine.
    printed = _printed(_start("--strict", "--esc-deadline-us", "1", cwd=tmp_path), exit_code=1)
    assert re.search(r"^stopped +node 'esc' exceeded its deadline", printed, re.MULTILINE)
    assert _value("shutdown order", printed) == "esc -> gps -> imu"
    assert _value("landed", printed).startswith("True")


def test_strict_sets_tight_limits(example: ModuleType) -> None:
    """`--strict` stops at a 200 us ESC tick and at ten misses; without it, misses are warned of."""
    strict = example.policies(example.parser().parse_args(["--strict"]))
    assert strict.esc["on_miss"] == "stop"
    assert strict.esc["deadline"] == pytest.approx(200e-6)
    assert strict.attitude["deadline"] == pytest.approx(500e-6)
    assert strict.scheduler["max_deadline_misses"] == 10
    relaxed = example.policies(example.parser().parse_args([]))
    assert relaxed.esc == {"on_miss": "warn"}
    assert relaxed.scheduler["max_deadline_misses"] is None


def _unreliable(kind: type, share: float, longest: int, seed: int) -> type:
    """Return a node class whose ticks fall out in bursts; `horus.dt()` says so afterwards."""

    class Unreliable(kind):  # type: ignore[misc]
        def __init__(self, *args: Any, **kwargs: Any) -> None:
            super().__init__(*args, **kwargs)
            self._random = random.Random(seed)
            self._left = 0
            self._lost_s = 0.0

        def tick(self) -> None:
            if self._left == 0 and self._random.random() < share:
                self._left = self._random.randint(1, longest)
            if self._left:
                self._left -= 1
                self._lost_s += horus.dt()
                return
            dt_s, self._lost_s = horus.dt() + self._lost_s, 0.0
            with mock.patch.object(horus, "dt", partial(float, dt_s)):
                super().tick()

    return Unreliable


@pytest.mark.parametrize(
    ("share", "longest"),
    [(0.3, 3), (0.03, 20)],
    ids=["gaps of up to 7.5 ms, often", "gaps of up to 50 ms, now and then"],
)
def test_the_flight_survives_skipped_ticks(
    example: ModuleType, monkeypatch: pytest.MonkeyPatch, share: float, longest: int
) -> None:
    """Flies the square when ticks of IMU, both controllers and ESC fall out at random."""
    for seed, name in enumerate(("ImuNode", "AttitudeControl", "PositionControl", "Esc")):
        # The outer loop ticks once in eight: its gaps are as long, its ticks fewer.
        gap = max(1, longest // 8) if name == "PositionControl" else longest
        monkeypatch.setattr(example, name, _unreliable(getattr(example, name), share, gap, seed))
    outcome = _fly(example).outcome
    assert outcome.failures == []
    # Measured: at most 0.043 m RMS and 0.11 m.
    assert outcome.rms_m < 0.10
    assert outcome.max_m < 0.30


def test_the_esc_does_not_fly_on_stale_commands(
    example: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    """When the attitude controller falls silent, the ESC comes down by itself and lands."""

    class Silent(example.AttitudeControl):  # type: ignore[misc, name-defined]
        def tick(self) -> None:
            if horus.elapsed() < 7.0:
                super().tick()

    monkeypatch.setattr(example, "AttitudeControl", Silent)
    flight = _fly(example)
    (descent,) = flight.log.find("failsafe descent")
    assert 7.09 < descent.at_s < 7.12
    assert "no motor command" in descent.detail
    assert flight.stop_reason == "brought down by the ESC"
    assert flight.outcome.landed
    assert flight.outcome.touchdown_mps < 0.7
    assert flight.outcome.motors_off_first


def test_the_controllers_know_the_airframe(example: ModuleType) -> None:
    """Mass and inertia that the controllers count on are those of the physics model."""
    from drone import airframe, world

    model = world.World().model
    body = model.body("drone")
    assert body.mass[0] == pytest.approx(airframe.MASS_KG)
    assert sorted(body.inertia) == pytest.approx(sorted(airframe.INERTIA_KGM2), rel=0.02)


def test_the_mixer_makes_the_thrust_and_torque_it_is_asked_for(example: ModuleType) -> None:
    """Within the rotors' range the mixer is exact; beyond it every rotor stays in range."""
    from drone import airframe, control

    def made(thrusts: tuple[float, ...]) -> tuple[float, ...]:
        pairs = list(zip(airframe.ROTORS, thrusts, strict=True))
        return (
            sum(thrusts),
            sum(n * r.y_sign * airframe.ARM_M for r, n in pairs),
            sum(-n * r.x_sign * airframe.ARM_M for r, n in pairs),
            sum(n * r.yaw_sign * airframe.YAW_TORQUE_M for r, n in pairs),
        )

    asked = (9.0, 0.1, -0.08, 0.01)
    assert made(control.mix(asked[0], asked[1:])) == pytest.approx(asked)
    for thrust, *torque in ((9.0, 5.0, 0.0, 0.0), (0.0, 0.2, 0.2, 0.2), (40.0, -1.0, 2.0, 1.0)):
        rotors = control.mix(thrust, tuple(torque))
        assert all(-1e-9 <= n <= airframe.MAX_THRUST_N + 1e-9 for n in rotors)


def test_a_leg_begins_and_ends_at_rest(example: ModuleType) -> None:
    """The reference moves smoothly from rest to rest, and stays at its target."""
    from drone import course

    leg = course.Leg((0.0, 0.0, 1.0), (4.0, 0.0, 1.0), 3.0)
    for time_s, x_m in ((0.0, 0.0), (1.5, 2.0), (3.0, 4.0), (9.0, 4.0)):
        assert leg.at(time_s).position_m == pytest.approx((x_m, 0.0, 1.0))
    for time_s in (0.0, 3.0, 9.0):
        assert math.hypot(*leg.at(time_s).velocity_mps) == pytest.approx(0.0, abs=1e-9)
    speed_mps = (leg.at(1.001).position_m[0] - leg.at(0.999).position_m[0]) / 0.002
    assert leg.at(1.0).velocity_mps[0] == pytest.approx(speed_mps, rel=1e-5)
