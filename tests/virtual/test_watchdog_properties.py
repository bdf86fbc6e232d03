"""What holds for the watchdog whatever happens: the real one, on a clock of the test's own."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from horus import Health

from .world import World

MS = 1_000_000
TIMEOUT = 100 * MS

timeouts = st.integers(1 * MS, 1000 * MS)
lengths = st.one_of(
    st.integers(0, 5 * TIMEOUT),
    st.sampled_from([n * TIMEOUT + d for n in (1, 2, 3) for d in (-1, 0, 1)]),
)
"""Lengths of ticks, those on the edge of a stage among them."""


# -- healthy nodes ---------------------------------------------------------------------------------


@given(timeouts, st.lists(st.tuples(st.floats(0, 1), st.integers(0, 5000 * MS)), max_size=20))
def test_ticks_within_the_timeout_never_escalate(timeout, ticks):
    """However often and however irregularly a node ticks: in time is healthy."""
    world = World(timeout)
    for fraction, pause in ticks:
        assert world.tick(int(fraction * timeout))
        assert world.health is Health.HEALTHY
        world.idle(pause)

    assert world.expirations == 0
    assert world.hooks == 0


@settings(deadline=None)
@given(st.integers(10 * MS, 1000 * MS), st.floats(0.2, 1000), st.floats(0, 0.99), st.integers(1, 9))
def test_no_rate_is_taken_for_a_freeze(timeout, rate_hz, fraction, ticks):
    """From 0.2 Hz to 1 kHz, a node that is busy for part of its period is healthy."""
    period = int(1e9 / rate_hz)
    length = int(fraction * min(period, timeout))
    world = World(timeout)
    for _ in range(ticks):
        world.tick(length)
        world.idle(period - length)

    assert world.expirations == 0
    assert world.live.counters.ticks == ticks


@given(st.lists(st.integers(0, TIMEOUT), max_size=20))
def test_messages_are_owed_one_after_another(ticks):
    """A backlog is no frozen tick: each message counts from the end of the tick before it."""
    world = World(TIMEOUT, critical_ns=TIMEOUT)
    arrived_ns = world.clock.now_ns()
    for length in ticks:
        world.due_since_ns = arrived_ns
        world.look()
        world.tick(length, release_ns=arrived_ns)

    assert world.expirations == 0
    assert not world.safety.active


@given(lengths, st.integers(0, 5 * TIMEOUT), st.integers(0, 2 * TIMEOUT))
def test_a_critical_tick_counts_by_what_it_took_whoever_could_look(length, suspended, waited):
    """The safe state follows from release and end alone, not from when supervision could look."""
    world = World(100 * TIMEOUT, critical_ns=TIMEOUT)
    released_ns = world.clock.now_ns()
    world.suspend(waited)
    world.tick(length, suspended_for_ns=suspended, release_ns=released_ns)

    late = waited + length + suspended > TIMEOUT
    assert world.safety.active == late
    assert world.hooks == world.expirations == late


@given(st.integers(0, 20 * TIMEOUT))
def test_a_tick_that_cannot_begin_isolates_nobody(waits):
    """It is not the node that hangs: it is unhealthy at most, and well when its tick has ended."""
    world = World(TIMEOUT)
    world.thread_of_node = None
    world.due_since_ns = world.clock.now_ns()
    world.look()
    world.idle(waits)
    stages = min(max(0, waits - 1) // TIMEOUT, 2)
    assert world.health is (Health.HEALTHY, Health.WARNING, Health.UNHEALTHY)[stages]
    world.due_since_ns = None
    assert world.tick(0)
    world.look()
    assert world.health is Health.HEALTHY
    assert world.hooks == 0


@given(st.integers(0, 20 * TIMEOUT), st.integers(0, TIMEOUT))
def test_a_message_that_waits_for_a_restart_is_owed_from_then_on(waited, length):
    """The back-off of a restart, 100 ms here, is held against nobody, nor is what came before."""
    world = World(TIMEOUT, critical_ns=TIMEOUT)
    arrived_ns = world.clock.now_ns()
    world.idle(waited)
    world.live.plan_restart()
    world.idle(100 * MS)
    world.due_since_ns = arrived_ns
    world.look()
    world.tick(length, release_ns=arrived_ns)

    assert world.live.counters.restarts == 1
    assert world.expirations == 0
    assert not world.safety.active


# -- frozen nodes ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("lasts", "health", "hooks"),
    [
        (TIMEOUT, Health.HEALTHY, 0),
        (TIMEOUT + 1, Health.WARNING, 0),
        (2 * TIMEOUT, Health.WARNING, 0),
        (2 * TIMEOUT + 1, Health.UNHEALTHY, 0),
        (3 * TIMEOUT, Health.UNHEALTHY, 0),
        (3 * TIMEOUT + 1, Health.ISOLATED, 1),
        (100 * TIMEOUT, Health.ISOLATED, 1),
    ],
)
def test_each_stage_begins_one_nanosecond_after_its_timeout(lasts, health, hooks):
    """Supervision asks to be woken when a stage can begin, neither before nor after."""
    world = World(TIMEOUT)
    world.tick(lasts)

    stages = (Health.HEALTHY, Health.WARNING, Health.UNHEALTHY, Health.ISOLATED)
    reached = stages[1 : stages.index(health) + 1]
    assert world.seen == [(n * TIMEOUT + 1, stages[n]) for n, _ in enumerate(reached, start=1)]
    assert world.expirations == len(reached[:1])
    assert world.hooks == hooks


@settings(max_examples=200)
@given(st.lists(st.tuples(st.sampled_from(["tick", "idle", "clear", "look"]), lengths)))
def test_a_node_lives_by_the_table(steps):
    """One expiration per frozen tick; isolated, no tick until it is let go; a hook per isolation.

    And no counter ever decreases.
    """
    world = World(TIMEOUT)
    expirations = hooks = ticks = skipped = 0
    isolated = False
    for what, length in steps:
        if what == "tick":
            assert world.tick(length) is not isolated
            if isolated:
                skipped += 1
            else:
                ticks += 1
                expirations += length > TIMEOUT
                isolated = length > 3 * TIMEOUT
                hooks += isolated
        elif what == "idle":
            world.idle(length)
        elif what == "clear":
            assert world.safety.clear([world.live]) == []
            isolated = False
        else:
            world.look()
        assert world.health is (Health.ISOLATED if isolated else Health.HEALTHY)
        assert (world.expirations, world.hooks) == (expirations, hooks)
        counters = world.live.counters
        assert (counters.ticks, counters.skipped) == (ticks, skipped)


@given(st.lists(st.tuples(lengths, st.booleans()), max_size=20))
def test_the_safe_state_is_entered_once_per_episode(ticks):
    """A critical node beyond its own timeout: one safe state, one hook, until it is cleared."""
    critical = TIMEOUT // 2
    world = World(TIMEOUT, critical_ns=critical)
    episodes = 0
    for length, clears in ticks:
        entered = world.safety.active
        world.tick(length)
        if not entered and length > critical:
            episodes += 1
        assert world.safety.active is (entered or length > critical)
        assert world.hooks == episodes
        if clears:
            world.safety.clear([world.live])

    assert world.live.standing.held is world.safety.active


# -- supervision that comes late -------------------------------------------------------------------


@given(st.integers(0, TIMEOUT // 2), st.integers(1, 100 * TIMEOUT), st.integers(0, TIMEOUT))
def test_a_suspended_process_is_not_a_frozen_tick(length, suspended, pause):
    """What supervision has not seen, because it was stopped itself, is held against nobody."""
    world = World(TIMEOUT)
    world.idle(pause)
    # One that is just as long as the timeout cannot be told from a freeze.
    world.tick(length, suspended_for_ns=TIMEOUT + TIMEOUT // 4 + 1 + suspended)

    assert world.expirations == 0
    assert world.health is Health.HEALTHY


@given(st.integers(1, 100 * TIMEOUT), st.integers(0, TIMEOUT))
def test_a_release_that_was_due_meanwhile_is_not_a_frozen_tick(suspended, pause):
    """Nor is a tick that could not begin while the process was stopped."""
    world = World(TIMEOUT)
    world.idle(pause)
    world.due_since_ns = world.clock.now_ns()
    world.suspend(TIMEOUT + TIMEOUT // 4 + suspended)
    world.look()
    assert world.health is Health.HEALTHY
    world.due_since_ns = None
    world.tick(0)

    assert world.expirations == 0


@given(st.integers(0, 100 * TIMEOUT))
def test_a_tick_that_goes_on_after_a_suspension_is_still_found_frozen(suspended):
    """The time that is not counted only puts the stages off: the watchdog does not give up."""
    world = World(TIMEOUT)
    world.tick(10 * TIMEOUT, suspended_for_ns=suspended)

    assert world.health is Health.ISOLATED
    assert world.expirations == 1


@given(st.integers(TIMEOUT, 100 * TIMEOUT), st.integers(0, TIMEOUT // 2))
def test_for_a_critical_node_that_time_counts(suspended, length):
    """Its motor was not controlled, whoever is to blame."""
    world = World(10_000 * TIMEOUT, critical_ns=TIMEOUT)
    world.tick(length, suspended_for_ns=suspended)
    # Supervision is woken together with the node, and may come second.
    if world.safety.active:
        assert world.hooks == 1
    else:
        assert world.live.counters.ticks == 1


@given(st.floats(0.0, 5.0))
def test_supervision_that_is_always_late_does_not_miss_a_freeze(lateness):
    """On a machine that is too busy the stages come later, but they come."""
    world = World(TIMEOUT)

    def late(instant_ns):
        while world.watchdog.next_ns + lateness * TIMEOUT <= instant_ns:
            world.clock.advance_to(int(world.watchdog.next_ns + lateness * TIMEOUT))
            world.look()
        world.clock.advance_to(instant_ns)

    world._pass_until = late
    world.tick(int(10 * (1 + lateness) * TIMEOUT))

    assert world.health is Health.ISOLATED
