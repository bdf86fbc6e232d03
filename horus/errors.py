"""Everything horus raises or warns about.

Each message names what was observed, the limit it broke and the remedy, and is
built here so that one mistake reads the same wherever it is made.
"""

from __future__ import annotations

import signal
import sys
import warnings
from typing import Any


def describe(value: Any, limit: int = 80) -> str:
    """Return `repr(value)`, shortened, and never failing itself."""
    try:
        text = repr(value)
    except Exception as exc:
        text = f"<{type(value).__name__} whose repr raised {type(exc).__name__}>"
    return text if len(text) <= limit else text[: limit - 3] + "..."


class HorusError(Exception):
    """Root of every exception that horus raises."""


class ConfigError(HorusError, ValueError):
    """An argument was refused where it was written."""

    def __init__(self, argument: str, value: object, remedy: str) -> None:
        """Build the message `argument=value: remedy`."""
        super().__init__(f"{argument}={describe(value)}: {remedy}")
        self.argument = argument
        self.value = value
        self.remedy = remedy


class UnknownNodeError(HorusError, LookupError):
    """A node was asked for by a name that the scheduler does not have."""

    def __init__(self, name: object, known: list[str]) -> None:
        """Name the nodes that do exist."""
        listing = ", ".join(known) if known else "none were added yet"
        super().__init__(f"no node named {name!r}; the nodes are: {listing}")
        self.name = name


class StateError(HorusError, RuntimeError):
    """A call came at a time when it cannot be answered."""


class TopicError(HorusError, ValueError):
    """A message or a topic name was refused."""


class RecordingError(HorusError, ValueError):
    """A recording cannot be read, found, replayed or deleted; the message says what and where."""


class NodeError(HorusError):
    """A node's callback failed and its failure policy is `fatal`.

    The original exception is the cause (`__cause__`).
    """

    def __init__(self, node: str, phase: str, cause: BaseException) -> None:
        """Name the node, the callback and what it raised."""
        super().__init__(f"node {node!r}: {phase}() raised {type(cause).__name__}: {cause}")
        self.__cause__ = cause
        self.node = node
        self.phase = phase


class CallbackInterrupted(BaseException):
    """Raised in a callback that blocks the main thread and does not end, once the run is to.

    Not an `Exception`, so that no `except Exception` in the callback holds it up.
    """

    def __init__(self) -> None:
        """Say why."""
        super().__init__("it blocked the event loop, and the run is to end")


class ShutdownTimeout(HorusError):
    """A node did not finish its shutdown in the time it is given."""

    def __init__(self, node: str, timeout_s: float) -> None:
        """Name the node and the limit [s]."""
        super().__init__(f"node {node!r} did not shut down within {timeout_s:g} s")
        self.node = node
        self.timeout_s = timeout_s


class WorkerError(HorusError):
    """A node's worker process cannot be had, or something cannot travel there or back."""


class WorkerDied(WorkerError):
    """A node's worker process has ended by itself, or was killed."""

    def __init__(self, node: str, status: int) -> None:
        """Tell how: the exit status, or the negative number of a signal."""
        if status < 0:
            try:
                how = f"was killed by {signal.Signals(-status).name}"
            except ValueError:
                how = f"was killed by signal {-status}"
        else:
            how = f"has exited with status {status}"
        super().__init__(f"the worker process of node {node!r} {how}")
        self.node = node
        self.status = status

    def __reduce__(self) -> tuple[type[WorkerDied], tuple[str, int]]:
        """Pickle by what it was made from."""
        return WorkerDied, (self.node, self.status)


class HorusWarning(UserWarning):
    """Root of every warning that horus emits."""


class ConfigWarning(HorusWarning):
    """A configuration that is legal and probably not meant."""


def warn_user(message: str, category: type[HorusWarning]) -> None:
    """Warn at the line of the user's program that called into horus."""
    level = 2
    frame = sys._getframe(1)
    while frame.f_back is not None and _is_ours(frame.f_globals.get("__name__", "")):
        frame = frame.f_back
        level += 1
    warnings.warn(message, category, stacklevel=level)


def _is_ours(module: str) -> bool:
    return module == "horus" or module.startswith("horus.")
