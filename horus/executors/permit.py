"""What a thread waits for, and others give it."""

from __future__ import annotations

import threading
from typing import Protocol

from horus import clock, os_rt
from horus.units import to_s


class Permit(Protocol):
    """Given several times before it is taken, it is still one."""

    def give(self) -> None:
        """Wake who waits, or let the next one not wait. Thread: any."""

    def take(self, until_ns: int | None = None) -> bool:
        """Wait, at most until an instant on CLOCK_MONOTONIC [ns]; return whether it was given."""


class LockPermit:
    """A permit that every platform has."""

    def __init__(self) -> None:
        """Begin with none given."""
        self._lock = threading.Lock()
        self._lock.acquire()

    def give(self) -> None:
        """See `Permit`."""
        try:
            self._lock.release()
        except RuntimeError:
            pass  # given already

    def take(self, until_ns: int | None = None) -> bool:
        """See `Permit`."""
        if until_ns is None:
            return self._lock.acquire()
        return self._lock.acquire(True, to_s(max(0, until_ns - clock.monotonic_ns())))


def make_permit() -> Permit:
    """Return the most exact kind of permit that the platform has."""
    try:
        return os_rt.Semaphore()
    except OSError:
        return LockPermit()
