"""Leaving the safe state: by `clear_safe_state()`, by a stop, by another run."""

from __future__ import annotations

import asyncio
import time

import pytest

from horus import Node, StateError, ms

from .freezing import (
    AWAITING,
    ON_LOOP,
    WAYS,
    Freezer,
    Witness,
    await_health,
    cleared,
    expirations,
    freezing_node,
    in_safe_state,
)
from .helpers import TRIGGER, run_async, running, until, wait_until

pytestmark = pytest.mark.realtime

TIMEOUT_MS = 100


# -- clear_safe_state ------------------------------------------------------------------------------


@pytest.mark.parametrize("way", WAYS)
def test_clear_safe_state_lets_the_nodes_tick_again(make, way):
    """Nodes are held until clear_safe_state(), once the critical one is not frozen any more."""
    sched = make()
    witness, freezer = Witness(sched), Freezer(armed=False)
    witness.add("Rt", "motor", order=10)
    sched.add(freezing_node(way, freezer, "critical", order=0, watchdog=60.0))
    sched.add_critical_node("critical", timeout_ms=TIMEOUT_MS)
    with running(sched), freezer:
        wait_until(lambda: witness.all_tick())
        freezer.freeze()
        sched.publish(TRIGGER, 1)
        wait_until(lambda: witness.names("hook") and freezer.hook_threads)
        with pytest.raises(StateError, match="critical is critical and still frozen"):
            sched.clear_safe_state()
        assert in_safe_state(sched)
        assert sched.get_node_stats("motor")["state"] == "safe_state"
        freezer.thaw()
        await_health(sched, "critical", "healthy")
        assert in_safe_state(sched)
        held_at, ended = witness.ticks["motor"], freezer.ended
        wait_until(lambda: cleared(sched))
        assert not in_safe_state(sched)
        assert sched.safety_stats()["safe_state_reason"] is None
        sched.publish(TRIGGER, 2)
        wait_until(lambda: witness.ticks["motor"] >= held_at + 3 and freezer.ended > ended)

        assert {info["state"] for info in sched.get_all_nodes()} == {"running"}
        assert len(witness.names("hook")) == len(freezer.hook_threads) == 1
        assert expirations(sched, "critical") == 1


def test_the_safe_state_stays_while_the_critical_node_cannot_begin(make):
    """A critical node that still waits for its thread is as frozen as one that runs on."""
    sched = make(watchdog_ms=60_000)
    witness, blocker = Witness(sched), Freezer(armed=False)
    sched.add(freezing_node("BestEffort", blocker, "blocker", order=0))
    witness.add("BestEffort", "critical", order=1)
    sched.add_critical_node("critical", timeout_ms=TIMEOUT_MS)
    with running(sched), blocker:
        wait_until(lambda: witness.all_tick())
        blocker.freeze()
        wait_until(lambda: witness.names("hook") == ["critical"])
        with pytest.raises(StateError, match="critical is critical and still frozen"):
            sched.clear_safe_state()
        assert in_safe_state(sched)
        blocker.thaw()
        wait_until(lambda: cleared(sched))
        held_at = witness.ticks["critical"]
        wait_until(lambda: witness.ticks["critical"] > held_at)

        assert witness.names("hook") == ["critical"]


@pytest.mark.parametrize("way", WAYS)
def test_an_isolated_node_ticks_again_once_its_tick_has_returned(make, way):
    """clear_safe_state() names nodes that cannot tick yet, and frees them when they can."""
    sched = make(watchdog_ms=TIMEOUT_MS)
    freezer = Freezer(armed=False)
    sched.add(freezing_node(way, freezer))
    with running(sched), freezer:
        freezer.freeze()
        sched.publish(TRIGGER, 1)
        await_health(sched, "frozen", "isolated")
        wait_until(lambda: freezer.hook_threads)
        if way not in AWAITING:
            assert sched.clear_safe_state() == ["frozen"]
            assert sched.get_node_stats("frozen")["state"] == "safe_state"
        freezer.thaw()
        wait_until(lambda: cleared(sched))
        ended = freezer.ended
        sched.publish(TRIGGER, 2)
        wait_until(lambda: freezer.ended > ended)

        assert sched.get_node_stats("frozen")["health"] == "healthy"
        assert sched.get_node_stats("frozen")["state"] == "running"
        assert expirations(sched) == 1


def test_clear_safe_state_without_one_does_nothing(make, caplog):
    """Where nobody is held, clear_safe_state() returns that nobody remains, and logs nothing."""
    sched = make()
    witness = Witness(sched)
    witness.add("Rt", "motor")
    assert sched.clear_safe_state() == []
    with running(sched):
        wait_until(lambda: witness.all_tick())
        assert sched.clear_safe_state() == []
        before = witness.ticks["motor"]
        wait_until(lambda: witness.ticks["motor"] > before)
    assert "cleared" not in caplog.text


def test_the_safe_state_can_be_entered_again(make):
    """A second freeze after clear_safe_state() is a second episode: hooks are called again."""
    sched = make()
    witness, freezer = Witness(sched), Freezer(armed=False)
    witness.add("Rt", "motor", order=10)
    sched.add(freezing_node("Rt", freezer, "critical", order=0, watchdog=60.0))
    sched.add_critical_node("critical", timeout_ms=TIMEOUT_MS)
    with running(sched), freezer:
        for episode in (1, 2):
            wait_until(lambda: witness.all_tick())
            freezer.freeze()
            wait_until(lambda: in_safe_state(sched))
            wait_until(lambda episode=episode: len(witness.names("hook")) == episode)
            freezer.thaw()
            await_health(sched, "critical", "healthy")
            wait_until(lambda: cleared(sched))


@pytest.mark.parametrize("way", [*ON_LOOP, "Rt"])
def test_a_tick_that_is_still_frozen_is_counted_once(make, way):
    """clear_safe_state() does not make two expirations of one frozen tick of another node."""
    sched = make(watchdog_ms=TIMEOUT_MS)
    freezer = Freezer(armed=False)
    sched.add(freezing_node(way, freezer, watchdog=2 * TIMEOUT_MS * ms))
    with running(sched), freezer:
        freezer.freeze()
        sched.publish(TRIGGER, 1)
        await_health(sched, "frozen", "warning")
        assert sched.clear_safe_state() == []
        assert sched.get_node_stats("frozen")["health"] == "warning"
        await_health(sched, "frozen", "unhealthy")

        assert expirations(sched) == 1


def test_the_same_while_the_system_is_in_its_safe_state(make):
    """A held node that is frozen, though not critical, stays so when it is let go."""
    sched = make()
    critical, other = Freezer(armed=False), Freezer(armed=False)
    sched.add(freezing_node("Rt", critical, "critical", watchdog=60.0))
    sched.add(freezing_node("Compute", other, "other", watchdog=2 * TIMEOUT_MS * ms))
    sched.add_critical_node("critical", timeout_ms=TIMEOUT_MS)
    with running(sched), critical, other:
        other.freeze()
        critical.freeze()
        wait_until(lambda: in_safe_state(sched))
        await_health(sched, "other", "warning")
        critical.thaw()
        await_health(sched, "critical", "healthy")
        wait_until(lambda: cleared(sched))
        await_health(sched, "other", "unhealthy")

        assert expirations(sched, "other") == 1


# -- coming and going ------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["BestEffort", "AsyncIo", "Rt", "Compute"])
def test_a_node_that_is_added_in_the_safe_state_is_held(make, kind):
    """A node that comes while the safe state is active joins it: hook, no ticks."""
    sched = make()
    witness, freezer = Witness(sched), Freezer()
    sched.add(freezing_node("Rt", freezer, "critical", watchdog=60.0))
    sched.add_critical_node("critical", timeout_ms=TIMEOUT_MS)
    with running(sched), freezer:
        wait_until(lambda: in_safe_state(sched))
        witness.add(kind, "late")
        witness.add(kind, "reporter", hook=False)
        wait_until(lambda: witness.names("hook") == ["late"])
        wait_until(lambda: witness.ticks["reporter"] >= 3)
        wait_until(lambda: sched.get_node_stats("late")["skipped"] >= 3)
        assert witness.ticks["late"] == 0
        assert sched.get_node_stats("late")["state"] == "safe_state"
        freezer.thaw()
        await_health(sched, "critical", "healthy")
        wait_until(lambda: cleared(sched))
        wait_until(lambda: witness.ticks["late"] >= 1)


def test_a_stop_in_the_safe_state_shuts_down_in_order_exactly_once(make, loop):
    """Held nodes are shut down like all others: in reverse order, once, after their hooks."""
    sched = make(loop=loop)
    witness, freezer = Witness(sched), Freezer(armed=False)
    for place, kind in enumerate(("BestEffort", "AsyncIo", "Rt", "Compute")):
        witness.add(kind, kind, order=10 + place)
    witness.add("Event", "free", order=14, hook=False)
    sched.add(
        freezing_node("Rt", freezer, "critical", order=0, shutdown=witness.shutdown, hook=False)
    )
    sched.add_critical_node("critical", timeout_ms=TIMEOUT_MS)
    with running(sched), freezer:
        wait_until(lambda: witness.all_tick())
        freezer.freeze()
        wait_until(lambda: in_safe_state(sched))
        sched.stop("enough")

    in_order = ["free", "Compute", "Rt", "AsyncIo", "BestEffort", "critical"]
    assert witness.names("shutdown") == in_order
    assert sorted(witness.names("hook")) == sorted(in_order[1:-1])
    for name in in_order[1:-1]:
        assert witness.journal.index(("hook", name)) < witness.journal.index(("shutdown", name))
    assert sched.stop_reason == "enough"
    assert {info["state"] for info in sched.get_all_nodes()} == {"stopped"}


@pytest.mark.parametrize("way", ["Rt", "BestEffort", "AsyncIo"])
def test_a_second_run_starts_clean(make, way):
    """What was held, frozen or isolated in one run ticks in the next; counters go on."""
    sched = make()
    witness, freezer = Witness(sched), Freezer(armed=False)
    witness.add("Rt", "motor", order=10)
    sched.add(freezing_node(way, freezer, "critical", order=0))
    sched.add_critical_node("critical", timeout_ms=TIMEOUT_MS)
    with running(sched), freezer:
        wait_until(lambda: witness.all_tick())
        freezer.freeze()
        await_health(sched, "critical", "isolated")
        wait_until(lambda: witness.names("hook") == ["motor"])
    stats = sched.safety_stats()
    held_at, ended = witness.ticks["motor"], freezer.ended
    with running(sched):
        assert not in_safe_state(sched)
        wait_until(lambda: witness.ticks["motor"] > held_at and freezer.ended > ended)
        assert {info["state"] for info in sched.get_all_nodes()} == {"running"}
        assert {info["health"] for info in sched.get_all_nodes()} == {"healthy"}

    assert witness.names("hook") == ["motor"]
    assert stats["watchdog_expirations"] == 1
    assert sched.safety_stats()["watchdog_expirations"] == 1
    assert sched.safety_stats()["safe_state_reason"] is None


def test_a_node_that_was_left_behind_keeps_its_counters(make):
    """watchdog_expirations is cumulative, also over a run whose frozen tick never ended."""
    sched = make(watchdog_ms=TIMEOUT_MS, shutdown_timeout=0.2)
    freezer = Freezer(armed=False)
    sched.add(freezing_node("Compute", freezer))
    with freezer:
        with running(sched):
            wait_until(lambda: freezer.ended >= 3)
            freezer.freeze()
            await_health(sched, "frozen", "isolated")
        before = sched.get_node_stats("frozen")
        assert before["watchdog_expirations"] == 1
        freezer._armed = False
        with running(sched):
            wait_until(lambda: sched.get_node_stats("frozen")["health"] == "healthy")
            after = sched.get_node_stats("frozen")

        assert after["watchdog_expirations"] == 1
        assert after["total_ticks"] >= before["total_ticks"]


def test_the_safe_state_in_an_application(make, loop):
    """arun(): the application's loop goes on, and sees and clears the safe state itself."""
    sched = make(loop=loop)
    witness, freezer = Witness(sched), Freezer(armed=False)
    witness.add("AsyncIo", "uploader", order=10)
    witness.add("Rt", "motor", order=20)
    sched.add(freezing_node("AsyncIo", freezer, "critical", order=0, watchdog=60.0))
    sched.add_critical_node("critical", timeout_ms=TIMEOUT_MS)

    async def application():
        run = asyncio.ensure_future(sched.arun())
        await until(lambda: witness.all_tick())
        freezer.freeze()
        await until(lambda: len(witness.names("hook")) == 2 and freezer.hook_threads)
        assert witness.names("hook") == ["motor", "uploader"]
        with pytest.raises(StateError):
            sched.clear_safe_state()
        freezer.thaw()
        await until(lambda: sched.get_node_stats("critical")["health"] == "healthy")
        await until(lambda: cleared(sched))
        held_at = dict(witness.ticks)
        await until(lambda: all(witness.ticks[name] > held_at[name] for name in held_at))
        sched.stop()
        await run

    with freezer:
        run_async(application(), loop)

    assert witness.names("shutdown") == ["motor", "uploader"]


# -- statistics ------------------------------------------------------------------------------------


def test_safety_stats_tells_of_the_safe_state(make):
    """safety_stats(): the contract's keys, and whether and why the system is in its safe state."""
    sched = make()
    freezer = Freezer()
    sched.add(freezing_node("Rt", freezer, "critical"))
    sched.add_critical_node("critical", timeout_ms=TIMEOUT_MS)
    quiet = {
        "budget_overruns": 0,
        "deadline_misses": 0,
        "watchdog_expirations": 0,
        "skipped": 0,
        "order_violations": 0,
        "health_states": {"critical": "healthy"},
        "safe_state": False,
        "safe_state_reason": None,
    }
    assert quiet.items() <= sched.safety_stats().items()
    with running(sched), freezer:
        wait_until(lambda: in_safe_state(sched))
        stats = sched.safety_stats()
        assert stats["watchdog_expirations"] == 1
        assert stats["health_states"]["critical"] in ("warning", "unhealthy")
        assert stats["safe_state"] is True
        assert "critical" in stats["safe_state_reason"]
        assert "100.00 ms" in stats["safe_state_reason"]


def test_clearing_waits_for_hooks_that_were_just_called(make):
    """A node is not let go while its hook still commands it, if that takes a moment only."""
    sched = make()
    freezer = Freezer(armed=False)
    journal = []

    def hook(node):
        time.sleep(20 * ms)
        journal.append("hook ended")

    def tick(node):
        journal.append("tick")

    sched.add(Node("motor", tick, rate=100, safe_state=hook, order=10))
    sched.add(freezing_node("Rt", freezer, "critical", order=0, hook=False, watchdog=60.0))
    sched.add_critical_node("critical", timeout_ms=TIMEOUT_MS)
    with running(sched), freezer:
        freezer.freeze()
        wait_until(lambda: in_safe_state(sched))
        freezer.thaw()
        await_health(sched, "critical", "healthy")
        wait_until(lambda: cleared(sched))
        ended = journal.index("hook ended")
        wait_until(lambda: "tick" in journal[ended:])
