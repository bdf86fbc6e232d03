"""The main loop, without a loop: when it asks to be woken."""

from __future__ import annotations

from unittest.mock import Mock

import pytest

from horus import Node
from horus.clock import SimClock, Timeline
from horus.live import LiveNode
from horus.loop import cycle as module
from horus.loop.control import RunControl
from horus.loop.cycle import GIVE_WAY_NS, Cycle, HoldUp

PERIOD_NS = 100_000_000


def free(live: LiveNode, release_ns: int, now_ns: int) -> None:
    """Hold nobody up."""


@pytest.mark.parametrize(
    ("hold_up", "end_ns", "woken_at_ns"),
    [
        (None, 10 * PERIOD_NS, PERIOD_NS),
        (free, 10 * PERIOD_NS, PERIOD_NS + GIVE_WAY_NS),
        (free, PERIOD_NS + 1, PERIOD_NS),
    ],
    ids=["alone", "beside Rt nodes", "just before the end"],
)
def test_the_loop_gives_way_to_rt_nodes(
    monkeypatch: pytest.MonkeyPatch, hold_up: HoldUp | None, end_ns: int, woken_at_ns: int
) -> None:
    """But no release is lost to it at the end of the run."""
    ticker = Mock()
    monkeypatch.setattr(module, "Ticker", Mock(return_value=ticker))
    timeline = Timeline(SimClock(), 1000.0)
    timeline.begin(0, end_ns)
    control = RunControl(None, lambda live, lasted_ns: None)
    live = LiveNode(Node("logger", lambda: None, rate=10), timeline, control, 0)
    cycle = Cycle(Mock(), timeline)
    cycle.hold_up = hold_up

    cycle.add(live, Mock(), 1)

    ticker.arm.assert_called_once_with(woken_at_ns)


def test_who_is_held_up_is_due_still_while_others_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """Until it is free, or late: then it runs for the same release, once."""
    ticker = Mock()
    monkeypatch.setattr(module, "Ticker", Mock(return_value=ticker))
    clock = SimClock()
    timeline = Timeline(clock, 1000.0)
    timeline.begin(0)
    control = RunControl(None, lambda live, lasted_ns: None)
    logger = LiveNode(Node("logger", lambda: None, rate=10), timeline, control, 0)
    other = LiveNode(Node("other", lambda: None, rate=10), timeline, control, 1)
    until_ns: int | None = PERIOD_NS + 5
    cycle = Cycle(Mock(), timeline)
    cycle.hold_up = lambda live, release_ns, now_ns: until_ns if live is logger else None
    run: list[tuple[LiveNode, int]] = []
    for live in (logger, other):
        cycle.add(live, lambda live, release_ns: run.append((live, release_ns)), 1)

    clock.advance_to(PERIOD_NS + 1)
    cycle.run_due()
    assert run == [(other, PERIOD_NS)]
    assert ticker.arm.call_args.args == (PERIOD_NS + 5,)
    assert cycle.due_ns(logger, PERIOD_NS + 1) == PERIOD_NS

    until_ns = None
    cycle.run_due()
    cycle.run_due()
    assert run == [(other, PERIOD_NS), (logger, PERIOD_NS)]
    assert ticker.arm.call_args.args == (2 * PERIOD_NS + GIVE_WAY_NS,)


def test_who_leaves_while_it_is_held_up_does_not_come_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """Another node's tick may remove it."""
    monkeypatch.setattr(module, "Ticker", Mock())
    clock = SimClock()
    timeline = Timeline(clock, 1000.0)
    timeline.begin(0)
    control = RunControl(None, lambda live, lasted_ns: None)
    logger = LiveNode(Node("logger", lambda: None, rate=10), timeline, control, 0)
    other = LiveNode(Node("other", lambda: None, rate=10), timeline, control, 1)
    cycle = Cycle(Mock(), timeline)
    cycle.hold_up = lambda live, release_ns, now_ns: PERIOD_NS + 5 if live is logger else None
    cycle.add(logger, Mock(), 1)
    cycle.add(other, lambda live, release_ns: cycle.remove(logger), 1)

    clock.advance_to(PERIOD_NS + 1)
    cycle.run_due()

    assert cycle.due_ns(logger, PERIOD_NS + 1) is None
