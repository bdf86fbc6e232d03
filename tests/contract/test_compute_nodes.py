"""Compute nodes: CPU-heavy work that blocks nobody."""

from __future__ import annotations

import threading
import time

import pytest

import horus
from horus import Node, ms

from .helpers import PATIENCE_S, nothing, run_until, running, wait_until


def burn(seconds: float) -> int:
    """Use the CPU in pure Python, as a planner does."""
    end = time.thread_time() + seconds
    rounds = 0
    while time.thread_time() < end:
        rounds += 1
    return rounds


@pytest.mark.realtime
def test_compute_runs_on_a_thread_instead_of_the_main_loop(make, loop):
    """compute=True: run on a thread instead of the main loop; messages flow both ways."""
    paths = []
    threads = set()

    def plan_path(node):
        threads.add(threading.get_ident())
        if node.has_msg("map"):
            grid = node.recv("map")
            node.send("path", [(0, 0), (grid["width"] - 1, grid["height"] - 1)])

    sched = make(loop=loop)
    sched.add(
        Node(
            name="planner",
            tick=plan_path,
            rate=50,
            order=50,
            compute=True,
            subs=["map"],
            pubs=["path"],
        )
    )
    sched.add(Node("tracker", lambda n: paths.extend(n.recv_all("path")), order=60, subs=["path"]))
    sched.publish("map", {"width": 11, "height": 11})

    with running(sched):
        wait_until(lambda: paths)

    assert paths == [[(0, 0), (10, 10)]]
    assert len(threads) == 1


@pytest.mark.realtime
def test_a_busy_planner_does_not_block_the_motor_controller(make, loop):
    """The path planner needs its CPU time and must never block the motor controller."""
    journal = []
    sched = make(loop=loop)

    def plan(node):
        journal.append("plan begins")
        burn(40 * ms)
        journal.append("plan ends")

    sched.add(Node("planner", plan, rate=10, order=50, compute=True))
    sched.add(Node("motor", lambda: journal.append("motor"), rate=100, order=0))

    run_until(sched, lambda: journal.count("plan ends") >= 5)

    planning, during = False, 0
    for entry in journal:
        planning = entry == "plan begins" or (planning and entry != "plan ends")
        during += planning and entry == "motor"
    # Twenty on a quiet machine; none if the motor had to wait for the planner.
    assert during >= 6


@pytest.mark.realtime
def test_a_frozen_planner_delays_nobody(make, loop):
    """A slow compute node delays no other, neither Rt, Compute, async nor BestEffort."""
    let_go = threading.Event()
    counts = {}

    def count(node):
        counts[node.name] = counts.get(node.name, 0) + 1

    async def count_async(node):
        count(node)

    sched = make(loop=loop)
    sched.add(Node("frozen", lambda: let_go.wait(PATIENCE_S), rate=50, order=0, compute=True))
    sched.add(Node("compute", count, rate=50, order=1, compute=True))
    sched.add(Node("rt", count, rate=50, order=2))
    sched.add(Node("async", count_async, rate=50, order=3))
    sched.add(Node("best_effort", count, order=4))

    with running(sched):
        wait_until(
            lambda: all(
                counts.get(name, 0) >= 5 for name in ("compute", "rt", "async", "best_effort")
            )
        )
        assert sched.get_node_stats("frozen")["total_ticks"] == 0
        let_go.set()

    assert sched.get_node_stats("frozen")["skipped"] >= 1


@pytest.mark.realtime
def test_compute_ticks_never_overlap_themselves(make, loop):
    """A release that finds the node busy is skipped and counted, never run beside it."""
    inside, overlaps = [], []

    def tick(node):
        overlaps.extend(inside)
        inside.append(1)
        time.sleep(25 * ms)
        inside.pop()

    sched = make(loop=loop)
    sched.add(Node("planner", tick, rate=100, compute=True))

    run_until(sched, lambda: sched.get_node_stats("planner")["total_ticks"] >= 5)

    stats = sched.get_node_stats("planner")
    assert overlaps == []
    assert stats["skipped"] >= stats["total_ticks"]


@pytest.mark.realtime
def test_compute_nodes_run_beside_each_other(make, loop):
    """Two compute nodes are in their ticks at the same time."""
    barrier = threading.Barrier(2, timeout=PATIENCE_S)
    met = []

    def tick(node):
        barrier.wait()
        met.append(node.name)
        node.request_stop()

    sched = make(loop=loop)
    sched.add(Node("a", tick, rate=50, compute=True)).add(Node("b", tick, rate=50, compute=True))

    sched.run(duration=PATIENCE_S)

    assert set(met) == {"a", "b"}


def test_a_compute_node_without_a_rate_runs_at_30_hz(make):
    """compute=True without a rate has the default rate of 30 Hz."""
    ticks = []
    sched = make(deterministic=True)
    sched.add(Node("planner", lambda: ticks.append(1), compute=True))

    sched.tick_for(1.0)

    assert len(ticks) == 30


def test_compute_is_inline_in_deterministic_mode(make):
    """Deterministic mode runs Compute nodes on the one thread, in order."""
    journal = []
    sched = make(tick_rate=10, deterministic=True)
    sched.add(
        Node("planner", lambda: journal.append(("p", threading.get_ident())), rate=10, compute=True)
    )
    sched.add(Node("motor", lambda: journal.append(("m", threading.get_ident())), rate=10))

    sched.tick_for(0.2)

    me = threading.get_ident()
    assert journal == [("p", me), ("m", me)] * 2


@pytest.mark.realtime
def test_the_clock_answers_in_a_compute_tick(make, loop):
    """The framework clock answers on a compute thread as anywhere."""
    seen = []

    def tick(node):
        seen.append((horus.tick(), horus.dt(), horus.elapsed(), horus.budget_remaining()))
        node.request_stop()

    sched = make(loop=loop)
    sched.add(Node("planner", tick, rate=10, compute=True))

    sched.run(duration=PATIENCE_S)

    tick_number, dt, elapsed, left = seen[0]
    assert tick_number >= 0
    assert dt == pytest.approx(0.1)
    assert 0.0 <= elapsed < PATIENCE_S
    assert 0.0 <= left <= 0.08


def test_compute_in_tick_once_is_inline(make):
    """tick_once() runs a compute node on the calling thread, without threads."""
    threads = []
    sched = make(tick_rate=100)
    sched.add(Node("planner", lambda: threads.append(threading.get_ident()), compute=True))
    sched.add(Node("other", nothing))
    before = threading.active_count()

    sched.tick_once()

    assert threads == [threading.get_ident()]
    assert threading.active_count() == before
