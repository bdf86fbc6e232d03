"""Compares two recordings: where does the second one take another course?"""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import msgspec

from horus.errors import RecordingError
from horus.recording import encoding
from horus.recording.reader import RecordedMessage, set_of_names
from horus.recording.recovery import open_recording
from horus.snapshot import attributes, slots_of


@dataclass(frozen=True, slots=True)
class Divergence:
    """The first message in which two recordings differ."""

    tick: int
    """The scheduler's cycle in which it was sent; of the earlier one if those differ."""
    topic: str
    publisher: str
    sequence: int
    """Which message of this publisher on this topic it is, counted from 1."""
    field: str
    """Where in the message, such as `.pose[2]`; `(missing)` and `(tick)` if not in it."""
    a: Any
    """What the first recording has there; None if the message is missing."""
    b: Any
    """What the second recording has there."""

    def __str__(self) -> str:
        """Return it in words."""
        where = f"tick {self.tick}, topic {self.topic!r}, message {self.sequence}"
        return (
            f"{where} of {self.publisher!r}, {self.field or 'all of it'}: {self.a!r} != {self.b!r}"
        )


Messages = dict[tuple[str, str], list[RecordedMessage]]


def diff(
    a: str | os.PathLike[str],
    b: str | os.PathLike[str],
    *,
    topics: Iterable[str] | None = None,
    classes: Iterable[type] = (),
) -> Divergence | None:
    """Return the first message in which two recordings differ; None if there is none.

    The n-th message of a node on a topic in `a` is compared with the n-th in `b`; when it
    was sent counts only if both recordings are deterministic. The first is the one with
    the lowest tick.

    Args:
        a: A recording.
        b: Another one.
        topics: Compare only these; None for all.
        classes: As for `Scheduler.replay_from`; only to name the field.

    Raises:
        ConfigError: `topics` is no collection of names.
        RecordingError: One is no recording, or damaged; neither has messages on such a topic.
    """
    wanted = set_of_names("topics", topics)
    one, one_deterministic = _messages(a)
    two, two_deterministic = _messages(b)
    known_topics = {topic for topic, _ in {**one, **two}}
    for topic in sorted(wanted or ()):
        if topic not in known_topics:
            there_are = ", ".join(sorted(known_topics)) or "none"
            raise RecordingError(
                f"neither {a} nor {b} has messages on topic {topic!r}; there are: {there_are}"
            )
    known = {encoding.name_of(kind): kind for kind in classes}
    exact = one_deterministic and two_deterministic
    found = (
        divergence
        for key in {**one, **two}
        if wanted is None or key[0] in wanted
        if (divergence := _compare(one.get(key, []), two.get(key, []), exact, known)) is not None
    )
    return min(found, key=lambda each: each.tick, default=None)


def _messages(path: str | os.PathLike[str]) -> tuple[Messages, bool]:
    messages: Messages = defaultdict(list)
    with open_recording(path) as reader:
        for message in reader.messages():
            messages[message.topic, message.publisher].append(message)
        return dict(messages), bool(reader.about["deterministic"])


def _compare(
    one: list[RecordedMessage],
    two: list[RecordedMessage],
    exact: bool,
    classes: encoding.Classes,
) -> Divergence | None:
    for a, b in zip(one, two, strict=False):
        if a.data != b.data:
            field, value_a, value_b = _where(a, b, classes)
        elif exact and a.cycle != b.cycle:
            field, value_a, value_b = "(tick)", a.cycle, b.cycle
        else:
            continue
        cycle = min(a.cycle, b.cycle)
        return Divergence(cycle, a.topic, a.publisher, a.sequence, field, value_a, value_b)
    common = min(len(one), len(two))
    if len(one) == len(two):
        return None
    extra = one[common] if len(one) > common else two[common]
    value = _readable(extra, classes)
    pair = (value, None) if len(one) > common else (None, value)
    return Divergence(extra.cycle, extra.topic, extra.publisher, extra.sequence, "(missing)", *pair)


def _where(
    a: RecordedMessage, b: RecordedMessage, classes: encoding.Classes
) -> tuple[str, Any, Any]:
    one, two = _readable(a, classes), _readable(b, classes)
    return next(_differences("", one, two), ("", one, two))


def _readable(message: RecordedMessage, classes: encoding.Classes) -> Any:
    try:
        return message.message(classes)
    except RecordingError:  # of a class that is not there
        return msgspec.msgpack.decode(message.data)


def _differences(path: str, a: Any, b: Any) -> Iterator[tuple[str, Any, Any]]:
    """Yield the places in which two values differ."""
    if type(a) is not type(b):
        yield path, a, b
    elif isinstance(a, dict):
        for key in {**a, **b}:
            at = f"{path}.{key}" if isinstance(key, str) else f"{path}[{key!r}]"
            if key in a and key in b:
                yield from _differences(at, a[key], b[key])
            else:
                yield at, a.get(key), b.get(key)
    elif isinstance(a, list | tuple):
        for index, (one, two) in enumerate(zip(a, b, strict=False)):
            yield from _differences(f"{path}[{index}]", one, two)
        if len(a) != len(b):
            yield f"{path} (length)", len(a), len(b)
    elif hasattr(a, "tobytes") and hasattr(a, "shape") and a.shape and a.dtype == b.dtype:
        yield from _differences_of_arrays(path, a, b)
    elif isinstance(a, msgspec.Struct):
        for name in a.__struct_fields__:
            yield from _differences(f"{path}.{name}", getattr(a, name), getattr(b, name))
    elif hasattr(a, "__dict__") or getattr(a, "__slots__", None):
        slots = slots_of(type(a))
        yield from _differences(path, dict(attributes(slots, a)), dict(attributes(slots, b)))
    elif encoding.encode(a) != encoding.encode(b):  # as nan equals nan here
        yield path, a, b


def _differences_of_arrays(path: str, a: Any, b: Any) -> Iterator[tuple[str, Any, Any]]:
    if a.shape != b.shape:
        yield f"{path} (shape)", a.shape, b.shape
        return
    for index, (one, two) in enumerate(zip(a.flat, b.flat, strict=True)):
        if one.tobytes() != two.tobytes():
            place = ", ".join(str(each) for each in _unravel(index, a.shape))
            yield f"{path}[{place}]", one, two


def _unravel(index: int, shape: tuple[int, ...]) -> list[int]:
    place: list[int] = []
    for size in reversed(shape):
        index, rest = divmod(index, size)
        place.insert(0, rest)
    return place
