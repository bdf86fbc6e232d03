"""What only the kernel can do for timing: the one home of timerfd and its like.

Source: timerfd_create(2), clock_nanosleep(2).
"""

from __future__ import annotations

import ctypes
import functools
import os
import sys
import time

_TFD_TIMER_ABSTIME = 1
_NS_PER_S = 1_000_000_000


class _Timespec(ctypes.Structure):
    _fields_ = [("tv_sec", ctypes.c_long), ("tv_nsec", ctypes.c_long)]


class _Itimerspec(ctypes.Structure):
    _fields_ = [("it_interval", _Timespec), ("it_value", _Timespec)]


@functools.cache
def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)


class TimerFd:
    """A kernel timer that makes a descriptor readable at an absolute instant.

    Raises:
        OSError: The platform has no timerfd.
    """

    def __init__(self) -> None:
        """Create a disarmed timer on CLOCK_MONOTONIC."""
        if sys.platform != "linux":
            raise OSError("timerfd is a Linux interface")
        self._spec = _Itimerspec()
        self._pointer = ctypes.byref(self._spec)
        libc = _libc()
        self._settime = libc.timerfd_settime
        flags = os.O_NONBLOCK | os.O_CLOEXEC
        self.fd: int = libc.timerfd_create(time.CLOCK_MONOTONIC, flags)
        if self.fd < 0:
            error = ctypes.get_errno()
            raise OSError(error, os.strerror(error))

    def arm(self, at_ns: int) -> None:
        """Fire at `at_ns` on CLOCK_MONOTONIC [ns]; at once if that is past."""
        value = self._spec.it_value
        # An all-zero time would disarm the timer instead.
        value.tv_sec, value.tv_nsec = divmod(max(1, at_ns), _NS_PER_S)
        if self._settime(self.fd, _TFD_TIMER_ABSTIME, self._pointer, None) != 0:
            error = ctypes.get_errno()
            raise OSError(error, os.strerror(error))

    def acknowledge(self) -> None:
        """Make the descriptor unreadable again."""
        try:
            os.read(self.fd, 8)
        except BlockingIOError:
            pass

    def close(self) -> None:
        """Give the descriptor back."""
        os.close(self.fd)
