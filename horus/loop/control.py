"""Why and when a run ends."""

from __future__ import annotations

import logging
from collections.abc import Callable

from horus.errors import NodeError

_log = logging.getLogger("horus.scheduler")

_WARN_AT_MISSES = 100


class RunControl:
    """Collects the requests to stop and the limit on missed deadlines.

    Thread: any.
    """

    def __init__(self, max_deadline_misses: int | None, total_misses: Callable[[], int]) -> None:
        """Watch over a scheduler; `total_misses` counts over all its nodes."""
        self._max_deadline_misses = max_deadline_misses
        self._total_misses = total_misses
        self._warned = False
        self._on_stop: Callable[[], None] | None = None
        self.stop_reason: str | None = None
        self.failure: NodeError | None = None

    def begin(self, on_stop: Callable[[], None]) -> None:
        """Start a run that `on_stop` ends."""
        self.stop_reason = None
        self.failure = None
        self._on_stop = on_stop

    def end(self) -> None:
        """Take note that the run is over."""
        self._on_stop = None

    @property
    def stopping(self) -> bool:
        """Whether a stop was requested since the run began."""
        return self.stop_reason is not None

    def request_stop(self, reason: str) -> None:
        """Stop in order; the first reason given is the one reported."""
        if self.stop_reason is None:
            self.stop_reason = reason
        if self._on_stop is not None:
            self._on_stop()

    def fail(self, error: NodeError) -> None:
        """Stop in order; `run()` then raises `error`."""
        if self.failure is None:
            self.failure = error
        self.request_stop(str(error))

    def count_miss(self) -> None:
        """Stop when the limit on missed deadlines is reached."""
        total = self._total_misses()
        if self._max_deadline_misses is None:
            if total >= _WARN_AT_MISSES and not self._warned:
                self._warned = True
                _log.warning(
                    "%d deadlines were missed so far; no max_deadline_misses is set, so the "
                    "run goes on",
                    total,
                )
        elif total >= self._max_deadline_misses:
            self.request_stop(
                f"{total} deadlines were missed, max_deadline_misses={self._max_deadline_misses}"
            )
