"""The on_miss policy: warn, skip, safe_mode, stop."""

from __future__ import annotations

import asyncio
import re
import threading
import time

import pytest

import horus
from horus import Node, ms

from .helpers import KINDS, TRIGGER, node_of, nothing

FAST, SLOW, LATE = 2 * ms, 30 * ms, 70 * ms
"""Durations of a tick with a budget of 10 ms and a deadline of 50 ms: in time, over, late."""


def script(*durations, journal=None):
    """Return an async tick that takes these durations of virtual time, then `FAST` ones."""
    remaining = list(durations)

    async def tick(node):
        if journal is not None:
            journal.append(horus.now())
        await asyncio.sleep(remaining.pop(0) if remaining else FAST)

    return tick


def timed(tick, **options) -> Node:
    """Return a 10 Hz node with a budget of 10 ms and a deadline of 50 ms."""
    return Node("node", tick, rate=10, budget=10 * ms, deadline=50 * ms, **options)


@pytest.fixture
def sched(make):
    """A deterministic scheduler of 10 cycles a second."""
    return make(tick_rate=10, deterministic=True)


# -- warn ------------------------------------------------------------------------------


def test_warn_is_the_default(sched, caplog):
    """The default policy is "warn": log a warning, continue normally."""
    times = []
    sched.add(timed(script(SLOW, journal=times)))

    sched.tick_for(0.5)

    assert times == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4])
    warnings = [r for r in caplog.records if r.levelname == "WARNING"]
    assert len(warnings) == 1
    assert warnings[0].name == "horus.node.node"


def test_warn_logs_a_warning_and_continues_normally(sched, caplog):
    """Policy "warn": the warning names the limit and the excess; nothing else changes."""
    times = []
    hooks = []
    sched.add(timed(script(LATE, LATE, journal=times), on_miss="warn", safe_state=as_hook(hooks)))

    sched.tick_for(0.4)

    assert times == pytest.approx([0.0, 0.1, 0.2, 0.3])
    assert hooks == []
    assert any("deadline of 50.00 ms" in r.getMessage() for r in caplog.records)


def test_misses_in_every_tick_are_logged_at_most_once_a_second(sched, caplog):
    """A node that always misses does not flood the log: the others are summed up."""
    sched.add(timed(script(*[SLOW] * 50)))

    sched.tick_for(5.0)

    assert sched.get_node_stats("node")["budget_overruns"] == 50
    warnings = [r for r in caplog.records if r.levelname == "WARNING"]
    assert 2 <= len(warnings) <= 6
    assert any(re.search(r"\b(9|10|11) ticks", r.getMessage()) for r in warnings)


def as_hook(journal, value=None):
    """Return an async safe-state hook that appends to `journal`."""

    async def hook(node):
        journal.append(horus.now() if value is None else value)

    return hook


# -- when it fires -----------------------------------------------------------------------


@pytest.mark.parametrize("takes", [SLOW, LATE])
def test_the_policy_fires_on_a_budget_overrun_and_on_a_deadline_miss(sched, takes):
    """When a node exceeds its budget, or its deadline, the miss policy fires."""
    hooks = []
    sched.add(timed(script(takes), on_miss="safe_mode", safe_state=as_hook(hooks)))

    sched.tick_for(0.3)

    assert len(hooks) == 1


def test_the_policy_fires_once_per_tick_even_if_both_limits_are_exceeded(sched, caplog):
    """on_miss fires once per tick; the counters of the two limits stay apart."""
    hooks = []
    sched.add(timed(script(LATE), on_miss="safe_mode", safe_state=as_hook(hooks)))

    sched.tick_for(0.2)

    stats = sched.get_node_stats("node")
    assert stats["budget_overruns"] == 1
    assert stats["deadline_misses"] == 1
    assert len(hooks) == 1
    assert len([r for r in caplog.records if r.levelname == "WARNING"]) == 1


@pytest.mark.parametrize("policy", ["warn", "skip", "safe_mode", "stop"])
def test_no_policy_fires_for_ticks_that_meet_their_limits(sched, policy, caplog):
    """A node that keeps its limits is left alone by every policy."""
    hooks = []
    times = []
    sched.add(timed(script(journal=times), on_miss=policy, safe_state=as_hook(hooks)))

    sched.tick_for(0.5)

    assert len(times) == 5
    assert hooks == []
    assert sched.stop_reason is None
    assert not [r for r in caplog.records if r.levelname == "WARNING"]


# -- skip ------------------------------------------------------------------------------


def test_skip_drops_exactly_the_next_release(sched):
    """Policy "skip": skip this node's next tick to recover, exactly that one."""
    times = []
    sched.add(timed(script(FAST, SLOW, FAST, LATE, journal=times), on_miss="skip"))

    sched.tick_for(0.8)

    assert times == pytest.approx([0.0, 0.1, 0.3, 0.4, 0.6, 0.7])
    assert sched.get_node_stats("node")["skipped"] == 2


def test_skip_does_not_skip_other_nodes(sched):
    """Policy "skip" skips this node's next tick, nobody else's."""
    times = []
    sched.add(timed(script(SLOW, SLOW, SLOW), on_miss="skip"))
    sched.add(Node("other", lambda: times.append(horus.now()), rate=10))

    sched.tick_for(0.5)

    assert len(times) == 5


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind not in ("Event",)])
def test_skip_works_in_steps_for_every_class(make, kind):
    """In tick_once() the next tick is the one that "skip" drops."""
    ticks = []

    def tick(node):
        ticks.append(len(ticks))
        time.sleep(5 * ms)

    sched = make(tick_rate=10)
    node = node_of(kind, "node", tick, rate=1, on_miss="skip")
    sched.add(node)
    sched.set_tick_budget("node", 1000)

    for _ in range(4):
        sched.tick_once()

    assert ticks == [0, 1]


# -- safe_mode ---------------------------------------------------------------------------


def test_safe_mode_calls_enter_safe_state_on_the_node(sched):
    """Policy "safe_mode": call enter_safe_state() on the node."""
    journal = []

    class Motor(Node):
        def __init__(self):
            super().__init__(
                "motor", rate=10, budget=10 * ms, deadline=50 * ms, on_miss="safe_mode"
            )

        async def tick(self):
            journal.append("tick")
            await asyncio.sleep(SLOW if len(journal) == 1 else FAST)

        async def enter_safe_state(self):
            journal.append("safe state")

    sched.add(Motor())
    sched.add(Node("other", nothing, rate=10, safe_state=lambda: journal.append("other")))

    sched.tick_for(0.2)

    assert journal == ["tick", "safe state", "tick"]


def test_safe_mode_calls_the_safe_state_function(sched):
    """Safe state: Node(safe_state=fn) is called as the method would be."""
    hooks = []
    sched.add(timed(script(SLOW), on_miss="safe_mode", safe_state=as_hook(hooks, "braked")))

    sched.tick_for(0.2)

    assert hooks == ["braked"]


def test_safe_mode_calls_the_hook_once_per_episode(sched):
    """The hook runs once per episode; an episode ends with a tick that meets both limits."""
    hooks = []
    sched.add(
        timed(
            script(SLOW, LATE, SLOW, FAST, SLOW, FAST, FAST, LATE, LATE),
            on_miss="safe_mode",
            safe_state=as_hook(hooks),
        )
    )

    sched.tick_for(1.0)

    assert hooks == pytest.approx([0.03, 0.43, 0.77])


def test_a_node_in_safe_mode_keeps_ticking(sched):
    """After "safe_mode" the node is still released: it may recover."""
    times = []
    sched.add(timed(script(SLOW, journal=times), on_miss="safe_mode", safe_state=as_hook([])))

    sched.tick_for(0.3)

    assert len(times) == 3


def test_safe_mode_without_a_hook_is_a_warning(sched, caplog):
    """A node without a safe-state hook under "safe_mode" is warned about and goes on."""
    times = []
    sched.add(timed(script(SLOW, journal=times), on_miss="safe_mode"))

    sched.tick_for(0.3)

    assert len(times) == 3
    assert any(r.levelname == "WARNING" for r in caplog.records)


def test_a_raising_safe_state_hook_is_contained(sched, caplog):
    """A hook that raises is logged; the node and the others go on."""

    async def fail(node):
        raise OSError("brake is stuck")

    times = []
    sched.add(timed(script(SLOW, journal=times), on_miss="safe_mode", safe_state=fail))

    sched.tick_for(0.3)

    assert len(times) == 3
    assert any("brake is stuck" in r.getMessage() for r in caplog.records)
    assert sched.get_node_stats("node")["errors_count"] == 1


@pytest.mark.realtime
@pytest.mark.parametrize("kind", KINDS)
def test_the_safe_state_hook_runs_where_the_node_ticks(make, loop, kind):
    """A node's own miss calls its hook on its own thread, where its hardware lives."""
    threads = {}

    def tick(node):
        threads["tick"] = threading.get_ident()
        time.sleep(5 * ms)

    def hook(node):
        threads["hook"] = threading.get_ident()
        node.request_stop()

    sched = make(loop=loop)
    sched.add(node_of(kind, "node", tick, rate=20, on_miss="safe_mode", safe_state=hook))
    sched.set_tick_budget("node", 1000)
    sched.publish(TRIGGER, 1)

    sched.run(duration=10.0)

    assert threads["hook"] == threads["tick"]


# -- stop ------------------------------------------------------------------------------


def test_stop_ends_the_run_in_order(sched):
    """Policy "stop": stop the entire scheduler, in order; run() returns."""
    journal = []
    sched.add(
        timed(script(FAST, SLOW), on_miss="stop", order=0, shutdown=as_hook(journal, "safety down"))
    )
    sched.add(
        Node(
            "motor",
            lambda: journal.append("tick"),
            rate=10,
            order=1,
            shutdown=lambda: journal.append("motor down"),
        )
    )

    sched.run(duration=60.0)

    assert journal[-2:] == ["motor down", "safety down"]
    assert journal.count("tick") == 2
    assert sched.status() == "stopped"


@pytest.mark.parametrize(
    ("takes", "limit", "by"), [(SLOW, "10.00 ms", "20.00 ms"), (LATE, "50.00 ms", "20.00 ms")]
)
def test_stop_reason_names_node_limit_and_observed_value(sched, takes, limit, by):
    """sched.stop_reason names the node, the limit and by how much it was exceeded."""
    sched.add(timed(script(takes), on_miss="stop"))

    sched.run(duration=60.0)

    assert "'node'" in sched.stop_reason
    assert limit in sched.stop_reason
    assert by in sched.stop_reason


@pytest.mark.realtime
@pytest.mark.parametrize("kind", KINDS)
def test_stop_stops_the_entire_scheduler_in_real_time(make, loop, kind):
    """on_miss="stop" of a node of any class stops everything, and run() returns."""
    sched = make(loop=loop)
    down = []

    def tick(node):
        time.sleep(5 * ms)

    sched.add(node_of(kind, "safety_monitor", tick, rate=2, on_miss="stop"))
    sched.set_tick_budget("safety_monitor", 1000)
    sched.add(Node("other", nothing, shutdown=lambda: down.append(1)))
    sched.publish(TRIGGER, 1)

    sched.run(duration=20.0)

    assert "safety_monitor" in sched.stop_reason
    assert "budget of 1.00 ms" in sched.stop_reason
    assert down == [1]


def test_an_overrun_of_a_node_that_only_warns_stops_nothing(sched):
    """One budget overrun stops nothing, unless the node's policy is "stop"."""
    times = []
    sched.add(timed(script(*[LATE] * 20, journal=times)))

    sched.run(duration=2.0)

    assert len(times) == 20
    assert sched.stop_reason is None
