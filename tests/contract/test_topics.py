"""Topics: broadcast, bounded queues, isolation of messages, and access for applications."""

from __future__ import annotations

import dataclasses
import enum
import math
import threading
from typing import NamedTuple

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from horus import ConfigError, Node, Pub, Scheduler, Sub, TopicError

from .helpers import nothing, run_until


def exchange(message, *, receivers=1, after=None, capacity=1024):
    """Send a message through a topic; return what each receiver got.

    `after(message)` is called on the sender's side when the message is on its way.
    """
    received = []
    sched = Scheduler(tick_rate=100, deterministic=True)

    def send(node):
        node.send("topic", message)
        if after is not None:
            after(message)

    sched.add(Node("sender", send, rate=100, order=0, pubs=["topic"], failure_policy="fatal"))
    for index in range(receivers):
        sched.add(
            Node(
                f"receiver{index}",
                lambda n: received.append(n.recv("topic")),
                rate=100,
                order=1,
                subs=[Sub("topic", capacity=capacity)],
            )
        )
    sched.tick_once()
    sched.stop()
    return received


# -- recv, has_msg, recv_all, latest -------------------------------------------------------------


def test_recv_returns_the_next_message_or_none(make):
    """recv: the next message, oldest first, or None; has_msg tells whether one waits."""
    seen = []
    sched = make(tick_rate=100, deterministic=True)

    def receive(node):
        seen.append((node.has_msg("x"), node.recv("x"), node.has_msg("x")))

    sched.add(Node("receiver", receive, rate=100, subs=["x"]))
    sched.publish("x", 1)
    sched.publish("x", 2)
    for _ in range(3):
        sched.tick_once()

    assert seen == [(True, 1, True), (True, 2, False), (False, None, False)]


def test_recv_all_returns_what_waits_oldest_first(make):
    """recv_all: every message that waits, oldest first."""
    seen = []
    sched = make(tick_rate=100, deterministic=True)
    sched.add(Node("receiver", lambda n: seen.append(n.recv_all("x")), rate=100, subs=["x"]))
    for value in (1, 2, 3):
        sched.publish("x", value)
    sched.tick_once()
    sched.tick_once()
    assert seen == [[1, 2, 3], []]


def test_latest_is_the_newest_value_kept(make):
    """latest: the newest value, kept (sample and hold), even if already received."""
    seen = []
    sched = make(tick_rate=100, deterministic=True)
    sched.add(
        Node("receiver", lambda n: seen.append((n.latest("x"), n.recv("x"))), rate=100, subs=["x"])
    )
    sched.tick_once()
    sched.publish("x", 1)
    sched.publish("x", 2)
    for _ in range(3):
        sched.tick_once()
    assert seen == [(None, None), (2, 1), (2, 2), (2, None)]


def test_send_broadcasts_to_every_subscriber():
    """Send broadcasts: every subscriber gets every message, in a queue of its own."""
    assert exchange({"v": 1.0}, receivers=5) == [{"v": 1.0}] * 5


def test_a_late_subscriber_starts_empty(make):
    """A late subscriber starts empty: what was sent earlier is not received."""
    seen = []
    sched = make(tick_rate=100, deterministic=True)
    sched.add(Node("sender", lambda n: n.send("x", 1), rate=100, order=9, pubs=["x"]))
    sched.tick_once()
    sched.add(Node("late", lambda n: seen.append(n.recv("x")), rate=100, order=1, subs=["x"]))
    sched.tick_once()
    sched.tick_once()
    assert seen == [None, 1]


def test_two_schedulers_have_separate_topics(make):
    """Topics belong to a scheduler: another one's topic of that name is another topic."""
    seen = []
    first, second = make(deterministic=True), make(deterministic=True)
    first.add(Node("a", lambda n: n.send("x", 1), pubs=["x"]))
    second.add(Node("b", lambda n: seen.append(n.recv("x")), subs=["x"]))
    first.tick_once()
    second.tick_once()
    assert seen == [None]


# -- bounded queues ----------------------------------------------------------------------------


def flood(make, count, subs):
    """Send `count` numbers in one tick; return what arrives and the receiver's stats."""
    seen = []
    sched = make(tick_rate=100, deterministic=True)

    def send(node):
        for value in range(count):
            node.send("x", value)

    sched.add(Node("sender", send, rate=100, order=0, pubs=["x"]))
    sched.add(
        Node("receiver", lambda n: seen.extend(n.recv_all("x")), rate=100, order=1, subs=subs)
    )
    sched.tick_once()
    return seen, sched.get_node_stats("receiver")


def test_a_full_queue_drops_the_oldest_and_counts_it(make, caplog):
    """Full: drop the oldest, count it per subscriber, log once per episode."""
    seen, stats = flood(make, 25, [Sub("x", capacity=10)])
    assert seen == list(range(15, 25))
    assert stats["dropped"] == 15
    told = [r for r in caplog.records if "'x'" in r.getMessage() and "drop" in r.getMessage()]
    assert len(told) == 1
    assert "receiver" in told[0].getMessage()


def test_the_default_capacity_is_1024(make):
    """Each subscriber has its own bounded FIFO, of 1024 messages by default."""
    seen, stats = flood(make, 1025, ["x"])
    assert seen == list(range(1, 1025))
    assert stats["dropped"] == 1


def test_capacity_one_keeps_the_latest_silently(make, caplog):
    """Sub(topic, capacity=1) is keep-latest: that is what was asked for, so nothing is logged."""
    seen, _ = flood(make, 25, [Sub("x", capacity=1)])
    assert seen == [24]
    assert not [r for r in caplog.records if "drop" in r.getMessage()]


def test_a_slow_subscriber_costs_the_others_nothing(make):
    """One subscriber's full queue does not make another one lose messages."""
    seen = []
    sched = make(tick_rate=100, deterministic=True)
    sched.add(Node("slow", nothing, rate=1, order=1, subs=[Sub("x", capacity=2)]))
    sched.add(Node("fast", lambda n: seen.extend(n.recv_all("x")), rate=100, order=2, subs=["x"]))
    sched.add(Node("sender", lambda n: n.send("x", len(seen)), rate=100, order=0, pubs=["x"]))

    sched.tick_for(0.2)

    assert seen == list(range(20))
    assert sched.get_node_stats("slow")["dropped"] == 18
    assert sched.get_node_stats("fast")["dropped"] == 0


# -- isolation -----------------------------------------------------------------------------------


class Colour(enum.Enum):
    """An enum to send."""

    RED = 1


class Point(NamedTuple):
    """A named tuple to send."""

    x: float
    tags: list


@dataclasses.dataclass
class Pose:
    """A mutable dataclass to send."""

    x: float
    history: list


@dataclasses.dataclass(frozen=True)
class Fix:
    """A frozen dataclass to send."""

    lat: float


class Reading(msgspec.Struct):
    """A mutable struct to send."""

    values: list


class Stamp(msgspec.Struct, frozen=True):
    """A frozen struct to send."""

    t: float


class Plain:
    """An ordinary object to send."""

    def __init__(self, items):
        self.items = items

    def __eq__(self, other):
        return self.items == other.items

    __hash__ = None


def clear_list(message):
    """Change a message as deeply as its type allows."""
    target = {
        dict: lambda m: m["list"].clear(),
        list: lambda m: m[0].append(99),
        Point: lambda m: m.tags.append(99),
        Pose: lambda m: m.history.append(99),
        Reading: lambda m: m.values.append(99),
        Plain: lambda m: m.items.append(99),
        set: lambda m: m.add(99),
        bytearray: lambda m: m.extend(b"!"),
    }[type(message)]
    target(message)


MUTABLE = [
    lambda: {"list": [1.0, 2.0]},
    lambda: [[1], (2, [3])],
    lambda: Point(1.0, [1]),
    lambda: Pose(1.0, [1]),
    lambda: Reading([1]),
    lambda: Plain([1]),
    lambda: {1, 2},
    lambda: bytearray(b"abc"),
]


@pytest.mark.parametrize("build", MUTABLE, ids=lambda build: type(build()).__name__)
def test_later_changes_by_the_publisher_are_never_seen(build):
    """A message is snapshotted at send: later changes by the publisher are not seen."""
    assert exchange(build(), after=clear_list) == [build()]


@pytest.mark.parametrize("build", MUTABLE, ids=lambda build: type(build()).__name__)
def test_changes_by_one_receiver_are_never_seen_by_another(make, build):
    """Later changes by one receiver are never seen by another, nor by latest()."""
    seen = []
    sched = make(tick_rate=100, deterministic=True)

    def vandal(node):
        clear_list(node.recv("topic"))
        clear_list(node.latest("topic"))

    def witness(node):
        seen.append((node.latest("topic"), node.recv("topic")))

    sched.add(Node("vandal", vandal, rate=100, order=0, subs=["topic"], failure_policy="fatal"))
    sched.add(Node("witness", witness, rate=100, order=1, subs=["topic"]))
    sched.publish("topic", build())

    sched.tick_once()

    assert seen == [(build(), build())]


@pytest.mark.parametrize("message", [Fix(48.1), Stamp(1.0), "text", (1, "a"), Colour.RED, 7])
def test_immutable_and_frozen_messages_pass_by_reference(message):
    """Immutable values and frozen messages pass by reference: no copy, no cost."""
    (received,) = exchange(message)
    assert received is message


def test_numpy_arrays_are_copied_once_and_delivered_read_only():
    """NumPy arrays are copied once and delivered read-only."""
    image = np.arange(12, dtype=np.float32).reshape(3, 4)

    first, second = exchange(image, receivers=2, after=lambda array: array.fill(-1.0))

    assert first.dtype == np.float32
    assert first.tolist() == np.arange(12).reshape(3, 4).tolist()
    assert not first.flags.writeable
    assert first is second or not np.shares_memory(first, image)
    with pytest.raises(ValueError, match="read-only"):
        first[0, 0] = 1.0


def test_arrays_inside_containers_are_isolated_too():
    """An array in a dict is as safe as one on its own."""
    scan = {"ranges": np.ones(5), "stamp": 1.0}
    (received,) = exchange(scan, after=lambda message: message["ranges"].fill(0.0))
    assert received["ranges"].tolist() == [1.0] * 5
    assert not received["ranges"].flags.writeable


def test_inf_and_nan_survive():
    """Inf and nan survive; NaN does not become None."""
    sent = {"a": math.inf, "b": -math.inf, "c": math.nan, "d": [math.nan, 1.0]}
    (received,) = exchange(sent)
    assert received["a"] == math.inf
    assert received["b"] == -math.inf
    assert math.isnan(received["c"])
    assert math.isnan(received["d"][0])
    (received,) = exchange(math.nan)
    assert math.isnan(received)


@pytest.mark.parametrize("size", [4_095, 4_097, 1_000_000])
def test_messages_of_any_size_are_delivered(size):
    """Messages over 4 kB are not refused."""
    assert exchange(b"x" * size) == [b"x" * size]
    assert exchange(["text" * 10] * (size // 40)) == [["text" * 10] * (size // 40)]


MESSAGES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False)
    | st.text()
    | st.binary(),
    lambda inner: (
        st.lists(inner)
        | st.dictionaries(st.text() | st.integers(), inner)
        | st.tuples(inner, inner)
        | st.sets(st.integers())
    ),
    max_leaves=25,
).filter(lambda message: message is not None)


def shape(message):
    """Return a message with the type of each part, to compare as strictly as that."""
    if isinstance(message, dict):
        parts = {key: shape(value) for key, value in message.items()}
    elif isinstance(message, list | tuple):
        parts = [shape(item) for item in message]
    else:
        parts = message
    return type(message), parts


@settings(max_examples=60, deadline=None)
@given(message=MESSAGES)
def test_what_was_sent_is_what_arrives(message):
    """Plain containers are copied structurally: equal values of equal types arrive."""
    (received,) = exchange(message)
    assert shape(received) == shape(message)


@pytest.mark.parametrize(
    "message",
    [
        lambda: None,
        nothing,
        threading.Lock(),
        (n for n in range(3)),
        math,
        {"callback": nothing},
        [threading.Lock()],
        np.array([object()], dtype=object),
    ],
    ids=lambda message: type(message).__name__,
)
def test_what_cannot_be_snapshotted_is_a_clear_error(make, message):
    """What cannot be snapshotted is an error that names the topic and the type."""
    sched = make()
    with pytest.raises(TopicError, match="'topic'") as refused:
        sched.publish("topic", message)
    assert type(message).__name__ in str(refused.value)


def test_a_message_that_contains_itself_is_refused(make):
    """A message that contains itself is refused, not endlessly copied."""
    loop: list = []
    loop.append(loop)
    with pytest.raises(TopicError, match="contains itself"):
        make().publish("topic", loop)


def test_none_is_not_a_message(make):
    """None cannot be sent: it is what recv() returns when there is nothing."""
    with pytest.raises(TopicError, match=r"'topic'.*None"):
        make().publish("topic", None)


# -- types -------------------------------------------------------------------------------------


def test_declared_types_are_checked_for_applications_as_well(make):
    """Declared types are checked at send, whoever sends."""
    sched = make()
    sched.add(Node("reader", nothing, subs=[Sub("count", int)]))
    sched.publish("count", 5)
    with pytest.raises(TopicError, match=r"'count' carries int.*str"):
        sched.publish("count", "five")


def test_an_int_is_a_fine_float(make):
    """A topic of floats takes whole numbers too."""
    sched = make()
    sched.add(Node("reader", nothing, subs=[Sub("speed", float)]))
    sched.publish("speed", 1)
    sched.publish("speed", 1.5)
    with pytest.raises(TopicError, match="speed"):
        sched.publish("speed", "fast")


def test_two_types_for_one_topic_are_refused_where_the_second_is_declared(make):
    """All who declare a type for a topic must name the same."""
    sched = make()
    sched.add(Node("a", nothing, pubs=[Pub("x", int)]))
    with pytest.raises(ConfigError, match=r"'x'.*int.*b"):
        sched.add(Node("b", nothing, subs=[Sub("x", str)]))
    assert sched.get_node_names() == ["a"]


# -- many threads ------------------------------------------------------------------------------


@pytest.mark.realtime
def test_messages_between_threads_are_complete_and_in_order(make, loop):
    """From an Rt thread to a Compute thread: nothing is lost, doubled or reordered."""
    received = []
    sent = [0]
    sched = make(loop=loop)

    def send(node):
        for _ in range(5):
            node.send("x", {"n": sent[0], "data": [sent[0]] * 10})
            sent[0] += 1

    def receive(node):
        received.extend(node.recv_all("x"))

    sched.add(Node("rt", send, rate=200, pubs=["x"]))
    sched.add(Node("compute", receive, rate=50, compute=True, subs=["x"]))

    run_until(sched, lambda: len(received) >= 100)

    assert [message["n"] for message in received] == list(range(len(received)))
    assert all(message["data"] == [message["n"]] * 10 for message in received)
