"""Event nodes: one tick per message of their trigger topic, first in, first out."""

from __future__ import annotations

import functools
from collections import deque
from concurrent.futures import Future

from horus.event_tick import EventTick
from horus.executors.async_io import TaskExecutor, TaskRunner
from horus.executors.thread import NodeThread, ThreadExecutor
from horus.live import LiveNode
from horus.loop.bridge import Bridge
from horus.loop.cycle import Cycle
from horus.loop.executor import Executor
from horus.loop.realtime import RealTime
from horus.loop.stacks import Stack
from horus.tick_path import RunTick, build_tick
from horus.units import to_s


class EventExecutor:
    """Sends each node to the event loop, or to a thread of its own if it is urgent.

    Urgent is a plain node with a priority, a budget or a deadline: an emergency
    stop must not wait behind a logger that blocks the loop.
    """

    def __init__(self, bridge: Bridge, cycle: Cycle, real_time: RealTime) -> None:
        """Serve the nodes of one run."""
        self._on_loop = LoopEventExecutor(bridge, cycle)
        self._on_threads = ThreadEventExecutor(real_time)

    def adopt(self, live: LiveNode) -> None:
        """Give the node its home."""
        self._home_of(live).adopt(live)

    def engage(self, live: LiveNode, from_ns: int) -> None:
        """Listen to the trigger topic, starting with what has arrived already."""
        self._home_of(live).engage(live, from_ns)

    def disengage(self, live: LiveNode) -> None:
        """Stop listening."""
        self._home_of(live).disengage(live)

    def cancel(self, live: LiveNode) -> None:
        """Cut a tick in progress short, if it is async."""
        self._home_of(live).cancel(live)

    def call(self, live: LiveNode, phase: str | None) -> Future[bool]:
        """Run a callback in the node's home."""
        return self._home_of(live).call(live, phase)

    def retime(self, live: LiveNode) -> None:
        """Do nothing: messages release the node."""

    def is_home(self, live: LiveNode) -> bool:
        """Return whether the calling thread is the node's home."""
        return self._home_of(live).is_home(live)

    def due_ns(self, live: LiveNode, now_ns: int) -> int | None:
        """Return the arrival of the message whose tick has not begun."""
        return self._home_of(live).due_ns(live, now_ns)

    def thread_id(self, live: LiveNode) -> int | None:
        """Return the thread that runs the node's callbacks."""
        return self._home_of(live).thread_id(live)

    def computes(self, live: LiveNode) -> bool:
        """Return whether an async tick has the loop at this moment."""
        return self._home_of(live).computes(live)

    def stack(self, live: LiveNode) -> Stack:
        """Return where the node's callbacks are."""
        return self._home_of(live).stack(live)

    def isolate(self, live: LiveNode) -> None:
        """Cut a frozen tick short, if it is async."""
        self._home_of(live).isolate(live)

    def dismiss(self, live: LiveNode) -> None:
        """Take the home away."""
        self._home_of(live).dismiss(live)

    def _home_of(self, live: LiveNode) -> Executor:
        spec = live.spec
        # As the node was configured: a budget set later does not move it.
        urgent = spec.priority is not None or live.core.spec.budget_given
        urgent = urgent or live.core.spec.deadline_given
        return self._on_threads if urgent and not live.is_async else self._on_loop


class Arrivals:
    """When each message arrived that waits: the release of its tick.

    Thread: `add` on the senders', the rest where the node ticks.
    """

    def __init__(self, live: LiveNode) -> None:
        """Begin with no messages."""
        assert live.trigger is not None
        self._live = live
        self.trigger = live.trigger
        self._now_ns = live.timeline.now_ns
        self._instants: deque[int] = deque(maxlen=live.trigger.capacity)

    def add(self) -> None:
        """Take note that a message has arrived."""
        self._instants.append(self._now_ns())

    def next_release_ns(self) -> int:
        """Return the arrival of the message whose turn it is [ns]."""
        # A message may be queued and not yet noted: its sender is between the two.
        return self._instants[0] if self._instants else self._now_ns()

    def due_ns(self) -> int | None:
        """Return the arrival of the message that waits for its tick [ns].

        None while nobody listens, or the node waits to restart. Thread: any.
        """
        trigger = self.trigger
        if trigger.wake is None or not trigger.queue or self._live.resume_after_ns():
            return None
        try:
            return self._instants[0]
        except IndexError:  # taken meanwhile, or not noted yet
            return None

    def forget_used(self) -> None:
        """Get in step with the queue after a tick."""
        while len(self._instants) > len(self.trigger.queue):
            self._instants.popleft()


class EventThread(NodeThread):
    """Sleeps until a message arrives, and ticks."""

    def __init__(self, live: LiveNode, real_time: RealTime) -> None:
        """Prepare a thread that does not listen yet."""
        super().__init__(live, functools.partial(real_time.enter_node_thread, live))
        self.engaged = False
        self.arrivals = Arrivals(live)
        self._run_tick = build_tick(live)

    def wake(self) -> None:
        """Take note of a message. Thread: any."""
        self.arrivals.add()
        self.unpark()

    def idle(self) -> None:
        """Wait for a message and tick for it."""
        arrivals = self.arrivals
        if not self.engaged or self.live.retired or not arrivals.trigger.queue:
            self.park()
            return
        delay_ns = self.live.resume_after_ns()
        if delay_ns:
            # Restarting: the messages wait, and are not lost to the back-off.
            self.park(self.live.timeline.now_ns() + delay_ns)
            return
        before = EventTick(self.live)
        self._run_tick(arrivals.next_release_ns())
        before.settle()
        arrivals.forget_used()


class ThreadEventExecutor(ThreadExecutor[EventThread]):
    """Gives every node an `EventThread`."""

    def __init__(self, real_time: RealTime) -> None:
        """Serve the nodes of one run."""
        super().__init__()
        self._real_time = real_time

    def make_thread(self, live: LiveNode) -> EventThread:
        """Return the node's thread, not started."""
        return EventThread(live, self._real_time)

    def engage(self, live: LiveNode, from_ns: int) -> None:
        """Listen to the trigger topic, starting with what has arrived already."""
        live.enter_service()
        thread = self.thread_of(live)
        thread.arrivals.trigger.wake = thread.wake
        thread.post(functools.partial(setattr, thread, "engaged", True))

    def disengage(self, live: LiveNode) -> None:
        """Stop listening; a tick in progress goes on."""
        live.leave_service()
        thread = self.thread_of(live)
        thread.arrivals.trigger.wake = None
        thread.engaged = False
        thread.unpark()

    def due_ns(self, live: LiveNode, now_ns: int) -> int | None:
        """Return the arrival of the message whose tick has not begun."""
        thread = self.find_thread(live)
        return None if thread is None else thread.arrivals.due_ns()

    def retime(self, live: LiveNode) -> None:
        """Do nothing: messages release the node."""


class LoopEventExecutor(TaskExecutor):
    """Wakes a node when its trigger topic receives a message."""

    def __init__(self, bridge: Bridge, cycle: Cycle) -> None:
        """Serve the nodes of one run."""
        super().__init__(bridge, cycle)
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
        """Stop listening."""
        super().disengage(live)
        self._runners[live].ignore()

    def due_ns(self, live: LiveNode, now_ns: int) -> int | None:
        """Return the arrival of the message whose tick has not begun."""
        runner = self._runners.get(live)
        return None if runner is None else runner.arrivals.due_ns()

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
        self._live = live
        self.arrivals = Arrivals(live)
        self._trigger = self.arrivals.trigger
        self._bridge = bridge
        self._run_tick = run_tick
        self._tasks = tasks
        self._scheduled = False

    def listen(self) -> None:
        self._trigger.wake = self.wake
        if self._trigger.queue:
            self._schedule()

    def ignore(self) -> None:
        self._trigger.wake = None

    def wake(self) -> None:
        """Take note of a message. Thread: any."""
        self.arrivals.add()
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
        release_ns = self.arrivals.next_release_ns()
        before = EventTick(live)
        if self._run_tick is None:
            task = self._tasks.start(live, release_ns)
            task.add_done_callback(lambda _: self._ticked(before))
        else:
            try:
                self._run_tick(release_ns)
            except KeyboardInterrupt:
                raise
            except BaseException as exc:
                live.broken(exc)
            self._ticked(before)

    def _ticked(self, before: EventTick) -> None:
        before.settle()
        self.arrivals.forget_used()
        if self._trigger.queue and not self._live.retired:
            self._schedule()
