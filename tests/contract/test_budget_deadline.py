"""Budget and deadline: auto-derivation, overrides, and what they are measured from."""

from __future__ import annotations

import asyncio
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from horus import Node, ms, us

from .helpers import nothing


@given(rate=st.floats(min_value=0.01, max_value=1e5))
def test_budget_is_80_and_deadline_95_percent_of_the_period(rate):
    """When you set rate: budget = 80% of the period, deadline = 95% of the period."""
    node = Node("auto", nothing, rate=rate)
    # Whole nanoseconds inside, so to the nanosecond or two.
    assert node.budget == pytest.approx(0.80 / rate, rel=1e-9, abs=2e-9)
    assert node.deadline == pytest.approx(0.95 / rate, rel=1e-9, abs=2e-9)


def test_1000_hz_derives_800_us_and_950_us():
    """1000 Hz means a 1 ms period, so budget = 800 us and deadline = 950 us."""
    node = Node(name="auto", tick=nothing, rate=1000, order=0)
    assert node.budget == pytest.approx(800 * us)
    assert node.deadline == pytest.approx(950 * us)


def test_you_can_override_either_with_explicit_values():
    """Explicit budget and deadline override the 80% / 95% defaults."""
    node = Node(
        name="explicit", tick=nothing, rate=1000, order=0, budget=300 * us, deadline=900 * us
    )
    assert node.budget == pytest.approx(300 * us)
    assert node.deadline == pytest.approx(900 * us)


def test_overriding_one_leaves_the_other_derived():
    """Either can be overridden alone; the other keeps its default."""
    node = Node("a", nothing, rate=1000, budget=300 * us)
    assert node.budget == pytest.approx(300 * us)
    assert node.deadline == pytest.approx(950 * us)
    node = Node("b", nothing, rate=1000, deadline=900 * us)
    assert node.budget == pytest.approx(800 * us)
    assert node.deadline == pytest.approx(900 * us)


@given(
    rate=st.floats(min_value=1.0, max_value=1e4), fraction=st.floats(min_value=0.01, max_value=1.0)
)
def test_a_derived_limit_never_contradicts_an_explicit_one(rate, fraction):
    """A tick within its budget meets its deadline, whichever of the two was derived."""
    for argument in ("budget", "deadline"):
        node = Node("node", nothing, rate=rate, **{argument: fraction / rate})
        assert node.budget <= node.deadline


def test_a_node_without_timing_has_no_limits():
    """None of rate, budget and deadline: no limits are derived."""
    node = Node("logger", nothing)
    assert node.budget is None
    assert node.deadline is None


def test_an_event_node_gets_no_limit_from_a_period_it_does_not_have():
    """An event node has no period: only explicit limits count."""
    node = Node("estop", nothing, on="emergency.stop", budget=1 * ms)
    assert node.budget == pytest.approx(1 * ms)
    assert node.deadline is None


def sleeper(seconds):
    """Return an async tick that takes `seconds` of virtual time."""

    async def tick(node):
        await asyncio.sleep(seconds)

    return tick


@pytest.mark.parametrize(
    ("takes", "overruns", "misses"),
    [
        (7.9 * ms, 0, 0),
        (8.1 * ms, 10, 0),
        (9.4 * ms, 10, 0),
        (9.6 * ms, 10, 10),
    ],
)
def test_budget_bounds_the_tick_duration_deadline_the_time_from_release(
    make, takes, overruns, misses
):
    """Exceeding the budget is an overrun, exceeding the deadline a miss: counted apart."""
    sched = make(tick_rate=100, deterministic=True)
    sched.add(Node("node", sleeper(takes), rate=100))

    sched.tick_for(0.1)

    stats = sched.get_node_stats("node")
    assert stats["total_ticks"] == 10
    assert stats["budget_overruns"] == overruns
    assert stats["deadline_misses"] == misses


@pytest.mark.realtime
def test_the_deadline_runs_from_the_release_not_from_the_start(make, loop):
    """A short tick that starts late misses its deadline without overrunning its budget."""
    sched = make(loop=loop)

    async def punctual(node):
        pass

    # Released at the same instants and ordered first, the hog delays every start.
    sched.add(Node("hog", lambda node: time.sleep(60 * ms), order=0))
    sched.set_node_rate("hog", 10)
    sched.add(Node("punctual", punctual, rate=10, order=1, budget=30 * ms, deadline=30 * ms))

    sched.run(duration=0.35)

    stats = sched.get_node_stats("punctual")
    assert stats["total_ticks"] >= 3
    assert stats["deadline_misses"] == stats["total_ticks"]
    assert stats["budget_overruns"] < stats["total_ticks"]


def test_in_tick_once_the_deadline_runs_from_the_start(make):
    """In tick_once() nobody is released, so the deadline counts from the tick's start."""
    sched = make(tick_rate=100)
    sched.add(Node("hog", lambda node: time.sleep(60 * ms), order=0))
    sched.add(Node("node", nothing, rate=20, order=1, deadline=40 * ms))

    sched.tick_once()

    assert sched.get_node_stats("node")["deadline_misses"] == 0


def test_set_node_rate_derives_the_limits_anew(make):
    """Derived limits follow the rate; explicit ones stay."""
    sched = make(tick_rate=100, deterministic=True)
    sched.add(Node("derived", sleeper(5 * ms), rate=100))
    sched.add(Node("explicit", sleeper(5 * ms), rate=100, budget=6 * ms, deadline=9 * ms))
    sched.tick_for(0.1)
    for name in ("derived", "explicit"):
        assert sched.get_node_stats(name)["budget_overruns"] == 0

    # At 200 Hz the derived limits are 4 ms and 4.75 ms.
    for name in ("derived", "explicit"):
        sched.set_node_rate(name, 200)
    sched.tick_for(0.1)

    assert sched.get_node_stats("derived")["budget_overruns"] > 0
    assert sched.get_node_stats("derived")["deadline_misses"] > 0
    assert sched.get_node_stats("explicit")["budget_overruns"] == 0
    assert sched.get_node_stats("explicit")["deadline_misses"] == 0
