"""Real-time scheduling: what is asked of the kernel, what it grants, and how it is given back.

With `rt=True` everything below is applied when a run starts; a refusal is a
readable degradation, never an error. Explicit `priority`, `core` and `cores` are
applied without it, too, as well as they can be.
"""

from __future__ import annotations

import contextlib
import functools
import gc
import logging
import math
import os
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from horus import os_rt
from horus.live import LiveNode
from horus.spec import SchedulerSpec

_log = logging.getLogger("horus.scheduler")

_SUPERVISOR_PRIORITY, _HOOK_PRIORITY = 99, 98
_LOWEST_PRIORITY, _HIGHEST_PRIORITY = 50, 89
_TIMER_SLACK_NS = 1
_NOT_LOCKED = (
    "mlockall not permitted (RLIMIT_MEMLOCK, no CAP_IPC_LOCK) - memory pages may be swapped"
)


class RealTime:
    """The real-time side of one scheduler.

    Thread: any; `enter_*` concern the thread that calls them.
    """

    def __init__(self, spec: SchedulerSpec) -> None:
        """Find out what would be granted, without changing anything that lasts."""
        self._rt = spec.rt
        self._cores = spec.cores
        self.spin_ns = spec.spin_ns
        self._degradations: dict[str, None] = {}
        self._lock = threading.Lock()
        if spec.rt:
            fifo = _try_fifo()
            if fifo is not None:
                self.degrade(f"SCHED_FIFO unavailable ({fifo}) - using SCHED_OTHER")
            if not os_rt.may_lock_memory():
                self.degrade(_NOT_LOCKED)

    @property
    def collects_garbage(self) -> bool:
        """Whether garbage is collected by supervision instead of automatically."""
        return self._rt

    def degradations(self) -> list[str]:
        """Return what was requested and refused."""
        with self._lock:
            return list(self._degradations)

    def degrade(self, what: str) -> None:
        """Take note of a refusal, and log it the first time."""
        with self._lock:
            if what in self._degradations:
                return
            self._degradations[what] = None
        _log.warning("%s", what)

    def priority_of(self, live: LiveNode) -> int | None:
        """Return the SCHED_FIFO priority of a node's thread; None for ordinary scheduling.

        Explicit, or with `rt=True` rate-monotonic: 50 at 1 Hz, ten more for each
        factor of ten.
        """
        if live.spec.priority is not None:
            return live.spec.priority
        if not self._rt:
            return None
        by_rate = _LOWEST_PRIORITY + round(10 * math.log10(live.spec.rate_hz))
        return min(max(by_rate, _LOWEST_PRIORITY), _HIGHEST_PRIORITY)

    def enter_node_thread(self, live: LiveNode) -> int | None:
        """Give a node's thread its core, its priority and exact sleeps; it ends with the run.

        Returns:
            The SCHED_FIFO priority that was granted; None for ordinary scheduling.
        """
        cores = self._cores_of(live)
        if cores is not None:
            self._pin(cores, f"node {live.name!r}")
        priority = self.priority_of(live)
        if priority is not None:
            try:
                os_rt.run_fifo(priority)
            except OSError as exc:
                reason = _reason(exc)
                if self._rt:
                    self.degrade(f"SCHED_FIFO unavailable ({reason}) - using SCHED_OTHER")
                else:
                    self.degrade(f"node {live.name!r}: priority {priority} refused ({reason})")
                priority = None
        with contextlib.suppress(OSError):
            os_rt.set_timer_slack(_TIMER_SLACK_NS)
        return priority

    def enter_worker_thread(self, live: LiveNode) -> None:
        """Give a compute node's thread its cores; under `rt=True`, see that it is not preempted.

        A thread that holds the interpreter while the kernel runs another program
        in its place keeps every Rt thread waiting, whatever their priorities.
        """
        cores = self._cores if live.spec.core is None else (live.spec.core,)
        if cores is not None:
            self._pin(cores, f"node {live.name!r}")
        if self._rt:
            with contextlib.suppress(OSError):
                os_rt.run_first()

    def cores_of_worker(self, live: LiveNode) -> tuple[int, ...] | None:
        """Return where a node's worker process runs; None for anywhere.

        Under `rt=True` away from the core that the Rt nodes share, if there is another.
        """
        if live.spec.core is not None:
            return (live.spec.core,)
        allowed = os_rt.affinity() if self._cores is None else set(self._cores)
        if self._rt:
            allowed = allowed - set(self._cores_of(live) or ()) or allowed
        return tuple(sorted(allowed)) or None

    def enter_supervisor_thread(self) -> None:
        """Put supervision, and the threads that it starts, above every node."""
        if self._rt:
            with contextlib.suppress(OSError):
                os_rt.run_fifo(_SUPERVISOR_PRIORITY, inherited=True)

    def enter_hook_thread(self) -> None:
        """Put a safe-state hook above every node and below supervision."""
        if self._rt:
            with contextlib.suppress(OSError):
                os_rt.run_fifo(_HOOK_PRIORITY)

    def demote_hook_thread(self, thread: threading.Thread) -> None:
        """Put a safe-state hook that does not return below every node, on which it may spin."""
        if self._rt and thread.native_id is not None:
            with contextlib.suppress(OSError):
                os_rt.demote(thread.native_id)

    @contextlib.contextmanager
    def in_loop_thread(self) -> Iterator[None]:
        """Pin the event loop's thread and make its timers exact, then put both back."""
        with _thread_put_back() as undo:
            if self._cores is not None:
                undo.setdefault("cores", functools.partial(os_rt.run_on, os_rt.affinity()))
                self._pin(self._cores, "the scheduler")
            with contextlib.suppress(OSError):
                slack_ns = os_rt.timer_slack_ns()
                os_rt.set_timer_slack(_TIMER_SLACK_NS)
                undo.setdefault("slack", functools.partial(os_rt.set_timer_slack, slack_ns))
            if self._rt:
                with contextlib.suppress(OSError):
                    before = os_rt.niceness()
                    os_rt.run_first()
                    undo.setdefault("niceness", functools.partial(os_rt.run_ordinarily, before))
            yield

    @contextlib.contextmanager
    def in_process(self) -> Iterator[None]:
        """With `rt=True`, lock memory and keep garbage collection out of ticks, then undo it."""
        with contextlib.ExitStack() as undo:
            if self._rt:
                undo.enter_context(_memory_locked(self))
                undo.enter_context(_garbage_frozen())
            yield

    def _cores_of(self, live: LiveNode) -> tuple[int, ...] | None:
        """Return where a node's real-time thread runs; None for anywhere.

        Under `rt=True` nodes that name no core share one: an isolated one if there
        is any, else the last of those allowed. Passing the baton within a core
        takes half as long as across two, and a thread that stays is not migrated.
        """
        if live.spec.core is not None:
            return (live.spec.core,)
        allowed = os_rt.affinity() if self._cores is None else set(self._cores)
        if self._rt and len(allowed) > 1:
            isolated = os_rt.isolated_cores()
            # Isolated cores are in nobody's default affinity: they have to be asked for.
            usable = isolated if self._cores is None else isolated & allowed
            return (max(usable or allowed),)
        return self._cores

    def _pin(self, cores: tuple[int, ...], who: str) -> None:
        try:
            os_rt.run_on(cores)
        except OSError as exc:
            listing = ", ".join(map(str, cores))
            self.degrade(f"{who} is not pinned to core {listing} ({_reason(exc)})")


def capabilities() -> dict[str, object]:
    """Return what this process could have, and facts about the machine."""
    isolated = os_rt.isolated_cores()
    return {
        "rt_scheduling": _try_fifo() is None,
        "memory_locking": os_rt.may_lock_memory(),
        "cpu_isolation": bool(isolated),
        "isolated_cores": sorted(isolated),
        "cores": sorted(os_rt.affinity()),
        "preempt_rt": os_rt.is_preempt_rt(),
        "kernel": f"{os.uname().sysname} {os.uname().release}" if hasattr(os, "uname") else "",
    }


@dataclass(slots=True)
class _ChangedThread:
    """A thread that runs have changed, and what undoes the first change of each kind."""

    undo: dict[str, Callable[[], None]] = field(default_factory=dict)
    users: int = 0


_changed_threads: dict[int, _ChangedThread] = {}


@contextlib.contextmanager
def _thread_put_back() -> Iterator[dict[str, Callable[[], None]]]:
    """Undo what was changed in the calling thread once no run on it needs that any more.

    Runs that share an event loop end in any order: the last to end, not the first to
    have begun, puts back what there was before all of them.
    """
    thread_id = threading.get_ident()
    changed = _changed_threads.setdefault(thread_id, _ChangedThread())
    changed.users += 1
    try:
        yield changed.undo
    finally:
        changed.users -= 1
        if changed.users == 0:
            del _changed_threads[thread_id]
            with contextlib.ExitStack() as all_of_it:
                for undo in changed.undo.values():
                    all_of_it.callback(undo)


_process_lock = threading.Lock()
_locked_by = 0
_frozen_by = 0
_collected_before = True
_thaws = True


@contextlib.contextmanager
def _memory_locked(real_time: RealTime) -> Iterator[None]:
    """Lock memory while any run wants it."""
    global _locked_by
    with _process_lock:
        granted = True
        if _locked_by == 0:
            try:
                os_rt.lock_memory()
            except OSError as exc:
                granted = False
                failed = f"mlockall failed ({exc.strerror}) - memory pages may be swapped"
                real_time.degrade(failed if os_rt.may_lock_memory() else _NOT_LOCKED)
        _locked_by += granted
    try:
        yield
    finally:
        with _process_lock:
            _locked_by -= granted
            if granted and _locked_by == 0:
                os_rt.unlock_memory()


@contextlib.contextmanager
def _garbage_frozen() -> Iterator[None]:
    """Leave garbage to supervision while any run wants it.

    An automatic collection stops all threads for milliseconds in a program with
    many objects. What exists at the start is frozen: it is looked at no more.
    """
    global _frozen_by, _collected_before, _thaws
    with _process_lock:
        if _frozen_by == 0:
            _collected_before = gc.isenabled()
            gc.collect()
            # Frozen by the application: it stays so, and is not ours to thaw.
            _thaws = gc.get_freeze_count() == 0
            gc.freeze()
            gc.disable()
        _frozen_by += 1
    try:
        yield
    finally:
        with _process_lock:
            _frozen_by -= 1
            if _frozen_by == 0:
                if _thaws:
                    gc.unfreeze()
                if _collected_before:
                    gc.enable()


def _try_fifo() -> str | None:
    """Return why SCHED_FIFO is refused, or None; tried on a thread that ends at once."""
    refusal: list[str] = []

    def attempt() -> None:
        try:
            os_rt.run_fifo(1)
        except OSError as exc:
            refusal.append(_reason(exc))

    thread = threading.Thread(target=attempt)
    thread.start()
    thread.join()
    return refusal[0] if refusal else None


def _reason(exc: OSError) -> str:
    if isinstance(exc, PermissionError):
        return "no CAP_SYS_NICE"
    return exc.strerror or str(exc)
