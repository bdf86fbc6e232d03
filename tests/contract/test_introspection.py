"""Introspection: what the scheduler tells about itself and its nodes at runtime."""

from __future__ import annotations

import asyncio
import threading

import pytest

import horus
from horus import Node, Scheduler, UnknownNodeError, ms

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


@pytest.fixture
def robot(make, deterministic):
    """A scheduler with the three nodes of the contract's example."""
    sched = make(tick_rate=100, name="robot", deterministic=deterministic)
    sched.add(Node("motor", nothing, rate=100, order=20))
    sched.add(Node("sensor", nothing, rate=100, order=10))
    sched.add(Node("planner", nothing, rate=10, order=50, compute=True))
    return sched


def test_status_is_idle_running_or_stopped(make, deterministic):
    """status(): "idle", "running" or "stopped"."""
    seen = []
    sched = make(tick_rate=100, deterministic=deterministic)
    sched.add(Node("node", lambda: seen.append(sched.status()), rate=100))
    assert sched.status() == "idle"

    sched.tick_once()
    assert sched.status() == "idle"
    sched.run(duration=0.05)

    assert set(seen) == {"running"}
    assert sched.status() == "stopped"


def test_current_tick_is_the_current_tick_number(make):
    """current_tick(): the current tick number, the one that horus.tick() shows."""
    seen = []
    sched = make(tick_rate=100, deterministic=True)
    sched.add(Node("node", lambda: seen.append((sched.current_tick(), horus.tick())), rate=50))
    assert sched.current_tick() == 0

    for step in range(1, 5):
        sched.tick_once()
        assert sched.current_tick() == step

    assert seen == [(0, 0), (2, 2)]


def test_is_running_is_true_in_the_tick_loop(make, deterministic):
    """is_running(): True if in the tick loop."""
    seen = []
    sched = make(tick_rate=100, deterministic=deterministic)
    sched.add(Node("node", lambda: seen.append(sched.is_running()), rate=100))
    assert sched.is_running() is False

    sched.run(duration=0.05)

    assert set(seen) == {True}
    assert sched.is_running() is False


def test_scheduler_name(make):
    """scheduler_name(): the name given, or a default."""
    assert make(name="warehouse").scheduler_name() == "warehouse"
    assert isinstance(make().scheduler_name(), str)
    assert make().scheduler_name()


def test_node_introspection(robot):
    """get_node_count(), get_node_names() and has_node() tell which nodes are registered."""
    assert robot.get_node_count() == 3
    assert robot.get_node_names() == ["sensor", "motor", "planner"]
    assert robot.has_node("motor") is True
    assert robot.has_node("lidar") is False


def test_get_all_nodes_has_name_order_and_state(robot):
    """get_all_nodes(): a dict per node with at least name, order and state."""
    infos = robot.get_all_nodes()
    assert [(info["name"], info["order"]) for info in infos] == [
        ("sensor", 10),
        ("motor", 20),
        ("planner", 50),
    ]
    assert {info["state"] for info in infos} == {"uninitialized"}

    robot.tick_once()
    assert {info["state"] for info in robot.get_all_nodes()} == {"running"}
    robot.stop()
    assert {info["state"] for info in robot.get_all_nodes()} == {"stopped"}


def test_get_node_info_returns_the_execution_order(robot):
    """get_node_info(): returns execution order (int)."""
    assert robot.get_node_info("motor") == 20
    assert type(robot.get_node_info("motor")) is int
    with pytest.raises(UnknownNodeError, match=r"lidar.*sensor, motor, planner"):
        robot.get_node_info("lidar")


def test_order_is_100_when_not_given(make):
    """The default order is 100, not 0, also as introspection shows it."""
    sched = make()
    sched.add(Node("node", nothing))
    assert sched.get_node_info("node") == 100


@pytest.mark.realtime
def test_introspection_is_not_empty_while_running(make, loop):
    """Query the scheduler at runtime, from another thread: everything answers."""
    sched = make(tick_rate=100, name="robot", loop=loop)
    for order, kind in enumerate(KINDS):
        sched.add(node_of(kind, kind, order=order))
    sched.publish(TRIGGER, 1)

    with running(sched):
        wait_until(lambda: all_have_ticked(sched))
        assert sched.status() == "running"
        assert sched.is_running() is True
        assert sched.get_node_names() == list(KINDS)
        assert sched.get_node_count() == len(KINDS)
        assert sched.has_node("Rt")
        assert sched.get_node_info("AsyncIo") == 2
        before = sched.current_tick()
        wait_until(lambda: sched.current_tick() > before)
        for info in sched.get_all_nodes():
            assert info["state"] == "running"
            assert info["total_ticks"] > 0
        assert set(sched.safety_stats()["health_states"]) == set(KINDS)
        assert [row.name for row in sched.timing_report().rows] == list(KINDS)


@pytest.mark.realtime
def test_a_node_may_query_the_scheduler_inside_its_tick(make, loop, kind):
    """Every query may be made from inside a tick of any class."""
    seen = []
    sched = make(tick_rate=100, loop=loop)

    def tick(node):
        seen.append(
            (
                sched.status(),
                sched.get_node_names(),
                sched.get_node_stats("node")["name"],
                str(sched.timing_report()),
                sched.safety_stats()["deadline_misses"],
            )
        )

    sched.add(node_of(kind, "node", tick))
    sched.publish(TRIGGER, 1)

    run_until(sched, lambda: seen)

    assert seen[0][:3] == ("running", ["node"], "node")


# -- get_node_stats --------------------------------------------------------------------------


def test_get_node_stats_has_the_keys_of_the_contract(make):
    """get_node_stats(): name, priority, total_ticks and errors_count."""
    sched = make(tick_rate=100, deterministic=True)
    sched.add(Node("motor", nothing, rate=100))
    sched.tick_for(0.05)

    stats = sched.get_node_stats("motor")

    assert stats["name"] == "motor"
    assert stats["priority"] is None
    assert stats["total_ticks"] == 5
    assert stats["errors_count"] == 0
    assert stats["state"] == "running"
    with pytest.raises(UnknownNodeError, match="lidar"):
        sched.get_node_stats("lidar")


def test_stats_survive_the_end_of_the_run(make):
    """Counters are still there after run(), and go on in the next one."""
    sched = make(tick_rate=100, deterministic=True)
    sched.add(Node("motor", nothing, rate=100))
    sched.run(duration=0.05)
    assert sched.get_node_stats("motor")["total_ticks"] == 5
    sched.run(duration=0.05)
    assert sched.get_node_stats("motor")["total_ticks"] == 10


def test_what_introspection_returns_is_a_copy(make):
    """Changing a returned dict or list changes nothing in the scheduler."""
    sched = make()
    sched.add(Node("motor", nothing))
    sched.get_node_stats("motor")["total_ticks"] = 99
    sched.get_node_names().clear()
    sched.safety_stats()["health_states"].clear()
    assert sched.get_node_stats("motor")["total_ticks"] == 0
    assert sched.get_node_names() == ["motor"]
    assert "motor" in sched.safety_stats()["health_states"]


# -- the timing report -------------------------------------------------------------------------


def test_the_timing_report_has_a_row_per_node(make):
    """timing_report(): per node class, rate asked and achieved, times, overruns, misses."""
    sched = make(tick_rate=100, deterministic=True)

    async def tick(node):
        await asyncio.sleep(9 * ms)

    sched.add(Node("uploader", tick, rate=100, order=1))
    sched.add(Node("motor", nothing, rate=50, order=0))
    sched.add(Node("estop", nothing, on="stop", order=2))
    sched.run(duration=2.0)

    motor, uploader, estop = sched.timing_report().rows

    assert (motor.name, motor.execution_class, motor.rate_hz) == ("motor", "Rt", 50)
    assert motor.achieved_hz == pytest.approx(50, rel=1e-6)
    assert motor.ticks == 100
    assert uploader.execution_avg_s == pytest.approx(9 * ms, rel=1e-3)
    assert uploader.execution_max_s == pytest.approx(9 * ms, rel=1e-3)
    assert uploader.execution_p99_s == pytest.approx(9 * ms, rel=0.1)
    assert uploader.budget_overruns == 200
    assert uploader.deadline_misses == 0
    assert (estop.rate_hz, estop.ticks) == (None, 0)


def test_the_timing_report_prints_as_a_table(make):
    """str() of the report is a table with a line per node."""
    sched = make(tick_rate=100, deterministic=True)
    for name in ("sensor", "motor"):
        sched.add(Node(name, nothing, rate=100))
    sched.run(duration=0.5)

    lines = str(sched.timing_report()).splitlines()

    assert any("sensor" in line and "Rt" in line and "100" in line for line in lines)
    assert any("motor" in line for line in lines)
    assert len({len(line) > 20 for line in lines}) == 1


@pytest.mark.realtime
def test_start_latency_and_rate_are_measured_in_real_time(make, loop):
    """The report tells rate achieved and start latency of a real run."""
    sched = make(tick_rate=100, loop=loop)
    sched.add(Node("node", nothing, rate=50))

    run_until(sched, lambda: sched.get_node_stats("node")["total_ticks"] >= 10)

    (row,) = sched.timing_report().rows
    assert 0.0 <= row.start_latency_avg_s <= row.start_latency_max_s
    assert row.start_latency_p99_s <= row.start_latency_max_s
    assert 10 < row.achieved_hz < 60


def test_queries_from_other_threads_need_no_run():
    """A scheduler that does not run answers from any thread."""
    sched = Scheduler()
    sched.add(Node("node", nothing))
    seen = []
    thread = threading.Thread(target=lambda: seen.append(sched.get_node_names()))
    thread.start()
    thread.join()
    assert seen == [["node"]]
