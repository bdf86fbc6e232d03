"""A plain statement when a node runs slower than asked."""

from __future__ import annotations

import asyncio
import time

import pytest

from horus import Node, ms

from .helpers import node_of

pytestmark = pytest.mark.realtime


def statements(caplog) -> list[str]:
    return [r.getMessage() for r in caplog.records if "asked for" in r.getMessage()]


@pytest.mark.parametrize("kind", ["Rt", "AsyncIo", "Compute"])
def test_a_node_whose_tick_is_too_long_is_told_so(make, kind, caplog):
    """A 50 Hz node whose tick takes 30 ms: the rate it reaches, the rate it was given, and why."""

    async def doze(node):
        await asyncio.sleep(30 * ms)

    sched = make()
    sched.add(
        node_of(kind, "camera", doze if kind == "AsyncIo" else lambda n: time.sleep(0.03), rate=50)
    )
    sched.run(duration=3.2)

    told = statements(caplog)
    assert told, "nothing was said in three seconds"
    assert "camera" in told[0]
    assert "asked for 50 Hz" in told[0]
    assert "a tick takes" in told[0]
    assert len(told) <= 2, "it is said ever more rarely"


def test_a_node_that_waits_for_another_is_told_that_it_gets_to_run_too_late(make, caplog):
    """A BestEffort node behind one that takes 100 ms each time."""
    sched = make()
    sched.add(Node("slow", lambda node: time.sleep(0.1), order=0))
    sched.add(Node("quick", lambda node: None, order=1))
    sched.run(duration=2.5)

    told = [line for line in statements(caplog) if "quick" in line]
    assert told
    assert "too late" in told[0]


def test_a_node_that_keeps_its_rate_is_not_mentioned(make, caplog):
    """Healthy nodes, also slow ones, also such that skip on purpose."""
    sched = make()
    sched.add(Node("motor", lambda node: None, rate=100))
    sched.add(Node("camera", lambda node: None, rate=2))
    sched.add(Node("skips", lambda node: time.sleep(0.015), rate=100, on_miss="skip"))
    sched.run(duration=2.5)
    assert statements(caplog) == []
