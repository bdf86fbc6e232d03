"""The example that replays recorded sensors through a changed controller."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).parents[2] / "examples" / "record_and_replay.py"
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"

pytest.importorskip("mujoco", reason="the example's physics engine is in the extra 'examples'")


def test_the_same_controller_repeats_itself_and_a_new_one_differs(tmp_path: Path) -> None:
    """Unchanged, not one bit differs; the gentler drive departs soon, and speeds up later."""
    process = subprocess.run(
        [sys.executable, EXAMPLE, "--out", "it.png"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    printed = process.stdout
    assert re.search(r"^recorded +\d{4} messages on 9 topics$", printed, re.MULTILINE), printed
    assert re.search(r"^the same +no difference$", printed, re.MULTILINE), printed
    assert re.search(r"^gentler +tick \d+, topic 'odom', .*pose\.", printed, re.MULTILINE), printed
    times = re.search(r"^at 1.5 m/s +after (\S+) s as recorded, (\S+) s", printed, re.MULTILINE)
    assert times, printed
    assert float(times[2]) > 1.5 * float(times[1])
    assert (tmp_path / "it.png").read_bytes().startswith(PNG_SIGNATURE)
