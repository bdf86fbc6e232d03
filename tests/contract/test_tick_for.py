"""tick_for(): timed runs."""

from __future__ import annotations

import asyncio
import time

import pytest

import horus
from horus import Node, StateError, UnknownNodeError, ms

from .helpers import KINDS, TRIGGER, node_of, nothing, run_async


@pytest.mark.realtime
def test_tick_for_runs_for_a_specific_duration_then_returns(make, loop):
    """tick_for(): runs the tick loop for a specific duration, in real time, then returns."""
    ticks = []
    sched = make(tick_rate=100, loop=loop)
    sched.add(Node("node", lambda: ticks.append(1), rate=50))
    begun = time.monotonic()

    sched.tick_for(0.2)

    assert 0.2 <= time.monotonic() - begun < 2.0
    assert 1 <= len(ticks) <= 11


def test_tick_for_is_virtual_seconds_at_full_speed_in_deterministic_mode(make):
    """Deterministic: virtual seconds at full speed, with every tick of that time."""
    times = []
    sched = make(tick_rate=100, deterministic=True)
    sched.add(Node("node", lambda: times.append(horus.now()), rate=100))
    begun = time.monotonic()

    sched.tick_for(100.0)

    assert len(times) == 10_000
    assert horus.now() == pytest.approx(100.0)
    assert time.monotonic() - begun < 20.0


def test_simulation_stepping_by_a_fixed_interval(make):
    """Simulation stepping: advancing by intervals gives the same ticks as one long run."""

    def times(step, count):
        seen = []
        sched = make(tick_rate=100, deterministic=True)
        sched.add(Node("a", lambda: seen.append(("a", horus.now())), rate=30))
        sched.add(Node("b", lambda: seen.append(("b", horus.now())), rate=100))
        for _ in range(count):
            sched.tick_for(step)
        return seen

    assert times(0.05, 20) == times(1.0, 1)


@pytest.mark.realtime
def test_the_nodes_stay_initialised_between_timed_runs(make, loop, kind):
    """tick_for() returns without shutting down: the next one goes on."""
    journal = []
    sched = make(tick_rate=100, loop=loop)
    sched.add(
        node_of(
            kind,
            "node",
            lambda node: journal.append("tick"),
            init=lambda node: journal.append("init"),
            shutdown=lambda node: journal.append("shutdown"),
        )
    )

    for _ in range(2):
        sched.publish(TRIGGER, 1)
        sched.tick_for(0.06)
    assert journal[0] == "init"
    assert set(journal[1:]) == {"tick"}
    assert sched.status() == "idle"
    sched.stop()

    assert journal[-1] == "shutdown"
    assert journal.count("shutdown") == 1


@pytest.mark.realtime
@pytest.mark.parametrize("kind", KINDS)
def test_only_the_named_nodes_run(make, deterministic, kind):
    """tick_for(0.5, ["sensor"]): run only sensor; the filter holds for every class."""
    ticks = []
    sched = make(tick_rate=100, deterministic=deterministic)
    for name in ("sensor", "other"):
        sched.add(node_of(kind, name, lambda node: ticks.append(node.name)))
    sched.publish(TRIGGER, 1)

    sched.tick_for(0.15, ["sensor"])

    assert set(ticks) == {"sensor"}


@pytest.mark.realtime
def test_nodes_that_were_not_named_join_in_a_later_timed_run(make, deterministic):
    """Frozen nodes are not lost: a later tick_for() without names ticks them."""
    ticks = []
    sched = make(tick_rate=100, deterministic=deterministic)
    for name in ("sensor", "other"):
        sched.add(Node(name, lambda n: ticks.append(n.name), rate=100))

    sched.tick_for(0.05, ["sensor"])
    ticks.clear()
    sched.tick_for(0.1)

    assert set(ticks) == {"sensor", "other"}


def test_unknown_names_are_an_error(make, deterministic):
    """Unknown names are an error, and then nothing runs."""
    ticks = []
    sched = make(tick_rate=100, deterministic=deterministic)
    sched.add(Node("sensor", lambda: ticks.append(1), rate=100))

    with pytest.raises(UnknownNodeError, match="lidar"):
        sched.tick_for(0.01, ["lidar"])

    assert ticks == []


def test_a_stop_ends_a_timed_run_early(make, deterministic):
    """request_stop() ends tick_for() before its time, and stop_reason says why."""
    ticks = []
    sched = make(tick_rate=100, deterministic=deterministic)

    def tick(node):
        ticks.append(1)
        if len(ticks) == 3:
            node.request_stop("seen enough")

    sched.add(Node("node", tick, rate=100))
    begun = time.monotonic()

    sched.tick_for(3600.0)

    assert len(ticks) <= 4
    assert sched.stop_reason == "seen enough"
    assert time.monotonic() - begun < 10.0


def test_an_async_tick_goes_on_over_the_end_of_a_virtual_interval(make):
    """A tick that sleeps across the end of a timed run goes on in the next one."""
    journal = []

    async def tick(node):
        journal.append(("begin", round(horus.now(), 6)))
        await asyncio.sleep(0.25)
        journal.append(("end", round(horus.now(), 6)))

    sched = make(tick_rate=10, deterministic=True)
    sched.add(Node("node", tick, rate=1))

    sched.tick_for(0.2)
    assert journal == [("begin", 0.0)]
    sched.tick_for(0.2)

    assert journal == [("begin", 0.0), ("end", 0.25)]


def test_tick_for_inside_an_event_loop_points_to_arun(make, loop):
    """In real time tick_for() would block a running event loop: the error names arun()."""
    sched = make(tick_rate=100)
    sched.add(Node("node", nothing, rate=100))

    async def main():
        with pytest.raises(StateError, match="arun"):
            sched.tick_for(0.01)

    run_async(main(), loop)


def test_a_deterministic_tick_for_works_inside_an_event_loop(make, loop):
    """Virtual time needs no loop of its own: tick_for() works in an async test."""
    ticks = []

    async def tick(node):
        await asyncio.sleep(1 * ms)
        ticks.append(1)

    sched = make(tick_rate=100, deterministic=True)
    sched.add(Node("node", tick, rate=100))

    async def main():
        sched.tick_for(0.1)
        sched.stop()

    run_async(main(), loop)

    assert len(ticks) == 10


@pytest.mark.realtime
def test_observing_behaviour_over_time(make):
    """Integration tests observe behavior over time: one tick_for(), then the counters."""
    sched = make(tick_rate=200)
    sched.add(Node("sensor", lambda n: n.send("scan", 1.0), rate=100, pubs=["scan"]))
    sched.add(Node("ctrl", lambda n: n.recv_all("scan"), rate=50, subs=["scan"]))

    sched.tick_for(0.2)

    sensor, ctrl = sched.get_node_stats("sensor"), sched.get_node_stats("ctrl")
    assert sensor["total_ticks"] > ctrl["total_ticks"] > 0
    assert sensor["errors_count"] == ctrl["errors_count"] == 0
