"""Every contract example runs, ends by itself and prints what its docstring says."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
EXAMPLES = sorted((ROOT / "examples" / "contract").glob("*.py"))
TIMEOUT_S = 60


def documented_output(path: Path) -> list[str]:
    """Return the lines of the indented block after "Prints:" in a module's docstring."""
    docstring = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    _, found, block = docstring.partition("\nPrints:\n")
    assert found, f"{path.name} does not say what it prints"
    lines = []
    for line in block.splitlines():
        if not line.startswith("    "):
            break
        lines.append(line[4:])
    return lines


def matches(documented: list[str], printed: list[str]) -> bool:
    """Return whether output fits its documentation.

    `...` within a line stands for any text, alone on a line for any number of lines.
    """
    if not documented:
        return not printed
    if documented[0] == "...":
        return any(matches(documented[1:], printed[n:]) for n in range(len(printed) + 1))
    if not printed:
        return False
    pattern = ".*".join(re.escape(piece) for piece in documented[0].split("..."))
    same = re.fullmatch(pattern, printed[0]) is not None
    return same and matches(documented[1:], printed[1:])


@pytest.mark.parametrize(
    ("documented", "printed", "fits"),
    [
        (["a", "b"], ["a", "b"], True),
        (["a"], ["a", "b"], False),
        (["a", "b"], ["a"], False),
        (["a ... c"], ["a (b) c"], True),
        (["a ... c"], ["a b d"], False),
        (["a.c"], ["abc"], False),
        (["...", "c"], ["a", "b", "c"], True),
        (["...", "c"], ["c"], True),
        (["a", "..."], ["a"], True),
        (["...", "c"], ["a", "b"], False),
    ],
)
def test_matcher(documented: list[str], printed: list[str], fits: bool) -> None:
    """The matcher that keeps the examples honest is itself right."""
    assert matches(documented, printed) is fits


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_example_prints_what_it_says(path: Path, tmp_path: Path) -> None:
    """The example exits with 0 and its output matches the docstring."""
    run_and_compare(path, tmp_path)


def test_mapping_example_prints_what_it_says(tmp_path: Path) -> None:
    """The larger example keeps the same promise."""
    pytest.importorskip("rtbdata", reason="the laser log comes with the examples extra")
    path = ROOT / "examples" / "real_lidar_mapping.py"
    run_and_compare(path, tmp_path, "--deterministic", "--scans", "200")


def run_and_compare(path: Path, directory: Path, *options: str) -> None:
    """Run a file in a directory and compare its output with its docstring."""
    done = subprocess.run(
        [sys.executable, str(path), *options],
        cwd=directory,
        env=os.environ | {"PYTHONWARNINGS": "default"},
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    documented, printed = documented_output(path), done.stdout.splitlines()
    comparison = "\n".join(["documented:", *documented, "printed:", *printed, done.stderr])
    assert matches(documented, printed), comparison


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_example_is_short(path: Path) -> None:
    """One idea fits on a screen or two."""
    assert len(path.read_text(encoding="utf-8").splitlines()) <= 60


def test_index_lists_every_example() -> None:
    """The table in the README links each example and nothing that does not exist."""
    index = (ROOT / "examples" / "README.md").read_text(encoding="utf-8")
    linked = set(re.findall(r"\]\(([\w/]+\.py)\)", index))
    contract = {f"contract/{path.name}" for path in EXAMPLES}
    programs = {path.name for path in (ROOT / "examples").glob("*.py")}
    assert linked == contract | programs
