"""Driving nodes from plain code on one thread: `tick_once` and deterministic mode.

Both run every node, of every class, inline. `Stepper` holds what they share:
each node's tick path, and a private event loop for the async ones.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Collection, Iterable

from horus import clock
from horus.clock import Timeline
from horus.live import LiveNode
from horus.loop.private_loop import StepLoop
from horus.spec import NodeState
from horus.tick_path import RunTick, RunTickAsync, build_async_tick, build_tick


class Stepper:
    """Initialises, ticks and shuts down nodes on the calling thread.

    Thread: one at a time.
    """

    def __init__(self, timeline: Timeline) -> None:
        """Begin with no nodes."""
        self.timeline = timeline
        self._plain: dict[LiveNode, RunTick] = {}
        self._async: dict[LiveNode, RunTickAsync] = {}
        self._in_order: list[LiveNode] = []
        self._step_loop: StepLoop | None = None
        self._depth = 0
        self._changes: deque[Callable[[], None]] = deque()

    @property
    def step_loop(self) -> StepLoop:
        """The private event loop of the async nodes, made when the first one needs it."""
        if self._step_loop is None:
            self._step_loop = self.make_loop()
        return self._step_loop

    def make_loop(self) -> StepLoop:
        """Return a loop on real time."""
        return StepLoop(asyncio.new_event_loop())

    def start(self, lives: Iterable[LiveNode]) -> None:
        """Begin with these nodes: call `init()` of each, in order."""
        clock.set_ambient(self.timeline)
        for live in lives:
            self.add(live)

    def add(self, live: LiveNode) -> None:
        """Make a node ready to tick, calling `init()` if it has not been.

        Called from a callback, a plain node is ready at once, an async one when
        that callback has ended: its `init()` needs the loop.
        """
        self._change(live, lambda: self._add(live))

    def remove(self, live: LiveNode) -> None:
        """Shut a node down and forget it: at once, or when the callback that asks has ended.

        The latter for a node that removes itself, and for async nodes.
        """
        live.leave_service()
        self._change(live, lambda: self._remove(live))

    def retime(self, live: LiveNode) -> None:
        """Do nothing: steps have no rates."""

    def run_phase(self, live: LiveNode, phase: str) -> None:
        """Run a callback other than `tick`."""
        self._depth += 1
        try:
            if live.is_async:
                self.step_loop.run(live.run_phase_async(phase), live.context)
            else:
                live.run_phase(phase)
        finally:
            self._callback_ended()

    def tick(self, live: LiveNode, release_ns: int) -> None:
        """Run a tick to its end."""
        self._depth += 1
        try:
            if live.is_async:
                self.step_loop.run(self._async[live](release_ns), live.context)
            else:
                self._plain[live](release_ns)
        finally:
            self._callback_ended()

    def cycle(self, stopped: Callable[[], bool], named: Collection[LiveNode] | None) -> None:
        """Tick the nodes once, in order, without rate control; only those named, if any are.

        An event node ticks once per message that waits when its turn comes.
        """
        timeline = self.timeline
        timeline.begin_step()
        for live in self._in_order:
            if live.retired or (named is not None and live not in named):
                continue
            if live.trigger is not None:
                self._tick_per_message(live)
            else:
                self.tick(live, timeline.now_ns())
            if stopped():
                break
        timeline.end_step()

    def shut_down(self, lives: Iterable[LiveNode]) -> None:
        """Call `shutdown()` of each initialised node, in reverse order."""
        for live in sorted(lives, key=lambda live: live.rank, reverse=True):
            self.shut_down_one(live)

    def shut_down_one(self, live: LiveNode) -> None:
        """Call `shutdown()` of a node, if it is initialised."""
        live.leave_service()
        if live.initialized:
            live.state = NodeState.STOPPING
            self.run_phase(live, "shutdown")
            live.stopped()

    def close(self) -> None:
        """Give the private loop back."""
        if self._step_loop is not None:
            self._step_loop.close()
            self._step_loop = None

    def _add(self, live: LiveNode) -> None:
        if live.removed:
            return
        if live.is_async:
            self._async[live] = build_async_tick(live)
        else:
            self._plain[live] = build_tick(live)
        if live.state is NodeState.UNINITIALIZED:
            self.run_phase(live, "init")
        live.enter_service()
        self._in_order = sorted([*self._in_order, live], key=lambda live: live.rank)

    def _remove(self, live: LiveNode) -> None:
        self._in_order = [other for other in self._in_order if other is not live]
        self.shut_down_one(live)
        self._plain.pop(live, None)
        self._async.pop(live, None)

    def _change(self, live: LiveNode, change: Callable[[], None]) -> None:
        """Change who takes part: now, or when the callback on the stack below has ended."""
        if self._depth and (live.is_async or live.ticking):
            self._changes.append(change)
        else:
            change()

    def _callback_ended(self) -> None:
        """Make the changes that had to wait for the end of the outermost callback."""
        self._depth -= 1
        while self._changes and not self._depth:
            self._changes.popleft()()

    def _tick_per_message(self, live: LiveNode) -> None:
        trigger = live.trigger
        assert trigger is not None
        for _ in range(len(trigger.queue)):
            received = trigger.received
            self.tick(live, self.timeline.now_ns())
            trigger.consume_one_since(received)
            if not trigger.queue:
                return
