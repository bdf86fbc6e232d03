"""Safety and monitoring: miss escalation and safety_stats()."""

from __future__ import annotations

import asyncio
import time

import pytest

from horus import Node, ms

from .helpers import KINDS, TRIGGER, node_of, nothing, run_until


async def overrun(node: Node) -> None:
    """Take longer than a budget of 10 ms, and less than a deadline of 95 ms."""
    await asyncio.sleep(30 * ms)


async def be_late(node: Node) -> None:
    """Take longer than a deadline of 50 ms."""
    await asyncio.sleep(70 * ms)


def late_node(name: str, **options) -> Node:
    """Return a 10 Hz node that misses its deadline in every tick."""
    return Node(name, be_late, rate=10, deadline=50 * ms, **options)


def test_max_deadline_misses_stops_the_scheduler_after_a_cumulative_threshold(make):
    """After 50 total deadline misses across all nodes, the scheduler stops."""
    sched = make(tick_rate=10, deterministic=True, max_deadline_misses=50)
    for name in ("a", "b", "c"):
        sched.add(late_node(name))
    down = []
    sched.add(Node("other", nothing, rate=10, shutdown=lambda: down.append(1)))

    sched.run(duration=3600.0)

    # The ticks that were under way at the fiftieth miss still ended, and missed.
    assert 50 <= sched.safety_stats()["deadline_misses"] <= 52
    assert "50" in sched.stop_reason
    assert "max_deadline_misses" in sched.stop_reason
    assert down == [1]
    assert sched.status() == "stopped"


def test_misses_of_all_nodes_count_together(make):
    """The threshold counts across all nodes, not per node."""
    sched = make(tick_rate=10, deterministic=True, max_deadline_misses=5)
    for name in ("a", "b"):
        sched.add(late_node(name))

    sched.run(duration=3600.0)

    misses = [sched.get_node_stats(name)["deadline_misses"] for name in ("a", "b")]
    assert 5 <= sum(misses) <= 6
    assert min(misses) >= 2


def test_only_misses_count_not_budget_overruns(make):
    """The counters stay apart: only deadline misses count towards max_deadline_misses."""
    sched = make(tick_rate=10, deterministic=True, max_deadline_misses=1)
    sched.add(Node("node", overrun, rate=10, budget=10 * ms))

    sched.run(duration=5.0)

    stats = sched.safety_stats()
    assert stats["budget_overruns"] == 50
    assert stats["deadline_misses"] == 0
    assert sched.stop_reason is None


def test_no_limit_by_default_but_a_warning_at_100(make, caplog):
    """max_deadline_misses=None means no limit (a warning at 100), and is not overwritten."""
    sched = make(tick_rate=10, deterministic=True)
    sched.add(late_node("node"))

    sched.run(duration=30.0)

    assert sched.safety_stats()["deadline_misses"] == 300
    assert sched.stop_reason is None
    told = [r for r in caplog.records if "max_deadline_misses" in r.getMessage()]
    assert len(told) == 1
    assert told[0].levelname == "WARNING"
    assert "100" in told[0].getMessage()


@pytest.mark.realtime
@pytest.mark.parametrize("kind", KINDS)
def test_the_threshold_works_for_every_class_in_real_time(make, loop, kind):
    """Misses of nodes of any class count towards the threshold."""
    sched = make(tick_rate=100, loop=loop, max_deadline_misses=2)

    def tick(node):
        time.sleep(5 * ms)

    sched.add(node_of(kind, "node", tick, rate=50, deadline=1 * ms))
    for index in range(3):
        sched.publish(TRIGGER, index)

    sched.run(duration=20.0)

    assert "max_deadline_misses=2" in sched.stop_reason


def test_safety_stats_has_the_keys_of_the_contract(make):
    """safety_stats(): budget_overruns, watchdog_expirations and health_states."""
    sched = make(tick_rate=10, deterministic=True)
    sched.add(Node("slow", overrun, rate=10, budget=10 * ms))
    sched.add(Node("fine", nothing, rate=10))
    sched.run(duration=1.0)

    stats = sched.safety_stats()

    assert stats
    assert stats["budget_overruns"] == 10
    assert stats["watchdog_expirations"] == 0
    assert stats["health_states"] == {"slow": "healthy", "fine": "healthy"}


def test_safety_stats_of_a_scheduler_that_has_not_run(make):
    """Statistics can be queried at any time."""
    stats = make().safety_stats()
    assert stats["budget_overruns"] == 0
    assert stats["health_states"] == {}


@pytest.mark.realtime
def test_safety_stats_is_the_sum_over_the_nodes(make, loop):
    """Query safety monitoring statistics at runtime: sums over all nodes of all classes."""
    sched = make(tick_rate=100, loop=loop)

    def tick(node):
        time.sleep(2 * ms)

    for kind in KINDS:
        sched.add(node_of(kind, kind, tick, rate=20))
        sched.set_tick_budget(kind, 500)
    sched.publish(TRIGGER, 1)

    run_until(sched, lambda: all(n["budget_overruns"] for n in sched.get_all_nodes()))

    total = sum(info["budget_overruns"] for info in sched.get_all_nodes())
    assert sched.safety_stats()["budget_overruns"] == total


def test_one_budget_overrun_stops_nothing(make):
    """One budget overrun does not stop everything."""
    sched = make(tick_rate=10, deterministic=True)
    sched.add(Node("node", overrun, rate=10, budget=10 * ms))
    sched.run(duration=1.0)
    assert sched.get_node_stats("node")["total_ticks"] == 10


def test_skipped_releases_are_counted(make):
    """A release that was not run is counted as skipped, never silently lost."""

    async def long(node):
        await asyncio.sleep(0.35)

    sched = make(tick_rate=10, deterministic=True)
    sched.add(Node("node", long, rate=10))
    sched.tick_for(1.2)

    stats = sched.get_node_stats("node")
    assert stats["total_ticks"] == 3
    assert stats["skipped"] == 9
