"""The tick path: what happens around every call of a node's `tick`, in every class.

`build_tick` makes one bound callable per node, `build_async_tick` its awaitable
twin. Both do, in this order:

1. admit: a node that is restarting, skipping or leaving does not tick;
2. enter the tick context, so that `horus.now()` and `horus.dt()` answer;
3. call the user's function, holding on to whatever it raises;
4. count: ticks, execution time, start latency; have the tick recorded, if anything does;
5. decide (`escalation.decide`, pure) and act, if anything is out of order.

No lock is taken and nothing is logged unless something is wrong.
"""

from __future__ import annotations

import asyncio
import inspect
import logging
import threading
from collections.abc import Callable, Coroutine
from typing import Any

from horus.clock import NEVER
from horus.errors import NodeError, WorkerDied
from horus.escalation import Action, Outcome, decide
from horus.live import Admission, Limits, LiveNode, being_cancelled, never_awaited
from horus.spec import Health

RunTick = Callable[[int], None]
RunTickAsync = Callable[[int], Coroutine[Any, Any, None]]


def build_tick(live: LiveNode) -> RunTick:
    """Return `run_tick(release_ns)` for a plain function. It raises KeyboardInterrupt at most."""
    callback = live.callbacks["tick"]
    assert callback is not None
    run_in_context = live.context.run
    now_ns = live.timeline.now_ns
    context = live.tick_context
    finish = _build_finish(live)

    def run_tick(release_ns: int) -> None:
        if live.gated and not _admitted(live):
            return
        context.release_ns = release_ns
        context.previous_ns = context.start_ns
        context.start_ns = start_ns = now_ns()
        context.ticking = True
        limits = live.limits
        error: BaseException | None = None
        try:
            result = run_in_context(callback)
            if result is not None and inspect.iscoroutine(result):
                result.close()
                error = never_awaited("tick")
        except BaseException as exc:
            if _is_interrupt(exc):
                context.ticking = False
                live.control.request_stop("KeyboardInterrupt")
                raise
            error = exc
        if finish(release_ns, start_ns, limits, error):
            live.run_phase("safe_state")
            live.safe_state_entered()
        # The exception's traceback refers to this frame: let go of it, or each
        # failed tick leaves a cycle to the garbage collector.
        error = None

    return run_tick


def build_async_tick(live: LiveNode) -> RunTickAsync:
    """Return `await run_tick(release_ns)` for a coroutine function.

    The caller runs it in a task of the node's context. Cancelling that task
    ends the tick without counting it as failed.
    """
    callback = live.callbacks["tick"]
    assert callback is not None
    now_ns = live.timeline.now_ns
    context = live.tick_context
    finish = _build_finish(live)

    async def run_tick(release_ns: int) -> None:
        if live.gated and not await _admitted_async(live):
            return
        context.release_ns = release_ns
        context.previous_ns = context.start_ns
        context.start_ns = start_ns = now_ns()
        context.ticking = True
        limits = live.limits
        error: BaseException | None = None
        try:
            await callback()
        except asyncio.CancelledError as exc:
            if being_cancelled():
                context.ticking = False
                raise
            error = exc
        except BaseException as exc:
            if _is_interrupt(exc):
                context.ticking = False
                live.control.request_stop("KeyboardInterrupt")
                raise
            error = exc
        if finish(release_ns, start_ns, limits, error):
            try:
                await live.run_phase_async("safe_state")
            finally:
                live.safe_state_entered()
        error = None

    return run_tick


def _build_finish(live: LiveNode) -> Callable[[int, int, Limits, BaseException | None], bool]:
    """Return steps 4 and 5, which tell whether the safe-state hook is to be called."""
    now_ns = live.timeline.now_ns
    context = live.tick_context
    counters = live.counters
    add_times = counters.times.add
    standing = live.standing
    note_tick = live.note_tick

    def finish(release_ns: int, start_ns: int, limits: Limits, error: BaseException | None) -> bool:
        finish_ns = now_ns()
        execution_ns = finish_ns - start_ns
        counters.ticks += 1
        if counters.first_release_ns is None:
            counters.first_release_ns = release_ns
        counters.last_release_ns = release_ns
        add_times(execution_ns, start_ns - release_ns)
        over_budget_ns = execution_ns - limits[0]
        if (
            over_budget_ns > 0
            or finish_ns - release_ns > limits[2]
            or error is not None
            or standing.alert
        ):
            return _settle(live, release_ns, finish_ns, limits, over_budget_ns, error)
        context.finish_ns = finish_ns
        context.ticking = False
        if note_tick is not None:
            note_tick(release_ns, start_ns, finish_ns, 0, 0, False)
        return False

    return finish


def _settle(
    live: LiveNode,
    release_ns: int,
    finish_ns: int,
    limits: Limits,
    over_budget_ns: int,
    error: BaseException | None,
) -> bool:
    """Count what went wrong, decide what follows and do it; see `_build_finish`.

    If the safe-state hook follows, the tick is not over before that has returned.
    """
    context = live.tick_context
    if live.abandoned:
        context.finish_ns = finish_ns
        context.ticking = False
        return False  # it was shut down without us: nothing may follow
    live.check_critical(release_ns, finish_ns)
    context.finish_ns = finish_ns
    counters = live.counters
    past_deadline_ns = finish_ns - release_ns - limits.deadline_ns
    outcome = Outcome(
        max(0, over_budget_ns),
        max(0, past_deadline_ns),
        failed=error is not None,
        died=isinstance(error, WorkerDied),
    )
    action = decide(
        outcome,
        on_miss=live.spec.on_miss,
        failure_policy=live.spec.failure_policy,
        in_episode=live.in_episode,
    )
    if live.note_tick is not None:
        live.note_tick(
            release_ns,
            context.start_ns,
            finish_ns,
            outcome.over_budget_ns,
            outcome.past_deadline_ns,
            outcome.failed,
        )
    standing = live.standing
    live.in_episode = standing.alert = outcome.missed
    if error is not None:
        live.tick_failed(error)
    if outcome.over_budget_ns:
        counters.budget_overruns += 1
    if outcome.past_deadline_ns:
        counters.deadline_misses += 1
        live.control.count_miss()
    _act(live, limits, outcome, action, error)
    # Not if the supervisor has called the hook, or is about to.
    enter_safe_state = action.enter_safe_state and not standing.held and standing.claim_hook()
    context.ticking = enter_safe_state
    if standing.health is not Health.HEALTHY:
        _tell_that_it_ended(live)
    return enter_safe_state


def worker_died(live: LiveNode, error: WorkerDied) -> None:
    """Do what a failed tick would lead to: the node's worker process has ended between two.

    Thread: the node's.
    """
    if live.retired or live.abandoned or not live.initialized:
        return  # it was to end
    live.tick_failed(error)
    outcome = Outcome(failed=True, died=True)
    policies = (live.spec.on_miss, live.spec.failure_policy)
    action = decide(outcome, on_miss=policies[0], failure_policy=policies[1], in_episode=False)
    _act(live, live.limits, outcome, action, error)


def _tell_that_it_ended(live: LiveNode) -> None:
    if live.standing.recovered():
        live.emit(logging.INFO, "healthy again")
    elif live.standing.health is Health.ISOLATED:
        live.emit(
            logging.WARNING, "its frozen tick has ended; clear_safe_state() lets it tick again"
        )


def _act(
    live: LiveNode, limits: Limits, outcome: Outcome, action: Action, error: BaseException | None
) -> None:
    if action.warn:
        if outcome.past_deadline_ns:
            kind, limit_ns, over_ns = "deadline", limits.deadline_ns, outcome.past_deadline_ns
        else:
            kind, limit_ns, over_ns = "budget", limits.budget_ns, outcome.over_budget_ns
        text = live.reports.limit_exceeded(kind, limit_ns, over_ns)
        if action.stop:
            live.control.give_up(f"node {live.name!r} {text}")
    if action.skip_next:
        live.skip_next = live.gated = True
    if action.fatal and error is not None:
        live.control.fail(NodeError(live.name, "tick", error))
    if action.restart:
        live.plan_restart()


def _admitted(live: LiveNode) -> bool:
    admission = live.admit()
    if admission is Admission.RESTART:
        live.revival_ns = live.timeline.now_ns()
        live.restarted(live.run_phase("init"))
        live.revival_ns = NEVER
        admission = live.admit()
    return _counted(live, admission)


async def _admitted_async(live: LiveNode) -> bool:
    admission = live.admit()
    if admission is Admission.RESTART:
        live.revival_ns = live.timeline.now_ns()
        try:
            live.restarted(await live.run_phase_async("init"))
        finally:
            live.revival_ns = NEVER
        admission = live.admit()
    return _counted(live, admission)


def _counted(live: LiveNode, admission: Admission) -> bool:
    if admission is Admission.SKIP:
        live.counters.skipped += 1
    return admission is Admission.TICK


def _is_interrupt(exc: BaseException) -> bool:
    """Return whether this is the user's Ctrl+C, which goes to the main thread only."""
    return isinstance(exc, KeyboardInterrupt) and (
        threading.current_thread() is threading.main_thread()
    )
