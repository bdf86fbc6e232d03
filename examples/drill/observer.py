"""What a program can know of supervision: the log, its own hooks, and the statistics."""

from __future__ import annotations

import logging
import queue
import re
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

SYSTEM = "(system)"
"""Stands where an event is not about one node."""

_FRAME = re.compile(r'File "(?P<path>.+)", line (?P<line>\d+), in (?P<function>\w+)')
_SAMPLE_EVERY_S = 0.010


@dataclass(frozen=True, slots=True, kw_only=True)
class Event:
    """Something that happened."""

    at_s: float
    """On the clock of `time.monotonic` [s]."""
    node: str
    kind: str
    """A level of the log in upper case, or what the robot itself noted: "fault", "hook", ..."""
    text: str = ""
    place: str = ""
    """Where the stack in a message says that the node is."""


class Observer(logging.Handler):
    """Collects what is logged and noted, and how the nodes' conditions change.

    Attach it to the logger `horus`. Whoever waits reads; ticks and hooks only leave a note.

    Thread: any for `emit` and `note`, one for the rest.
    """

    def __init__(self) -> None:
        """Begin at time 0."""
        super().__init__(logging.INFO)
        self.began_s = time.monotonic()
        self.events: list[Event] = []
        self.conditions: dict[str, list[tuple[float, str]]] = {}
        """Of each node: since when [s] it was in which condition."""
        self._incoming: queue.SimpleQueue[Event] = queue.SimpleQueue()
        self._sampled_s = 0.0

    def emit(self, record: logging.LogRecord) -> None:
        """Take a record of the log."""
        node = getattr(record, "node", SYSTEM)
        text, _, stack = record.getMessage().partition("; it is in:\n")
        self.note(record.levelname, node, text.removeprefix(f"{node}: "), _place(stack))

    def note(self, kind: str, node: str, text: str = "", place: str = "") -> None:
        """Take note that something happens now."""
        now_s = time.monotonic()
        self._incoming.put(Event(at_s=now_s, node=node, kind=kind, text=text, place=place))

    def next_event(self, timeout_s: float) -> Event | None:
        """Wait for the next event; None if none comes in time."""
        try:
            event = self._incoming.get(timeout=timeout_s)
        except queue.Empty:
            return None
        self.events.append(event)
        return event

    def sample(self, nodes: Callable[[], Iterable[dict[str, Any]]]) -> None:
        """Look at `get_all_nodes()` every now and then, and remember what has changed."""
        now_s = time.monotonic()
        if now_s - self._sampled_s < _SAMPLE_EVERY_S:
            return
        self._sampled_s = now_s
        seen = {stats["name"]: _condition(stats) for stats in nodes()}
        for name in self.conditions.keys() | seen.keys():
            changes = self.conditions.setdefault(name, [])
            condition = seen.get(name, "gone")
            if not changes or changes[-1][1] != condition:
                changes.append((now_s, condition))


def _condition(stats: dict[str, Any]) -> str:
    held = stats["state"] == "safe_state" and stats["health"] != "isolated"
    if held or stats["state"] == "restarting":
        return str(stats["state"])
    return str(stats["health"])


def _place(stack: str) -> str:
    """Return where in the robot's own code a stack ends, not in a library that it calls."""
    frames = [frame.groupdict() for frame in _FRAME.finditer(stack)]
    own = [frame for frame in frames if Path(frame["path"]).parent == Path(__file__).parent]
    for frame in (own or frames)[-1:]:
        return f"{frame['function']}(), {Path(frame['path']).name}:{frame['line']}"
    return ""
