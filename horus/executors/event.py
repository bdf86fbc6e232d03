"""Event nodes: one tick per message of their trigger topic, first in, first out."""

from __future__ import annotations

from collections import deque
from concurrent.futures import Future

from horus.executors.async_io import TaskRunner
from horus.executors.base import LoopExecutor
from horus.live import EventTick, LiveNode
from horus.loop.bridge import Bridge
from horus.loop.cycle import Cycle
from horus.tick_path import RunTick, build_tick
from horus.units import to_s


class EventExecutor(LoopExecutor):
    """Wakes a node when its trigger topic receives a message."""

    def __init__(self, bridge: Bridge, cycle: Cycle) -> None:
        """Serve the nodes of one run."""
        super().__init__(bridge, cycle)
        self._tasks = TaskRunner(bridge)
        self._runners: dict[LiveNode, _EventRunner] = {}

    def adopt(self, live: LiveNode) -> None:
        """Build the node's tick path."""
        if live.is_async:
            self._tasks.adopt(live)
            self._runners[live] = _EventRunner(live, self._bridge, None, self._tasks)
        else:
            self._runners[live] = _EventRunner(live, self._bridge, build_tick(live), self._tasks)

    def engage(self, live: LiveNode, from_ns: int) -> None:
        """Listen to the trigger topic, starting with what has arrived already."""
        live.enter_service()
        self._runners[live].listen()

    def disengage(self, live: LiveNode) -> None:
        """Stop listening; an async tick in progress is cancelled."""
        super().disengage(live)
        self._runners[live].ignore()
        self._tasks.cancel(live)

    def call(self, live: LiveNode, phase: str | None) -> Future[bool]:
        """Run a callback on the loop's thread."""
        if live.is_async:
            return self._tasks.call(live, phase)
        return self.call_plain(live, phase)

    def dismiss(self, live: LiveNode) -> None:
        """Forget the node."""
        self._runners.pop(live, None)
        self._tasks.forget(live)


class _EventRunner:
    """Turns messages into ticks of one node.

    Thread: loop, except `wake`, which senders call on theirs.
    """

    def __init__(
        self, live: LiveNode, bridge: Bridge, run_tick: RunTick | None, tasks: TaskRunner
    ) -> None:
        trigger = live.trigger
        assert trigger is not None
        self._live = live
        self._trigger = trigger
        self._bridge = bridge
        self._run_tick = run_tick
        self._tasks = tasks
        self._scheduled = False
        self._now_ns = live.timeline.now_ns
        # When each waiting message arrived: its tick's release. In step with the
        # queue, and as bounded.
        self._arrivals: deque[int] = deque(maxlen=trigger.capacity)

    def listen(self) -> None:
        self._trigger.wake = self.wake
        if self._trigger.queue:
            self.wake()

    def ignore(self) -> None:
        self._trigger.wake = None

    def wake(self) -> None:
        """Take note of a message. Thread: any."""
        self._arrivals.append(self._now_ns())
        self._schedule()

    def _schedule(self) -> None:
        if not self._scheduled:
            self._scheduled = True
            if self._bridge.on_loop_thread():
                self._bridge.loop.call_soon(self._step)
            else:
                self._bridge.post(self._step)

    def _step(self) -> None:
        """Tick once; if more messages wait, come back after the loop's other work."""
        self._scheduled = False
        live = self._live
        if live.retired or not self._trigger.queue or self._tasks.busy(live):
            return
        delay_ns = live.resume_after_ns()
        if delay_ns:
            # Restarting: the messages wait, and are not lost to the back-off.
            self._scheduled = True
            self._bridge.loop.call_later(to_s(delay_ns), self._step)
            return
        release_ns = self._arrivals[0] if self._arrivals else self._now_ns()
        before = EventTick(live)
        if self._run_tick is None:
            task = self._tasks.start(live, release_ns)
            task.add_done_callback(lambda _: self._ticked(before))
        else:
            self._run_tick(release_ns)
            self._ticked(before)

    def _ticked(self, before: EventTick) -> None:
        before.settle()
        while len(self._arrivals) > len(self._trigger.queue):
            self._arrivals.popleft()
        if self._trigger.queue and not self._live.retired:
            self._schedule()
