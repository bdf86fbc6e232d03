"""Holds simulated time to real time, at a speed."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable

from horus import clock
from horus.units import NS_PER_MS, to_s

_LONGEST_WAIT_NS = 20 * NS_PER_MS
"""How long to wait before looking again whether the speed has changed, or nobody waits [ns]."""


class Pacer:
    """Makes a simulation wait until an instant would have come.

    Thread: who simulates; `set_speed` any.
    """

    def __init__(self) -> None:
        """Begin without a pace: as fast as possible."""
        self._speed = math.inf
        self._wait = threading.Event().wait
        self._anchor = (0, 0)

    @property
    def speed(self) -> float:
        """Simulated seconds in a second; `math.inf` for as fast as possible."""
        return self._speed

    def set_speed(self, speed: float) -> None:
        """Change the speed, from now on."""
        self._speed = speed

    def begin(self, instant_ns: int) -> None:
        """Let simulated time go on from an instant [ns] now."""
        self._anchor = (instant_ns, clock.monotonic_ns())

    def wait_until(self, instant_ns: int, stopped: Callable[[], bool]) -> None:
        """Return when an instant [ns] has come, or when nobody waits for it."""
        while (speed := self._speed) != math.inf and not stopped():
            from_ns, began_ns = self._anchor
            now_ns = clock.monotonic_ns()
            wait_ns = int((instant_ns - from_ns) / speed) - (now_ns - began_ns)
            if wait_ns <= 0:
                return
            self._wait(to_s(min(wait_ns, _LONGEST_WAIT_NS)))
            if speed != self._speed:
                passed_ns = clock.monotonic_ns() - began_ns
                self.begin(from_ns + int(passed_ns * speed))
