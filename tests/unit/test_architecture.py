"""The layering is executable: imports point down, names are what they were."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import horus

ROOT = Path(horus.__file__).parent

LAYERS = [
    ["units", "errors"],
    ["timing", "validation", "os_rt", "endpoint", "foxglove"],
    ["ports", "callables", "spec", "stats", "ratelimit"],
    ["clock", "logs", "snapshot", "standing"],
    ["topics", "graph", "escalation", "stream", "reports"],
    ["core"],
    ["node", "live"],
    ["tick_path", "event_tick"],
    ["loop"],
    ["workers"],
    ["executors"],
    ["registry", "drivers", "recording"],
    ["observe"],
    ["oversight"],
    ["session"],
    ["embedding"],
    ["scheduler"],
    ["__init__", "testing", "cli"],
    ["__main__"],
]
LEVEL = {name: level for level, names in enumerate(LAYERS) for name in names}


def component(path: Path) -> str:
    relative = path.relative_to(ROOT)
    return relative.parts[0] if len(relative.parts) > 1 else relative.stem


def imports_of(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("horus"):
            parts = node.module.split(".")
            found |= {parts[1]} if len(parts) > 1 else {alias.name for alias in node.names}
    return found


def test_imports_point_down() -> None:
    """Every module imports from lower layers only, or from its own component."""
    for path in ROOT.rglob("*.py"):
        own = component(path)
        for other in imports_of(path):
            assert other == own or LEVEL[other] <= LEVEL[own], f"{path.name} imports {other}"


def test_every_module_has_a_layer() -> None:
    """A new module is given its place here before it is used."""
    assert {component(path) for path in ROOT.rglob("*.py")} == set(LEVEL)


def test_only_clock_reads_the_clock() -> None:
    """Time is a parameter: no module but clock.py (and the kernel's home) imports `time`."""
    for path in ROOT.rglob("*.py"):
        if path.name in {"clock.py", "os_rt.py"}:
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            assert "time" not in names, path
            assert not (isinstance(node, ast.ImportFrom) and node.module == "time"), path


def test_public_names() -> None:
    """The public interface changes on purpose or not at all."""
    assert sorted(horus.__all__) == [
        "CallbackInterrupted",
        "ConfigError",
        "ConfigWarning",
        "Divergence",
        "ExecutionClass",
        "FailurePolicy",
        "Health",
        "HorusError",
        "HorusWarning",
        "MessageStream",
        "Miss",
        "Node",
        "NodeError",
        "NodeState",
        "NodeTiming",
        "Pub",
        "RecordedMessage",
        "RecordingError",
        "RecordingReader",
        "Recovery",
        "Scheduler",
        "ShutdownTimeout",
        "StateError",
        "Sub",
        "TimingReport",
        "TopicError",
        "UnknownNodeError",
        "WorkerDied",
        "WorkerError",
        "__version__",
        "budget_remaining",
        "diff",
        "dt",
        "elapsed",
        "ms",
        "now",
        "open_recording",
        "recover",
        "rng_float",
        "run",
        "tick",
        "us",
    ]
    assert all(hasattr(horus, name) for name in horus.__all__)


def test_heavy_parts_load_lazily() -> None:
    """`import horus` loads neither an event loop nor a library that a robot may never need."""
    program = (
        "import sys, horus; "
        "heavy = 'asyncio uvloop anyio aiohttp mcap msgspec numpy platformdirs random'.split(); "
        "print([name for name in heavy if name in sys.modules])"
    )
    found = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert found.stdout.strip() == "[]"
