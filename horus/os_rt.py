"""What only the kernel can do for timing: the one home of these calls.

Everything here concerns the calling thread or the whole process, raises OSError
where the kernel refuses, and does nothing on its own account.

Source: timerfd_create(2), sem_clockwait(3), sched(7), sched_setaffinity(2), setpriority(2),
mlockall(2), PR_SET_TIMERSLACK in prctl(2), /sys/devices/system/cpu/isolated.
"""

from __future__ import annotations

import ctypes
import functools
import os
import signal
import sys
import time
from collections.abc import Iterable
from pathlib import Path

_TFD_TIMER_ABSTIME = 1
_PR_SET_PDEATHSIG = 1
_PR_SET_TIMERSLACK = 29
_PR_GET_TIMERSLACK = 30
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
_CAP_IPC_LOCK = 14
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
        _check(self.fd)

    def arm(self, at_ns: int) -> None:
        """Fire at `at_ns` on CLOCK_MONOTONIC [ns]; at once if that is past."""
        value = self._spec.it_value
        # An all-zero time would disarm the timer instead.
        value.tv_sec, value.tv_nsec = divmod(max(1, at_ns), _NS_PER_S)
        _check(self._settime(self.fd, _TFD_TIMER_ABSTIME, self._pointer, None))

    def acknowledge(self) -> None:
        """Make the descriptor unreadable again."""
        try:
            os.read(self.fd, 8)
        except BlockingIOError:
            pass

    def close(self) -> None:
        """Give the descriptor back."""
        os.close(self.fd)


class Semaphore:
    """A binary semaphore for which a thread waits until an absolute instant.

    The locks of `threading` take a timeout, and tell the kernel of it once other threads have
    let them: the sleep is too long by what those have computed meanwhile.

    Raises:
        OSError: The platform has no sem_clockwait.
    """

    def __init__(self) -> None:
        """Begin with none given."""
        libc, kept = _libc_of_semaphores()
        # A sem_t, which is four longs everywhere.
        self._memory = (ctypes.c_ulong * 4)()
        self._semaphore = ctypes.byref(self._memory)
        self._until = _Timespec()
        self._pointer = ctypes.byref(self._until)
        self._given = False
        self._wait, self._wait_until, self._post = libc.sem_wait, libc.sem_clockwait, kept.sem_post
        libc.sem_init(self._semaphore, 0, 0)

    def give(self) -> None:
        """Wake who waits, or let the next one not wait. Thread: any."""
        # Who has just taken it and not said so yet looks at what there is to do after this.
        if not self._given:
            self._given = True
            self._post(self._semaphore)

    def take(self, until_ns: int | None = None) -> bool:
        """Wait, at most until an instant on CLOCK_MONOTONIC [ns]; return whether it was given."""
        if until_ns is None:
            failed = self._wait(self._semaphore)
        else:
            until = self._until
            until.tv_sec, until.tv_nsec = divmod(until_ns, _NS_PER_S)
            failed = self._wait_until(self._semaphore, time.CLOCK_MONOTONIC, self._pointer)
        if failed:
            return False
        self._given = False
        return True


@functools.cache
def _libc_of_semaphores() -> tuple[ctypes.CDLL, ctypes.PyDLL]:
    """Return libc to wait with, and libc to call without giving the interpreter away."""
    if sys.platform == "linux":
        libc = ctypes.CDLL(None)
        if hasattr(libc, "sem_clockwait"):  # glibc 2.30
            return libc, ctypes.PyDLL(None)
    raise OSError("sem_clockwait is not available on this platform")


def run_fifo(priority: int, *, inherited: bool = False) -> None:
    """Schedule the calling thread with SCHED_FIFO at `priority`, 1 to 99.

    Unless `inherited`, threads and processes that it starts get ordinary scheduling:
    a driver's helper thread must not outrank the machine.

    Raises:
        OSError: Not permitted (no CAP_SYS_NICE), or not on this platform.
    """
    if not hasattr(os, "sched_setscheduler"):
        raise OSError("SCHED_FIFO is not available on this platform")
    policy = os.SCHED_FIFO if inherited else os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
    os.sched_setscheduler(0, policy, os.sched_param(priority))


def change_fifo(priority: int) -> None:
    """Change the SCHED_FIFO priority of the calling thread, 1 to 99.

    Raises:
        OSError: Not permitted.
    """
    os.sched_setparam(0, os.sched_param(priority))


def run_first() -> None:
    """Let the calling thread run before all others of ordinary scheduling: nice -20.

    Threads and processes that it starts do not inherit it.

    Raises:
        OSError: Not permitted (no CAP_SYS_NICE), or not on this platform.
    """
    if not hasattr(os, "sched_setscheduler"):
        raise OSError("per-thread priorities are not available on this platform")
    # On Linux 0 is the calling thread, not the process: getpriority(2), C library differences.
    os.setpriority(os.PRIO_PROCESS, 0, -20)
    os.sched_setscheduler(0, os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, os.sched_param(0))


def niceness() -> int:
    """Return the nice value of the calling thread, -20 to 19; lower runs first."""
    return os.getpriority(os.PRIO_PROCESS, 0) if hasattr(os, "getpriority") else 0


def run_ordinarily(niceness: int) -> None:
    """Undo `run_first`: ordinary scheduling with this nice value for the calling thread."""
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    os.setpriority(os.PRIO_PROCESS, 0, niceness)


def demote(thread: int) -> None:
    """Give another thread of this process ordinary scheduling, by its native id.

    Raises:
        OSError: It has ended, or not on this platform.
    """
    if not hasattr(os, "sched_setscheduler"):
        raise OSError("per-thread priorities are not available on this platform")
    os.sched_setscheduler(thread, os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, os.sched_param(0))


def run_behind(niceness: int) -> None:
    """Let the calling process run behind others: 1 to 19, the higher the more.

    Raises:
        OSError: Not on this platform.
    """
    if not hasattr(os, "setpriority"):
        raise OSError("priorities are not available on this platform")
    os.setpriority(os.PRIO_PROCESS, 0, niceness)


def die_with_parent() -> None:
    """Have the kernel kill this process when the thread that started it ends, or its process.

    Does nothing where the kernel cannot. Source: prctl(2), PR_SET_PDEATHSIG.
    """
    try:
        _prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    except OSError:
        pass


def affinity() -> set[int]:
    """Return the cores that the calling thread may run on."""
    if not hasattr(os, "sched_getaffinity"):
        return set(range(os.cpu_count() or 1))
    return os.sched_getaffinity(0)


def run_on(cores: Iterable[int]) -> None:
    """Let the calling thread run on these cores only.

    Raises:
        OSError: None of them may be used, or not on this platform.
    """
    if not hasattr(os, "sched_setaffinity"):
        raise OSError("pinning is not available on this platform")
    os.sched_setaffinity(0, cores)


def timer_slack_ns() -> int:
    """Return by how much the calling thread's sleeps may be stretched [ns]."""
    return _prctl(_PR_GET_TIMERSLACK, 0)


def set_timer_slack(slack_ns: int) -> None:
    """Let the calling thread's sleeps be stretched by at most `slack_ns`; 0 for the default.

    Threads of SCHED_FIFO have none anyway.
    """
    _prctl(_PR_SET_TIMERSLACK, slack_ns)


def lock_memory() -> None:
    """Keep what is mapped now in memory, and what is mapped later once it is touched.

    Raises:
        OSError: Not permitted (RLIMIT_MEMLOCK, no CAP_IPC_LOCK), or not on this
            platform. Nothing is locked then.
    """
    if sys.platform != "linux":
        raise OSError("mlockall is not available on this platform")
    _check(_libc().mlockall(_MCL_CURRENT))
    _check(_libc().mlockall(_MCL_FUTURE | _MCL_ONFAULT))


def unlock_memory() -> None:
    """Undo `lock_memory`."""
    _libc().munlockall()


def may_lock_memory() -> bool:
    """Return whether `lock_memory` would be permitted, without doing it."""
    if sys.platform != "linux":
        return False
    import resource

    unlimited = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY
    status = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
    effective = next(
        (int(line.split()[1], 16) for line in status.splitlines() if line.startswith("CapEff")), 0
    )
    return unlimited or bool(effective >> _CAP_IPC_LOCK & 1)


def isolated_cores() -> set[int]:
    """Return the cores that the kernel keeps free of ordinary work (isolcpus=)."""
    cores: set[int] = set()
    for part in _read("/sys/devices/system/cpu/isolated").split(","):
        first, _, last = part.partition("-")
        if first.isdigit():
            cores.update(range(int(first), int(last or first) + 1))
    return cores


def is_preempt_rt() -> bool:
    """Return whether the kernel is built with PREEMPT_RT."""
    return _read("/sys/kernel/realtime") == "1"


def _read(path: str) -> str:
    try:
        return Path(path).read_text(encoding="ascii").strip()
    except OSError:
        return ""


def _prctl(option: int, argument: int) -> int:
    if sys.platform != "linux":
        raise OSError("prctl is a Linux interface")
    return _check(_libc().prctl(option, ctypes.c_ulong(argument), 0, 0, 0))


def _check(result: int) -> int:
    if result < 0:
        error = ctypes.get_errno()
        raise OSError(error, os.strerror(error))
    return result
