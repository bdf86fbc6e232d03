"""What executors decide, without a run."""

from __future__ import annotations

import time
from unittest.mock import MagicMock, Mock

import pytest

from horus import Node
from horus.clock import MonotonicClock, SimClock, Timeline
from horus.executors.compute import ComputeExecutor
from horus.executors.event import ThreadEventExecutor
from horus.executors.rt import RtExecutor, RtThread
from horus.live import LiveNode
from horus.loop.control import RunControl
from horus.units import NS_PER_S

NOTHING_DUE = Mock(due_ns=Mock(return_value=None))


@pytest.mark.parametrize(
    "executor",
    [
        RtExecutor(Mock(), Mock(), Mock()),
        ThreadEventExecutor(Mock()),
        ComputeExecutor(Mock(), NOTHING_DUE, Mock()),
    ],
    ids=["Rt", "Event", "Compute"],
)
def test_a_dismissed_node_owes_nothing(executor):
    """It looks at its own pace, and another thread may have dismissed the node meanwhile."""
    gone = Mock()

    assert executor.due_ns(gone, 10**9) is None
    assert executor.thread_id(gone) is None
    executor.isolate(gone)


def test_the_baton_wakes_only_those_whose_turn_it_is():
    """A tracker at 100 Hz sleeps through nine of ten ticks of the safety monitor at 1 kHz."""
    control = RunControl(None, lambda live, lasted_ns: None)
    timeline = Timeline(SimClock(), 1000.0)
    wake_loop = Mock()
    safety, tracker = (
        RtThread(
            LiveNode(Node(name, lambda: None, rate=1000), timeline, control, place),
            Mock(spin_ns=0),
            wake_loop,
        )
        for place, name in enumerate(("safety", "tracker"))
    )
    tracker.engage(10_000_000)
    tracker.park(0)
    safety._waiting.append(tracker)

    safety._pass_baton(9_000_000)
    assert not tracker.park(0)
    safety._pass_baton(10_000_000)
    assert tracker.park(0)
    assert not safety._waiting
    wake_loop.assert_not_called()

    safety.loop_waits_for_ns = 12_000_000
    safety._pass_baton(11_000_000)
    wake_loop.assert_not_called()
    safety._pass_baton(12_000_000)
    safety._pass_baton(13_000_000)
    wake_loop.assert_called_once_with()


def test_who_waits_for_an_rt_node_owes_its_tick_from_the_end_of_the_wait():
    """Not from its latest start; and what it waits with says nothing about a tick in progress."""
    clock = SimClock()
    timeline = Timeline(clock, 1000.0)
    control = RunControl(None, lambda live, lasted_ns: None)
    motor, cloud = (
        LiveNode(Node(name, lambda: None, rate=rate, order=order), timeline, control, order)
        for order, (name, rate) in enumerate((("motor", 1000), ("cloud", 20)))
    )
    thread = RtThread(motor, Mock(spin_ns=0), Mock())
    thread.engage(0)
    executor = RtExecutor(Mock(), Mock(), Mock())
    executor._in_order = [thread]
    release_ns = 50_000_000

    clock.advance_to(release_ns)
    until_ns = executor._hold_up(cloud, release_ns, release_ns)
    assert until_ns is not None
    assert until_ns == cloud.owed_from_ns > release_ns

    thread._pass_baton(release_ns)
    assert executor._hold_up(cloud, release_ns, release_ns + 100) is None
    assert cloud.owed_from_ns == release_ns + 100

    cloud.tick_context.start_ns = release_ns + 100
    cloud.tick_context.ticking = True
    assert executor._hold_up(cloud, 2 * release_ns, 2 * release_ns) is not None
    assert cloud.owed_from_ns == release_ns + 100


def test_a_thread_held_up_on_its_way_to_sleep_does_not_oversleep():
    """What others compute between its look at the clock and its sleep does not make it late."""
    timeline = Timeline(MonotonicClock(), 1.0)
    control = RunControl(None, lambda live, lasted_ns: None)
    motor = RtThread(
        LiveNode(Node("motor", lambda: None, rate=1), timeline, control, 0), Mock(spin_ns=0), Mock()
    )
    began_ns = timeline.now_ns()
    motor.engage(began_ns + 1)
    motor.park(0)

    def hold_up():
        time.sleep(1.1)
        return iter(())

    motor._awaited = MagicMock(__iter__=Mock(side_effect=hold_up))
    motor.idle()
    assert timeline.now_ns() - began_ns < 1.6 * NS_PER_S
