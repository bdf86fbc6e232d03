"""Where the original breaks its own documentation: each point is kept here.

Each as small as it can be; those about signals and the end of a process are in
test_shutdown.py, where the programs are that they need.
"""

from __future__ import annotations

import asyncio
import math
import time

import pytest

import horus
from horus import Node, Scheduler, ms

from .helpers import (
    KINDS,
    TRIGGER,
    all_have_ticked,
    node_of,
    nothing,
    run_until,
    running,
    wait_until,
)


def recorder(journal, word=None):
    """Return a callback that notes the node's name, or a word."""
    return lambda node: journal.append(node.name if word is None else word)


def test_remove_node_does_not_raise():
    """remove_node works, running or not."""
    sched = Scheduler(tick_rate=100, deterministic=True)
    sched.add(Node("a", nothing, rate=100)).add(Node("b", nothing, rate=100))
    assert sched.remove_node("a") is True
    sched.tick_once()
    assert sched.remove_node("b") is True
    assert sched.get_node_names() == []


def test_tick_once_with_names_honours_the_filter():
    """tick_once(names) does not ignore the filter."""
    journal = []
    sched = Scheduler(tick_rate=100)
    for name in ("a", "b"):
        sched.add(Node(name, recorder(journal), rate=100))
    sched.tick_once(["b"])
    assert journal == ["b"]


def test_tick_for_with_names_honours_the_filter():
    """tick_for(names) does not ignore the filter."""
    journal = []
    sched = Scheduler(tick_rate=100, deterministic=True)
    for name in ("a", "b"):
        sched.add(Node(name, recorder(journal), rate=100))
    sched.tick_for(0.05, ["b"])
    assert journal == ["b"] * 5


def test_tick_once_right_after_add_ticks():
    """tick_once right after add ticks the node, rather than nothing."""
    journal = []
    sched = Scheduler(tick_rate=100)
    sched.add(Node("a", recorder(journal), rate=100))
    sched.tick_once()
    assert journal == ["a"]


def test_shutdown_does_not_run_forwards(make):
    """Shutdown runs in reverse order, not forwards."""
    journal = []
    sched = make(tick_rate=100)
    for order, name in enumerate("abc"):
        sched.add(Node(name, nothing, rate=100, order=order, shutdown=recorder(journal)))
    run_until(sched, lambda: all_have_ticked(sched))
    assert journal == ["c", "b", "a"]


def test_init_is_in_order_not_in_insertion_order(make):
    """Init goes by order, not by insertion."""
    journal = []
    sched = make(tick_rate=100)
    for order in (3, 1, 2):
        sched.add(Node(f"n{order}", nothing, rate=100, order=order, init=recorder(journal)))
    run_until(sched, lambda: all_have_ticked(sched))
    assert journal == ["n1", "n2", "n3"]


def test_a_failing_init_is_not_retried(make):
    """A failing init is not retried."""
    attempts = []

    def fail(node):
        attempts.append(1)
        raise OSError("no device")

    sched = make(tick_rate=100)
    sched.add(Node("a", nothing, rate=100, init=fail)).add(Node("b", nothing, rate=100))
    run_until(sched, lambda: sched.get_node_stats("b")["total_ticks"] >= 5)
    assert attempts == [1]


def test_the_default_order_is_100_not_0():
    """The default order is 100."""
    assert Node("a", nothing).order == 100


def test_dt_is_actual_and_not_zero_after_tick_once():
    """dt() is the actual time between ticks, and not 0 after tick_once."""
    seen = []

    def tick(node):
        seen.append(horus.dt())

    sched = Scheduler(tick_rate=100)
    sched.add(Node("a", tick, rate=100))
    sched.tick_once()
    time.sleep(30 * ms)
    sched.tick_once()
    assert seen[1] >= 30 * ms
    assert horus.dt() > 0.0


def test_now_is_wall_time():
    """now() is wall time."""
    seen = []
    sched = Scheduler(tick_rate=100)
    sched.add(Node("a", lambda: seen.append(horus.now()), rate=100))
    sched.tick_once()
    assert seen[0] == pytest.approx(time.time(), abs=5.0)


def test_deterministic_mode_honours_per_node_rates():
    """Deterministic mode does not ignore per-node rates."""
    journal = []
    sched = Scheduler(tick_rate=100, deterministic=True)
    sched.add(Node("a", recorder(journal), rate=10))
    sched.tick_for(1.0)
    assert len(journal) == 10


@pytest.mark.realtime
def test_best_effort_is_reachable(make, loop):
    """BestEffort is reachable: a node without timing is one, and ticks."""
    journal = []
    sched = make(loop=loop)
    sched.add(Node("a", recorder(journal)))
    assert sched.get_all_nodes()[0]["execution_class"] == "BestEffort"
    run_until(sched, lambda: journal)


@pytest.mark.realtime
def test_a_second_run_runs_something(make, loop):
    """A second run() runs as the first did."""
    sched = make(tick_rate=100, loop=loop)
    sched.add(Node("a", nothing, rate=100))
    for ticks in (3, 6):
        run_until(sched, lambda ticks=ticks: sched.get_node_stats("a")["total_ticks"] >= ticks)


@pytest.mark.realtime
def test_introspection_is_not_empty_while_running(make, loop):
    """Introspection is not empty while running."""
    sched = make(tick_rate=100, loop=loop)
    sched.add(Node("a", nothing, rate=100))
    with running(sched):
        assert sched.get_node_names() == ["a"]
        assert sched.get_node_count() == 1
        assert sched.get_all_nodes()[0]["name"] == "a"


def test_max_deadline_misses_is_not_overwritten():
    """max_deadline_misses is neither overwritten with 100 nor switched on by default."""

    async def late(node):
        await asyncio.sleep(0.05)

    for limit, ticks in ((None, 150), (7, 7), (120, 120)):
        sched = Scheduler(tick_rate=10, deterministic=True, max_deadline_misses=limit)
        sched.add(Node("a", late, rate=10, deadline=40 * ms))
        sched.run(duration=15.0)
        assert sched.get_node_stats("a")["deadline_misses"] == ticks


@pytest.mark.realtime
def test_an_idle_event_node_is_healthy(make, loop):
    """An idle event node is healthy, however long it is silent."""
    sched = make(loop=loop)
    sched.add(Node("estop", nothing, on="emergency.stop")).add(Node("a", nothing, rate=100))
    run_until(sched, lambda: sched.get_node_stats("a")["total_ticks"] >= 10)
    assert sched.safety_stats()["watchdog_expirations"] == 0
    assert sched.get_node_stats("estop")["health"] == "healthy"


def test_stats_have_priority_state_and_health_states():
    """Stats do not lack priority, state, health_states."""
    sched = Scheduler()
    sched.add(Node("a", nothing))
    assert "priority" in sched.get_node_stats("a")
    assert "state" in sched.get_node_stats("a")
    assert "state" in sched.get_all_nodes()[0]
    assert sched.safety_stats()["health_states"] == {"a": "healthy"}


@pytest.mark.realtime
def test_two_event_nodes_on_one_topic_both_fire(make, loop):
    """Two event nodes on one topic: both fire."""
    journal = []
    sched = make(loop=loop)
    sched.add(Node("a", recorder(journal), on="go")).add(Node("b", recorder(journal), on="go"))
    sched.publish("go", 1)
    run_until(sched, lambda: len(journal) >= 2)
    assert sorted(journal) == ["a", "b"]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("phase", ["init", "tick", "shutdown"])
def test_a_type_error_in_a_callback_does_not_run_it_twice(kind, phase):
    """A TypeError in a callback does not run it twice."""
    calls = []

    def fail(node):
        calls.append(1)
        raise TypeError("missing 1 required positional argument: 'node'")

    callbacks = {"tick": nothing, phase: fail}
    sched = Scheduler(tick_rate=100)
    sched.add(node_of(kind, "a", callbacks.pop("tick"), **callbacks))
    sched.publish(TRIGGER, 1)
    sched.tick_once()
    sched.stop()
    assert calls == [1]


def through_a_topic(message):
    """Return a message as it arrives."""
    received = []
    sched = Scheduler(deterministic=True)
    sched.add(Node("a", lambda n: n.send("x", message), order=0, pubs=["x"]))
    sched.add(Node("b", lambda n: received.append(n.recv("x")), order=1, subs=["x"]))
    sched.tick_once()
    return received[0]


def test_messages_over_4_kb_are_not_refused():
    """Messages over 4 kB are not refused."""
    assert through_a_topic({"image": b"x" * 5000}) == {"image": b"x" * 5000}


def test_nan_does_not_become_none():
    """NaN stays NaN."""
    assert math.isnan(through_a_topic({"v": math.nan})["v"])


def test_overflow_does_not_drop_silently(caplog):
    """Overflow is counted and logged, not silent."""
    sched = Scheduler(deterministic=True)

    def flood(node):
        for index in range(2000):
            node.send("x", index)

    sched.add(Node("a", flood, order=0, pubs=["x"]))
    sched.add(Node("b", nothing, order=1, subs=["x"]))
    sched.tick_once()
    assert sched.get_node_stats("b")["dropped"] == 2000 - 1024
    assert any("'x'" in r.getMessage() for r in caplog.records)


@pytest.mark.realtime
def test_stop_from_a_callback_does_not_deadlock(make, loop, kind):
    """Stop from a callback of any class ends the run, without a deadlock."""
    sched = make(tick_rate=100, loop=loop)
    sched.add(node_of(kind, "a", lambda node: sched.stop()))
    sched.publish(TRIGGER, 1)
    sched.run()
    assert sched.status() == "stopped"


@pytest.mark.realtime
def test_a_safe_pose_can_be_commanded_on_the_way_out(make, loop):
    """On stop, a node can still command a safe pose before the context dies."""
    poses = []
    sched = make(loop=loop)
    sched.add(Node("driver", lambda n: poses.append(n.recv("pose")), on="pose", order=0))
    sched.add(
        Node(
            "arm",
            nothing,
            rate=100,
            order=1,
            pubs=["pose"],
            shutdown=lambda n: (n.send("pose", "parked"), poses.append("sent")),
        )
    )
    with running(sched):
        wait_until(lambda: sched.get_node_stats("arm")["total_ticks"] > 0)
    assert poses == ["sent"]
