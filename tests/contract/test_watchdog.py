"""The watchdog in real time: a tick that does not end is noticed while it does not end."""

from __future__ import annotations

import time

import pytest

from horus import Node, ms

from .freezing import (
    AWAITING,
    MARKER,
    ON_LOOP,
    WAYS,
    Freezer,
    await_health,
    expirations,
    freezing_node,
    reports,
)
from .helpers import TRIGGER, nothing, running, wait_until

pytestmark = pytest.mark.realtime

TIMEOUT_MS = 100


@pytest.fixture(params=WAYS)
def way(request: pytest.FixtureRequest) -> str:
    """Name each way in which a tick can freeze."""
    return request.param


# -- the rows of the table -------------------------------------------------------------------


def test_a_frozen_tick_is_warned_of_then_unhealthy_then_isolated(make, way, caplog):
    """1x: log warning. 2x: log error. 3x: isolated. Each with the stack of the frozen code."""
    sched = make(watchdog_ms=TIMEOUT_MS, loop="uvloop")
    freezer = Freezer()
    sched.add(freezing_node(way, freezer))
    sched.publish(TRIGGER, 1)
    with running(sched), freezer:
        wait_until(lambda: len(reports(caplog)) >= 3)

        assert [report[:2] for report in reports(caplog)] == [
            ("WARNING", "warning"),
            ("ERROR", "unhealthy"),
            ("ERROR", "isolated"),
        ]
        for _, _, message in reports(caplog):
            assert MARKER in message
            assert "100.0 ms" in message or "100.00 ms" in message


def test_an_isolated_node_ticks_no_more_and_its_hook_is_called_once(make, way):
    """3x: remove from tick loop, call enter_safe_state() - not on the thread that is frozen."""
    sched = make(watchdog_ms=TIMEOUT_MS, loop="asyncio")
    freezer = Freezer()
    sched.add(freezing_node(way, freezer))
    sched.publish(TRIGGER, 1)
    with running(sched), freezer:
        await_health(sched, "frozen", "isolated")
        wait_until(lambda: freezer.hook_threads)
        if way not in AWAITING:
            assert freezer.hook_threads[0] != freezer.frozen_thread
        before = sched.get_node_stats("frozen")
        assert before["state"] == "safe_state"
        assert before["health"] == "isolated"
        freezer.thaw()
        sched.publish(TRIGGER, 2)
        sched.publish(TRIGGER, 3)
        # Releases go by, counted, and nothing begins.
        wait_until(lambda: sched.get_node_stats("frozen")["skipped"] >= before["skipped"] + 2)

        assert freezer.ticks == 1
        assert len(freezer.hook_threads) == 1
        after = sched.get_node_stats("frozen")
        assert after["state"] == "safe_state"
        assert after["health"] == "isolated"
        assert after["watchdog_expirations"] == 1


@pytest.mark.parametrize("way", ["BestEffort", "AsyncIo", "Rt"])
def test_a_node_without_a_hook_is_isolated_too(make, way):
    """Isolation does not depend on there being a safe-state hook."""
    sched = make(watchdog_ms=TIMEOUT_MS)
    freezer = Freezer()
    sched.add(freezing_node(way, freezer, hook=False))
    sched.publish(TRIGGER, 1)
    with running(sched), freezer:
        await_health(sched, "frozen", "isolated")
        freezer.thaw()
        sched.publish(TRIGGER, 2)
        skipped = sched.get_node_stats("frozen")["skipped"]
        wait_until(lambda: sched.get_node_stats("frozen")["skipped"] > skipped)

        assert freezer.ticks == 1


def test_a_tick_that_returns_in_time_restores_health(make, way, caplog):
    """A tick that returns while not isolated restores Healthy, and the node ticks on."""
    caplog.set_level("INFO", "horus")
    sched = make(watchdog_ms=2 * TIMEOUT_MS)
    freezer = Freezer()
    sched.add(freezing_node(way, freezer))
    sched.publish(TRIGGER, 1)
    with running(sched), freezer:
        await_health(sched, "frozen", "warning")
        assert sched.get_node_stats("frozen")["state"] == "running"
        freezer.thaw()
        await_health(sched, "frozen", "healthy")
        sched.publish(TRIGGER, 2)
        wait_until(lambda: freezer.ended >= 2)
        wait_until(lambda: ("INFO", "healthy") in [report[:2] for report in reports(caplog)])

        assert freezer.hook_threads == []
        assert expirations(sched) == 1


@pytest.mark.parametrize("way", ["BestEffort", "async Event", "Rt", "Compute"])
def test_expirations_are_cumulative_one_for_each_frozen_tick(make, way):
    """watchdog_expirations counts frozen ticks: one each, whatever stage they reached."""
    sched = make(watchdog_ms=TIMEOUT_MS)
    freezer = Freezer(armed=False)
    sched.add(freezing_node(way, freezer))
    with running(sched), freezer:
        freezer.freeze()
        sched.publish(TRIGGER, 1)
        await_health(sched, "frozen", "warning")
        freezer.thaw()
        await_health(sched, "frozen", "healthy")
        wait_until(lambda: freezer.ended >= 1)
        assert expirations(sched) == 1
        freezer.freeze()
        sched.publish(TRIGGER, 2)
        await_health(sched, "frozen", "isolated")

        assert expirations(sched) == 2
        assert sched.safety_stats()["watchdog_expirations"] == 2


@pytest.mark.parametrize("way", ["BestEffort", "urgent Event", "AsyncIo", "Rt"])
def test_the_reaction_comes_within_the_timeout_and_little_more(make, way):
    """A watchdog that was given 200 ms does not take a second, nor bark before its time."""
    sched = make(watchdog_ms=200)
    freezer = Freezer(armed=False)
    sched.add(freezing_node(way, freezer))
    with running(sched), freezer:
        freezer.freeze()
        sched.publish(TRIGGER, 1)
        wait_until(lambda: freezer.frozen_thread is not None)
        began = time.monotonic()
        await_health(sched, "frozen", "warning")

        # Release and start may have been a little earlier than we could look.
        assert 0.1 < time.monotonic() - began < 0.5


# -- whose timeout -----------------------------------------------------------------------------


@pytest.mark.parametrize("way", ["BestEffort", "AsyncIo", "Compute"])
def test_a_nodes_own_watchdog_overrides_the_global_one(make, way):
    """Per-node watchdog: stricter for one, more patient for another."""
    sched = make(watchdog_ms=TIMEOUT_MS)
    patient, strict = Freezer(), Freezer()
    sched.add(freezing_node(way, patient, "patient", watchdog=60.0))
    sched.add(freezing_node("Rt", strict, "strict", watchdog=TIMEOUT_MS / 2 * ms))
    with running(sched), patient, strict:
        wait_until(lambda: patient.ticks == 1)
        await_health(sched, "strict", "isolated")
        time.sleep(3 * TIMEOUT_MS * ms)

        assert sched.get_node_stats("patient")["health"] == "healthy"
        assert expirations(sched, "patient") == 0


def test_a_nodes_own_watchdog_works_without_a_global_one(make):
    """watchdog_ms=0 disables the global watchdog, not that of a node."""
    sched = make()
    watched, unwatched = Freezer(), Freezer()
    sched.add(freezing_node("Rt", watched, "watched", watchdog=TIMEOUT_MS * ms))
    sched.add(freezing_node("Rt", unwatched, "unwatched"))
    with running(sched), watched, unwatched:
        await_health(sched, "watched", "isolated")

        assert unwatched.ticks == 1
        assert sched.get_node_stats("unwatched")["health"] == "healthy"


@pytest.mark.parametrize("way", ["BestEffort", "Rt"])
def test_without_a_timeout_nothing_is_watched(make, way):
    """watchdog_ms=0, the default, disables the watchdog."""
    sched = make()
    freezer = Freezer()
    sched.add(freezing_node(way, freezer))
    sched.publish(TRIGGER, 1)
    with running(sched), freezer:
        wait_until(lambda: freezer.ticks == 1)
        time.sleep(0.2)

        assert sched.safety_stats()["watchdog_expirations"] == 0
        assert sched.safety_stats()["health_states"] == {"frozen": "healthy"}


@pytest.mark.parametrize("way", ["Event", "AsyncIo", "Rt", "Compute"])
def test_a_node_that_is_added_while_running_is_watched(make, way):
    """The watchdog looks after nodes that come later, with a timeout of their own, too."""
    sched = make()
    freezer = Freezer()
    sched.add(Node("first", nothing, rate=100))
    with running(sched), freezer:
        sched.add(freezing_node(way, freezer, watchdog=TIMEOUT_MS * ms))
        sched.publish(TRIGGER, 1)
        await_health(sched, "frozen", "isolated")
        wait_until(lambda: freezer.hook_threads)


# -- supervision itself ------------------------------------------------------------------------


def test_supervision_goes_on_while_the_loop_is_blocked(make):
    """A BestEffort tick that blocks the loop keeps neither warnings nor hooks of others away."""
    sched = make(watchdog_ms=TIMEOUT_MS)
    blocker, frozen = Freezer(), Freezer()
    sched.add(freezing_node("BestEffort", blocker, "blocker"))
    sched.add(freezing_node("Rt", frozen))
    with running(sched), blocker, frozen:
        await_health(sched, "frozen", "isolated")
        await_health(sched, "blocker", "isolated")
        wait_until(lambda: blocker.hook_threads and frozen.hook_threads)

        assert {blocker.frozen_thread, frozen.frozen_thread}.isdisjoint(
            {*blocker.hook_threads, *frozen.hook_threads}
        )


@pytest.mark.parametrize("way", ON_LOOP)
def test_rt_nodes_tick_on_while_the_loop_is_blocked(make, way):
    """The planner's frozen tick never blocks the motor controller, nor an urgent event node."""
    sched = make(watchdog_ms=TIMEOUT_MS)
    freezer = Freezer()
    motor, halts = [], []
    sched.add(freezing_node(way, freezer))
    sched.add(Node("motor", lambda: motor.append(1), rate=100))
    sched.add(Node("estop", lambda: halts.append(1), on="estop", deadline=30.0))
    sched.publish(TRIGGER, 1)
    with running(sched), freezer:
        await_health(sched, "frozen", "isolated")
        before = len(motor)
        sched.publish("estop", 1)
        wait_until(lambda: len(motor) >= before + 10 and halts)

        assert sched.get_node_stats("motor")["health"] == "healthy"
        assert expirations(sched, "motor") == expirations(sched, "estop") == 0
