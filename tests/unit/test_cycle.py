"""The main loop, without a loop: when it asks to be woken."""

from __future__ import annotations

from unittest.mock import Mock

import pytest

from horus import Node
from horus.clock import SimClock, Timeline
from horus.live import LiveNode
from horus.loop import cycle as module
from horus.loop.control import RunControl
from horus.loop.cycle import GIVE_WAY_NS, Cycle

PERIOD_NS = 100_000_000


@pytest.mark.parametrize(
    ("gives_way", "end_ns", "woken_at_ns"),
    [
        (False, 10 * PERIOD_NS, PERIOD_NS),
        (True, 10 * PERIOD_NS, PERIOD_NS + GIVE_WAY_NS),
        (True, PERIOD_NS + 1, PERIOD_NS),
    ],
    ids=["alone", "beside Rt nodes", "just before the end"],
)
def test_the_loop_gives_way_to_rt_nodes(
    monkeypatch: pytest.MonkeyPatch, gives_way: bool, end_ns: int, woken_at_ns: int
) -> None:
    """But no release is lost to it at the end of the run."""
    ticker = Mock()
    monkeypatch.setattr(module, "Ticker", Mock(return_value=ticker))
    timeline = Timeline(SimClock(), 1000.0)
    timeline.begin(0, end_ns)
    control = RunControl(None, lambda live, lasted_ns: None)
    live = LiveNode(Node("logger", lambda: None, rate=10), timeline, control, 0)
    cycle = Cycle(Mock(), timeline)
    cycle.gives_way = gives_way

    cycle.add(live, Mock(), 1)

    ticker.arm.assert_called_once_with(woken_at_ns)
