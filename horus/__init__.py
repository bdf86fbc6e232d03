"""horus: an asyncio-first scheduler for robot programs."""

from __future__ import annotations

from horus.clock import budget_remaining, dt, elapsed, now, rng_float, tick
from horus.errors import (
    ConfigError,
    ConfigWarning,
    HorusError,
    HorusWarning,
    NodeError,
    ShutdownTimeout,
    StateError,
    TopicError,
    UnavailableWarning,
    UnknownNodeError,
)
from horus.node import Node
from horus.ports import Pub, Sub
from horus.scheduler import Scheduler, run
from horus.spec import ExecutionClass, FailurePolicy, Health, Miss, NodeState
from horus.stats import NodeTiming, TimingReport
from horus.stream import MessageStream
from horus.units import ms, us

__version__ = "0.1.0"

__all__ = [
    "ConfigError",
    "ConfigWarning",
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
    "Scheduler",
    "ShutdownTimeout",
    "StateError",
    "Sub",
    "TimingReport",
    "TopicError",
    "UnavailableWarning",
    "UnknownNodeError",
    "__version__",
    "budget_remaining",
    "dt",
    "elapsed",
    "ms",
    "now",
    "rng_float",
    "run",
    "tick",
    "us",
]
