"""Runtime mutation: changing the scheduler while it is running."""

from __future__ import annotations

import asyncio
import threading
import time

import pytest

import horus
from horus import ConfigError, Node, UnknownNodeError, ms

from .helpers import (
    KINDS,
    PATIENCE_S,
    TRIGGER,
    all_have_ticked,
    node_of,
    nothing,
    run_async,
    run_until,
    running,
    until,
    wait_until,
)

RATED = [kind for kind in KINDS if kind != "Event"]


# -- set_node_rate ---------------------------------------------------------------------------


@pytest.mark.parametrize("kind", RATED)
def test_set_node_rate_changes_the_rate_between_timed_runs(make, kind):
    """set_node_rate(): 100 Hz to 20 Hz to 500 Hz, exactly, in virtual time."""
    ticks = []
    sched = make(tick_rate=1000, deterministic=True)
    sched.add(node_of(kind, "sensor", lambda node: ticks.append(horus.now()), rate=100))
    counts = []
    for rate in (100, 20, 500):
        sched.set_node_rate("sensor", rate)
        ticks.clear()
        sched.tick_for(1.0)
        counts.append(len(ticks))
        assert ticks == pytest.approx([ticks[0] + k / rate for k in range(len(ticks))], abs=1e-6)
        assert sched.get_node_stats("sensor")["rate"] == rate

    assert counts == [100, 20, 500]


@pytest.mark.parametrize("kind", RATED)
def test_set_node_rate_inside_a_tick(make, kind):
    """A node changes its own rate inside a tick; dt() is the new 1/rate from then on."""
    seen = []
    sched = make(tick_rate=1000, deterministic=True)

    def tick(node):
        seen.append((round(horus.now(), 6), horus.dt()))
        if len(seen) == 3:
            sched.set_node_rate("sensor", 500)

    sched.add(node_of(kind, "sensor", tick, rate=100))
    sched.set_node_rate("sensor", 100)

    sched.tick_for(0.03)

    assert [when for when, _ in seen] == pytest.approx(
        [0.0, 0.01, 0.02, 0.022, 0.024, 0.026, 0.028]
    )
    assert [dt for _, dt in seen[:3]] == [0.01] * 3
    assert {dt for _, dt in seen[4:]} == {0.002}


@pytest.mark.realtime
@pytest.mark.parametrize("kind", RATED)
def test_set_node_rate_while_running_from_another_thread(make, loop, kind):
    """The rate changes dynamically while the scheduler is running, from any thread."""
    ticks = []
    sched = make(tick_rate=1000, loop=loop)
    sched.add(node_of(kind, "sensor", lambda node: ticks.append(time.monotonic()), rate=0.1))
    sched.set_node_rate("sensor", 0.1)
    with running(sched):
        wait_until(lambda: len(ticks) >= 1)
        sched.set_node_rate("sensor", 200)
        # At 0.1 Hz this would take minutes.
        wait_until(lambda: len(ticks) >= 20)
        sched.set_node_rate("sensor", 0.1)
        time.sleep(0.05)
        settled = len(ticks)
        time.sleep(0.1)
        assert len(ticks) <= settled + 1


def test_set_node_rate_of_an_unknown_node_is_an_error(make):
    """Unknown names are errors that name what there is."""
    sched = make()
    sched.add(Node("sensor", nothing))
    with pytest.raises(UnknownNodeError, match=r"lidar.*sensor"):
        sched.set_node_rate("lidar", 10)


def test_set_node_rate_of_an_event_node_is_refused(make):
    """An event node has no rate to set."""
    sched = make()
    sched.add(Node("estop", nothing, on="emergency.stop"))
    with pytest.raises(ConfigError, match="messages"):
        sched.set_node_rate("estop", 10)


def test_set_node_rate_before_the_run_holds_in_it(make):
    """The rate may be set before anything runs."""
    ticks = []
    sched = make(tick_rate=100, deterministic=True)
    sched.add(Node("sensor", lambda: ticks.append(1), rate=100))
    sched.set_node_rate("sensor", 20)

    sched.run(duration=1.0)

    assert len(ticks) == 20


# -- set_tick_budget -------------------------------------------------------------------------


def test_set_tick_budget_is_in_microseconds(make):
    """set_tick_budget(): the argument is in microseconds, unlike the Node constructor."""
    overruns = []
    sched = make(tick_rate=10, deterministic=True)

    async def tick(node):
        await asyncio.sleep(600e-6)

    sched.add(Node("motor", tick, rate=10, budget=1 * ms))
    for budget_us in (500, 700, 599.5, 600.5):
        before = sched.get_node_stats("motor")["budget_overruns"]
        sched.set_tick_budget("motor", budget_us)
        sched.tick_for(1.0)
        overruns.append(sched.get_node_stats("motor")["budget_overruns"] - before)

    assert overruns == [10, 0, 10, 0]


def test_set_tick_budget_shows_in_budget_remaining(make):
    """The new budget is what budget_remaining() counts down from."""
    seen = []
    sched = make(tick_rate=100, deterministic=True)
    sched.add(Node("motor", lambda: seen.append(horus.budget_remaining()), rate=100))
    sched.tick_once()
    sched.set_tick_budget("motor", 500)
    sched.tick_once()

    assert seen == pytest.approx([8 * ms, 0.5 * ms])


@pytest.mark.realtime
def test_set_tick_budget_while_running(make, loop, kind):
    """A node's tick budget changes dynamically while the scheduler runs."""
    sched = make(tick_rate=100, loop=loop)

    def tick(node):
        time.sleep(2 * ms)

    sched.add(node_of(kind, "node", tick, rate=20))
    sched.set_tick_budget("node", 15_000_000)
    with running(sched):
        sched.publish(TRIGGER, 1)
        wait_until(lambda: all_have_ticked(sched))
        assert sched.get_node_stats("node")["budget_overruns"] == 0
        sched.set_tick_budget("node", 1000)
        sched.publish(TRIGGER, 2)
        wait_until(lambda: sched.get_node_stats("node")["budget_overruns"] > 0)


def test_set_tick_budget_of_an_unknown_node_is_an_error(make):
    """Unknown names are errors."""
    with pytest.raises(UnknownNodeError, match="motor"):
        make().set_tick_budget("motor", 500)


# -- remove_node -----------------------------------------------------------------------------


def test_remove_node_returns_true_if_found(make):
    """remove_node() returns True if found, False if there was no such node."""
    sched = make()
    sched.add(Node("cloud_logger", nothing))
    assert sched.remove_node("cloud_logger") is True
    assert sched.remove_node("cloud_logger") is False
    assert not sched.has_node("cloud_logger")
    assert sched.get_node_count() == 0


@pytest.mark.realtime
def test_the_removed_nodes_shutdown_is_called_before_it_is_detached(make, loop, kind):
    """The removed node's shutdown() has run when remove_node() returns; it ticks no more."""
    journal = []
    sched = make(tick_rate=100, loop=loop)
    sched.add(
        node_of(
            kind,
            "node",
            lambda node: journal.append("tick"),
            shutdown=lambda node: journal.append("shutdown"),
        )
    )
    sched.add(Node("other", nothing, rate=100))
    sched.publish(TRIGGER, 1)
    with running(sched):
        wait_until(lambda: all_have_ticked(sched))
        assert sched.remove_node("node") is True
        after = list(journal)
        sched.publish(TRIGGER, 2)
        others = sched.get_node_stats("other")["total_ticks"]
        wait_until(lambda: sched.get_node_stats("other")["total_ticks"] >= others + 5)

    assert after[-1] == "shutdown"
    assert journal == after
    assert journal.count("shutdown") == 1


def test_remove_node_between_steps(make, deterministic, kind):
    """A node removed between steps is shut down once and does not tick in the next."""
    journal = []
    sched = make(tick_rate=100, deterministic=deterministic)
    sched.add(
        node_of(
            kind,
            "node",
            lambda node: journal.append("tick"),
            shutdown=lambda node: journal.append("shutdown"),
        )
    )
    sched.add(Node("other", nothing, rate=100))
    sched.publish(TRIGGER, 1)
    sched.tick_once()
    assert sched.remove_node("node") is True
    assert journal == ["tick", "shutdown"]

    sched.publish(TRIGGER, 2)
    sched.tick_once()
    sched.stop()

    assert journal == ["tick", "shutdown"]


@pytest.mark.realtime
def test_a_node_may_remove_itself(make, loop, kind):
    """remove_node() from inside the node's own tick: shut down as soon as it has ended."""
    journal = []
    sched = make(tick_rate=100, loop=loop)

    def tick(node):
        journal.append(sched.remove_node("node"))

    sched.add(node_of(kind, "node", tick, shutdown=lambda node: journal.append("shutdown")))
    sched.publish(TRIGGER, 1)
    sched.publish(TRIGGER, 2)

    run_until(sched, lambda: "shutdown" in journal)

    assert journal == [True, "shutdown"]
    assert not sched.has_node("node")


@pytest.mark.realtime
@pytest.mark.parametrize("victim", KINDS)
@pytest.mark.parametrize("remover", ["BestEffort", "AsyncIo", "Rt", "Compute"])
def test_a_tick_may_remove_any_other_node(make, remover, victim):
    """remove_node() from inside a tick of any class removes a node of any class."""
    journal = []
    sched = make(tick_rate=100)

    def remove(node):
        if sched.has_node("victim"):
            journal.append(sched.remove_node("victim"))

    sched.add(node_of(remover, "remover", remove, order=0))
    sched.add(node_of(victim, "victim", order=1, shutdown=lambda node: journal.append("shutdown")))

    run_until(sched, lambda: "shutdown" in journal)

    assert sorted(map(str, journal)) == ["True", "shutdown"]


def test_a_removed_node_can_be_added_again(make, deterministic):
    """A node that was removed can be added anew, here or elsewhere."""
    journal = []
    node = Node(
        "node",
        lambda: journal.append("tick"),
        rate=100,
        init=lambda: journal.append("init"),
        shutdown=lambda: journal.append("shutdown"),
    )
    for _ in range(2):
        sched = make(tick_rate=100, deterministic=deterministic)
        sched.add(node)
        sched.tick_once()
        sched.remove_node("node")

    assert journal == ["init", "tick", "shutdown"] * 2


def test_removing_a_node_frees_its_name(make):
    """After remove_node() another node may take the name."""
    sched = make()
    sched.add(Node("motor", nothing, order=1))
    sched.remove_node("motor")
    sched.add(Node("motor", nothing, order=2))
    assert sched.get_node_info("motor") == 2


# -- add ---------------------------------------------------------------------------------


@pytest.mark.realtime
def test_nodes_can_be_added_while_running_from_another_thread(make, loop, kind):
    """Nodes can be added while running: initialised, ticked and shut down like the others."""
    journal = []
    sched = make(tick_rate=100, loop=loop)
    sched.add(Node("first", nothing))
    with running(sched):
        sched.add(
            node_of(
                kind,
                "late",
                lambda node: journal.append("tick"),
                init=lambda node: journal.append("init"),
                shutdown=lambda node: journal.append("shutdown"),
            )
        )
        sched.publish(TRIGGER, 1)
        wait_until(lambda: "tick" in journal)

    assert journal[0] == "init"
    assert journal[-1] == "shutdown"
    assert set(journal[1:-1]) == {"tick"}


@pytest.mark.realtime
@pytest.mark.parametrize("adder", ["BestEffort", "AsyncIo", "Rt", "Compute"])
def test_a_tick_may_add_a_node(make, adder, kind):
    """Nodes can be added from inside a tick of any class."""
    ticks = []
    sched = make(tick_rate=100)

    def add(node):
        if not sched.has_node("late"):
            sched.add(node_of(kind, "late", lambda node: ticks.append(1)))
            sched.publish(TRIGGER, 1)

    sched.add(node_of(adder, "adder", add))

    run_until(sched, lambda: ticks)

    assert sched.get_node_names() == ["adder", "late"]


def test_a_tick_may_add_and_remove_nodes_in_virtual_time(make, kind):
    """Adding and removing inside a tick works in deterministic mode and replays."""
    journal = []
    sched = make(tick_rate=100, deterministic=True)

    def manage(node):
        if horus.tick() == 2:
            sched.add(
                node_of(
                    kind,
                    "late",
                    lambda node: journal.append(horus.tick()),
                    init=lambda node: journal.append("init"),
                    shutdown=lambda node: journal.append("shutdown"),
                )
            )
            if kind == "BestEffort":
                sched.set_node_rate("late", 100)
        if horus.tick() == 6:
            sched.remove_node("late")
        if horus.tick() in (3, 4):
            node.send(TRIGGER, 1)

    sched.add(Node("manager", manage, rate=100, order=0, pubs=[TRIGGER]))

    sched.tick_for(0.1)

    assert journal[0] == "init"
    assert journal[-1] == "shutdown"
    assert set(journal[1:-1]) >= {3, 4}
    assert max(journal[1:-1]) < 6


@pytest.mark.realtime
def test_mutation_storm_from_many_threads(make, loop):
    """Nodes may be added, removed and re-rated from many threads at once."""
    errors = []
    sched = make(tick_rate=100, loop=loop)
    sched.add(Node("anchor", nothing, rate=100))

    def storm(prefix):
        try:
            for index in range(6):
                name = f"{prefix}{index}"
                sched.add(node_of(KINDS[index % len(KINDS)], name))
                if KINDS[index % len(KINDS)] != "Event":
                    sched.set_node_rate(name, 50)
                sched.set_tick_budget(name, 5000)
                sched.get_all_nodes()
                assert sched.remove_node(name)
        except BaseException as exc:
            errors.append(exc)

    with running(sched):
        threads = [threading.Thread(target=storm, args=(prefix,)) for prefix in "abc"]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(PATIENCE_S)

    assert errors == []
    assert sched.get_node_names() == ["anchor"]


@pytest.mark.realtime
def test_an_application_mutates_beside_arun(make, loop):
    """Beside arun() the application adds and removes nodes from its own coroutines."""
    ticks = []
    sched = make(tick_rate=100)
    sched.add(Node("first", nothing))

    async def main():
        async with sched:
            sched.add(Node("second", lambda: ticks.append(1), rate=100))
            await until(lambda: len(ticks) >= 3)
            assert sched.remove_node("second") is True
            count = len(ticks)
            await asyncio.sleep(50 * ms)
            assert len(ticks) == count

    run_async(main(), loop)


# -- add_critical_node -------------------------------------------------------------------------


def test_add_critical_node_knows_its_node_and_checks_its_timeout(make):
    """add_critical_node() refuses an unknown name, and a timeout that is none."""
    sched = make()
    sched.add(Node("motor_controller", nothing))
    with pytest.raises(UnknownNodeError, match="motor_controler"):
        sched.add_critical_node("motor_controler", timeout_ms=500)
    with pytest.raises(ConfigError, match="timeout_ms"):
        sched.add_critical_node("motor_controller", timeout_ms=0)
    sched.add_critical_node("motor_controller", timeout_ms=500)
