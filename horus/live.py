"""`LiveNode`: one node inside one scheduler, with everything that changes as it runs."""

from __future__ import annotations

import asyncio
import contextvars
import copy
import inspect
import logging
import threading
from collections.abc import Callable
from enum import Enum, auto
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from horus import clock
from horus.clock import TickContext, Timeline
from horus.core import core_of
from horus.errors import NodeError
from horus.reports import NodeReports
from horus.spec import ExecutionClass, Health, NodeSpec, NodeState
from horus.standing import Standing
from horus.stats import NodeCounters
from horus.timing import Grid, ReleaseGrid, ReleaseTimes
from horus.units import NS_PER_MS, NS_PER_S, readable

if TYPE_CHECKING:
    from horus.topics import Subscription

NO_LIMIT_NS = 1 << 62
FIRST_BACKOFF_NS = 100 * NS_PER_MS
LONGEST_BACKOFF_NS = 5 * NS_PER_S


class Control(Protocol):
    """What a node may ask of the scheduler that runs it.

    Thread: any.
    """

    def request_stop(self, reason: str) -> None:
        """Stop in order."""

    def give_up(self, reason: str) -> None:
        """Stop in order, because something is wrong."""

    def fail(self, error: NodeError) -> None:
        """Stop in order, then raise `error` from `run()`."""

    def count_miss(self) -> None:
        """Take note that a deadline was missed."""

    def critical_late(self, live: LiveNode, lasted_ns: int) -> None:
        """Take note that a critical node got no tick within its limit, unseen by supervision.

        Args:
            live: The node.
            lasted_ns: Since it was owed one [ns].
        """


class Limits(NamedTuple):
    """What a tick is measured against; replaced as a whole, read once per tick."""

    budget_ns: int
    deadline_ns: int
    latest_ns: int
    """The deadline, or the timeout of a critical node if that is shorter."""


NoteTick = Callable[[int, int, int, int, int, bool], None]
"""Takes release, start, finish, excess over budget and past deadline [ns], and failure."""

NoteChange = Callable[[str, str], None]
"""Takes what has changed, and to what."""


class Admission(Enum):
    """Whether a released node may tick."""

    TICK = auto()
    SKIP = auto()
    RESTART = auto()
    """Run `init()` again first."""
    END = auto()
    """The node is leaving; nothing is owed."""


class LiveNode:
    """A node's run-time state.

    Thread: written by the thread that runs the node's callbacks; others read
    single attributes, set `gated` and `retired`, which are only ever looked at, and
    change its health and whether it is held by methods that say so.
    """

    def __init__(
        self,
        node: object,
        timeline: Timeline,
        control: Control,
        sequence: int,
        counters: NodeCounters | None = None,
    ) -> None:
        """Put `node` into service as the `sequence`-th node added; `counters` go on."""
        self.node = node
        self.core = core = core_of(node)
        self.control = control
        self.timeline = timeline
        self.sequence = sequence
        self.counters = counters or NodeCounters()
        self._state = NodeState.UNINITIALIZED
        self.note_tick: NoteTick | None = None
        """Takes note of every tick, if anybody wants to know."""
        self.note_change: NoteChange | None = None
        """Takes note of changes of state and health, if anybody wants to know."""
        self.trigger: Subscription | None = None
        self.publishes, self.subscribes = core.publishes, core.subscribes
        self.tick_context = TickContext(core.spec.name, timeline, self.counters)
        self.context = contextvars.copy_context()
        self.context.run(clock.current.set, self.tick_context)
        self.gated = False
        """Whether a release must be admitted (`admit`) before it ticks."""
        self.retired = False
        """Whether the node is out of service: no tick begins."""
        self.removed = False
        """Whether the node was taken from the scheduler for good."""
        self.abandoned = False
        """Whether a thread or task that never returned may still hold this object."""
        self.skip_next = False
        self.in_episode = False
        self.critical_ns: int | None = None
        """How long a critical node may be owed a tick [ns]; None for other nodes."""
        self.revival_ns = clock.NEVER
        """Since when `init()` runs again in place of a tick [ns]; `NEVER` while it does not."""
        self.waited_until_ns = clock.NEVER
        """Until when the node waits for its predecessors, or has last waited [ns]."""
        self.reports = NodeReports(core.log, self.tick_context)
        self.callbacks = core.callbacks
        has_hook = core.callbacks["safe_state"] is not None
        self.standing = Standing(self.counters, self._close_gate, self._changed, has_hook=has_hook)
        self._claims = threading.Lock()
        self._restart_at_ns = 0
        self._freed_ns = clock.NEVER
        self._backoff_ns = FIRST_BACKOFF_NS
        self.apply(core.spec)

    # -- what it is --------------------------------------------------------------

    @property
    def name(self) -> str:
        """The node's name."""
        return self.spec.name

    @property
    def state(self) -> NodeState:
        """Where the node is in its life."""
        return self._state

    @state.setter
    def state(self, state: NodeState) -> None:
        if state is not self._state:
            self._state = state
            self._changed("state", state)

    @property
    def order(self) -> int:
        """The node's execution order."""
        return self.spec.order

    @property
    def is_async(self) -> bool:
        """Whether the node's tick is a coroutine function."""
        return self.core.is_async

    @property
    def rank(self) -> tuple[int, int]:
        """The place in execution order: (order, insertion)."""
        return (self.spec.order, self.sequence)

    @property
    def ticking(self) -> bool:
        """Whether a tick is in progress."""
        return self.tick_context.ticking

    @property
    def busy_since_ns(self) -> int:
        """Since when a tick, or `init()` in its place, is in progress [ns]; else `NEVER`."""
        revival_ns = self.revival_ns
        if revival_ns != clock.NEVER:
            return revival_ns
        # The tick path writes the start before `ticking`, so we read them the other way round.
        return self.tick_context.start_ns if self.ticking else clock.NEVER

    @property
    def after_tick(self) -> bool:
        """Whether the tick has ended, and the safe-state hook that it has led to has not."""
        context = self.tick_context
        return context.ticking and context.finish_ns > context.start_ns

    @property
    def busy(self) -> bool:
        """Whether a tick, or `init()` in its place, is in progress."""
        return self.busy_since_ns != clock.NEVER

    @property
    def initialized(self) -> bool:
        """Whether `init()` has succeeded and `shutdown()` has not run."""
        return self.state in (NodeState.RUNNING, NodeState.RESTARTING)

    def apply(self, spec: NodeSpec) -> None:
        """Take over a configuration: rate and limits hold from the next tick on."""
        self.spec = spec
        self.period_ns = spec.period_ns
        deadline_ns = NO_LIMIT_NS if spec.deadline_ns is None else spec.deadline_ns
        self.limits = Limits(
            NO_LIMIT_NS if spec.budget_ns is None else spec.budget_ns,
            deadline_ns,
            deadline_ns if self.critical_ns is None else min(deadline_ns, self.critical_ns),
        )
        context = self.tick_context
        context.budget_ns = spec.budget_ns
        context.nominal_dt_s = 1.0 / spec.rate_hz
        if self.timeline.deterministic and spec.execution_class is not ExecutionClass.EVENT:
            context.fixed_dt_s = context.nominal_dt_s

    def make_critical(self, timeout_ns: int) -> None:
        """Put the system in its safe state when a tick takes longer than this [ns]."""
        self.critical_ns = timeout_ns
        self.apply(self.spec)

    def grid(self) -> Grid:
        """Return the node's release grid: every node counts from the same epoch."""
        if self.core.releases_ns is not None:
            return ReleaseTimes(self.timeline.epoch_ns, self.core.releases_ns)
        return ReleaseGrid(self.timeline.epoch_ns, self.spec.rate_hz)

    # -- callbacks ---------------------------------------------------------------

    def call(self, phase: str) -> Any:
        """Run a callback in the node's context; an async one returns its coroutine."""
        callback = self.callbacks[phase]
        if callback is None:
            return None
        if clock.current.get() is self.tick_context:
            return callback()
        return self.context.run(callback)

    def run_phase(self, phase: str) -> bool:
        """Run a plain callback; return whether it succeeded. Never raises."""
        error: BaseException | None = None
        try:
            result = self.call(phase)
            if inspect.iscoroutine(result):
                result.close()
                error = never_awaited(phase)
        except BaseException as exc:
            error = exc
        return self._phase_ended(phase, error)

    async def run_phase_async(self, phase: str) -> bool:
        """Run a callback of either kind; return whether it succeeded."""
        error: BaseException | None = None
        try:
            result = self.call(phase)
            if inspect.isawaitable(result):
                await result
        except asyncio.CancelledError as exc:
            if being_cancelled():
                raise
            error = exc
        except (Exception, SystemExit) as exc:
            error = exc
        return self._phase_ended(phase, error)

    def _phase_ended(self, phase: str, error: BaseException | None) -> bool:
        if error is not None:
            self.phase_failed(phase, error)
        if phase == "init" and self.state is NodeState.UNINITIALIZED:
            self._initialized_with(error is None)
        return error is None

    def phase_failed(self, phase: str, exc: BaseException) -> None:
        """Count, log and report an exception from `init`, `shutdown` or `safe_state`."""
        self.counters.errors += 1
        self.emit(logging.ERROR, f"{phase}() raised {type(exc).__name__}: {exc}", exc)
        self.notify_error(exc)

    def notify_error(self, exc: BaseException) -> None:
        """Tell `on_error`; what it raises itself is logged and goes no further."""
        if self.core.on_error is None:
            return
        try:
            self.core.on_error(self.node, exc)
        except (Exception, SystemExit) as second:
            self.emit(logging.ERROR, f"on_error() raised {type(second).__name__}: {second}", second)

    def emit(self, level: int, message: str, exc: BaseException | None = None) -> None:
        """Log on the node's behalf."""
        self.reports.emit(level, message, exc)

    # -- life cycle --------------------------------------------------------------

    def _initialized_with(self, success: bool) -> None:
        self.state = NodeState.RUNNING if success else NodeState.ERROR
        self.regate()
        if not success:
            self.emit(logging.ERROR, "excluded from ticking, because init() failed")

    def broken(self, exc: BaseException) -> None:
        """End the run because something escaped the tick path: a logging filter, say.

        The tick path and `run_phase` hold on to what callbacks raise, so this is
        not the node's fault alone; but a node that silently ticks no more must
        not look healthy.
        """
        self.leave_service()
        self.control.fail(NodeError(self.name, "tick", exc))

    def renew(self) -> None:
        """Get ready for another `init()`: a new run begins."""
        if not self.initialized:
            self.state = NodeState.UNINITIALIZED
            self.skip_next = self.in_episode = False
            self.standing.renew()
            context = self.tick_context
            context.start_ns = context.previous_ns = context.finish_ns = clock.NEVER

    def claim_shutdown(self) -> bool:
        """Return whether `shutdown()` is owed; the caller who hears yes must call it.

        Thread: any.
        """
        with self._claims:
            if not self.initialized:
                return False
            self.state = NodeState.STOPPING
            return True

    def successor(self) -> LiveNode:
        """Return a fresh start for a node that was left behind.

        Whatever still runs of the old one has no say in the new one.
        """
        counters = copy.deepcopy(self.counters)
        fresh = LiveNode(self.node, self.timeline, self.control, self.sequence, counters)
        fresh.trigger = self.trigger
        fresh.critical_ns = self.critical_ns
        fresh.apply(self.spec)
        self.control = _Nobody()
        return fresh

    def stopped(self) -> None:
        """Enter the state that follows `shutdown()`."""
        if self.state is NodeState.STOPPING:
            self.state = NodeState.STOPPED
        self.gated = True
        if self.removed:
            self.core.disconnect()

    def regate(self) -> None:
        """Close or open the gate as the state demands."""
        self.gated = self._must_be_admitted()
        # Another thread may have closed the gate between the look and the step.
        if not self.gated and self._must_be_admitted():
            self.gated = True

    def _must_be_admitted(self) -> bool:
        closed = self.retired or self.standing.held or self.skip_next
        return closed or self.state is not NodeState.RUNNING

    def enter_service(self) -> None:
        """Tick when released, from now on."""
        self.retired = False
        self.regate()

    def leave_service(self) -> None:
        """Begin no further tick."""
        self.retired = self.gated = True

    def admit(self) -> Admission:
        """Decide whether a release of a gated node may tick."""
        if self.retired:
            return Admission.END
        if self.standing.held:
            return Admission.SKIP
        if self.state is NodeState.RESTARTING:
            waited = self.timeline.now_ns() >= self._restart_at_ns
            return Admission.RESTART if waited else Admission.SKIP
        if self.skip_next:
            self.skip_next = False
            self.regate()
            return Admission.SKIP
        return Admission.TICK if self.state is NodeState.RUNNING else Admission.SKIP

    def resume_after_ns(self) -> int:
        """Return how long a restarting node waits before `init()` runs again [ns]."""
        if self.state is not NodeState.RESTARTING:
            return 0
        return max(0, self._restart_at_ns - self.timeline.now_ns())

    def plan_restart(self) -> None:
        """Wait for the back-off, which doubles while the node keeps failing."""
        if not self.initialized:
            return  # shut down meanwhile: a stuck tick has come back too late
        now_ns = self.timeline.now_ns()
        if now_ns - self._restart_at_ns > LONGEST_BACKOFF_NS:
            self._backoff_ns = FIRST_BACKOFF_NS
        self._restart_at_ns = now_ns + self._backoff_ns
        self.state = NodeState.RESTARTING
        self.gated = True
        self.emit(logging.WARNING, f"restarts in {readable(self._backoff_ns)}")
        self._backoff_ns = min(2 * self._backoff_ns, LONGEST_BACKOFF_NS)

    def restarted(self, success: bool) -> None:
        """Resume after `init()` ran again, or wait for the next attempt."""
        if not self.initialized:
            return
        if success:
            self.counters.restarts += 1
            self.state = NodeState.RUNNING
            self.regate()
            self.emit(logging.INFO, "restarted")
        else:
            self.plan_restart()

    # -- trouble -----------------------------------------------------------------

    def tick_failed(self, exc: BaseException) -> None:
        """Count, log and report an exception from `tick`."""
        self.counters.errors += 1
        self.reports.tick_failed(exc, self.spec.failure_policy)
        self.notify_error(exc)

    def order_violated(self, predecessor: LiveNode) -> None:
        """Count and log that this node ran before one it should follow."""
        self.counters.order_violations += 1
        self.reports.order_violated(predecessor.name)

    # -- supervision ---------------------------------------------------------------

    @property
    def reported_state(self) -> NodeState:
        """The state as people see it: a node that is held says so."""
        return NodeState.SAFE_STATE if self.standing.held and self.initialized else self.state

    @property
    def owed_from_ns(self) -> int:
        """The instant before which no tick is owed, whatever waits [ns].

        Messages wait while nothing runs, and while the node is to restart or is held. How
        long it waits for its predecessors is bounded and by design, however short a timeout.
        """
        return max(
            self.timeline.epoch_ns, self._restart_at_ns, self.waited_until_ns, self._freed_ns
        )

    def frozen_for(self, limit_ns: int) -> bool:
        """Return whether a tick, or `init()` in its place, has been running for longer.

        Thread: any.
        """
        since_ns = self.busy_since_ns
        return since_ns != clock.NEVER and self.timeline.now_ns() - since_ns > limit_ns

    def check_critical(self, since_ns: int, now_ns: int) -> None:
        """Tell supervision of a critical node that got no tick for too long, if it has not seen it.

        Args:
            since_ns: The release that was served, or skipped, only now [ns]. What waited
                behind another tick of the node was not owed before that one's end.
            now_ns: Now [ns].

        Thread: that which ticks the node, or releases it.
        """
        standing, critical_ns = self.standing, self.critical_ns
        if critical_ns is None or standing.held or standing.health is not Health.HEALTHY:
            return
        lasted_ns = now_ns - max(since_ns, self.tick_context.finish_ns, self.owed_from_ns)
        if lasted_ns > critical_ns:
            self.control.critical_late(self, lasted_ns)

    def skip_late(self, count: int, since_ns: int, now_ns: int) -> None:
        """Count releases that have passed because nothing ran, the first at `since_ns` [ns].

        Thread: that which releases the node.
        """
        self.counters.skipped += count
        self.check_critical(since_ns, now_ns)

    def safe_state_entered(self) -> None:
        """Take note that the hook has returned that a tick has led to: the tick is over.

        Thread: the node's.
        """
        self.standing.hook_returned.set()
        self.tick_context.finish_ns = self.timeline.now_ns()
        self.tick_context.ticking = False

    def free(self) -> None:
        """Let the node tick again, not isolated any more.

        Thread: any.
        """
        self._freed_ns = self.timeline.now_ns()
        self.standing.let_go()
        self.in_episode = False
        self.regate()

    def _close_gate(self) -> None:
        self.gated = True

    def _changed(self, what: str, value: str) -> None:
        if self.note_change is not None:
            self.note_change(what, value)


class _Nobody:
    """Listens to nothing: the control of a node that was left behind."""

    def request_stop(self, reason: str) -> None:
        pass

    def give_up(self, reason: str) -> None:
        pass

    def fail(self, error: NodeError) -> None:
        pass

    def count_miss(self) -> None:
        pass

    def critical_late(self, live: LiveNode, lasted_ns: int) -> None:
        pass


def never_awaited(phase: str) -> TypeError:
    """Return the error of a plain callback that returns a coroutine."""
    return TypeError(
        f"{phase}() returned a coroutine that nobody would await; declare it with `async def`, "
        "or pass the coroutine function itself instead of a function that calls it"
    )


def being_cancelled() -> bool:
    """Return whether the current task was asked to end, as opposed to code that raises at will."""
    task = asyncio.current_task()
    return task is not None and task.cancelling() > 0
