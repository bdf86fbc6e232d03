"""Driving nodes from plain code on one thread: `tick_once` and deterministic mode.

Both run every node, of every class, inline. `Stepper` holds what they share:
each node's tick path, and a private event loop for the async ones.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections import deque
from collections.abc import Callable, Collection, Iterable
from concurrent.futures import Future

from horus import clock
from horus.clock import Timeline
from horus.event_tick import EventTick
from horus.live import LiveNode
from horus.loop.executor import Home
from horus.loop.private_loop import StepLoop, StuckError
from horus.loop.safety import HOOK_TIMEOUT_S, Safety
from horus.loop.stacks import Stack, stack_of_task, stack_of_thread
from horus.spec import NodeState
from horus.tick_path import RunTick, RunTickAsync, build_async_tick, build_tick


class Stepper:
    """Initialises, ticks and shuts down nodes on the calling thread.

    Thread: one at a time drives; `add`, `remove` and `retime` may come from any.
    """

    def __init__(
        self,
        timeline: Timeline,
        step_loop: Callable[[], StepLoop],
        stopped: Callable[[], bool],
        safety: Safety,
    ) -> None:
        """Begin with no nodes.

        Args:
            timeline: The scheduler's time.
            step_loop: Returns the event loop of the async nodes.
            stopped: Asked between callbacks whether to end early.
            safety: Told of nodes that begin to take part.
        """
        self.timeline = timeline
        self.step_loop = step_loop
        self.stopped = stopped
        self._safety = safety
        self._plain: dict[LiveNode, RunTick] = {}
        self._async: dict[LiveNode, RunTickAsync] = {}
        self._in_order: tuple[LiveNode, ...] = ()
        # Each node with its plain tick path; None where a tick takes more than a call.
        self._cycle: list[tuple[LiveNode, RunTick | None]] = []
        self._taken_on: tuple[LiveNode, ...] = ()
        self._depth = 0
        self._driver: int | None = None
        self._lock = threading.RLock()
        self._changes: deque[Callable[[], object]] = deque()

    def take_on(self, lives: tuple[LiveNode, ...]) -> bool:
        """Make the nodes that are new ready to tick, calling `init()`, in order.

        Return whether there are any.
        """
        if lives is self._taken_on:
            return False
        clock.set_ambient(self.timeline)
        for live in lives:
            if not self.stopped():
                self._add(live)
        self._taken_on = lives
        return True

    def add(self, live: LiveNode) -> None:
        """Let a node take part that was added while others tick.

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
                self.step_loop().run(live.run_phase_async(phase), live.context)
            else:
                live.run_phase(phase)
        except StuckError as exc:
            live.phase_failed(phase, exc)
            live.state = NodeState.ERROR if phase == "init" else live.state
        finally:
            self._callback_ended()

    def tick(self, live: LiveNode, release_ns: int) -> None:
        """Run a tick to its end."""
        self._depth += 1
        try:
            if live.is_async:
                # Cancelled: it was frozen, and is isolated.
                with contextlib.suppress(asyncio.CancelledError):
                    self.step_loop().run(self._async[live](release_ns), live.context)
            else:
                self._plain[live](release_ns)
        finally:
            self._callback_ended()

    def cycle(self, named: Collection[LiveNode] | None) -> None:
        """Tick the nodes once, in order, without rate control; only those named, if any are.

        An event node ticks once per message that waits when its turn comes.
        """
        timeline = self.timeline
        now_ns = timeline.now_ns
        stopped = self.stopped
        timeline.begin_step()
        self.begin_driving()
        try:
            for live, run_tick in self._cycle:
                if live.retired or (named is not None and live not in named):
                    continue
                if run_tick is not None:
                    self._depth += 1
                    run_tick(now_ns())
                    self._depth -= 1
                    if self._changes:
                        self._make_changes()
                elif live.trigger is not None:
                    self._tick_per_message(live)
                else:
                    self.tick(live, now_ns())
                if stopped():
                    break
        finally:
            self.end_driving()
        timeline.end_step()

    def begin_driving(self) -> None:
        """Become the thread that makes changes of membership."""
        self._driver = threading.get_ident()

    def end_driving(self) -> None:
        """Make the changes that others have asked for, and let them make their own."""
        self._depth = 0
        with self._lock:
            self._make_changes()
            self._driver = None

    def shut_down(self, lives: Iterable[LiveNode]) -> None:
        """Call `shutdown()` of each initialised node, in reverse order."""
        for live in sorted(lives, key=lambda live: live.rank, reverse=True):
            self.shut_down_one(live)

    def shut_down_one(self, live: LiveNode) -> None:
        """Call `shutdown()` of a node, if it is initialised, after its safe-state hook."""
        live.leave_service()
        if not self.timeline.deterministic:
            live.standing.hook_returned.wait(HOOK_TIMEOUT_S)
        if live.claim_shutdown():
            self.run_phase(live, "shutdown")
            live.stopped()

    # -- what supervision asks -----------------------------------------------------

    def members(self) -> list[tuple[LiveNode, Home]]:
        """Return the nodes that take part. Thread: any."""
        return [(live, self) for live in self._in_order]

    def due_ns(self, live: LiveNode, now_ns: int) -> int | None:
        """Return None: a step that is not taken is not owed."""
        return None

    def thread_id(self, live: LiveNode) -> int | None:
        """Return the thread that drives. Thread: any."""
        return self._driver

    def computes(self, live: LiveNode) -> bool:
        """Return False: nobody waits for the thread that drives."""
        return False

    def stack(self, live: LiveNode) -> Stack:
        """Return where the tick in progress is. Thread: any other."""
        step = self.step_loop().running if live.is_async else None
        return stack_of_thread(self._driver) if step is None else stack_of_task(*step)

    def isolate(self, live: LiveNode) -> None:
        """Cancel an async tick, so that the step can end. Thread: any other."""
        if live.is_async:
            self.step_loop().cancel()

    def close(self) -> None:
        """Give back what is the stepper's own."""

    def _add(self, live: LiveNode) -> None:
        if live.removed or live in self._in_order:
            return
        if live.is_async:
            self._async[live] = build_async_tick(live)
        else:
            self._plain[live] = build_tick(live)
        if live.state is NodeState.UNINITIALIZED:
            self.run_phase(live, "init")
        if live.removed:
            self.shut_down_one(live)
            return
        self._safety.join(live)
        live.enter_service()
        self._put_in_order((*self._in_order, live))

    def _remove(self, live: LiveNode) -> None:
        self._put_in_order(other for other in self._in_order if other is not live)
        self.shut_down_one(live)
        self._plain.pop(live, None)
        self._async.pop(live, None)

    def _put_in_order(self, lives: Iterable[LiveNode]) -> None:
        self._in_order = tuple(sorted(lives, key=lambda live: live.rank))
        self._cycle = [
            (live, None if live.trigger is not None else self._plain.get(live))
            for live in self._in_order
        ]

    def _change(self, live: LiveNode, change: Callable[[], None]) -> None:
        """Change who takes part: now, or when the callback on the stack below has ended.

        Asked from another thread than the one that drives, wait for that one.
        """
        made: Future[None] = Future()

        def make() -> None:
            try:
                change()
            except BaseException as exc:
                made.set_exception(exc)
            else:
                made.set_result(None)

        context = clock.current.get()
        # In a callback of ours we are at home, whatever thread it runs on.
        inside = context is not None and context.timeline is self.timeline
        with self._lock:
            elsewhere = not inside and self._driver not in (None, threading.get_ident())
            deferred = elsewhere or (self._depth and (live.is_async or live.ticking))
            if deferred:
                self._changes.append(make)
        if elsewhere:
            made.result()
        elif not deferred:
            change()

    def _callback_ended(self) -> None:
        """Make the changes that had to wait for the end of the outermost callback."""
        self._depth -= 1
        if self._changes:
            self._make_changes()

    def _make_changes(self) -> None:
        while self._changes and not self._depth:
            self._changes.popleft()()

    def _tick_per_message(self, live: LiveNode) -> None:
        trigger = live.trigger
        assert trigger is not None
        for _ in range(len(trigger.queue)):
            before = EventTick(live)
            self.tick(live, self.timeline.now_ns())
            before.settle()
            if not trigger.queue or live.retired:
                return
