"""Event-driven nodes: asleep until their topic receives a message."""

from __future__ import annotations

import asyncio
import threading
import time
from dataclasses import dataclass

import pytest

import horus
from horus import Node, Sub, ms

from .helpers import PATIENCE_S, node_of, nothing, run_until, running, wait_until


def test_on_makes_an_event_node():
    """Set on="topic.name" to create a node that sleeps until that topic receives a message."""
    assert Node("estop", nothing, on="emergency.stop").execution_class == "Event"


@pytest.mark.realtime
def test_the_emergency_stop_of_the_contract(make, loop, caplog):
    """The e-stop node wakes when its message arrives, logs it and stops the scheduler."""

    def handle_estop(node):
        msg = node.recv("emergency.stop")
        node.log_warning(f"E-STOP triggered: {msg}")
        node.request_stop()

    def check(node):
        if horus.elapsed() > 0.05:
            node.send("emergency.stop", {"reason": "obstacle"})

    sched = make(loop=loop)
    sched.add(
        Node(name="estop", tick=handle_estop, on="emergency.stop", order=0, subs=["emergency.stop"])
    )
    sched.add(Node("safety", check, rate=200, order=1, pubs=["emergency.stop"]))

    sched.run(duration=20.0)

    assert "estop" in sched.stop_reason
    messages = [r.getMessage() for r in caplog.records if r.name == "horus.node.estop"]
    assert messages == ["E-STOP triggered: {'reason': 'obstacle'}"]


@pytest.mark.realtime
def test_it_only_wakes_when_a_message_arrives(make, loop):
    """Without a message an event node does not tick, and is healthy all the same."""
    ticks = []
    sched = make(loop=loop)
    sched.add(Node("estop", lambda: ticks.append(1), on="emergency.stop"))
    sched.add(Node("other", nothing, rate=100))

    run_until(sched, lambda: sched.get_node_stats("other")["total_ticks"] >= 10)

    assert ticks == []
    stats = sched.get_node_stats("estop")
    assert stats["health"] == "healthy"
    assert stats["watchdog_expirations"] == 0
    assert sched.safety_stats()["health_states"]["estop"] == "healthy"


@pytest.mark.realtime
@pytest.mark.parametrize("sender_kind", ["BestEffort", "AsyncIo", "Rt", "Compute"])
def test_one_tick_per_message_first_in_first_out(make, loop, sender_kind):
    """One tick per message, in the order they were sent, whichever class sends them."""
    received = []
    sent = []

    def send(node):
        for _ in range(3):
            sent.append(len(sent))
            node.send("number", sent[-1])

    sched = make(loop=loop)
    sched.add(node_of(sender_kind, "sender", send, pubs=["number"]))
    sched.add(Node("event", lambda n: received.append(n.recv("number")), on="number"))

    with running(sched):
        wait_until(lambda: len(received) >= 9)

    assert received == sent[: len(received)]
    assert sched.get_node_stats("event")["total_ticks"] == len(received)


def test_a_tick_that_does_not_ask_for_its_message_has_had_it(make, deterministic):
    """One tick per message, also for a tick that never calls recv()."""
    ticks = []
    sched = make(tick_rate=100, deterministic=deterministic)
    sched.add(Node("bell", lambda: ticks.append(1), on="ring"))
    for _ in range(3):
        sched.publish("ring", True)

    sched.tick_for(0.05)
    sched.tick_for(0.05)

    assert len(ticks) == 3


@pytest.mark.realtime
def test_two_event_nodes_on_one_topic_both_fire(make, loop):
    """Each event node of a topic gets every message, not just the first node."""
    received = {"a": [], "b": [], "c": []}
    sched = make(loop=loop)

    async def tick_async(node):
        received[node.name].append(node.recv("go"))

    for name in "ab":
        sched.add(Node(name, lambda n: received[n.name].append(n.recv("go")), on="go"))
    sched.add(Node("c", tick_async, on="go"))

    with running(sched):
        for index in range(5):
            sched.publish("go", index)
        wait_until(lambda: sum(map(len, received.values())) == 15)

    assert received == {name: [0, 1, 2, 3, 4] for name in "abc"}


def test_an_event_node_is_subscribed_without_saying_so(make):
    """on= subscribes the node: subs need not repeat the topic."""
    received = []
    sched = make(deterministic=True)
    sched.add(Node("event", lambda n: received.append(n.recv("go")), on="go"))
    sched.publish("go", 1)

    sched.tick_once()

    assert received == [1]


def test_an_event_node_may_receive_other_topics_too(make):
    """An event node wakes for its own topic only, and reads others when it does."""
    received = []
    sched = make(tick_rate=100, deterministic=True)
    sched.add(
        Node(
            "event",
            lambda n: received.append((n.recv("go"), n.latest("pose"))),
            on="go",
            subs=["pose"],
        )
    )
    sched.publish("pose", (1.0, 2.0))
    sched.tick_for(0.1)
    assert received == []
    sched.publish("go", True)

    sched.tick_for(0.1)

    assert received == [(True, (1.0, 2.0))]


def test_a_message_class_can_be_the_trigger(make):
    """on= takes a message class for the topic named after it."""

    @dataclass(frozen=True)
    class Alarm:
        code: int

    received = []
    sched = make(deterministic=True)
    sched.add(Node("event", lambda n: received.append(n.recv(Alarm)), on=Alarm))
    sched.publish(Alarm, Alarm(7))

    sched.tick_once()

    assert received == [Alarm(7)]


def test_events_are_handled_at_the_instant_of_their_message(make):
    """In deterministic mode an event node ticks in the cycle, right after its message."""
    journal = []
    sched = make(tick_rate=100, deterministic=True)

    def source(node):
        journal.append(("source", horus.now()))
        node.send("go", 1)

    sched.add(Node("source", source, rate=100, order=0, pubs=["go"]))
    sched.add(Node("event", lambda: journal.append(("event", horus.now())), on="go", order=50))
    sched.add(Node("motor", lambda: journal.append(("motor", horus.now())), rate=100, order=9))

    sched.tick_for(0.02)

    assert [name for name, _ in journal] == ["source", "event", "motor"] * 2
    assert [when for _, when in journal] == pytest.approx([0.0] * 3 + [0.01] * 3)


@pytest.mark.realtime
def test_an_async_event_node_is_awaited_one_message_at_a_time(make, loop):
    """`async def` with `on` is an Event node that is awaited; its ticks do not overlap."""
    inside, overlaps, received = [], [], []

    async def tick(node):
        overlaps.extend(inside)
        inside.append(1)
        received.append(node.recv("go"))
        await asyncio.sleep(5 * ms)
        inside.pop()

    sched = make(loop=loop)
    sched.add(Node("event", tick, on="go"))
    for index in range(6):
        sched.publish("go", index)

    with running(sched):
        wait_until(lambda: len(received) == 6)

    assert received == list(range(6))
    assert overlaps == []


@pytest.mark.realtime
@pytest.mark.parametrize("urgency", [{"priority": 90}, {"budget": 0.5}, {"deadline": 0.5}], ids=str)
def test_an_urgent_event_node_is_never_behind_a_slow_logger(make, loop, urgency):
    """Event node with priority, budget or deadline: a thread of its own, as for an e-stop."""
    stopped = threading.Event()
    in_time = []
    sched = make(loop=loop)

    def slow_log(node):
        node.send("emergency.stop", True)
        in_time.append(stopped.wait(PATIENCE_S))
        node.request_stop()

    def stop_motors(node):
        if node.recv("emergency.stop"):
            stopped.set()

    sched.add(Node("logger", slow_log, pubs=["emergency.stop"]))
    sched.add(Node("estop", stop_motors, on="emergency.stop", **urgency))

    sched.run()

    assert in_time[0] is True


@pytest.mark.realtime
@pytest.mark.parametrize("sender_kind", ["BestEffort", "AsyncIo", "Rt", "Compute"])
def test_an_urgent_event_node_has_one_tick_per_message_in_order(make, loop, sender_kind):
    """On its own thread, too, an event node has one tick per message, first in, first out."""
    received = []
    sent = []

    def send(node):
        for _ in range(3):
            sent.append(len(sent))
            node.send("number", sent[-1])

    sched = make(loop=loop)
    sched.add(node_of(sender_kind, "sender", send, pubs=["number"]))
    sched.add(Node("event", lambda n: received.append(n.recv("number")), on="number", deadline=0.5))

    with running(sched):
        wait_until(lambda: len(received) >= 9)

    assert received == sent[: len(received)]


@pytest.mark.realtime
def test_messages_sent_before_the_run_are_waiting(make, loop):
    """Messages that were published before the run began wake the node at its start."""
    received = []
    sched = make(loop=loop)
    sched.add(Node("event", lambda n: received.append(n.recv("go")), on="go"))
    sched.publish("go", 1)
    sched.publish("go", 2)

    run_until(sched, lambda: len(received) == 2)

    assert received == [1, 2]


@pytest.mark.realtime
def test_a_flood_of_events_leaves_the_loop_its_turn(make, loop):
    """A flooded event node does not starve the other nodes of the loop."""
    ticks = []
    sched = make(loop=loop)

    def tick(node):
        node.recv("go")
        time.sleep(1 * ms)
        node.send("go", 1)
        node.send("go", 1)

    sched.add(Node("event", tick, on="go", subs=[Sub("go", capacity=64)], pubs=["go"]))
    sched.add(Node("logger", lambda: ticks.append(1)))
    sched.publish("go", 1)

    run_until(sched, lambda: len(ticks) >= 4 and sched.get_node_stats("event")["total_ticks"] >= 10)


@pytest.mark.realtime
def test_an_event_node_that_frees_the_loop_answers_quickly(make, loop):
    """A message wakes its node at once, not at the next tick of some timer."""
    delays = []
    sched = make(loop=loop)
    sched.add(Node("event", lambda n: delays.append(time.monotonic() - n.recv("go")), on="go"))
    sched.add(Node("sender", lambda n: n.send("go", time.monotonic()), rate=50, pubs=["go"]))

    run_until(sched, lambda: len(delays) >= 15)

    delays.sort()
    # At the pace of a 30 Hz or a 100 Hz poll, the median would be 5 ms or more.
    assert delays[len(delays) // 3] < 4 * ms


def test_a_feedback_loop_of_events_is_reported_not_endless(make):
    """Event nodes that trigger each other at one virtual instant end in an error."""
    sched = make(deterministic=True)
    for name, on, to in (("ping", "a", "b"), ("pong", "b", "a")):
        sched.add(Node(name, lambda n, to=to: n.send(to, 1), on=on, pubs=[to]))
    sched.publish("a", 1)

    with pytest.raises(horus.StateError, match="feedback"):
        sched.tick_once()
