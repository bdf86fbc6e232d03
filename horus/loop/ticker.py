"""The alarm clock of the event loop: one kernel timer, armed for the next release only."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from horus.clock import monotonic_ns
from horus.os_rt import TimerFd
from horus.units import to_s


class Ticker:
    """Calls back on the loop at an absolute instant.

    The loop's own timers will not do: uvloop's have a resolution of 1 ms and
    fire up to 1 ms early, epoll rounds up to the next millisecond. A timerfd is
    as exact as the kernel. Where there is none, the loop's timer serves, and
    the receiver must expect to be called early.

    Thread: loop.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, wake: Callable[[], None]) -> None:
        """Attach to `loop`; `wake` is called once per `arm`."""
        self._loop = loop
        self._wake = wake
        self._timer: TimerFd | None = None
        self._handle: asyncio.TimerHandle | None = None
        try:
            self._timer = TimerFd()
        except OSError:
            return
        loop.add_reader(self._timer.fd, self._on_readable)

    def arm(self, at_ns: int) -> None:
        """Call back at `at_ns` [ns, CLOCK_MONOTONIC] instead of at any earlier request."""
        if self._timer is not None:
            self._timer.arm(at_ns)
            return
        if self._handle is not None:
            self._handle.cancel()
        self._handle = self._loop.call_later(to_s(max(0, at_ns - monotonic_ns())), self._wake)

    def close(self) -> None:
        """Detach from the loop."""
        if self._timer is not None:
            self._loop.remove_reader(self._timer.fd)
            self._timer.close()
        if self._handle is not None:
            self._handle.cancel()

    def _on_readable(self) -> None:
        if self._timer is not None:
            self._timer.acknowledge()
        self._wake()
