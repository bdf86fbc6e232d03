"""What a scheduler and a worker say to each other, as it is pickled."""

from __future__ import annotations

import io
import pickle
from typing import Any

import pytest

from horus.clock import Moment, Position
from horus.snapshot import freeze
from horus.workers import messages

MOMENT = Moment(
    position=Position(epoch_ns=1, first_cycle=2, paused_at=None, started_ns=3),
    ticking=True,
    release_ns=4,
    start_ns=5,
    previous_ns=6,
    budget_ns=None,
    nominal_dt_s=0.1,
    ticks=7,
)
PAYLOADS = [None, 1.5, "text", {"x": 1.5}, [1.5, 2.5], (1, [2]), {"deep": [{"er": 1}]}]
SAID = [
    messages.Call("tick", MOMENT),
    messages.Call("tick", MOMENT, [("scan", [freeze(payload) for payload in PAYLOADS])]),
    messages.Done(None, [("scan", 3, 1)]),
    messages.Done(b"error", ()),
    *(messages.Sent("scan", freeze(payload)) for payload in PAYLOADS),
    messages.Logged({"name": "horus", "msg": "text"}),
    messages.Stop("enough"),
    messages.Open("scan"),
    messages.Fetch("Map"),
]


def thawed(message: Any) -> Any:
    """Return a message with its frozen values as receivers see them: how they are copied, too."""
    match message:
        case messages.Call(phase, moment, inputs):
            return phase, moment, [(topic, [*map(take, frozen)]) for topic, frozen in inputs]
        case messages.Sent(topic, frozen):
            return topic, take(frozen)
    return message


def take(frozen: Any) -> tuple[Any, bool]:
    payload, thaw = frozen
    fresh = payload if thaw is None else thaw(payload)
    return fresh, fresh is payload


@pytest.mark.parametrize("message", SAID, ids=lambda message: type(message).__name__)
def test_what_is_said_is_heard(message: Any) -> None:
    """The kind of message, its fields, and how receivers copy what was sent."""
    heard = messages.from_plain(pickle.loads(pickle.dumps(messages.to_plain(message), 5)))
    assert type(heard) is type(message)
    assert thawed(heard) == thawed(message)
    if isinstance(message, messages.Call):
        assert type(heard.moment) is Moment
        assert type(heard.moment.position) is Position


@pytest.mark.parametrize(
    "message",
    [
        messages.Call("tick", MOMENT, [("pose", [freeze({"x": 1.5}), freeze([1.5]), freeze(1.5)])]),
        messages.Sent("pose", freeze({"x": 1.5})),
        messages.Done(None, [("pose", 3, 0)]),
    ],
    ids=["call", "sent", "done"],
)
def test_nothing_is_looked_up_by_name_for_plain_messages(message: Any) -> None:
    """Names are what takes time."""

    class Unpickler(pickle.Unpickler):
        def find_class(self, module: str, name: str) -> Any:
            raise AssertionError(f"{module}.{name}")

    Unpickler(io.BytesIO(pickle.dumps(messages.to_plain(message), 5))).load()
