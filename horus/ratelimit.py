"""Log messages that do not flood: the first at once, then ever more rarely."""

from __future__ import annotations

from typing import NamedTuple

from horus.units import NS_PER_S

_LONGEST_SILENCE_NS = 32 * NS_PER_S


class Summary(NamedTuple):
    """What a message stands for besides itself."""

    held_back: int
    """Occurrences since the last message that were not logged."""
    worst: int
    """The largest size among them and this one."""
    period_ns: int
    """Time since the last message [ns]."""


class Limiter:
    """Lets a message through now and then, ever more rarely while the trouble lasts."""

    def __init__(self) -> None:
        """Begin with nothing held back."""
        self._last_ns = 0
        self._pause_ns = 0
        self._held_back = 0
        self._worst = 0

    def note(self, now_ns: int, size: int) -> Summary | None:
        """Return what to log now, or None to hold it back."""
        self._worst = max(self._worst, size)
        waited_ns = now_ns - self._last_ns
        if waited_ns < self._pause_ns:
            self._held_back += 1
            return None
        if waited_ns > 2 * self._pause_ns:
            self._pause_ns = 0
        summary = Summary(self._held_back, self._worst, waited_ns)
        self._pause_ns = min(max(NS_PER_S, 2 * self._pause_ns), _LONGEST_SILENCE_NS)
        self._last_ns = now_ns
        self._held_back = self._worst = 0
        return summary
