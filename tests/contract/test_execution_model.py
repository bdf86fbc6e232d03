"""The Execution Model: how a tick works."""

from __future__ import annotations

import asyncio
import itertools
import sys
import threading
import time

import pytest

import horus
from horus import ExecutionClass, Node, ms

from .helpers import (
    KINDS,
    TRIGGER,
    all_have_ticked,
    node_of,
    nothing,
    record_ticks,
    run_async,
    run_until,
    until,
)


def test_nodes_tick_in_order_sequence(make, deterministic):
    """For each registered node, in order sequence: the lower order ticks first."""
    journal = []
    sched = make(tick_rate=100, deterministic=deterministic)
    for name, order in (("motor", 20), ("safety", 0), ("sensor", 10)):
        sched.add(Node(name, lambda node: journal.append(node.name), rate=100, order=order))

    sched.tick_once()
    sched.tick_once()

    assert journal == ["safety", "sensor", "motor"] * 2


def test_nodes_of_every_class_tick_in_one_order_sequence(make, deterministic):
    """Order holds across execution classes: a tick cycle goes through all nodes by order."""
    journal = []
    sched = make(tick_rate=100, deterministic=deterministic)
    for order, kind in reversed(list(enumerate(k for k in KINDS if k != "BestEffort"))):
        sched.add(node_of(kind, kind, lambda node: journal.append(node.name), order=order))
    sched.publish(TRIGGER, 1)

    sched.tick_once()

    assert journal == [kind for kind in KINDS if kind != "BestEffort"]


def test_nodes_of_equal_order_tick_in_order_of_insertion(make, deterministic):
    """Nodes of equal order, unrelated by topics, tick as they were added."""
    journal = []
    sched = make(tick_rate=100, deterministic=deterministic)
    for name in ("c", "a", "b"):
        sched.add(Node(name, lambda node: journal.append(node.name), rate=100))

    sched.tick_once()

    assert journal == ["c", "a", "b"]


@pytest.mark.realtime
def test_best_effort_nodes_execute_sequentially_in_order_on_the_calling_thread(make, loop):
    """BestEffort nodes (the default) execute sequentially in order on the main thread."""
    journal = []
    sched = make(loop=loop)

    def tick(node):
        journal.append((horus.tick(), node.order, threading.get_ident()))

    for order in (2, 3, 1):
        sched.add(Node(f"node{order}", tick, order=order))

    run_until(sched, lambda: len(journal) >= 12)

    assert journal == sorted(journal)
    assert {order for _, order, _ in journal} == {1, 2, 3}
    assert {thread for _, _, thread in journal} == {threading.get_ident()}


@pytest.mark.realtime
def test_rt_and_compute_nodes_run_on_their_own_threads(make, loop):
    """Rt and Compute nodes run on their own threads, each on one and the same for life."""
    journal = []
    sched = make(loop=loop)

    def note(node):
        journal.append((node.name, threading.get_ident()))

    for index, kind in enumerate(("Rt", "Compute", "Rt", "Compute")):
        sched.add(node_of(kind, f"{kind}{index}", note, init=note, shutdown=note))

    run_until(sched, lambda: all_have_ticked(sched))

    threads = {name: {t for n, t in journal if n == name} for name, _ in journal}
    assert len(threads) == 4
    assert all(len(own) == 1 for own in threads.values())
    assert len(set.union(*threads.values(), {threading.get_ident()})) == 5


@pytest.mark.realtime
def test_event_and_async_nodes_share_the_event_loop_of_the_run(make, loop):
    """Event and AsyncIo nodes run as coroutines on the one event loop of the run."""
    places = {}
    sched = make(loop=loop)

    def note(node):
        places[node.name] = (threading.get_ident(), asyncio.get_running_loop())

    sched.add(node_of("Event", "event", note)).add(node_of("AsyncIo", "async", note))
    sched.add(Node("best_effort", note))
    sched.publish(TRIGGER, 1)

    run_until(sched, lambda: len(places) == 3)

    assert len(set(places.values())) == 1
    assert places["event"][0] == threading.get_ident()


def test_a_10_hz_node_inside_a_1_khz_scheduler_ticks_every_100th_cycle(make):
    """Rate limiting is per-node: a 10 Hz node at 1 kHz ticks only every 100th cycle."""
    slow, fast = [], []
    sched = make(tick_rate=1000, deterministic=True)
    sched.add(Node("slow", record_ticks(slow, horus.tick), rate=10))
    sched.add(Node("fast", record_ticks(fast, horus.tick), rate=1000))

    for _ in range(500):
        sched.tick_once()

    assert slow == [0, 100, 200, 300, 400]
    assert fast == list(range(500))


@pytest.mark.realtime
def test_each_node_keeps_its_own_rate_in_real_time(make, loop):
    """Check the per-node rate limiter: is this node due to tick?"""
    counts = {"slow": 0, "fast": 0}
    sched = make(tick_rate=1000, loop=loop)

    def count(node):
        counts[node.name] += 1

    sched.add(Node("slow", count, rate=20)).add(Node("fast", count, rate=200))

    begun = time.monotonic()
    run_until(sched, lambda: counts["slow"] >= 8)
    took = time.monotonic() - begun

    # Late releases are skipped and never made up for: a rate is an upper bound.
    assert counts["fast"] <= 200 * took + 1
    assert counts["slow"] <= 20 * took + 1
    assert counts["fast"] > 3 * counts["slow"]


@pytest.mark.parametrize("kind", ["Rt", "Compute", "AsyncIo"])
@pytest.mark.parametrize("rate", [30.0, 7.0, 33.3, 100 / 3])
def test_rate_ratios_that_are_not_whole_hold_on_average_without_drift(make, kind, rate):
    """A 30 Hz node under a 100 Hz tick rate is 30 Hz, its releases at k/rate for ever."""
    times = []
    sched = make(tick_rate=100, deterministic=True)
    sched.add(node_of(kind, "node", record_ticks(times, horus.elapsed), rate=rate))

    sched.tick_for(30.0)

    assert times == pytest.approx([k / rate for k in range(len(times))], abs=2e-9)
    assert len(times) == pytest.approx(30 * rate, abs=1)


@pytest.mark.realtime
def test_a_real_time_release_grid_does_not_drift(make, loop):
    """Releases are absolute: late ticks do not push the later ones back."""
    counts = {}
    sched = make(loop=loop)

    def tick(node):
        counts[node.name] = counts.get(node.name, 0) + 1
        time.sleep(2 * ms)

    sched.add(Node("rt", tick, rate=100)).add(Node("compute", tick, rate=100, compute=True))

    sched.run(duration=0.5)

    for name in ("rt", "compute"):
        # Sleeping a period after each tick would give at most 41, not 50.
        done = counts[name] + sched.get_node_stats(name)["skipped"]
        assert done >= 45


@pytest.mark.realtime
@pytest.mark.parametrize("kind", ["Rt", "Compute", "AsyncIo"])
def test_a_late_start_does_not_lose_the_first_release(make, kind):
    """A node that starts late ticks at once for the release it is late for, its first one too."""
    seen = []
    over = threading.Event()
    sched = make(tick_rate=1)
    sched.add(node_of(kind, "slow", record_ticks(seen, horus.tick), rate=0.2))

    def hog():
        while not over.is_set():
            pass

    interval = sys.getswitchinterval()
    # A thread that wants to run waits for each of the others this long.
    sys.setswitchinterval(0.01)
    hogs = [threading.Thread(target=hog) for _ in range(3)]
    try:
        for thread in hogs:
            thread.start()
        run_until(sched, lambda: seen)
    finally:
        over.set()
        for thread in hogs:
            thread.join()
        sys.setswitchinterval(interval)

    assert seen[0] == 0


def test_the_timer_measures_how_long_tick_took(make):
    """Start a timer, call tick(), stop the timer: the tick duration is recorded."""
    sched = make(tick_rate=100, deterministic=True)

    async def tick(node):
        await asyncio.sleep(4 * ms)

    sched.add(Node("node", tick, rate=100))

    sched.tick_for(0.1)

    stats = sched.get_node_stats("node")
    assert stats["total_ticks"] == 10
    assert stats["avg_tick_duration"] == pytest.approx(4 * ms, rel=1e-3)
    assert stats["max_tick_duration"] == pytest.approx(4 * ms, rel=1e-3)


def test_metrics_are_recorded_tick_duration_overruns_health_state(make, kind):
    """Record metrics (tick duration, overruns, health state) for nodes of every class."""
    sched = make(tick_rate=100)
    sched.add(node_of(kind, "node"))
    sched.publish(TRIGGER, 1)

    sched.tick_once()

    stats = sched.get_node_stats("node")
    assert stats["total_ticks"] == 1
    assert stats["budget_overruns"] == 0
    assert stats["health"] == "healthy"
    assert stats["max_tick_duration"] > 0
    assert stats["avg_tick_duration"] == pytest.approx(stats["max_tick_duration"])


def test_budget_enforcement_happens_after_tick_returns(make):
    """The scheduler does not preempt mid-tick; it records the overrun afterwards."""
    overruns_seen = []
    finished = []
    sched = make(tick_rate=100)

    def tick(node):
        time.sleep(5 * ms)
        overruns_seen.append(sched.get_node_stats("slow")["budget_overruns"])
        finished.append(True)

    sched.add(Node("slow", tick, rate=10, budget=1 * ms, deadline=90 * ms))

    sched.tick_once()

    assert finished == [True]
    assert overruns_seen == [0]
    assert sched.get_node_stats("slow")["budget_overruns"] == 1


@pytest.mark.realtime
def test_after_all_nodes_are_processed_the_scheduler_sleeps(make, loop):
    """After all nodes are processed, sleep: an idle 1 kHz scheduler does not burn the CPU."""
    sched = make(tick_rate=1000, loop=loop)
    sched.add(Node("idle", nothing, rate=10)).add(Node("logger", nothing))
    cpu_before = time.process_time()

    sched.run(duration=0.5)

    assert time.process_time() - cpu_before < 0.2


@pytest.mark.realtime
def test_the_global_tick_rate_is_maintained(make, loop):
    """The cycle count grows by the global tick rate each second, whatever the nodes' rates."""
    sched = make(tick_rate=200, loop=loop)
    cycles = []
    sched.add(Node("node", record_ticks(cycles, horus.tick), rate=50))

    sched.run(duration=0.4)

    steps = {later - earlier for earlier, later in itertools.pairwise(cycles)}
    assert cycles[0] % 4 == 0
    assert all(step % 4 == 0 for step in steps)
    assert sched.current_tick() >= 80
    assert cycles[-1] <= 84


def test_the_execution_class_of_every_kind_is_the_one_under_test(kind):
    """The classes named in these tests are the ones the scheduler infers."""
    assert node_of(kind, "node").execution_class == ExecutionClass(kind)


@pytest.mark.realtime
def test_the_scheduler_runs_beside_an_application_on_its_loop(make, loop):
    """`await sched.arun()` ticks the nodes on the application's running loop."""
    loops = {}
    sched = make()
    sched.add(Node("node", lambda: loops.update(node=asyncio.get_running_loop())))

    async def main():
        loops["application"] = asyncio.get_running_loop()
        async with sched:
            await until(lambda: "node" in loops)

    run_async(main(), loop)

    assert loops["node"] is loops["application"]
