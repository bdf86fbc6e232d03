"""horus: an asyncio-first scheduler for robot programs."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from horus.clock import budget_remaining, dt, elapsed, now, rng_float, tick
from horus.errors import (
    CallbackInterrupted,
    ConfigError,
    ConfigWarning,
    HorusError,
    HorusWarning,
    NodeError,
    RecordingError,
    ShutdownTimeout,
    StateError,
    TopicError,
    UnknownNodeError,
    WorkerDied,
    WorkerError,
)
from horus.node import Node
from horus.ports import Pub, Sub
from horus.spec import ExecutionClass, FailurePolicy, Health, Miss, NodeState
from horus.stats import NodeTiming, TimingReport
from horus.units import ms, us

if TYPE_CHECKING:
    from horus.recording.diff import Divergence, diff
    from horus.recording.reader import RecordedMessage, RecordingReader
    from horus.recording.recovery import Recovery, open_recording, recover
    from horus.scheduler import Scheduler, run
    from horus.stream import MessageStream

__version__ = "0.1.0"

__all__ = [
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

# These bring in asyncio, which takes longer to import than all the rest: a
# program that only describes nodes does not wait for it.
_LAZY = {
    "Divergence": "horus.recording.diff",
    "diff": "horus.recording.diff",
    "MessageStream": "horus.stream",
    "RecordedMessage": "horus.recording.reader",
    "RecordingReader": "horus.recording.reader",
    "Recovery": "horus.recording.recovery",
    "open_recording": "horus.recording.recovery",
    "recover": "horus.recording.recovery",
    "Scheduler": "horus.scheduler",
    "run": "horus.scheduler",
}


def __getattr__(name: str) -> Any:
    """Import the names that are loaded on first use."""
    if name not in _LAZY:
        raise AttributeError(f"module 'horus' has no attribute {name!r}")
    value = getattr(importlib.import_module(_LAZY[name]), name)
    globals()[name] = value
    return value
