"""Messages as bytes and back: exactly what the bus accepts, and nothing harmful."""

from __future__ import annotations

import collections
import dataclasses
import datetime as dt
import decimal
import enum
import fractions
import math
import pathlib
import pickle
import tempfile
import uuid
import zoneinfo
from typing import Any, NamedTuple

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from horus import Node, Scheduler
from horus.recording import encoding
from horus.recording.encoding import UnrecordableError, decode, encode
from horus.snapshot import freeze


class Pose(NamedTuple):
    x: float
    y: float


@dataclasses.dataclass
class Scan:
    ranges: list[float]
    pose: Pose


@dataclasses.dataclass(frozen=True, slots=True)
class Twist:
    linear: float
    __angular: float = 0.5


class Imu(msgspec.Struct, frozen=True):
    acceleration: tuple[float, float, float]
    frame: str = "base"


class Mode(enum.Enum):
    MANUAL = 1
    AUTO = "auto"


class Fault(enum.Flag):
    MOTOR = enum.auto()
    LIDAR = enum.auto()


class Plain:
    """No dataclass: holds what somebody has put there."""


class Harmful(Plain):
    def __del__(self) -> None:
        """Stands for a class that deletes a file that it holds the name of."""


def same(one: Any, other: Any) -> bool:
    """Return whether two values are of the same types and values, through and through."""
    if type(one) is not type(other):
        return False
    match one:
        case float():
            return math.copysign(1, one) == math.copysign(1, other) and (
                one == other or (math.isnan(one) and math.isnan(other))
            )
        case np.ndarray() | np.generic():
            return one.dtype == other.dtype and bool(
                one.shape == other.shape and one.tobytes() == other.tobytes()
            )
        case dict():
            return same([*one, *one.values()], [*other, *other.values()])
        case list() | tuple() | collections.deque():
            return len(one) == len(other) and all(map(same, one, other))
        case Scan() | Plain():
            return same(vars(one), vars(other))
    return bool(one == other)


ATOMS = (
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text()
    | st.text(st.characters(categories=("Cs", "Lu")))
    | st.binary()
)
KEYS = st.text() | st.integers() | st.tuples(st.integers(), st.text()) | st.binary()
OTHERS = (
    st.complex_numbers(allow_nan=False)
    | st.dates()
    | st.times(timezones=st.just(dt.UTC) | st.none())
    | st.datetimes(timezones=st.none() | st.timezones())
    | st.timedeltas()
    | st.decimals(allow_nan=False)
    | st.fractions()
    | st.uuids()
    | st.binary().map(bytearray)
    | st.builds(Pose, st.floats(allow_nan=False), st.integers())
    | st.builds(Twist, st.floats(allow_nan=False))
    | st.builds(Imu, st.tuples(st.integers()))
    | st.sampled_from(Mode)
    | st.sampled_from([Fault.MOTOR, Fault.MOTOR | Fault.LIDAR, Fault(0)])
    | hnp.arrays(hnp.scalar_dtypes(), hnp.array_shapes(min_dims=0, min_side=0, max_dims=3))
    | st.sets(st.integers() | st.text())
    | st.frozensets(st.integers())
)
MESSAGES = st.recursive(
    ATOMS | OTHERS,
    lambda inner: (
        st.lists(inner)
        | st.lists(inner).map(tuple)
        | st.dictionaries(st.text(), inner)
        | st.dictionaries(KEYS, inner)
        | st.builds(Scan, st.lists(inner), st.just(Pose(1.0, 2.0)))
        | st.lists(inner).map(collections.deque)
    ),
    max_leaves=20,
)


@given(MESSAGES)
def test_every_message_comes_back_as_it_was(message: Any) -> None:
    """Types and values, nan and -0.0 included."""
    assert same(decode(encode(message)), message)


@given(MESSAGES)
def test_what_the_bus_accepts_can_be_recorded(message: Any) -> None:
    """The frozen copy that a recording sees gives a receiver's message."""
    if message is None:
        return
    payload, thaw = freeze(message)
    assert same(decode(encode(payload if thaw is None else thaw(payload))), message)


@settings(max_examples=40, deadline=None)
@given(st.lists(MESSAGES.filter(lambda message: message is not None), min_size=1, max_size=5))
def test_messages_survive_record_and_replay(messages: list[Any]) -> None:
    """A node that is live again receives from a stand-in exactly what the bus had accepted."""
    received: list[Any] = []

    def send(node: Node) -> None:
        for message in messages:
            node.send("topic", message)

    def receive(node: Node) -> None:
        received.extend(node.recv_all("topic"))

    with tempfile.TemporaryDirectory() as directory:
        sched = Scheduler(tick_rate=10, recording=directory, deterministic=True)
        sched.add(Node("sender", send, rate=10, order=0, pubs=["topic"]))
        sched.tick_once()
        (path,) = sched.stop_recording()
        sched.stop()
        replayed = Scheduler.replay_from(path, classes=[Plain])
        replayed.set_replay_speed(math.inf)
        replayed.add(Node("receiver", receive, rate=10, order=1, subs=["topic"]))
        replayed.run()
    assert same(received, messages)


@pytest.mark.parametrize(
    "message",
    [
        2**63,
        -(2**63) - 1,
        2**200,
        [2**64, 1],
        {"a": {"b": (1, [2, (3,)])}},
        range(1, 10, 3),
        pathlib.PurePosixPath("/dev/null"),
        pathlib.Path("a"),
        "\ud800",
        {"\ud800": 1},
        decimal.Decimal("NaN"),
        fractions.Fraction(1, 3),
        uuid.UUID(int=7),
        dt.datetime(2026, 10, 25, 2, 30, fold=1, tzinfo=zoneinfo.ZoneInfo("Europe/Berlin")),
        dt.timezone(dt.timedelta(hours=1), "CET") and dt.time(1, tzinfo=dt.timezone.min),
        collections.OrderedDict(b=1, a=2),
        collections.Counter("abca"),
        collections.deque([1, 2], maxlen=2),
        np.float32(1.5),
        np.bool_(True),
        np.datetime64("2026-03-20", "ns"),
        np.arange(6, dtype=">i2").reshape(2, 3).T,
        np.zeros((0, 3)),
        np.array(5.0),
        np.array([(1, 2.5)], dtype=[("id", "<u1"), ("range", "<f4", (2,))]),
        np.array(["a", "bcd"]),
        {(1, 2): "cell", None: 0},
        Twist(1.0),
        Scan([math.inf, math.nan], Pose(-0.0, 1.0)),
    ],
    ids=repr,
)
def test_these_come_back_as_they_were(message: Any) -> None:
    """What random data rarely is."""
    back = decode(encode(message))
    if repr(message) != "Decimal('NaN')":
        assert same(back, message)
    assert repr(back) == repr(message)


def test_a_deque_keeps_its_limit_and_an_array_its_layout() -> None:
    """What equality does not see."""
    assert decode(encode(collections.deque([1], maxlen=3))).maxlen == 3
    columns = decode(encode(np.asfortranarray(np.ones((2, 3)))))
    assert columns.flags.f_contiguous
    assert not columns.flags.writeable
    assert decode(encode(dt.datetime(2026, 10, 25, 2, fold=1))).fold == 1


def test_plain_data_is_plain_messagepack() -> None:
    """Any library reads a scan."""
    scan = {"ranges": [1.0, 2.0], "frame": "lidar", "valid": True, "raw": b"\0"}
    assert encode(scan) == msgspec.msgpack.encode(scan)


def test_a_set_has_the_same_bytes_in_every_process() -> None:
    """Hashes of texts differ from process to process, recordings of one run do not."""
    assert encode({"b", "a", "c"}) == encode({"c", "b", "a"})
    assert list(map(decode, map(encode, ({"b", "a"}, frozenset({1}))))) == [{"a", "b"}, {1}]


@pytest.mark.parametrize(
    "message",
    [object(), iter([1]), np.ma.masked_array([1], [True]), {"a": [Exception("x")]}],
    ids=["object", "iterator", "masked array", "exception"],
)
def test_what_is_not_data_is_refused_by_name(message: Any) -> None:
    """The class and the remedy are in the message."""
    with pytest.raises(UnrecordableError, match=r"a .*; send data, a dataclass"):
        encode(message)


def test_a_plain_object_comes_back_only_if_its_class_is_named() -> None:
    """A file must not choose which of all loaded classes to make objects of."""
    thing = Plain()
    thing.speed = 1.5  # type: ignore[attr-defined]
    data = encode(thing)
    with pytest.raises(ValueError, match="Plain is no dataclass, Struct"):
        decode(data)
    assert same(decode(data, {encoding.name_of(Plain): Plain}), thing)


def test_a_class_that_acts_when_deleted_does_not_come_back() -> None:
    """Its attributes would come from the file."""
    local = dataclasses.dataclass(Harmful)
    data = encode(local())
    with pytest.raises(ValueError, match="Harmful"):
        decode(data)


def test_classes_are_not_imported() -> None:
    """A name in a file must not run a module."""
    data = encode(Twist(1.0)).replace(b"test_encoding", b"antigravityyy")
    with pytest.raises(ValueError, match=r"there is no class .*import it first"):
        decode(data)


def test_pickles_are_only_bytes() -> None:
    """They come back as they are, and nothing looks into them."""
    data = pickle.dumps(Pose(1, 2))
    assert decode(encode(data)) == data
    with pytest.raises(ValueError, match="extension 99 is not known"):
        decode(msgspec.msgpack.encode(msgspec.msgpack.Ext(99, data)))


@given(st.binary())
def test_any_bytes_are_decoded_or_refused(data: bytes) -> None:
    """Whatever a damaged file holds."""
    try:
        decode(data)
    except ValueError:
        pass


@given(MESSAGES, st.data())
def test_damaged_bytes_are_decoded_or_refused(message: Any, draw: st.DataObject) -> None:
    """One byte is another, somewhere."""
    data = bytearray(encode(message))
    place = draw.draw(st.integers(0, len(data) - 1))
    data[place] = draw.draw(st.integers(0, 255))
    try:
        decode(bytes(data))
    except ValueError:
        pass


def test_a_message_nested_without_end_is_refused() -> None:
    """The bus refuses it first; a file could hold one."""
    nested: Any = 1
    for _ in range(100_000):
        nested = [nested]
    with pytest.raises(RecursionError):
        encode(nested)
    with pytest.raises(ValueError, match="Recursion"):
        decode(b"\x91" * 100_000 + b"\x01")
