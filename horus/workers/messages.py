"""What a scheduler and a worker say to each other.

The scheduler sends a `Place` and a `Setup` first, and then `Call`s, one at a time. The
worker answers the setup and each call with a `Done`; in between come, in their order,
whatever the callback does: a message it `Sent`, a line it `Logged`, a stop it asks for, a
question.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from horus.clock import Moment, Position
from horus.snapshot import Frozen, lengthen, shorten

Inputs = Sequence[tuple[str, Sequence[Frozen]]]
"""What has arrived since the last call: topics with their messages, oldest first."""


class Place(NamedTuple):
    """Where a worker lives: what it needs to understand the rest."""

    parent: int
    """The scheduler's process."""
    path: Sequence[str]
    """Its `sys.path`."""
    cores: Sequence[int] | None
    """Where to run; None for anywhere."""


class Setup(NamedTuple):
    """What a worker is to run."""

    levels: Mapping[str, int]
    """From which level on loggers are listened to."""
    timeline: tuple[float, int]
    """Its tick rate [Hz], and the offset of its wall time [ns]."""
    parcel: bytes
    """The node; see `pickling.pack`."""
    types: Mapping[str, type]
    """The types that topics have been declared with."""
    newest: Mapping[str, bytes | None]
    """The newest message of each topic that the node receives, pickled: each may be lost alone."""


class Call(NamedTuple):
    """Run a callback."""

    phase: str
    moment: Moment
    inputs: Inputs = ()


class Done(NamedTuple):
    """The setup or the callback is through, or has raised `error` (see `pickling.pack_error`)."""

    error: bytes | None
    queues: Sequence[tuple[str, int, int]]
    """Topics with how many messages were received of them in all, and how many wait."""
    understood: bool = True
    """Whether the call could be read; if not, nothing was run."""


class Sent(NamedTuple):
    """The callback has sent a message, isolated already."""

    topic: str
    message: Frozen


class Logged(NamedTuple):
    """The callback has logged something; the fields of its record."""

    record: Mapping[str, Any]


class Stop(NamedTuple):
    """The callback asks for an ordered stop."""

    reason: str


class Open(NamedTuple):
    """The callback receives from a topic it did not declare; the answer is its newest message."""

    topic: str


class Fetch(NamedTuple):
    """The worker does not know something of `__main__`; the answer is that, by value."""

    name: str


class Answer(NamedTuple):
    """What was asked for, pickled, or why it cannot be had (see `pickling.pack_error`)."""

    error: bytes | None
    content: bytes | None


_KINDS = (Call, Done, Sent, Logged, Stop, Open, Fetch)
_NUMBERS = {kind: number for number, kind in enumerate(_KINDS)}


def to_plain(message: Any) -> tuple[Any, ...]:
    """Return a message as a tuple, without classes of ours.

    A class is pickled by its name. To look for it takes longer than everything else about a small
    message, a hundred microseconds in a worker that has slept since its last tick.
    """
    fields: tuple[Any, ...] = message
    match message:
        case Call(phase, moment, inputs):
            position, *rest = moment
            short = [(topic, list(map(shorten, arrived))) for topic, arrived in inputs]
            fields = (phase, (tuple(position), *rest), short)
        case Sent(topic, frozen):
            fields = (topic, shorten(frozen))
    return (_NUMBERS[type(message)], *fields)


def from_plain(plain: tuple[Any, ...]) -> Any:
    """Return the message that `to_plain` was given."""
    number, *fields = plain
    kind = _KINDS[number]
    if kind is Call:
        phase, (position, *rest), short = fields
        inputs = [(topic, list(map(lengthen, arrived))) for topic, arrived in short]
        return Call(phase, Moment(Position(*position), *rest), inputs)
    if kind is Sent:
        topic, short = fields
        return Sent(topic, lengthen(short))
    return kind(*fields)
