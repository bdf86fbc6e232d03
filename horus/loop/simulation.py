"""Deterministic mode: every class on one thread, in virtual time, in a fixed order."""

from __future__ import annotations

import asyncio
import functools
import logging
from collections.abc import Callable, Collection, Iterable

from horus.clock import FOREVER_NS, SimClock, Timeline
from horus.errors import StateError
from horus.event_tick import EventTick
from horus.graph import contradictions, dataflow_order
from horus.live import LiveNode
from horus.loop.inspector import Inspector
from horus.loop.pacer import Pacer
from horus.loop.private_loop import VirtualLoop
from horus.loop.releases import ReleaseQueue
from horus.loop.safety import Safety
from horus.loop.stacks import Stack, stack_of_task, stack_of_thread
from horus.loop.stepping import Stepper
from horus.units import to_s

_log = logging.getLogger("horus.scheduler")

_MAX_EVENTS_AT_ONCE = 10_000
"""Event ticks at one instant beyond which a feedback loop is assumed."""


class Simulation(Stepper):
    """A discrete-event simulation of the run loop.

    `advance` is its body::

        while something happens before the end:
            move the clock to the earliest release or timer; paced, wait for it
            let async ticks go on whose sleep is over
            let the watchdog look at those that still wait
            for each node released at this instant, in execution order:
                tick it; an async tick starts and goes on until it awaits
                tick the event nodes whose messages have arrived
        move the clock to the end

    Execution order is `order`, then publishers before subscribers, then
    insertion. A tick takes no virtual time, except what it awaits.

    Thread: one at a time.
    """

    def __init__(
        self,
        timeline: Timeline,
        sim_clock: SimClock,
        stopped: Callable[[], bool],
        safety: Safety,
        inspector: Inspector,
        pacer: Pacer,
    ) -> None:
        """Begin at the clock's instant, with no nodes."""
        super().__init__(timeline, self._virtual_loop, stopped, safety)
        self._inspector = inspector
        self._pacer = pacer
        self._clock = sim_clock
        self._begun = False
        self._releases = ReleaseQueue()
        self._messaged: dict[LiveNode, None] = {}
        self._in_flight: dict[LiveNode, asyncio.Task[None]] = {}
        self._places: dict[LiveNode, tuple[int, int]] = {}
        self._virtual: VirtualLoop | None = None

    # -- membership ---------------------------------------------------------------

    def take_on(self, lives: tuple[LiveNode, ...]) -> bool:
        """Make the nodes that are new ready to tick; the first call begins the release grid."""
        news = super().take_on(lives)
        if self._begun:
            return news
        self._begun = True
        self.timeline.begin(self._clock.now_ns())
        self._find_order()
        for live in self._in_order:
            self._join(live)
        for edge in contradictions(self._in_order):
            _log.info(
                "order runs %s before %s, which publishes its topic %r: "
                "each message arrives one cycle later",
                edge.subscriber,
                edge.publisher,
                edge.topic,
            )
        return news

    def retime(self, live: LiveNode) -> None:
        """Move a node to the grid of its changed rate."""
        self._change(live, lambda: self._releases.retime(live, self._clock.now_ns()))

    def shut_down(self, lives: Iterable[LiveNode]) -> None:
        """Cancel async ticks, then call each node's `shutdown()` in reverse order."""
        for task in self._in_flight.values():
            task.cancel()
        self._settle()
        super().shut_down(lives)

    def close(self) -> None:
        """Give back the event loop."""
        if self._virtual is not None:
            self._virtual.close()
            self._virtual = None

    def _virtual_loop(self) -> VirtualLoop:
        if self._virtual is None:
            self._virtual = VirtualLoop(self._clock)
        return self._virtual

    def _add(self, live: LiveNode) -> None:
        super()._add(live)
        if self._begun and live in self._in_order:
            self._find_order()
            self._join(live)

    def _remove(self, live: LiveNode) -> None:
        self._releases.remove(live)
        self._messaged.pop(live, None)
        if live.trigger is not None:
            live.trigger.wake = None
        task = self._in_flight.pop(live, None)
        if task is not None:
            task.cancel()
            self._settle()
        super()._remove(live)

    def _join(self, live: LiveNode) -> None:
        trigger = live.trigger
        if trigger is None:
            self._releases.add(live, self._places[live], self._clock.now_ns())
            return
        trigger.wake = lambda: self._messaged.setdefault(live)
        if trigger.queue:
            self._messaged.setdefault(live)

    def _find_order(self) -> None:
        by_arrival = sorted(self._in_order, key=lambda live: live.sequence)
        place = {name: index for index, name in enumerate(dataflow_order(by_arrival))}
        self._places = {live: (place[live.name], 0) for live in by_arrival}
        self._releases.rerank(self._places)

    # -- time ----------------------------------------------------------------------

    def advance(self, until_ns: int | None, only: Collection[LiveNode] | None = None) -> None:
        """Simulate what happens before `until_ns`; None until stopped or nothing is left.

        Args:
            until_ns: The end, exclusive [ns].
            only: The nodes that may tick; None lets all of them.
        """
        self.begin_driving()
        self._pacer.begin(self._clock.now_ns())
        try:
            self._deliver(only)
            while not self.stopped():
                instant_ns = self._next_ns()
                if instant_ns is None or (until_ns is not None and instant_ns >= until_ns):
                    break
                self._pacer.wait_until(instant_ns, self.stopped)
                if self.stopped():
                    break
                self._clock.advance_to(instant_ns)
                self._settle()
                if self._in_flight:
                    self._inspector.inspect()
                self._deliver(only)
                while not self.stopped() and (due := self._releases.pop_due(instant_ns)):
                    live, release_ns = due
                    if only is None or live in only:
                        self._release(live, release_ns)
                        self._deliver(only)
            if until_ns is not None:
                self._pacer.wait_until(until_ns, self.stopped)
                if not self.stopped():
                    self._clock.advance_to(until_ns)
        finally:
            self.end_driving()

    def cycle(self, named: Collection[LiveNode] | None) -> None:
        """Advance by one cycle; nodes that are named tick in it exactly once, due or not."""
        grid = self.timeline.grid
        now_ns = self._clock.now_ns()
        end_ns = grid.at(grid.index_at(now_ns) + 1)
        if named is None:
            self.advance(end_ns)
            return
        self.begin_driving()
        try:
            for live in sorted(named, key=self._places.__getitem__):
                if live.trigger is None and not live.retired:
                    self._release(live, now_ns)
                self._deliver(named)
        finally:
            self.end_driving()
        self.advance(end_ns, only=())

    def _next_ns(self) -> int | None:
        timer_ns = self._virtual.next_timer_ns if self._virtual is not None else None
        # A tick takes time only if it awaits something: else there is nothing to watch.
        look_ns = self._inspector.next_ns if self._in_flight else None
        instants = (self._releases.next_ns, timer_ns, look_ns)
        return min((t for t in instants if t is not None and t != FOREVER_NS), default=None)

    # -- ticks ----------------------------------------------------------------------

    def _release(self, live: LiveNode, release_ns: int) -> None:
        if not live.is_async:
            self.tick(live, release_ns)
            if self._virtual is not None and self._virtual.has_work:
                # It woke an async tick: that goes on now, not at the next instant.
                self._settle()
            return
        if live in self._in_flight:
            live.counters.skipped += 1
            return
        task = self._in_flight[live] = self._virtual_loop().loop.create_task(
            self._async[live](release_ns),
            name=f"horus:{live.name}",
            context=live.context,
        )
        task.add_done_callback(lambda _: self._in_flight.pop(live, None))
        self._settle()

    def _settle(self) -> None:
        if self._virtual is not None and not self._depth:
            self._depth += 1
            try:
                self._virtual.settle()
            finally:
                self._callback_ended()

    # -- supervision -----------------------------------------------------------------

    def look_again(self) -> None:
        """Take note that nodes have come, or that a timeout has changed."""
        self._inspector.look_again()

    def critical_late(self, live: LiveNode, lasted_ns: int, times_cleared: int) -> None:
        """Act on a critical node's tick that took too long [ns] and ended unseen."""
        self._inspector.critical_late(live, lasted_ns, times_cleared)

    def thread_id(self, live: LiveNode) -> int | None:
        """Return None: no tick keeps another from its thread."""
        return None

    def stack(self, live: LiveNode) -> Stack:
        """Return where an async tick waits."""
        task = self._in_flight.get(live)
        return stack_of_thread(None) if task is None else stack_of_task(task, None)

    def isolate(self, live: LiveNode) -> None:
        """Cancel an async tick."""
        task = self._in_flight.get(live)
        if task is not None:
            task.cancel()
            self._settle()

    def call_hooks(self, lives: Iterable[LiveNode]) -> None:
        """Call safe-state hooks: plain ones here and now, async ones begin."""
        for live in lives:
            if not live.is_async:
                live.context.copy().run(live.run_phase, "safe_state")
                live.standing.hook_returned.set()
                continue
            task = self._virtual_loop().loop.create_task(
                live.run_phase_async("safe_state"),
                name=f"horus-safe-state:{live.name}",
                context=live.context.copy(),
            )
            task.add_done_callback(functools.partial(_hook_returned, live))
        self._settle()

    # -- delivery --------------------------------------------------------------------

    def _deliver(self, only: Collection[LiveNode] | None) -> None:
        """Tick event nodes, one per message, until no message waits."""
        if not self._messaged:
            return
        for _ in range(_MAX_EVENTS_AT_ONCE):
            ready = [
                live
                for live in self._messaged
                if (only is None or live in only) and live not in self._in_flight
            ]
            if not ready or self.stopped():
                return
            self._tick_event(min(ready, key=self._places.__getitem__))
        raise StateError(
            f"event nodes have ticked {_MAX_EVENTS_AT_ONCE} times at t={self._clock.now_ns()} ns "
            "without coming to rest: their topics form a feedback loop"
        )

    def _tick_event(self, live: LiveNode) -> None:
        trigger = live.trigger
        assert trigger is not None
        if not trigger.queue or live.retired:
            self._messaged.pop(live, None)
            return
        delay_ns = live.resume_after_ns()
        if delay_ns:
            # Restarting: the messages wait for the end of the back-off.
            self._messaged.pop(live, None)
            self._virtual_loop().loop.call_later(to_s(delay_ns), self._messaged.setdefault, live)
            self._settle()
            return
        before = EventTick(live)
        self._release(live, self._clock.now_ns())
        task = self._in_flight.get(live)
        if task is None:
            before.settle()
        else:
            task.add_done_callback(lambda _: before.settle())


def _hook_returned(live: LiveNode, _: object) -> None:
    live.standing.hook_returned.set()
