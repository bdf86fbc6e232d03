"""Rt nodes: each on a thread of its own, on the absolute release grid."""

from __future__ import annotations

import contextlib
import functools
from collections import deque
from collections.abc import Callable

from horus import clock, os_rt
from horus.executors.thread import NodeThread, ThreadExecutor
from horus.live import LiveNode
from horus.loop.bridge import Bridge
from horus.loop.cycle import Cycle
from horus.loop.realtime import RealTime
from horus.tick_path import build_tick
from horus.units import NS_PER_US

_LEAD_STEP_NS = 500
_LAST_CHANCE_NS = 200 * NS_PER_US


class RtThread(NodeThread):
    """Sleeps until a release, ticks, and goes on to the next one.

    `idle` is the loop::

        if somebody earlier in order is due at the same instant and not done:
            sleep until that one passes the baton, or until it is time to go alone
        else sleep until shortly before the release, and spin until it comes
        if late by a period or more: skip to the latest release, once, and count
        tick
        pass the baton to whoever waits for it

    A late node keeps its phase: it runs for its latest release at once, earlier
    ones are skipped, and the next one stays where it always was. A predecessor
    holds a node up for as long as the node can still meet its own deadline, and
    not at all once it is frozen, past the deadline of an earlier release: the node
    then runs out of order, which is counted. If it was the machine that was late, the
    predecessor has 200 us more.

    Waking up takes a few microseconds when the machine is idle, and a hundred when
    another thread has the interpreter. How long it took lately is `_lead_ns`: the
    thread wakes up that much early, and by the release it has the interpreter.
    """

    def __init__(self, live: LiveNode, real_time: RealTime, wake_loop: Callable[[], None]) -> None:
        """Prepare a thread that does not release yet.

        Args:
            live: Its node.
            real_time: What the thread enters.
            wake_loop: Called on this thread when a release is over that the loop waits for.
        """
        super().__init__(live, self._enter_real_time)
        self.engaged = False
        self.priority: int | None = None
        """The SCHED_FIFO priority that the thread was granted; None for ordinary scheduling."""
        self.priority_after: int | None = None
        """The highest priority of those that follow this node in execution order."""
        self.predecessors: tuple[RtThread, ...] = ()
        """The engaged nodes before this one in execution order, the nearest first."""
        self.done_ns = clock.NEVER
        """The release of the last tick that is over [ns]: a skipped one frees nobody."""
        self.grid = live.grid()
        self.loop_waits_for_ns = clock.FOREVER_NS
        """The earliest release whose end the loop waits for [ns]."""
        self._waiting: deque[RtThread] = deque()
        self._wake_loop = wake_loop
        self._inherited = False
        self._real_time = real_time
        self._run_tick = build_tick(live)
        self._timeline = live.timeline
        self._now_ns = live.timeline.now_ns
        self._index = 0
        self._has_skipped = False
        self._release_ns = 0
        self._violated_ns = clock.NEVER
        self._pardoned_ns = clock.NEVER
        self._pardon_ends_ns = clock.NEVER
        self._spin_ns = real_time.spin_ns
        self._most_lead_ns = 0
        self._lead_ns = 0
        self._known: tuple[RtThread, ...] = ()
        self._awaited: list[RtThread] = []

    def idle(self) -> None:
        """Wait for the next release and run it; see the class for the steps."""
        release_ns = self._release_ns
        if not self.engaged or release_ns >= self._timeline.end_ns:
            self.park()
            return
        now_ns = self._now_ns()
        if self._known is not self.predecessors:
            self._move_to(self._index)
        for predecessor in self._awaited:
            if predecessor.done_ns < release_ns and self._wait_for_baton(
                predecessor, release_ns, now_ns
            ):
                self._has_skipped = False
                return
        wake_up_ns = release_ns - self._lead_ns
        if now_ns < wake_up_ns:
            # Woken early or for a job, we come back here and look again.
            if not self.park(wake_up_ns):
                self._learn_lead(self._now_ns() - wake_up_ns)
            return
        while now_ns < release_ns:
            now_ns = self._now_ns()
        # Not twice without a tick: of a period of microseconds, the next is over by now, too.
        if now_ns - release_ns >= self.live.period_ns and not self._has_skipped:
            latest = self.grid.index_at(min(now_ns, self._timeline.end_ns - 1))
            if latest > self._index:
                self._skip_to(latest)
                self._has_skipped = True
                return
        self._has_skipped = False
        self._run_tick(release_ns)
        self._hand_over(release_ns)
        self._move_to(self._index + 1)

    def engage(self, from_ns: int) -> None:
        """Begin with the first release at or after `from_ns` [ns].

        Thread: loop, while this one rests: those who follow look at the grid at once.
        """
        self._join_grid(from_ns)
        self.engaged = True
        self.unpark()

    def retime(self) -> None:
        """Move to the grid of the node's new rate; a release that is due is not lost to it."""
        if self.grid != self.live.grid():
            self._join_grid(min(self._release_ns, self._now_ns()))

    def due_ns(self, now_ns: int) -> int | None:
        """Return the release whose tick has not begun [ns], if one is due.

        Thread: any.
        """
        release_ns = self._release_ns
        due = self.engaged and release_ns <= now_ns and release_ns < self._timeline.end_ns
        return release_ns if due else None

    def _join_grid(self, from_ns: int) -> None:
        self.grid = self.live.grid()
        self._most_lead_ns = min(self._spin_ns, self.live.period_ns // 4)
        self._move_to(self.grid.first_from(from_ns))
        self._pass_baton(self._release_ns - 1)

    def _skip_to(self, index: int) -> None:
        self.live.skip_late(index - self._index, self._release_ns, self._now_ns())
        self._move_to(index)

    def _move_to(self, index: int) -> None:
        """Turn to a release, and find out now, with time to spare, who comes before us in it."""
        self._index = index
        self._release_ns = release_ns = self.grid.at(index)
        self._known = self.predecessors
        self._awaited = [other for other in self._known if other.grid.has(release_ns)]

    def _learn_lead(self, late_ns: int) -> None:
        """Follow the delay that 95 % of the wake-ups do not exceed: 19 steps down undo one up."""
        if late_ns > self._lead_ns:
            self._lead_ns = min(self._lead_ns + 19 * _LEAD_STEP_NS, self._most_lead_ns)
        else:
            self._lead_ns = max(self._lead_ns - _LEAD_STEP_NS, 0)

    def _wait_for_baton(self, predecessor: RtThread, release_ns: int, now_ns: int) -> bool:
        """Sleep until a predecessor is done; return False if this node must not wait for it."""
        limit_ns = _latest_start_ns(self.live, release_ns)
        behind = predecessor.is_behind(release_ns, now_ns)
        if now_ns >= limit_ns and not behind:
            limit_ns = self._last_chance_ns(release_ns, limit_ns, now_ns)
        if now_ns >= limit_ns or behind:
            self._note_violation(predecessor, release_ns)
            return False
        if self not in predecessor._waiting:
            predecessor._waiting.append(self)
        self.live.waited_until_ns = limit_ns
        # Looked at again now that the predecessor can see us.
        if predecessor.done_ns < release_ns:
            self.park(limit_ns)
        self.live.waited_until_ns = min(self._now_ns(), limit_ns)
        return True

    def _last_chance_ns(self, release_ns: int, limit_ns: int, now_ns: int) -> int:
        """Return until when the predecessors have one more chance, once per release [ns].

        Past the latest start, and none of them computes for that long: then the machine
        was late, not they. They can run now as we can, in microseconds, and in order.
        """
        if self._pardoned_ns != release_ns:
            self._pardoned_ns = release_ns
            waited_for = (other for other in self._awaited if other.done_ns < release_ns)
            if any(other.has_computed_since(limit_ns) for other in waited_for):
                return limit_ns
            self._pardon_ends_ns = now_ns + _LAST_CHANCE_NS
        return max(limit_ns, self._pardon_ends_ns)

    def has_computed_since(self, instant_ns: int) -> bool:
        """Return whether a tick is in progress that began before an instant [ns]."""
        context = self.live.tick_context
        return context.ticking and context.start_ns < instant_ns

    def is_behind(self, release_ns: int, now_ns: int) -> bool:
        """Return whether this node still ticks for an earlier release, past its deadline."""
        context = self.live.tick_context
        if not context.ticking or context.release_ns >= release_ns:
            return False
        limit_ns = min(self.live.limits.deadline_ns, self.live.period_ns)
        return now_ns >= context.release_ns + limit_ns

    def _note_violation(self, predecessor: RtThread, release_ns: int) -> None:
        if self._violated_ns != release_ns:
            self._violated_ns = release_ns
            self.live.order_violated(predecessor.live)

    def _enter_real_time(self) -> None:
        self.priority = self._real_time.enter_node_thread(self.live)

    def park(self, until_ns: int | None = None) -> bool:
        """Sleep; see `NodeThread`. What `_hand_over` has raised ends with it."""
        woken = super().park(until_ns)
        if self._inherited:
            self._inherited = False
            self._change_priority(self.priority)
        return woken

    def _hand_over(self, done_ns: int) -> None:
        """Pass the baton; until it sleeps, this thread inherits the priority of those after it.

        They share a core as a rule. Woken with a higher priority, one would preempt this
        thread at once, find the interpreter taken, and go back to sleep for it.
        """
        after = self.priority_after
        if self._waiting and after is not None and (self.priority or after) < after:
            self._inherited = True
            self._change_priority(after)
        self._pass_baton(done_ns)

    def _change_priority(self, priority: int | None) -> None:
        if priority is not None:
            with contextlib.suppress(OSError):
                os_rt.change_fifo(priority)

    def _pass_baton(self, done_ns: int) -> None:
        """Let those run that wait for this node.

        Thread: the node's, or supervision.
        """
        self.done_ns = done_ns
        for _ in range(len(self._waiting)):
            try:
                waiting = self._waiting.popleft()
            except IndexError:  # the other one has taken it
                break
            if waiting._release_ns <= done_ns:
                waiting.unpark()
            elif waiting.engaged:
                self._waiting.append(waiting)  # for a later release: let it sleep
        if self.loop_waits_for_ns <= done_ns:
            self.loop_waits_for_ns = clock.FOREVER_NS
            self._wake_loop()


def _latest_start_ns(live: LiveNode, release_ns: int) -> int:
    """Return how long a node can wait and still meet its deadline [ns].

    With a budget that was given, until the deadline less the budget. One that
    was derived, 80 % of the period, is an upper bound rather than an estimate:
    then the other 20 % are kept back.
    """
    spec = live.spec
    if spec.budget_given and spec.budget_ns is not None:
        reserve_ns = spec.budget_ns
    else:
        reserve_ns = live.period_ns // 5
    limit_ns = min(live.limits.deadline_ns, live.period_ns)
    return release_ns + max(0, limit_ns - reserve_ns)


class RtExecutor(ThreadExecutor[RtThread]):
    """Gives every node an `RtThread`."""

    def __init__(self, bridge: Bridge, cycle: Cycle, real_time: RealTime) -> None:
        """Serve the nodes of one run; `cycle` is to give way to them."""
        super().__init__()
        self._wake_loop = functools.partial(bridge.post, cycle.run_due)
        self._cycle = cycle
        self._real_time = real_time
        self._in_order: list[RtThread] = []

    def make_thread(self, live: LiveNode) -> RtThread:
        """Return the node's thread, not started."""
        return RtThread(live, self._real_time, self._wake_loop)

    def engage(self, live: LiveNode, from_ns: int) -> None:
        """Let the thread release the node."""
        live.enter_service()
        thread = self.thread_of(live)
        thread.engage(from_ns)
        self._in_order = sorted([*self._in_order, thread], key=lambda thread: thread.live.rank)
        self._introduce()

    def disengage(self, live: LiveNode) -> None:
        """Let the thread begin no further tick."""
        live.leave_service()
        thread = self.thread_of(live)
        thread.engaged = False
        self._in_order = [other for other in self._in_order if other is not thread]
        self._introduce()
        # Nobody waits any more for one that leaves.
        thread.post(functools.partial(thread._pass_baton, clock.FOREVER_NS))

    def due_ns(self, live: LiveNode, now_ns: int) -> int | None:
        """Return the release whose tick has not begun."""
        thread = self.find_thread(live)
        return None if thread is None else thread.due_ns(now_ns)

    def isolate(self, live: LiveNode) -> None:
        """Let nobody wait for a baton that does not come."""
        thread = self.find_thread(live)
        if thread is not None:
            thread._pass_baton(clock.FOREVER_NS)

    def retime(self, live: LiveNode) -> None:
        """Let the thread move to the grid of the new rate."""
        thread = self.thread_of(live)
        thread.post(thread.retime)

    def _introduce(self) -> None:
        """Tell every engaged thread whom it follows, and the loop whether there are any."""
        highest: int | None = None
        for place in reversed(range(len(self._in_order))):
            thread = self._in_order[place]
            thread.predecessors = tuple(reversed(self._in_order[:place]))
            thread.priority_after = highest
            if thread.priority is not None:
                highest = max(highest or 0, thread.priority)
        self._cycle.hold_up = self._hold_up if self._in_order else None

    def _hold_up(self, live: LiveNode, release_ns: int, now_ns: int) -> int | None:
        """Return until when a node of the loop's has to wait for Rt nodes [ns]; None: no more.

        It waits for those before it in order that are due at the same instant, for as
        long as an Rt node would.

        Thread: loop.
        """
        for thread in self._in_order:
            if thread.live.rank > live.rank:
                break
            if thread.done_ns >= release_ns or not thread.grid.has(release_ns):
                continue
            limit_ns = min(_latest_start_ns(live, release_ns), live.timeline.end_ns - 1)
            if now_ns >= limit_ns or thread.is_behind(release_ns, now_ns):
                live.order_violated(thread.live)
                break
            thread.loop_waits_for_ns = min(thread.loop_waits_for_ns, release_ns)
            # Looked at again now that the thread can see us.
            if thread.done_ns < release_ns:
                if not live.busy:  # the tick in progress, of an earlier release, waits for nobody
                    live.waited_until_ns = limit_ns
                return limit_ns
        live.waited_until_ns = min(live.waited_until_ns, now_ns)
        return None
