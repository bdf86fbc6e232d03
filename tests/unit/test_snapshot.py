"""Messages are isolated and exact."""

from __future__ import annotations

import array
import collections
import copy
import dataclasses
import datetime
import decimal
import enum
import math
import threading
from pathlib import PurePosixPath
from typing import Any, NamedTuple

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from horus.snapshot import UnsendableError, freeze

atoms = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.complex_numbers(),
    st.text(max_size=8),
    st.binary(max_size=8),
    st.datetimes(),
    st.decimals(),
)
hashables = st.one_of(st.integers(), st.text(max_size=4), st.booleans())
messages = st.recursive(
    st.one_of(atoms, st.lists(st.floats(), min_size=10, max_size=40)),
    lambda inner: st.one_of(
        st.lists(inner, max_size=5),
        st.tuples(inner, inner),
        st.dictionaries(hashables, inner, max_size=5),
        st.sets(hashables, max_size=5),
        st.binary(max_size=5).map(bytearray),
    ),
    max_leaves=20,
)


def received(message: Any) -> Any:
    payload, thaw = freeze(message)
    return payload if thaw is None else thaw(payload)


def shape(value: Any) -> Any:
    """Return something comparable that tells types apart, and NaN from NaN not."""
    if isinstance(value, dict):
        return ("dict", [(shape(k), shape(v)) for k, v in value.items()])
    if isinstance(value, list | tuple):
        return (type(value), [shape(item) for item in value])
    if isinstance(value, set):
        return ("set", sorted(map(repr, value)))
    return (type(value), repr(value))


@given(messages)
def test_what_arrives_is_what_was_sent(message: Any) -> None:
    """Every value arrives equal and of the same type: tuples stay tuples, inf and nan survive."""
    assert shape(received(message)) == shape(message)


def scramble(value: Any) -> None:
    """Change a value as deeply as it can be changed."""
    if isinstance(value, dict):
        for item in list(value.values()):
            scramble(item)
        value["scrambled"] = True
    elif isinstance(value, list):
        for item in value:
            scramble(item)
        value.append("scrambled")
    elif isinstance(value, tuple):
        for item in value:
            scramble(item)
    elif isinstance(value, set):
        value.add("scrambled")
    elif isinstance(value, bytearray):
        value.extend(b"scrambled")


@given(messages)
def test_later_changes_are_never_seen(message: Any) -> None:
    """Neither the publisher nor another receiver can change what a receiver gets."""
    expected = shape(message)
    payload, thaw = freeze(message)
    first = payload if thaw is None else thaw(payload)
    scramble(message)
    assert shape(first) == expected
    scramble(first)
    second = payload if thaw is None else thaw(payload)
    assert shape(second) == expected


class Colour(enum.Enum):
    RED = 1


class Point(NamedTuple):
    x: float
    tags: list[str]


@dataclasses.dataclass
class Pose:
    x: float
    history: list[float] = dataclasses.field(default_factory=list)


@dataclasses.dataclass(slots=True)
class Slotted:
    values: dict[str, float]


@dataclasses.dataclass(frozen=True)
class Fixed:
    x: float


class Scan(msgspec.Struct):
    ranges: list[float]


class FixedScan(msgspec.Struct, frozen=True):
    angle: float


@pytest.mark.parametrize(
    "message",
    [
        Point(1.0, ["a"]),
        Pose(1.0, [2.0]),
        Slotted({"a": 1.0}),
        Scan([1.0, math.inf]),
        collections.OrderedDict(a=[1]),
        collections.defaultdict(list, a=[1]),
        collections.deque([[1]], maxlen=3),
        array.array("d", [1.0]),
        {"nested": Pose(0.0, [1.0])},
        [Scan([0.0] * 20)],
    ],
    ids=lambda message: type(message).__name__,
)
def test_mutable_kinds_are_copied(message: Any) -> None:
    """Classes, structs and the library's containers arrive as copies, down to the bottom."""
    before = copy.deepcopy(message)
    payload, thaw = freeze(message)
    assert thaw is not None or isinstance(message, tuple)
    one, two = (payload if thaw is None else thaw(payload) for _ in range(2))
    assert type(one) is type(message)
    assert one == before
    assert one is not message
    assert one is not two
    for inner in ("tags", "history", "values", "ranges"):
        if hasattr(one, inner):
            assert getattr(one, inner) is not getattr(two, inner)
            assert getattr(one, inner) is not getattr(message, inner)


@pytest.mark.parametrize(
    "message",
    [
        1.5,
        "text",
        b"bytes",
        (1, "a", (2.0,)),
        frozenset({1}),
        Colour.RED,
        Fixed(1.0),
        FixedScan(0.1),
        datetime.timedelta(seconds=1),
        decimal.Decimal("0.1"),
        PurePosixPath("a"),
        np.float64(1.0),
        np.int32(3),
    ],
    ids=lambda message: type(message).__name__,
)
def test_immutable_kinds_pass_by_reference(message: Any) -> None:
    """What nobody can change is not copied."""
    assert freeze(message) == (message, None)
    assert freeze(message)[0] is message


def test_arrays_are_copied_once_and_arrive_read_only() -> None:
    """A NumPy array arrives as it was when it was sent, and cannot be written."""
    image = np.arange(6.0).reshape(2, 3)
    payload, thaw = freeze({"image": image})
    image[:] = 0
    one = thaw(payload)["image"]
    assert one.tolist() == [[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]]
    two = thaw(payload)["image"]
    assert np.shares_memory(one, two)
    with pytest.raises(ValueError, match="read-only"):
        one[0, 0] = 1.0
    with pytest.raises(ValueError, match="WRITEABLE"):
        one.flags.writeable = True
    # Each receiver has its own: shape and flags can be changed in place.
    assert one is not two


def test_a_view_does_not_keep_its_base() -> None:
    """Sending a slice of a large array copies the slice, not the array."""
    payload, _ = freeze(np.zeros(1_000_000)[:3])
    assert payload.base is None
    assert payload.nbytes == 24


@dataclasses.dataclass(frozen=True)
class FixedScanOf:
    ranges: Any


class FixedStructOf(msgspec.Struct, frozen=True):
    ranges: Any


class Key:
    """Hashable by identity, as every plain class is, and anything but immutable."""

    def __init__(self) -> None:
        self.notes: list[str] = []

    def __deepcopy__(self, memo: Any) -> Key:
        fresh = Key()
        fresh.notes = list(self.notes)
        return fresh


@pytest.mark.parametrize(
    ("message", "inner"),
    [
        (FixedScanOf([1.0]), lambda m: m.ranges),
        (FixedStructOf({"a": [1.0]}), lambda m: m.ranges["a"]),
        ({Key(): 1}, lambda m: next(iter(m)).notes),
        ({1, Key()}, lambda m: next(k for k in m if isinstance(k, Key)).notes),
        (frozenset({Key()}), lambda m: next(iter(m)).notes),
        ((1, {"a": (2, [3])}), lambda m: m[1]["a"][1]),
    ],
    ids=["dataclass", "struct", "key", "set", "frozenset", "tuple"],
)
def test_frozen_outside_does_not_mean_frozen_inside(message: Any, inner: Any) -> None:
    """A mutable part of an immutable-looking message is isolated all the same."""
    payload, thaw = freeze(message)
    assert thaw is not None
    one, two = thaw(payload), thaw(payload)
    inner(one).append("changed")
    inner(message).append("changed")
    assert "changed" not in inner(two)
    assert "changed" not in inner(thaw(payload))


def test_attributes_that_are_no_fields_are_isolated() -> None:
    """What `__post_init__` adds to a dataclass belongs to the message, too."""
    pose = Pose(1.0)
    pose.extra = [1]  # type: ignore[attr-defined]
    one, two = received(pose), received(pose)
    one.extra.append(2)
    assert pose.extra == two.extra == [1]  # type: ignore[attr-defined]


def test_structured_scalars_do_not_share_the_sender_s_memory() -> None:
    """A record taken from a structured array is a view of it, and is copied."""
    table = np.zeros(2, dtype=[("x", "f8")])
    record = received(table[0])
    table["x"] = 7.0
    assert record["x"] == 0.0


def test_shared_parts_do_not_cost_time_without_end() -> None:
    """A structure that refers to the same part again and again is copied in reasonable time."""
    shared: list[Any] = [1.0]
    for _ in range(40):
        shared = [shared, shared]
    payload, thaw = freeze(shared)
    assert thaw is not None
    assert type(thaw(payload)[0][0]) is list


def test_an_error_says_where() -> None:
    """The path to what cannot be sent is part of the error."""
    with pytest.raises(UnsendableError) as caught:
        freeze({"map": {"cells": [1, threading.Lock()]}})
    assert caught.value.path == "['map']['cells'][1]"


@pytest.mark.parametrize("inner", [np.float64(1.0), True, 1, "x"], ids=repr)
def test_a_long_list_of_almost_only_floats_is_still_exact(inner: Any) -> None:
    """The shortcut for scans takes nothing for a float that is not one."""
    message = [0.5] * 20 + [inner] + [0.5] * 20
    assert [type(item) for item in received(message)] == [type(item) for item in message]


@pytest.mark.parametrize(
    "message",
    [
        lambda: None,
        print,
        threading.Lock(),
        math,
        (item for item in []),
        int,
        np.array([object()]),
        {"deep": [threading.Lock()]},
    ],
    ids=["function", "builtin", "lock", "module", "generator", "class", "objects", "nested"],
)
def test_code_and_resources_are_refused(message: Any) -> None:
    """What cannot be isolated is an error that says what it is."""
    with pytest.raises(UnsendableError):
        freeze(message)


def test_a_message_that_contains_itself_is_refused() -> None:
    """Endless messages end in an error, not in a hang."""
    endless: list[Any] = []
    endless.append(endless)
    with pytest.raises(UnsendableError, match="contains itself"):
        freeze(endless)
