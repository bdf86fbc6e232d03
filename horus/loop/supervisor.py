"""The supervisor of a session: the tasks that look after it, whatever the nodes do."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import gc
import itertools
import logging
from collections.abc import Callable, Coroutine
from typing import Any

from horus import os_rt
from horus.clock import FOREVER_NS, Timeline
from horus.live import LiveNode
from horus.loop.bridge import Bridge
from horus.loop.ending import Ending, WayOut
from horus.loop.fault_log import FaultLog
from horus.loop.inspector import Inspector
from horus.loop.notify import Notifier
from horus.loop.pace import Pace
from horus.loop.realtime import RealTime
from horus.loop.safety import Safety
from horus.loop.supervisor_thread import SupervisorThread
from horus.loop.watchdog import Members, Watchdog
from horus.spec import Health, SchedulerSpec
from horus.units import to_s

_log = logging.getLogger("horus.supervisor")

_SHORTEST_SLEEP_S = 0.001
_PAUSE_AFTER_FAILURE_S = 0.1
_SECONDS_PER_FULL_COLLECTION = 60


class Supervisor:
    """Looks after the nodes of one session on a thread that none of them can block.

    ==================  ==============================================================
    task                what it does
    ==================  ==============================================================
    `_watch`            inspects the nodes when a watchdog timeout may have run out
    `_check_pace`       says it when a node runs slower than asked
    `Ending`            interrupts the callback that keeps a run from its end
    `_collect_garbage`  replaces the automatic collections under `rt=True`
    `FaultLog`          has all stacks written should Python itself stand still
    `Notifier`          tells systemd that all is well
    ==================  ==============================================================

    Thread: any, except `start` and `close`, which belong to those who drive the nodes.
    """

    def __init__(
        self,
        spec: SchedulerSpec,
        timeline: Timeline,
        real_time: RealTime,
        safety: Safety,
        members: Members,
        fault_log: FaultLog,
    ) -> None:
        """Prepare; nothing is watched before `start`."""
        self._timeline = timeline
        self._real_time = real_time
        self._safety = safety
        self._fault_log = fault_log
        self._patience_s = to_s(spec.shutdown_timeout_ns)
        self._thread = SupervisorThread(spec.name, real_time.enter_supervisor_thread)
        self._watchdog = Watchdog(spec.watchdog_ns, members)
        self._inspector = Inspector(self._watchdog, safety, timeline.now_ns, self.report)
        self._changed = asyncio.Event()
        self._started = False

    def start(self) -> None:
        """Begin to watch, unless it has begun."""
        if self._started:
            return
        self._started = True
        self._thread.start()
        self._spawn(self._watch)

    def attend(self) -> None:
        """Look after a run loop, too."""
        if self._real_time.collects_garbage:
            self._spawn(_collect_garbage)
        self._spawn(self._check_pace)

    def see_end(self, bridge: Bridge, stop: Callable[[], None], way_out: WayOut | None) -> Ending:
        """See to it that a run ends; see `Ending`."""
        return Ending(self._thread, bridge, stop, way_out, self._patience_s)

    def notify(self, notifier: Notifier) -> None:
        """Send the service manager signs of life for as long as all is well."""
        self._spawn(lambda: notifier.keep_alive(self._is_well))

    def look_again(self) -> None:
        """Take note that nodes have come, or that a timeout has changed."""
        self._thread.call(self._changed.set)

    def critical_late(self, live: LiveNode, lasted_ns: int, times_cleared: int) -> None:
        """Act on a critical node's tick that took too long [ns] and ended before we could look."""
        act = functools.partial(self._inspector.critical_late, live, lasted_ns, times_cleared)
        self._thread.call(act)

    def report(self, write: Callable[[], None]) -> None:
        """Log something soon; return at once."""
        self._thread.report(write)

    def close(self) -> None:
        """Watch no more."""
        self._thread.close()

    # -- tasks -----------------------------------------------------------------------

    def _spawn(self, work: Callable[[], Coroutine[Any, Any, None]]) -> None:
        self._thread.spawn(work)

    async def _watch(self) -> None:
        loop = asyncio.get_running_loop()
        dumping: asyncio.Task[None] | None = None
        while True:
            self._changed.clear()
            try:
                self._inspector.inspect()
            except Exception as exc:
                # Supervision goes on whatever happens to it.
                self.report(functools.partial(_log.error, "an inspection failed", exc_info=exc))
                # It may not have come to the point of saying when to look again.
                await asyncio.sleep(_PAUSE_AFTER_FAILURE_S)
                continue
            if self._inspector.next_ns == FOREVER_NS:
                await self._changed.wait()
                continue
            if dumping is None:
                dumping = loop.create_task(
                    self._fault_log.keep_putting_off(self._watchdog.shortest_ns, self.report)
                )
            delay_s = to_s(self._inspector.next_ns - self._timeline.now_ns())
            alarm = loop.call_later(max(_SHORTEST_SLEEP_S, delay_s), self._changed.set)
            await self._changed.wait()
            alarm.cancel()

    async def _check_pace(self) -> None:
        pace = Pace(self._watchdog.watched)
        while True:
            for slow in pace.look(self._timeline.now_ns()):
                self.report(slow.log)
            await asyncio.sleep(1.0)

    def _is_well(self) -> bool:
        critical = (live for live in self._watchdog.watched() if live.critical_ns is not None)
        healthy = all(live.standing.health is Health.HEALTHY for live in critical)
        return healthy and not self._safety.active


async def _collect_garbage() -> None:
    """Collect garbage little and often, in place of the automatic collections.

    What a second has left behind is little, and so is the time for which other
    threads have to wait. What gets old is looked at once a minute.
    """
    for second in itertools.count(1):
        await asyncio.sleep(1.0)
        await asyncio.to_thread(_collect, 2 if second % _SECONDS_PER_FULL_COLLECTION == 0 else 1)


def _collect(generation: int) -> None:
    """Collect garbage on a thread of its own: finalizers are other people's code, and may hang."""
    with contextlib.suppress(OSError):
        os_rt.run_first()
    gc.collect(generation)
