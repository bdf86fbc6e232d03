"""Deterministic mode: reproducible simulation and testing."""

from __future__ import annotations

import asyncio
import threading
import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import horus
from horus import Node, Scheduler, ms

from .helpers import KINDS, TRIGGER, node_of, nothing, run_program


def build_robot(journal: list, **options) -> Scheduler:
    """Return a deterministic scheduler with nodes of every class that feed each other."""
    sched = Scheduler(tick_rate=200, deterministic=True, **options)

    def note(node, *values):
        journal.append((node.name, horus.tick(), round(horus.now(), 9), horus.dt(), *values))

    def sense(node):
        value = horus.rng_float()
        node.send("scan", {"range": value})
        note(node, value)

    def plan(node):
        scans = node.recv_all("scan")
        node.send("path", [scan["range"] for scan in scans])
        note(node, len(scans))

    async def upload(node):
        await asyncio.sleep(0.003 + 0.02 * horus.rng_float())
        node.send("uploaded", horus.tick())
        note(node, node.latest("path"))

    def brake(node):
        note(node, node.recv("uploaded"))

    async def tell(node):
        await asyncio.sleep(0.001)
        note(node, node.recv("uploaded"))

    def log(node):
        note(node, horus.rng_float())

    sched.add(Node("sensor", sense, rate=100, order=0, pubs=["scan"]))
    sched.add(Node("planner", plan, rate=30, order=50, compute=True, subs=["scan"], pubs=["path"]))
    sched.add(Node("uploader", upload, rate=25, order=60, subs=["path"], pubs=["uploaded"]))
    sched.add(Node("brake", brake, on="uploaded", order=10))
    sched.add(Node("teller", tell, on="uploaded", order=20))
    sched.add(Node("logger", log, order=200))
    return sched


def test_two_runs_of_all_classes_replay_identically():
    """This guarantees identical results across runs: every class, Compute, Event and async."""
    journals = []
    for _ in range(2):
        journal = []
        with build_robot(journal) as sched:
            sched.run(duration=5.0)
        journals.append(journal)

    assert {entry[0] for entry in journals[0]} == {
        "sensor",
        "planner",
        "uploader",
        "brake",
        "teller",
        "logger",
    }
    assert len(journals[0]) > 1000
    assert journals[0] == journals[1]


def test_the_ways_to_advance_time_give_the_same_ticks():
    """run(), tick_for() and tick_once() are one simulation: the same ticks at the same times."""
    journals = []

    def steps(sched):
        for _ in range(200):
            sched.tick_once()

    for advance in (lambda s: s.run(duration=1.0), lambda s: s.tick_for(1.0), steps):
        journal = []
        with build_robot(journal) as sched:
            advance(sched)
        journals.append(journal)

    assert len(journals[0]) > 100
    assert journals[0] == journals[1] == journals[2]


PROGRAM = """
    import asyncio, hashlib
    import horus
    from horus import Node, Scheduler

    journal = []

    async def tick(node):
        await asyncio.sleep(0.01 * horus.rng_float())
        node.send("x", {"set": {"b", "a", "c"}, "v": horus.rng_float()})
        journal.append((node.name, horus.now(), horus.rng_float()))

    def event(node):
        journal.append((node.name, horus.now(), sorted(node.recv("x")["set"])))

    sched = Scheduler(tick_rate=100, deterministic=True)
    for name in ("a", "b", "c"):
        sched.add(Node(name, tick, rate=50, pubs=["x"]))
        sched.add(Node(f"event_{name}", event, on="x"))
    sched.run(duration=2.0)
    print(hashlib.sha256(repr(journal).encode()).hexdigest(), len(journal))
"""


def test_results_are_the_same_in_another_process_with_another_hash_seed():
    """Identical results on any machine: not even the hash seed of the process matters."""
    outputs = {run_program(PROGRAM, PYTHONHASHSEED=seed).stdout for seed in ("1", "2")}
    assert len(outputs) == 1


def test_everything_runs_on_one_thread():
    """Not OS thread scheduling: every class is executed on the one calling thread."""
    threads = set()
    sched = Scheduler(tick_rate=100, deterministic=True)
    for kind in KINDS:
        sched.add(node_of(kind, kind, lambda node: threads.add(threading.get_ident())))
    sched.publish(TRIGGER, 1)
    before = threading.active_count()

    sched.run(duration=0.1)

    assert threads == {threading.get_ident()}
    assert threading.active_count() == before


def test_nothing_waits_for_the_wall_clock():
    """1000 simulated seconds of a small graph run in a few real ones."""
    ticks = []
    sched = Scheduler(tick_rate=10, deterministic=True)
    sched.add(Node("a", lambda n: n.send("x", 1.0), rate=10, pubs=["x"]))
    sched.add(Node("b", lambda n: ticks.append(n.recv("x")), rate=10, subs=["x"]))
    begun = time.monotonic()

    sched.run(duration=1000.0)

    assert len(ticks) == 10_000
    assert time.monotonic() - begun < 30.0


def test_per_node_rates_are_honoured():
    """Deterministic mode does not ignore per-node rates."""
    counts = {}
    sched = Scheduler(tick_rate=1000, deterministic=True)

    def count(node):
        counts[node.name] = counts.get(node.name, 0) + 1

    for rate in (1, 7, 30, 100, 1000):
        sched.add(Node(f"at_{rate}", count, rate=rate))

    sched.run(duration=2.0)

    assert counts == {"at_1": 2, "at_7": 14, "at_30": 60, "at_100": 200, "at_1000": 2000}


@settings(max_examples=30, deadline=None)
@given(
    rates=st.lists(st.floats(min_value=0.5, max_value=300.0), min_size=1, max_size=4, unique=True)
)
def test_every_node_is_released_at_k_over_rate(rates):
    """Ticks are released at k/rate, for any rates under one tick rate."""
    times = {}
    sched = Scheduler(tick_rate=100, deterministic=True)
    for index, rate in enumerate(rates):
        times[rate] = []
        sched.add(
            Node(f"n{index}", lambda seen=times[rate]: seen.append(horus.elapsed()), rate=rate)
        )

    sched.tick_for(2.0)

    for rate, seen in times.items():
        assert seen == pytest.approx([k / rate for k in range(len(seen))], abs=2e-9)
        assert len(seen) == pytest.approx(2.0 * rate, abs=1.0)


# -- order -------------------------------------------------------------------------------


def trace_of(nodes) -> list[str]:
    """Return the order in which nodes, given as (name, order, pubs, subs), tick in a cycle."""
    journal = []
    sched = Scheduler(tick_rate=100, deterministic=True)
    for name, order, pubs, subs in nodes:
        sched.add(
            Node(
                name,
                lambda n: journal.append(n.name),
                rate=100,
                order=order,
                pubs=pubs,
                subs=subs,
            )
        )
    sched.tick_once()
    sched.stop()
    return journal


def test_execution_order_follows_the_dependency_graph():
    """Execution order is determined by the dependency graph, inferred from topic connections."""
    nodes = [
        ("motor", 10, [], ["cmd"]),
        ("controller", 10, ["cmd"], ["scan"]),
        ("sensor", 10, ["scan"], []),
    ]
    assert trace_of(nodes) == ["sensor", "controller", "motor"]
    assert trace_of(nodes[::-1]) == ["sensor", "controller", "motor"]


def test_order_comes_first_then_the_graph_then_insertion():
    """Deterministic order: order first, then publishers before subscribers, then insertion."""
    nodes = [
        ("late_publisher", 20, ["x"], []),
        ("unrelated_1", 10, [], []),
        ("subscriber", 10, [], ["x", "y"]),
        ("unrelated_2", 10, [], []),
        ("publisher", 10, ["y"], []),
    ]
    trace = trace_of(nodes)
    assert trace[-1] == "late_publisher"
    assert trace.index("publisher") < trace.index("subscriber")
    assert trace.index("unrelated_1") < trace.index("unrelated_2")


def test_a_feedback_cycle_is_cut_and_still_ticks_everybody():
    """Feedback cycles are cut: each node still ticks once per cycle, in a fixed order."""
    nodes = [
        ("plant", 10, ["state"], ["force"]),
        ("controller", 10, ["force"], ["state"]),
        ("observer", 10, [], ["state"]),
    ]
    first = trace_of(nodes)
    assert sorted(first) == ["controller", "observer", "plant"]
    assert first.index("plant") < first.index("observer")
    assert trace_of(nodes) == first


def test_feedback_cycles_are_cut_at_the_lowest_order():
    """In a feedback cycle the node of lowest order goes first."""
    nodes = [("controller", 20, ["force"], ["state"]), ("plant", 10, ["state"], ["force"])]
    assert trace_of(nodes) == ["plant", "controller"]


def test_an_order_that_contradicts_the_graph_is_logged_once_at_start(caplog):
    """An order that contradicts the graph is logged once at start, naming nodes and topic."""
    caplog.set_level("INFO", logger="horus")
    sched = Scheduler(tick_rate=100, deterministic=True)
    sched.add(Node("sensor", lambda n: n.send("scan", 1), rate=100, order=20, pubs=["scan"]))
    sched.add(Node("motor", lambda n: n.recv("scan"), rate=100, order=10, subs=["scan"]))

    sched.run(duration=1.0)

    told = [r.getMessage() for r in caplog.records if "scan" in r.getMessage()]
    assert len(told) == 1
    assert "motor" in told[0]
    assert "sensor" in told[0]


def test_a_graph_that_agrees_with_the_order_is_not_mentioned(caplog):
    """No contradiction, no message."""
    caplog.set_level("INFO", logger="horus")
    sched = Scheduler(tick_rate=100, deterministic=True)
    sched.add(Node("sensor", lambda n: n.send("scan", 1), rate=100, order=10, pubs=["scan"]))
    sched.add(Node("motor", lambda n: n.recv("scan"), rate=100, order=20, subs=["scan"]))

    sched.run(duration=0.1)

    assert [r for r in caplog.records if "scan" in r.getMessage()] == []


# -- use it for ------------------------------------------------------------------------------


def test_unit_tests_assert_exact_outputs_after_n_ticks():
    """Unit tests: assert exact outputs after N ticks."""
    positions = []
    state = {"x": 0.0}

    def move(node):
        state["x"] += 2.0 * horus.dt()
        positions.append(round(state["x"], 9))

    sched = Scheduler(tick_rate=100, deterministic=True)
    sched.add(Node("move", move, rate=100))
    for _ in range(5):
        sched.tick_once()

    assert positions == [0.02, 0.04, 0.06, 0.08, 0.1]


def test_virtual_time_stands_still_within_a_plain_tick():
    """A plain tick takes no virtual time, whatever it does."""
    seen = []

    def tick(node):
        begin = horus.now()
        time.sleep(1 * ms)
        seen.append(horus.now() - begin)

    sched = Scheduler(tick_rate=100, deterministic=True)
    sched.add(Node("node", tick, rate=100))

    sched.tick_for(0.03)

    assert seen == [0.0, 0.0, 0.0]


def test_a_new_scheduler_starts_at_time_zero():
    """Every simulation starts at time 0 and cycle 0, whatever ran before it."""
    for _ in range(2):
        seen = []
        sched = Scheduler(tick_rate=100, deterministic=True)
        sched.add(
            Node("node", lambda seen=seen: seen.append((horus.now(), horus.tick())), rate=100)
        )
        sched.tick_for(0.02)
        sched.stop()
        assert seen == [(0.0, 0), (0.01, 1)]


def test_a_signal_handler_is_restored_after_a_simulation_as_well():
    """A deterministic run() leaves the process as it found it, also with no duration."""
    sched = Scheduler(tick_rate=100, deterministic=True)

    def tick(node):
        if horus.tick() == 10:
            node.request_stop()

    sched.add(Node("node", tick, rate=100)).add(Node("other", nothing, rate=10))

    sched.run()

    assert sched.status() == "stopped"


def test_an_endless_simulation_ends_when_nothing_is_left_to_happen():
    """With nothing but idle event nodes, nothing is left to simulate: run() returns."""
    sched = Scheduler(tick_rate=100, deterministic=True)
    sched.add(Node("event", nothing, on="go"))
    begun = time.monotonic()

    sched.run()

    assert time.monotonic() - begun < 5.0
    assert sched.status() == "stopped"
