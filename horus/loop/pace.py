"""Which nodes run slower than asked, and why."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from horus.live import LiveNode
from horus.spec import Health, Miss, NodeState
from horus.units import NS_PER_S, readable

_WINDOW_NS = NS_PER_S
_FEWEST_RELEASES = 5
_KEPT = 0.95
"""The share of its releases that a node runs if it keeps its rate."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Slowness:
    """A node that has run fewer ticks than were released lately."""

    live: LiveNode
    achieved_hz: float
    reason: str

    def log(self) -> None:
        """Say it."""
        self.live.reports.slower_than_asked(self.live.spec.rate_hz, self.achieved_hz, self.reason)


@dataclass(slots=True)
class _Window:
    began_ns: int
    ticks: int
    skipped: int
    execution_ns: int
    interruptions: int
    """How often the node was held, frozen or restarted: then it is not its pace."""


class Pace:
    """Compares what was released with what was run, over windows of a second or more.

    Nodes that do not tick for a reason which is reported anyway are left out: held,
    frozen, restarting, or told to skip.

    Thread: one; counters are only read.
    """

    def __init__(self, members: Callable[[], Iterable[LiveNode]]) -> None:
        """Watch `members`."""
        self._members = members
        self._windows: dict[LiveNode, _Window] = {}

    def look(self, now_ns: int) -> list[Slowness]:
        """Return the nodes that were too slow in the window that ends now [ns]."""
        before, self._windows = self._windows, {}
        slow = []
        for live in self._members():
            counters = live.counters
            if not _is_asked_to_tick(live):
                continue
            present = _Window(
                now_ns,
                counters.ticks,
                counters.skipped,
                counters.times.execution_total_ns,
                live.standing.holds + counters.watchdog_expirations + counters.restarts,
            )
            window = before.get(live)
            if window is None or window.interruptions != present.interruptions:
                self._windows[live] = present
                continue
            ran = present.ticks - window.ticks
            released = ran + present.skipped - window.skipped
            if now_ns - window.began_ns < _WINDOW_NS or released < _FEWEST_RELEASES:
                self._windows[live] = window
                continue
            self._windows[live] = present
            if ran < _KEPT * released:
                tick_ns = (present.execution_ns - window.execution_ns) // max(1, ran)
                slow.append(
                    Slowness(
                        live=live,
                        achieved_hz=live.spec.rate_hz * ran / released,
                        reason=_reason(live, tick_ns),
                    )
                )
        return slow


def _is_asked_to_tick(live: LiveNode) -> bool:
    return (
        live.trigger is None
        and live.state is NodeState.RUNNING
        and live.standing.health is Health.HEALTHY
        and live.spec.on_miss is not Miss.SKIP
        and not (live.standing.held or live.retired)
    )


def _reason(live: LiveNode, tick_ns: int) -> str:
    period_ns = live.period_ns
    if tick_ns >= 0.9 * period_ns:
        return f"a tick takes {readable(tick_ns)}, its period is {readable(period_ns)}"
    return f"it gets to run too late; a tick takes {readable(tick_ns)} of {readable(period_ns)}"
