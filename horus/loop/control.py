"""Why and when a run ends."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

from horus.errors import NodeError
from horus.live import LiveNode

_log = logging.getLogger("horus.scheduler")

_WARN_AT_MISSES = 100


class RunControl:
    """Collects the requests to stop and the limit on missed deadlines.

    Thread: any.
    """

    def __init__(
        self, max_deadline_misses: int | None, critical_late: Callable[[LiveNode, int], None]
    ) -> None:
        """Watch over the runs of a scheduler; `critical_late` is told of critical nodes."""
        self._max_deadline_misses = max_deadline_misses
        self.critical_late = critical_late
        self._lock = threading.Lock()
        self._misses = 0
        self._on_stop: Callable[[], None] | None = None
        self.stop_reason: str | None = None
        self.failure: NodeError | None = None
        self.fault: str | None = None
        """Why the run had to end: a failure, or deadlines that were missed."""

    def begin(self, on_stop: Callable[[], None]) -> None:
        """Start a run that `on_stop` ends."""
        self._misses = 0
        self.stop_reason = None
        self.failure = None
        self.fault = None
        self._on_stop = on_stop

    def end(self) -> None:
        """Take note that ticking is over: a reason to stop comes too late."""
        self._on_stop = None

    @property
    def stopping(self) -> bool:
        """Whether a stop was requested since the run began."""
        return self.stop_reason is not None

    def request_stop(self, reason: str) -> None:
        """Stop in order; the first reason given is the one reported."""
        on_stop = self._on_stop
        if on_stop is not None:
            if self.stop_reason is None:
                self.stop_reason = reason
            on_stop()

    def fail(self, error: NodeError) -> None:
        """Stop in order; `run()` then raises `error`."""
        if self.failure is None:
            self.failure = error
        self.give_up(str(error))

    def give_up(self, reason: str) -> None:
        """Stop in order, because something is wrong."""
        if self.fault is None:
            self.fault = reason
        self.request_stop(reason)

    def count_miss(self) -> None:
        """Stop when the limit on missed deadlines is reached."""
        with self._lock:
            self._misses += 1
            misses = self._misses
        if self._max_deadline_misses is None:
            if misses == _WARN_AT_MISSES:
                _log.warning(
                    "%d deadlines were missed in this run; no max_deadline_misses is set, so it "
                    "goes on",
                    misses,
                )
        elif misses >= self._max_deadline_misses:
            self.give_up(
                f"{misses} deadlines were missed, max_deadline_misses={self._max_deadline_misses}"
            )
