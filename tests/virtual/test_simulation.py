"""Virtual time: a thousand seconds in a few, and the same ones every time."""

from __future__ import annotations

import asyncio
import hashlib
import time
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import horus
from horus import Node, Scheduler, StateError

pytestmark = pytest.mark.usefixtures("leaves_nothing_behind")


def trace_of(seed: int, seconds: float) -> list[tuple[Any, ...]]:
    """Run a graph with every class in it and return everything observable."""
    trace: list[tuple[Any, ...]] = []

    def note(name: str, *values: Any) -> None:
        trace.append((name, horus.now(), horus.dt(), horus.tick(), *values))

    def sensor(node: Node) -> None:
        node.send("scan", [horus.rng_float() for _ in range(3)])
        note("sensor")

    def planner(node: Node) -> None:
        note("planner", node.recv_all("scan"))
        node.send("path", {"x": horus.rng_float()})

    async def cloud(node: Node) -> None:
        note("cloud", node.recv("path"))
        await asyncio.sleep(0.07 + 0.1 * horus.rng_float())
        note("cloud back")
        node.send("ack", 1)

    def estop(node: Node) -> None:
        note("estop", node.recv("ack"))

    async def async_event(node: Node) -> None:
        message = node.recv("scan")
        await asyncio.sleep(0.003)
        note("async event", message)

    scheduler = Scheduler(tick_rate=1000, deterministic=True, seed=seed)
    for node in (
        Node("estop", estop, on="ack", order=0),
        Node("sensor", sensor, rate=30, order=10, pubs="scan"),
        Node("planner", planner, rate=7, order=10, compute=True, subs="scan", pubs="path"),
        Node("cloud", cloud, rate=3, subs="path", pubs="ack"),
        Node("async_event", async_event, on="scan"),
        Node("best", lambda: note("best")),
    ):
        scheduler.add(node)
    scheduler.run(seconds)
    return trace


def digest(trace: list[tuple[Any, ...]]) -> str:
    return hashlib.sha256(repr(trace).encode()).hexdigest()


def test_every_class_replays_identically() -> None:
    """Two runs of a graph with all classes give the same trace, random numbers included."""
    first, second = trace_of(1, 5.0), trace_of(1, 5.0)
    assert digest(first) == digest(second)
    assert {entry[0] for entry in first} == {
        "sensor",
        "planner",
        "cloud",
        "cloud back",
        "estop",
        "async event",
        "best",
    }
    assert digest(first) != digest(trace_of(2, 5.0))


def test_a_thousand_seconds_take_a_few() -> None:
    """1000 simulated seconds of a small graph run in a few real ones."""
    scheduler = Scheduler(tick_rate=100, deterministic=True)
    scheduler.add(Node("source", lambda node: node.send("x", 1.0), rate=100, pubs="x"))
    scheduler.add(Node("sink", lambda node: node.recv("x"), rate=100, subs="x"))
    scheduler.add(Node("slow", lambda: None, rate=1))
    began = time.monotonic()
    scheduler.run(1000.0)
    assert time.monotonic() - began < 20.0
    assert scheduler.get_node_stats("source")["total_ticks"] == 100_000
    assert scheduler.get_node_stats("slow")["total_ticks"] == 1000


@settings(max_examples=25, deadline=None)
@given(st.lists(st.sampled_from([0.01, 0.05, 0.3]), min_size=1, max_size=6))
def test_it_does_not_matter_in_which_steps_time_advances(steps: list[float]) -> None:
    """`tick_for` in pieces gives the same ticks as `tick_for` in one."""

    def ticks(pieces: list[float]) -> list[tuple[str, float]]:
        seen: list[tuple[str, float]] = []
        scheduler = Scheduler(tick_rate=100, deterministic=True)
        scheduler.add(Node("a", lambda: seen.append(("a", horus.now())), rate=30))
        scheduler.add(Node("b", lambda: seen.append(("b", horus.now())), rate=100))
        for piece in pieces:
            scheduler.tick_for(piece)
        scheduler.stop()
        return seen

    assert ticks(steps) == ticks([sum(round(1000 * step) for step in steps) / 1000])


def test_a_feedback_loop_of_events_is_an_error() -> None:
    """Event nodes that wake each other for ever are reported, and still shut down."""
    halted: list[str] = []
    scheduler = Scheduler(deterministic=True)
    scheduler.add(
        Node(
            "echo",
            lambda node: node.send("x", node.recv("x")),
            on="x",
            pubs="x",
            shutdown=lambda: halted.append("echo"),
        )
    )
    scheduler.publish("x", 1)
    with pytest.raises(StateError, match="feedback loop"):
        scheduler.run(1.0)
    assert halted == ["echo"]


def test_an_init_that_waits_for_ever_fails() -> None:
    """Nothing in virtual time can wake it: the node is in error, the others run."""

    async def hang() -> None:
        await asyncio.Event().wait()

    async def tick() -> None:
        pass

    ticks: list[int] = []
    scheduler = Scheduler(deterministic=True)
    scheduler.add(Node("hangs", tick, rate=10, init=hang))
    scheduler.add(Node("works", lambda: ticks.append(1), rate=10))
    scheduler.run(0.5)
    assert scheduler.get_node_stats("hangs")["state"] == "error"
    assert len(ticks) == 5


def test_a_woken_async_tick_goes_on_in_the_same_instant() -> None:
    """A tick that waits for a plain node continues when that node has ticked."""
    seen: list[float] = []
    event: list[asyncio.Event] = []

    async def waiter() -> None:
        event[:] = [asyncio.Event()]
        await event[0].wait()
        seen.append(horus.now())

    def waker() -> None:
        if event and horus.now() > 0:
            event[0].set()

    scheduler = Scheduler(deterministic=True)
    scheduler.add(Node("waiter", waiter, rate=1, order=0))
    scheduler.add(Node("waker", waker, rate=2, order=1))
    scheduler.run(2.0)
    assert seen == [0.5, 1.0]


def test_it_works_inside_a_running_event_loop() -> None:
    """`tick_once` and `tick_for` may be called by an async test."""

    async def nap(node: Node) -> None:
        await asyncio.sleep(0.01)
        node.send("done", horus.now())

    async def main() -> Any:
        scheduler = Scheduler(tick_rate=10, deterministic=True)
        scheduler.add(Node("nap", nap, rate=10, pubs="done"))
        stream = scheduler.subscribe("done")
        scheduler.tick_once()
        scheduler.tick_for(1.0)
        scheduler.stop()
        return stream.recv_all()

    assert asyncio.run(main()) == pytest.approx([0.01 + k / 10 for k in range(11)])
