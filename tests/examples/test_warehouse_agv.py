"""The eight-node AGV of the contract's opening scenario, in virtual time."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).parents[2] / "examples" / "warehouse_agv.py"
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
MISSION_TIMEOUT_S = 150

pytest.importorskip("mujoco", reason="the example's physics engine is in the extra 'examples'")


def _start(*arguments: str, cwd: Path) -> subprocess.Popen[str]:
    """Run the example as a user would."""
    return subprocess.Popen(
        [sys.executable, str(EXAMPLE), "--deterministic", *arguments],
        cwd=cwd,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def _printed(example: subprocess.Popen[str], *, exit_code: int) -> str:
    """Wait for a run to end and return what it printed."""
    try:
        printed, _ = example.communicate(timeout=MISSION_TIMEOUT_S)
    finally:
        example.kill()
    assert example.returncode == exit_code, printed
    return printed


def _value(name: str, printed: str) -> str:
    found = re.search(rf"^{name}\s{{2,}}(.*)$", printed, re.MULTILINE)
    assert found is not None, f"{name!r} is not in:\n{printed}"
    return found[1]


@pytest.fixture(scope="module")
def missions(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str, Path]:
    """Run the deterministic mission twice; return both outputs and the first one's picture."""
    folder = tmp_path_factory.mktemp("agv")
    # Side by side: whatever depended on the wall clock would come out differently.
    runs = [_start(cwd=folder), _start("--out", "second.png", cwd=folder)]
    first, second = [_printed(run, exit_code=0) for run in runs]
    return first, second, folder / "agv.png"


@pytest.mark.timeout(2 * MISSION_TIMEOUT_S)
def test_the_vehicle_reaches_its_goal(missions: tuple[str, str, Path]) -> None:
    """The mission ends itself at the goal, with reports delivered to the fleet server."""
    printed = missions[0]
    assert _value("goal reached", printed).startswith("True")
    assert "goal reached" in _value("stopped", printed)
    assert int(_value("fleet reports", printed).split()[0]) > 5


def test_the_emergency_stop_comes_before_contact(missions: tuple[str, str, Path]) -> None:
    """A pallet in the path triggers `emergency.stop`, and nothing is ever touched."""
    printed = missions[0]
    assert int(_value("emergency stops", printed)) == 1
    assert float(_value("least clearance", printed).split()[0]) > 0.05
    assert _value("contacts", printed).startswith("0 ")


def test_motors_halt_before_sensors_disconnect(missions: tuple[str, str, Path]) -> None:
    """Shutdown runs in reverse order: motors first, then camera and LiDARs."""
    order = _value("shutdown order", missions[0])
    assert order == "motor -> camera -> lidar_rear -> lidar_front"


def test_two_runs_take_the_same_trajectory(missions: tuple[str, str, Path]) -> None:
    """The same nodes in virtual time do the same to the last bit, every time."""
    first, second, _ = missions
    trajectory = _value("trajectory sha256", first)
    assert re.fullmatch(r"[0-9a-f]{64}", trajectory)
    assert trajectory == _value("trajectory sha256", second)


def test_the_picture_is_drawn(missions: tuple[str, str, Path]) -> None:
    """The driven path is written as a PNG."""
    assert missions[2].read_bytes().startswith(PNG_SIGNATURE)


def test_a_run_that_ends_early_says_what_it_did_not_do(tmp_path: Path) -> None:
    """Cut off by `--duration`, the example halts the motors first and still reports failure."""
    printed = _printed(_start("--duration", "2", cwd=tmp_path), exit_code=1)
    assert "the goal was missed" in printed
    assert "no emergency stop" in printed
    assert _value("shutdown order", printed).startswith("motor -> ")
    assert "still moved" not in printed
