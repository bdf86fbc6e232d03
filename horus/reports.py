"""What the log says about a running node; what repeats, ever more rarely."""

from __future__ import annotations

import logging

from horus.clock import TickContext
from horus.ratelimit import Limiter
from horus.spec import FailurePolicy
from horus.units import readable


class NodeReports:
    """Writes a node's troubles to its log.

    Thread: any; a message that two threads bring at once may count for one.
    """

    def __init__(self, log: logging.Logger, context: TickContext) -> None:
        """Speak for the node of this context."""
        self._log = log
        self._context = context
        self._now_ns = context.timeline.now_ns
        self._failures = Limiter()
        self._limits = Limiter()
        self._order = Limiter()
        self._pace = Limiter()

    def emit(self, level: int, message: str, exc: BaseException | None = None) -> None:
        """Log on the node's behalf."""
        name = self._context.node
        extra = {"node": name, "cycle": self._context.cycle()}
        self._log.log(level, "%s: %s", name, message, exc_info=exc, extra=extra)

    def tick_failed(self, exc: BaseException, policy: FailurePolicy | None) -> None:
        """Log an exception from `tick`: with traceback, unless a policy was chosen for it."""
        summary = self._failures.note(self._now_ns(), 0)
        if summary is None:
            return
        more = f" ({summary.held_back} more since the last message)" if summary.held_back else ""
        self.emit(
            logging.WARNING if policy is FailurePolicy.SKIP else logging.ERROR,
            f"tick() raised {type(exc).__name__}: {exc}{more}",
            exc if policy is None else None,
        )

    def limit_exceeded(self, kind: str, limit_ns: int, over_ns: int) -> str:
        """Log an exceeded budget or deadline; return its description."""
        text = f"exceeded its {kind} of {readable(limit_ns)} by {readable(over_ns)}"
        summary = self._limits.note(self._now_ns(), over_ns)
        if summary is not None and summary.held_back:
            self.emit(
                logging.WARNING,
                f"{summary.held_back + 1} ticks exceeded their limits in the last "
                f"{readable(summary.period_ns)}, worst {readable(summary.worst)} over",
            )
        elif summary is not None:
            self.emit(logging.WARNING, text)
        return text

    def order_violated(self, predecessor: str) -> None:
        """Log that the node ran before one it should follow."""
        summary = self._order.note(self._now_ns(), 0)
        if summary is not None:
            self.emit(
                logging.WARNING,
                f"runs before {predecessor}, which is late, to keep its own deadline "
                f"({summary.held_back + 1} times since the last message)",
            )

    def slower_than_asked(self, asked_hz: float, achieved_hz: float, why: str) -> None:
        """Log that the node does not keep its rate."""
        if self._pace.note(self._now_ns(), 0) is not None:
            self.emit(
                logging.WARNING, f"runs at {achieved_hz:.4g} Hz, asked for {asked_hz:g} Hz: {why}"
            )
