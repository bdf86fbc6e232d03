"""The drills: what goes wrong, and what has to happen, and when."""

from __future__ import annotations

from collections.abc import Callable

from drill.bench import Bench, Drill, Match
from drill.observer import SYSTEM
from drill.robot import (
    BACKOFF_S,
    BUDGET_S,
    CRITICAL_S,
    OVERRUN_S,
    PARTS,
    SHUTDOWN_ORDER,
    WATCHDOG_S,
    Fault,
)
from horus import StateError, ms, us

BLOCKS_LOOP = ("best_effort", "event")
"""The classes whose frozen ticks block the event loop."""

HOLD_S = 100 * ms
"""For how long it is made sure that a node that is held does not tick."""

LOOP_WAIT_S = 50 * ms
"""How long the hook of an async node waits for a blocked event loop before it goes without."""


def freeze(bench: Bench, kind: str) -> None:
    """A tick that does not return goes through all stages, and comes back by a command."""
    with bench.drill(kind, "freeze", "until it is isolated") as drill:
        before = _others_blamed(drill)
        drill.strike(Fault("freeze"))
        drill.expect("warning", _logs(drill, "warning: "), WATCHDOG_S)
        drill.expect("unhealthy", _logs(drill, "unhealthy: "), 2 * WATCHDOG_S)
        drill.expect("isolated", _logs(drill, "isolated: "), 3 * WATCHDOG_S)
        drill.expect("safe-state hook", _notes(drill, "hook"), 3 * WATCHDOG_S)
        if PARTS[kind].is_async:
            drill.expect("tick is cancelled", _notes(drill, "cancel"), 3 * WATCHDOG_S)
        else:
            drill.command("the device answers at last")
            drill.end_fault()
            drill.expect("its end is reported", _logs(drill, "its frozen tick has ended"), 0.0)
        ticks = _ticks(drill, drill.name)
        drill.pause(HOLD_S)
        stats = drill.robot.stats()[drill.name]
        isolated = (stats["state"], stats["health"]) == ("safe_state", "isolated")
        drill.confirm("held", isolated and stats["total_ticks"] == ticks)
        drill.confirm("nobody else blamed", _others_blamed(drill) == before)
        _clear(drill)
        _expect_next_tick(drill)


def recover(bench: Bench, kind: str) -> None:
    """A tick that returns before it is isolated makes the node healthy again."""
    with bench.drill(kind, "freeze", "for 1.8 timeouts") as drill:
        lasts_s = 1.8 * WATCHDOG_S
        drill.strike(Fault("freeze", lasts_s))
        drill.expect("warning", _logs(drill, "warning: "), WATCHDOG_S)
        drill.expect("healthy again", _logs(drill, "healthy again"), lasts_s)
        _expect_next_tick(drill, after_s=lasts_s)
        drill.confirm("no hook called", not drill.saw(_notes(drill, "hook")))


def critical(bench: Bench, kind: str) -> None:
    """A critical node takes the whole robot into its safe state."""
    with bench.drill(kind, "freeze", "as a critical node") as drill:
        scheduler = drill.robot.scheduler
        scheduler.add_critical_node(drill.name, timeout_ms=CRITICAL_S / ms)
        drill.strike(Fault("freeze"))
        # The time of a critical node counts from its release: a late start takes from it.
        earliest_s = CRITICAL_S / 2
        drill.expect(
            "safe state entered",
            lambda event: event.node == SYSTEM and event.text.startswith("safe state entered"),
            CRITICAL_S,
            earliest_s=earliest_s,
        )
        drill.expect(
            "every hook called",
            lambda event: event.kind == "hook" and event.node == SHUTDOWN_ORDER[-1],
            CRITICAL_S + (LOOP_WAIT_S if kind in BLOCKS_LOOP else 0.0),
            earliest_s=earliest_s,
            words=f"{CRITICAL_S / ms:.0f} ms + hooks",
        )
        hooks = [event.node for event in drill.saw(lambda event: event.kind == "hook")]
        drill.confirm("in shutdown order", hooks == SHUTDOWN_ORDER)
        drill.confirm("cannot be cleared yet", not _clears(drill))
        before = drill.robot.stats()
        drill.pause(HOLD_S)
        ticked = drill.until(lambda: _ticks(drill, "buttons") > before["buttons"]["total_ticks"])
        drill.confirm("ticks on without a hook", ticked)
        held = [name for name in SHUTDOWN_ORDER if name != drill.name]
        still = [name for name in held if _ticks(drill, name) == before[name]["total_ticks"]]
        drill.confirm("held with a hook", still == held)
        drill.command("the device answers at last")
        drill.end_fault()
        drill.until(lambda: _ticks(drill, drill.name) > before[drill.name]["total_ticks"])
        _clear(drill)
        _expect_next_tick(drill)
    bench.robot.fit(kind)


def raise_and_skip(bench: Bench, kind: str) -> None:
    """A tick that raises is logged, and the node ticks on."""
    with bench.drill(kind, "raise", 'failure_policy="skip"', failure_policy="skip") as drill:
        drill.strike(Fault("raise"))
        drill.expect("logged", _logs(drill, "tick() raised"), 0.0)
        _expect_next_tick(drill)


def raise_and_restart(bench: Bench, kind: str) -> None:
    """A tick that raises has init() run again after a pause."""
    with bench.drill(kind, "raise", 'failure_policy="restart"', failure_policy="restart") as drill:
        drill.strike(Fault("raise"))
        drill.expect("logged", _logs(drill, "tick() raised"), 0.0)
        due_s = BACKOFF_S + drill.period_s
        words = f"{BACKOFF_S / ms:.0f} ms + release"
        for what, match in (
            ("init() again", _notes(drill, "init")),
            ("ticks again", _notes(drill, "tick")),
        ):
            drill.expect(what, match, due_s, earliest_s=BACKOFF_S, words=words)


def overrun(bench: Bench, kind: str, on_miss: str) -> None:
    """A tick that takes too long is dealt with when it has returned."""
    with bench.drill(kind, "overrun", f'on_miss="{on_miss}"', on_miss=on_miss) as drill:
        # Whatever the class: a budget given to Node() would make an Rt node of the camera.
        drill.robot.scheduler.set_tick_budget(drill.name, BUDGET_S / us)
        skipped = drill.robot.stats()[drill.name]["skipped"]
        drill.strike(Fault("overrun", OVERRUN_S))
        drill.expect("logged", _logs(drill, "exceeded its"), OVERRUN_S)
        if on_miss == "safe_mode":
            drill.expect("safe-state hook", _notes(drill, "hook"), OVERRUN_S)
        if on_miss == "skip":
            _expect_next_tick(drill, periods=2)
            drill.confirm("release skipped", drill.robot.stats()[drill.name]["skipped"] > skipped)
        else:
            _expect_next_tick(drill)


DRILLS: dict[str, tuple[Callable[[Bench, str], None], ...]] = {
    "freeze": (freeze, recover, critical),
    "raise": (raise_and_skip, raise_and_restart),
    "overrun": (
        lambda bench, kind: overrun(bench, kind, "warn"),
        lambda bench, kind: overrun(bench, kind, "skip"),
        lambda bench, kind: overrun(bench, kind, "safe_mode"),
    ),
}
"""What is tried with a node of each class, by fault."""


def _logs(drill: Drill, beginning: str) -> Match:
    return lambda event: (
        event.node == drill.name and event.kind.isupper() and event.text.startswith(beginning)
    )


def _notes(drill: Drill, kind: str) -> Match:
    return lambda event: event.node == drill.name and event.kind == kind


def _expect_next_tick(drill: Drill, *, after_s: float = 0.0, periods: int = 1) -> None:
    # Releases are on a grid: from a tick that began late, or a command, it is less than a period.
    earliest_s = after_s + (periods - 1) * drill.period_s
    drill.expect(
        "ticks again",
        _notes(drill, "tick"),
        after_s + periods * drill.period_s,
        earliest_s=earliest_s,
        words="next release" if periods == 1 else "the one after next",
    )


def _clear(drill: Drill) -> None:
    drill.command("clear_safe_state()")
    # A tick that has just said that it ends has not quite ended: then it is called again.
    drill.confirm("cleared", drill.until(lambda: _clears(drill)))


def _clears(drill: Drill) -> bool:
    """Return whether nobody is held any more."""
    try:
        return drill.robot.scheduler.clear_safe_state() == []
    except StateError:  # a critical node is frozen
        return False


def _others_blamed(drill: Drill) -> dict[str, int]:
    """Return how often the watchdog of each other node has run out."""
    return {
        name: stats["watchdog_expirations"]
        for name, stats in drill.robot.stats().items()
        if name != drill.name
    }


def _ticks(drill: Drill, name: str) -> int:
    ticks: int = drill.robot.stats()[name]["total_ticks"]
    return ticks
