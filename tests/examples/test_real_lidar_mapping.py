"""The mapping example maps real scans: every one of them, the same way every time."""

from __future__ import annotations

import importlib.util
import os
import re
import struct
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

if TYPE_CHECKING:
    from collections.abc import Iterator
    from types import ModuleType

pytest.importorskip("rtbdata", reason="the laser log comes with the examples extra")

EXAMPLE = Path(__file__).parents[2] / "examples" / "real_lidar_mapping.py"
TIMEOUT_S = 120


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """What one run printed about itself."""

    counts: tuple[int, int, int, int]  # published, mapped, lost, out of order
    digest: str
    free_m2: float
    wall_cells: int
    drift_m: float
    png: bytes
    text: str


def run_example(tmp_path: Path, *options: str) -> Outcome:
    """Run the example and read its summary."""
    picture = tmp_path / "map.png"
    done = subprocess.run(
        [sys.executable, str(EXAMPLE), *options, "--out", str(picture)],
        env=os.environ | {"PYTHONWARNINGS": "default"},
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr

    def find(pattern: str) -> tuple[str, ...]:
        found = re.search(pattern, done.stdout, re.MULTILINE)
        assert found, done.stdout
        return found.groups()

    published, mapped, lost, disordered = map(
        int, find(r"^scans +(\d+) published, (\d+) mapped, (\d+) lost, (\d+) out of order$")
    )
    free_m2, wall_cells = find(r"^map .* (\d+) m2 free, (\d+) wall cells$")
    return Outcome(
        counts=(published, mapped, lost, disordered),
        digest=find(r"^sha256 +([0-9a-f]{64})$")[0],
        free_m2=float(free_m2),
        wall_cells=int(wall_cells),
        drift_m=float(find(r"^odometry strays up to ([\d.]+) m")[0]),
        png=picture.read_bytes(),
        text=done.stdout,
    )


def test_deterministic_runs_give_the_same_plausible_map(tmp_path: Path) -> None:
    """Two runs in virtual time lose no scan and draw the same map, bit for bit."""
    first = run_example(tmp_path, "--deterministic", "--scans", "400")
    second = run_example(tmp_path, "--deterministic", "--scans", "400")

    assert first.counts == (400, 400, 0, 0)
    assert (first.digest, first.png) == (second.digest, second.png)
    # 400 scans cover 200 m of corridors two to four metres wide.
    assert 500 < first.free_m2 < 1000
    assert 4000 < first.wall_cells < 12000
    width, height = struct.unpack(">II", first.png[16:24])
    assert first.png.startswith(b"\x89PNG")
    assert 800 < width < 1300
    assert 800 < height < 1300
    assert first.text.count("mapped ") > 5


def test_real_time_loses_nothing_at_high_speed(tmp_path: Path) -> None:
    """At a hundred times the speed a mapper of 10 Hz could take one by one, no scan is lost."""
    virtual = run_example(tmp_path, "--deterministic", "--scans", "300")
    real = run_example(tmp_path, "--speed", "2000", "--scans", "300")

    assert real.counts == (300, 300, 0, 0)
    assert real.digest == virtual.digest


def test_odometry_alone_drifts(tmp_path: Path) -> None:
    """Dead reckoning gives another map, and the example says how far it strays."""
    graph = run_example(tmp_path, "--deterministic", "--scans", "400")
    odometry = run_example(tmp_path, "--deterministic", "--scans", "400", "--poses", "odometry")

    assert odometry.counts == (400, 400, 0, 0)
    assert odometry.digest != graph.digest
    assert odometry.drift_m == graph.drift_m > 1.0


@pytest.mark.parametrize("option", ["--speed", "--scans", "--cell"])
def test_bad_options_are_refused(option: str, tmp_path: Path) -> None:
    """A speed, a number of scans or a cell size of zero is a usage error, not a crash."""
    done = subprocess.run(
        [sys.executable, str(EXAMPLE), option, "0", "--out", str(tmp_path / "map.png")],
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )
    assert done.returncode == 2
    assert f"{option} must be a positive number" in done.stderr


@pytest.fixture(scope="module")
def example() -> Iterator[ModuleType]:
    """Import the example as a module."""
    spec = importlib.util.spec_from_file_location("real_lidar_mapping", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


def test_log_is_parsed_whole(example: ModuleType) -> None:
    """The log has 3,873 scans, recorded in order, whose motions lead from pose to pose."""
    drive = example.parse_log(example.open_log())
    assert len(drive) == 3873
    assert drive.ranges_m.shape == (3873, 180)
    assert (np.diff(drive.stamp_s) > 0).all()
    assert drive.stamp_s[-1] == pytest.approx(7672.69)
    for before, motion, after in zip(
        drive.poses[:-1], drive.motions[1:], drive.poses[1:], strict=True
    ):
        error_m = np.subtract(example.compose(before, motion), after)[:2]
        assert np.hypot(*error_m) < 0.2


def test_phantoms_are_removed_and_walls_stay(example: ModuleType) -> None:
    """A lone echo between two others goes, as does "no echo"; a grazed wall stays whole."""
    ranges_m = np.array([2.0, 2.0, 3.5, 5.0, 50.0, 9.0, 4.0, 9.0, 9.0])
    clean_m = example.remove_phantoms(ranges_m, limit_m=30.0, jump_m=0.5)
    assert np.isnan(clean_m).tolist() == [False] * 4 + [True, False, True, False, False]
    wall_m = 1.5 / np.sin(np.radians(np.arange(5, 90, dtype=float)))
    assert np.isfinite(example.remove_phantoms(wall_m, limit_m=30.0, jump_m=0.5)).all()


def test_grid_draws_a_room(example: ModuleType) -> None:
    """Scans from inside a square room leave its inside free and its walls occupied."""
    bearings_rad = np.radians(np.arange(0.0, 360.0, 0.5))
    to_wall_m = 5.0 / np.maximum(abs(np.cos(bearings_rad)), abs(np.sin(bearings_rad)))
    grid = example.OccupancyGrid(cell_m=0.1)
    for _ in range(5):
        grid.cast((0.05, 0.05, 0.0), to_wall_m, bearings_rad)
    free_m2 = (grid.log_odds < 0).sum() * 0.01
    assert free_m2 == pytest.approx(100.0, rel=0.06)
    rows, columns = grid.known_box()
    assert (rows.stop - rows.start) * 0.1 == pytest.approx(14.0, abs=0.3)
    assert (columns.stop - columns.start) * 0.1 == pytest.approx(14.0, abs=0.3)


def test_grid_does_not_depend_on_growth(example: ModuleType) -> None:
    """Beams that share no cell give the same grid in whatever order it had to grow."""
    bearings_rad = np.zeros(1)
    places = [(0.0, 0.0, 0.0), (-70.0, 30.0, 1.0), (40.0, -90.0, 2.0)]
    digests = set()
    for order in ([0, 1, 2], [2, 1, 0]):
        grid = example.OccupancyGrid(cell_m=0.1)
        for place in order:
            grid.cast(places[place], np.array([4.0]), bearings_rad)
        digests.add(grid.digest())
    assert len(digests) == 1
