"""The framework clock: now, dt, elapsed, tick, budget_remaining, rng_float."""

from __future__ import annotations

import asyncio
import gc
import itertools
import threading
import time

import pytest

import horus
from horus import Node, ms

from .helpers import (
    KINDS,
    TRIGGER,
    node_of,
    nothing,
    record_ticks,
    run_until,
    running,
    wait_until,
)

# -- in callbacks, normal mode ---------------------------------------------------------------


@pytest.mark.realtime
def test_now_is_wall_clock_time_in_normal_mode(make, loop, kind):
    """In normal mode, horus.now() returns wall-clock time."""
    pairs = []
    sched = make(loop=loop)
    sched.add(node_of(kind, "node", lambda n: pairs.append((horus.now(), time.time()))))
    sched.publish(TRIGGER, 1)

    run_until(sched, lambda: pairs)

    assert all(abs(framework - wall) < 0.5 for framework, wall in pairs)


@pytest.mark.realtime
def test_now_is_consistent_across_nodes_and_never_jumps_back(make):
    """The framework clock provides consistent time across all nodes."""
    times = []
    sched = make()
    for name in "abc":
        sched.add(Node(name, lambda: times.append(horus.now()), order=1))

    run_until(sched, lambda: len(times) >= 9)

    assert times == sorted(times)


@pytest.mark.realtime
@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "Event"])
def test_dt_is_the_actual_time_since_the_last_tick(make, loop, kind):
    """horus.dt(): the actual elapsed duration since this node's last tick."""
    seen = []
    sched = make(loop=loop)

    def tick(node):
        seen.append((horus.now(), horus.dt()))
        if len(seen) == 3:
            time.sleep(80 * ms)

    sched.add(node_of(kind, "node", tick, rate=50))

    run_until(sched, lambda: len(seen) >= 6)

    for (earlier, _), (later, dt) in itertools.pairwise(seen):
        assert dt == pytest.approx(later - earlier, abs=20 * ms)
    # The tick of 80 ms shows in the next one's dt, which a nominal dt would hide.
    assert seen[3][1] >= 75 * ms
    assert sum(dt for _, dt in seen[1:]) == pytest.approx(seen[-1][0] - seen[0][0], abs=20 * ms)


@pytest.mark.realtime
def test_dt_is_nominal_on_the_first_tick(make, loop):
    """The first tick has no predecessor: dt() is the nominal 1/rate."""
    seen = []
    sched = make(loop=loop)
    sched.add(Node("node", lambda: seen.append(horus.dt()), rate=40))

    run_until(sched, lambda: seen)

    assert seen[0] == 1 / 40


def test_dt_in_tick_once_is_actual_not_zero(make):
    """After tick_once() in normal mode, dt() is the time between the steps."""
    seen = []
    sched = make(tick_rate=100)
    sched.add(Node("node", lambda: seen.append(horus.dt()), rate=100))

    sched.tick_once()
    time.sleep(30 * ms)
    sched.tick_once()

    assert seen[0] == 0.01
    assert 30 * ms <= seen[1] < 5.0


@pytest.mark.realtime
def test_elapsed_is_the_time_since_scheduler_start(make, loop):
    """horus.elapsed(): seconds since scheduler start."""
    seen = []
    sched = make(loop=loop)
    sched.add(Node("node", lambda: seen.append(horus.elapsed()), rate=50))
    begun = time.monotonic()

    run_until(sched, lambda: len(seen) >= 10)

    took = time.monotonic() - begun
    assert seen[0] >= 0.0
    assert seen == sorted(seen)
    # Ten releases of a 50 Hz node take at least nine periods.
    assert 0.18 - 20 * ms <= seen[-1] <= took


@pytest.mark.realtime
def test_tick_is_a_monotonically_increasing_counter(make, loop, kind):
    """horus.tick(): a monotonically increasing tick counter, in every class."""
    seen = []
    sched = make(tick_rate=100, loop=loop)

    def tick(node):
        seen.append(horus.tick())
        assert type(seen[-1]) is int

    sched.add(node_of(kind, "node", tick))
    if kind == "Event":
        sched.add(Node("driver", lambda n: n.send(TRIGGER, 1), rate=100, pubs=[TRIGGER]))

    run_until(sched, lambda: len(seen) >= 5)

    assert all(later > earlier for earlier, later in itertools.pairwise(seen)) or (
        kind == "Event" and seen == sorted(seen)
    )


def test_tick_goes_on_counting_over_steps_and_runs(make, deterministic):
    """The tick counter never goes back, whichever way the scheduler is driven."""
    seen = []
    sched = make(tick_rate=100, deterministic=deterministic)
    sched.add(Node("node", record_ticks(seen, horus.tick), rate=100))

    for _ in range(3):
        sched.tick_once()
    sched.tick_for(0.05)
    sched.tick_once()
    sched.run(duration=0.05)

    assert seen[:3] == [0, 1, 2]
    assert all(later > earlier for earlier, later in itertools.pairwise(seen))


def test_budget_remaining_counts_down_to_zero(make):
    """horus.budget_remaining(): seconds remaining in this tick's budget, down to zero."""
    seen = []

    def tick(node):
        seen.append(horus.budget_remaining())
        time.sleep(20 * ms)
        seen.append(horus.budget_remaining())
        time.sleep(120 * ms)
        seen.append(horus.budget_remaining())

    sched = make(tick_rate=10)
    sched.add(Node("node", tick, rate=1, budget=100 * ms))

    sched.tick_once()

    assert 0.05 < seen[0] <= 0.1
    assert seen[1] <= seen[0] - 20 * ms
    assert seen[2] == 0.0


def test_budget_remaining_counts_down_exactly_in_virtual_time(make):
    """The remaining budget follows the simulated clock in deterministic mode."""
    seen = []

    async def tick(node):
        for _ in range(4):
            seen.append(horus.budget_remaining())
            await asyncio.sleep(30 * ms)

    sched = make(tick_rate=1, deterministic=True)
    sched.add(Node("node", tick, rate=1, budget=80 * ms))

    sched.tick_for(1.0)

    assert seen == pytest.approx([0.08, 0.05, 0.02, 0.0])


def test_budget_remaining_is_inf_without_a_budget(make, deterministic):
    """horus.budget_remaining(): float('inf') if no budget is set."""
    seen = []
    sched = make(tick_rate=100, deterministic=deterministic)
    sched.add(Node("node", lambda: seen.append(horus.budget_remaining())))

    sched.tick_once()

    assert seen == [float("inf")]


def test_rng_float_is_in_the_unit_interval_and_random_in_normal_mode(make):
    """horus.rng_float(): a float in [0.0, 1.0), from system entropy in normal mode."""
    runs = []
    for _ in range(2):
        seen = []
        sched = make(tick_rate=100)
        sched.add(
            Node("node", lambda seen=seen: seen.extend(horus.rng_float() for _ in range(500)))
        )
        sched.tick_once()
        runs.append(seen)

    for seen in runs:
        assert all(type(value) is float and 0.0 <= value < 1.0 for value in seen)
        assert len(set(seen)) > 490
        assert 0.4 < sum(seen) / 500 < 0.6
    assert runs[0] != runs[1]


@pytest.mark.parametrize("phase", ["init", "tick", "shutdown"])
def test_the_clock_answers_in_init_tick_and_shutdown(make, deterministic, phase):
    """Inside tick(), init(), and shutdown() callbacks, the framework clock answers."""
    seen = []

    def ask(node):
        seen.append(
            (
                horus.now(),
                horus.dt(),
                horus.elapsed(),
                horus.tick(),
                horus.budget_remaining(),
                horus.rng_float(),
            )
        )

    callbacks = {"tick": nothing, phase: ask}
    sched = make(tick_rate=100, deterministic=deterministic)
    sched.add(Node("node", rate=100, **callbacks))

    sched.tick_once()
    sched.stop()

    now, dt, elapsed, tick, left, random = seen[0]
    assert now >= 0.0 if deterministic else abs(now - time.time()) < 5.0
    assert dt > 0.0
    assert elapsed >= 0.0
    assert tick in (0, 1)
    assert left > 0.0
    assert 0.0 <= random < 1.0


def test_frame_rate_independent_physics(make):
    """Use dt for frame-rate-independent physics: the result does not depend on the rate."""
    results = []
    for rate in (50, 400):
        state = {"position": 0.0, "velocity": 0.0}

        def physics(state=state):
            delta = horus.dt()
            state["velocity"] += 2.0 * delta
            state["position"] += state["velocity"] * delta

        sched = make(tick_rate=400, deterministic=True)
        sched.add(Node("physics", physics, rate=rate))
        sched.tick_for(1.0)
        results.append(state)

    for state in results:
        assert state["velocity"] == pytest.approx(2.0)
        assert state["position"] == pytest.approx(1.0, rel=0.03)


# -- deterministic -----------------------------------------------------------------------


@pytest.mark.parametrize("rate", [1, 30, 100, 1000 / 3])
@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind not in ("Event", "BestEffort")])
def test_dt_is_exactly_one_over_rate_in_deterministic_mode(make, kind, rate):
    """In deterministic mode horus.dt() returns a fixed 1/rate value every tick."""
    seen = set()
    sched = make(tick_rate=1000, deterministic=True)
    sched.add(node_of(kind, "node", lambda n: seen.add(horus.dt()), rate=rate))

    sched.tick_for(5.0)

    assert seen == {1 / rate}


def test_dt_of_a_best_effort_node_is_a_thirtieth_of_a_second(make):
    """Without a rate the fixed dt() is that of 30 Hz, exactly."""
    seen = set()
    sched = make(tick_rate=1000, deterministic=True)
    sched.add(Node("node", lambda: seen.add(horus.dt())))

    sched.tick_for(5.0)

    assert seen == {1 / 30}


def test_dt_after_a_step_is_one_cycle(make):
    """The example of the contract: after tick_once(), horus.dt() is 1/100 Hz = 10 ms."""
    sched = make(tick_rate=100, deterministic=True)
    sched.add(Node(name="sim_sensor", tick=nothing, rate=100, order=0))

    for _ in range(1000):
        sched.tick_once()
        assert horus.dt() == 0.01


def test_now_advances_by_dt_each_tick(make):
    """In deterministic mode horus.now() advances by dt each tick, from zero."""
    seen = []
    sched = make(tick_rate=100, deterministic=True)
    sched.add(Node("node", lambda: seen.append((horus.now(), horus.elapsed())), rate=100))

    for _ in range(1000):
        sched.tick_once()

    expected = pytest.approx([k * 0.01 for k in range(1000)], abs=1e-9)
    assert [now for now, _ in seen] == expected
    assert [elapsed for _, elapsed in seen] == expected


def test_the_simulated_clock_does_not_follow_the_wall_clock(make):
    """Nothing waits for the wall clock: real time spent in a tick is not simulated time."""
    seen = []

    def tick(node):
        seen.append(horus.now())
        time.sleep(2 * ms)
        seen.append(horus.now())

    sched = make(tick_rate=1000, deterministic=True)
    sched.add(Node("node", tick, rate=1000))

    sched.tick_for(0.003)

    assert seen == pytest.approx([0.0, 0.0, 0.001, 0.001, 0.002, 0.002])
    assert sched.get_node_stats("node")["deadline_misses"] == 0


def random_trace(make, **options):
    """Return what two nodes draw in twenty ticks."""
    seen = []
    sched = make(tick_rate=100, deterministic=True, **options)
    for name in ("a", "b"):
        sched.add(
            Node(
                name,
                lambda n: seen.append((n.name, horus.rng_float(), horus.rng_float())),
                rate=100,
            )
        )
    sched.tick_for(0.2)
    return seen


def test_rng_float_produces_the_same_sequence_across_runs(make):
    """In deterministic mode horus.rng_float() produces the same sequence across runs."""
    first = random_trace(make)
    assert random_trace(make) == first
    values = [value for _, one, two in first for value in (one, two)]
    assert len(set(values)) == len(values)
    assert all(0.0 <= value < 1.0 for value in values)


def test_rng_float_depends_on_the_seed(make):
    """Another seed gives another sequence, and the same one again for the same seed."""
    assert random_trace(make, seed=1) == random_trace(make, seed=1)
    assert random_trace(make, seed=1) != random_trace(make, seed=2)


def test_rng_float_is_seeded_by_node_and_tick(make):
    """A tick-seeded sequence: a node added beside, or an extra draw, changes nobody's numbers."""

    def draws(extra):
        seen = []
        sched = make(tick_rate=100, deterministic=True)

        def noisy(node):
            for _ in range(extra + (horus.tick() % 2) * extra):
                horus.rng_float()

        if extra:
            sched.add(Node("noisy", noisy, rate=100, order=0))
        sched.add(Node("node", lambda: seen.append(horus.rng_float()), rate=100, order=1))
        sched.tick_for(0.1)
        return seen

    assert draws(0) == draws(3)


# -- outside callbacks ---------------------------------------------------------------------


def test_outside_any_scheduler_the_functions_answer_sensibly_and_never_raise():
    """Outside callbacks: wall time, inf and so on, and never an exception."""
    # Schedulers that earlier tests left unstopped are no longer anybody's.
    gc.collect()
    answers = {}

    def ask():
        answers["now"] = horus.now()
        answers["dt"] = horus.dt()
        answers["elapsed"] = horus.elapsed()
        answers["tick"] = horus.tick()
        answers["left"] = horus.budget_remaining()
        answers["random"] = horus.rng_float()

    thread = threading.Thread(target=ask)
    thread.start()
    thread.join()

    assert answers["now"] == pytest.approx(time.time(), abs=5.0)
    assert answers["dt"] == 0.0
    assert answers["elapsed"] == 0.0
    assert answers["tick"] == 0
    assert answers["left"] == float("inf")
    assert 0.0 <= answers["random"] < 1.0


def test_outside_callbacks_an_active_scheduler_answers(make):
    """Outside callbacks the functions tell the time of the scheduler that is active."""
    sched = make(tick_rate=100, deterministic=True)
    sched.add(Node("node", nothing, rate=100))
    for _ in range(50):
        sched.tick_once()

    assert horus.now() == pytest.approx(0.5)
    assert horus.elapsed() == pytest.approx(0.5)
    assert horus.tick() == 50
    assert horus.budget_remaining() == float("inf")

    sched.stop()
    assert horus.now() == pytest.approx(time.time(), abs=5.0)


@pytest.mark.realtime
def test_an_application_thread_sees_the_time_of_the_run(make, loop):
    """While a scheduler runs, other threads can ask for its elapsed time and tick."""
    sched = make(tick_rate=100, loop=loop)
    sched.add(Node("node", nothing, rate=100))
    with running(sched):
        first = horus.elapsed(), horus.tick()
        wait_until(lambda: horus.tick() >= first[1] + 5)
        assert horus.elapsed() > first[0]
        assert horus.tick() == pytest.approx(sched.current_tick(), abs=1)
