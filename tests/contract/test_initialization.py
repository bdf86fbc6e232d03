"""Initialization: lazy, in order, and tolerant of a node that cannot start."""

from __future__ import annotations

import asyncio
import threading

import pytest

import horus
from horus import ExecutionClass, Node, Scheduler, ms, us

from .helpers import KINDS, TRIGGER, all_have_ticked, node_of, nothing, run_until


def advance(sched: Scheduler, way: str) -> None:
    """Start a scheduler in one of the ways there are."""
    if way == "tick_once":
        sched.tick_once()
    elif way == "tick_for":
        sched.tick_for(0.1)
    else:
        sched.run(duration=0.1)


@pytest.fixture(params=("tick_once", "tick_for", "run"))
def way(request) -> str:
    """Name each way to start a scheduler."""
    return request.param


def test_initialization_happens_lazily(make, way, deterministic):
    """init() runs when the scheduler starts, not when a node is made or added."""
    journal = []
    node = Node("node", nothing, rate=100, init=lambda node: journal.append("init"))
    sched = make(tick_rate=100, deterministic=deterministic)
    sched.add(node)
    assert journal == []

    advance(sched, way)

    assert journal == ["init"]


@pytest.mark.realtime
def test_init_is_called_on_every_node_in_order_before_the_first_tick(make, loop):
    """init() is called on every node in order sequence, then the main tick loop begins."""
    journal = []
    sched = make(tick_rate=100, loop=loop)
    for order, kind in reversed(list(enumerate(KINDS))):
        sched.add(
            node_of(
                kind,
                kind,
                lambda node: journal.append(("tick", node.name)),
                init=lambda node: journal.append(("init", node.name)),
                order=order,
            )
        )
    sched.publish(TRIGGER, 1)

    run_until(sched, lambda: all_have_ticked(sched))

    assert journal[: len(KINDS)] == [("init", kind) for kind in KINDS]
    assert {name for phase, name in journal[len(KINDS) :] if phase == "tick"} == set(KINDS)
    assert [phase for phase, _ in journal].count("init") == len(KINDS)


def test_init_order_is_by_order_then_insertion_in_every_mode(make, way, deterministic):
    """init() goes by order, not by insertion; nodes of equal order go as they were added."""
    journal = []
    sched = make(tick_rate=100, deterministic=deterministic)
    for name, order in (("late", 50), ("early_1", 5), ("early_2", 5), ("first", 0)):
        sched.add(Node(name, nothing, rate=100, order=order, init=lambda n: journal.append(n.name)))

    advance(sched, way)

    assert journal == ["first", "early_1", "early_2", "late"]


def test_init_runs_once_however_often_the_scheduler_is_stepped(make, deterministic, kind):
    """init() is called once at startup, whatever follows."""
    journal = []
    sched = make(tick_rate=100, deterministic=deterministic)
    sched.add(node_of(kind, "node", init=lambda node: journal.append("init")))

    sched.tick_once()
    sched.tick_once(["node"])
    sched.tick_for(0.05)

    assert journal == ["init"]


def test_pending_configurations_are_finalized_inference_and_derivation(make):
    """Class inference and budget and deadline auto-derivation are complete at startup."""
    sched = make(deterministic=True)
    sched.add(Node("motor", nothing, rate=1000))
    sched.tick_once()

    node = Node("motor", nothing, rate=1000)
    assert node.execution_class is ExecutionClass.RT
    assert node.budget == pytest.approx(800 * us)
    assert node.deadline == pytest.approx(950 * us)
    assert sched.get_node_stats("motor")["execution_class"] == "Rt"


@pytest.mark.realtime
def test_a_node_whose_init_raises_enters_error_state_and_others_continue(make, loop, kind):
    """If init() raises, that node enters Error state, is excluded; other nodes continue."""
    ticked = []

    def fail(node):
        raise OSError("no such device")

    sched = make(tick_rate=100, loop=loop)
    sched.add(node_of(kind, "broken", lambda node: ticked.append("broken"), init=fail, order=0))
    sched.add(Node("working", lambda node: ticked.append("working"), rate=100, order=1))
    sched.publish(TRIGGER, 1)
    states = []
    sched.add(
        Node("watch", lambda: states.append(sched.get_node_stats("broken")["state"]), order=2)
    )

    run_until(sched, lambda: ticked.count("working") >= 5 and states)

    assert "broken" not in ticked
    assert set(states) == {"error"}


def test_an_init_error_excludes_the_node_in_every_mode(make, way, deterministic, caplog):
    """The Error state is the same in steps, timed runs and runs, and it is logged."""
    ticked = []

    def fail(node):
        raise OSError("no such device")

    sched = make(tick_rate=100, deterministic=deterministic)
    sched.add(Node("broken", lambda: ticked.append("broken"), rate=100, init=fail))
    sched.add(Node("working", lambda: ticked.append("working"), rate=100))

    advance(sched, way)

    assert set(ticked) == {"working"}
    assert sched.get_node_stats("broken")["state"] == "error"
    assert sched.get_node_stats("broken")["errors_count"] == 1
    assert any(
        record.levelname == "ERROR"
        and record.name == "horus.node.broken"
        and "no such device" in record.getMessage()
        for record in caplog.records
    )


def test_a_failing_init_is_not_retried(make, deterministic):
    """A node in Error state is excluded: its init() is not tried again in the same run."""
    attempts = []

    def fail(node):
        attempts.append(node.name)
        raise RuntimeError("still broken")

    sched = make(tick_rate=100, deterministic=deterministic)
    sched.add(Node("broken", nothing, rate=100, init=fail))

    sched.tick_once()
    sched.tick_once()
    sched.tick_once(["broken"])
    sched.tick_for(0.05)

    assert attempts == ["broken"]


def test_a_type_error_in_init_does_not_run_it_twice(make, kind):
    """A TypeError raised by a callback is its own: the callback is not called again."""
    calls = []

    def init(node):
        calls.append(node.name)
        raise TypeError("init() takes 0 positional arguments but 1 was given")

    sched = make(tick_rate=100)
    sched.add(node_of(kind, "node", init=init))

    sched.tick_once()

    assert calls == ["node"]


def test_nodes_can_be_added_and_configured_in_any_order(make):
    """Lazy initialization means you can add and configure nodes in any order."""
    received = []
    sched = make(tick_rate=100, deterministic=True)
    consumer = Node("b", lambda n: received.append(n.recv("x")), rate=100, order=1, subs=["x"])
    producer = Node("a", lambda n: n.send("x", horus.tick()), rate=100, order=0, pubs=["x"])
    sched.add(consumer)
    sched.set_node_rate("b", 50)
    sched.add(producer)
    sched.set_node_rate("b", 100)

    sched.tick_once()

    assert received == [0]


def test_what_init_sends_is_received_in_the_first_tick(make, deterministic):
    """Subscriptions exist before any init(): a message sent in init() is not lost."""
    received = []
    sched = make(tick_rate=100, deterministic=deterministic)
    sched.add(Node("driver", nothing, rate=100, order=0, init=lambda n: n.send("up", True)))
    sched.add(Node("app", lambda n: received.append(n.recv("up")), rate=100, order=1, subs=["up"]))

    sched.tick_once()

    assert received == [True]


@pytest.mark.realtime
def test_init_runs_where_the_node_ticks(make, loop, kind):
    """init(), tick() and shutdown() of a node run on one thread, so drivers may rely on it."""
    threads = []

    def note(node):
        threads.append(threading.get_ident())

    sched = make(tick_rate=100, loop=loop)
    sched.add(node_of(kind, "node", note, init=note, shutdown=note))
    sched.publish(TRIGGER, 1)

    run_until(sched, lambda: all_have_ticked(sched))

    assert len(threads) >= 3
    assert len(set(threads)) == 1


def test_an_async_init_is_awaited_before_the_first_tick(make, way, deterministic):
    """An `async def` init of an async node has ended before its first tick begins."""
    journal = []

    async def init(node):
        await asyncio.sleep(5 * ms)
        journal.append("init")

    async def tick(node):
        journal.append("tick")

    sched = make(tick_rate=100, deterministic=deterministic)
    sched.add(Node("node", tick, rate=100, init=init))

    advance(sched, way)

    assert journal[:2] == ["init", "tick"]
    assert journal.count("init") == 1


@pytest.mark.realtime
def test_a_scheduler_can_run_again_with_a_new_init(make, loop, kind):
    """A scheduler can be run again: init(), ticks and shutdown() happen anew."""
    journal = []
    sched = make(tick_rate=100, loop=loop)
    sched.add(
        node_of(
            kind,
            "node",
            lambda node: journal.append("tick"),
            init=lambda node: journal.append("init"),
            shutdown=lambda node: journal.append("shutdown"),
        )
    )

    for _ in range(2):
        sched.publish(TRIGGER, 1)
        run_until(sched, lambda: journal[-1:] == ["tick"])

    second = journal.index("shutdown") + 1
    for life in (journal[:second], journal[second:]):
        assert life[0] == "init"
        assert life[-1] == "shutdown"
        assert "tick" in life
        assert set(life[1:-1]) == {"tick"}


def test_a_node_in_error_state_gets_another_chance_in_the_next_run(make):
    """Error state lasts for a run; the next run begins with init() again."""
    attempts = []
    ticks = []

    def init(node):
        attempts.append(node.name)
        if len(attempts) == 1:
            raise OSError("not plugged in yet")

    sched = make(tick_rate=100, deterministic=True)
    sched.add(Node("node", lambda: ticks.append(1), rate=100, init=init))

    sched.run(duration=0.05)
    assert ticks == []
    sched.run(duration=0.05)

    assert len(attempts) == 2
    assert len(ticks) == 5
