"""tick_once(): exactly one tick cycle, inline, for tests and simulation."""

from __future__ import annotations

import asyncio
import threading
import time

import pytest

import horus
from horus import ConfigError, Node, Scheduler, StateError, UnknownNodeError, ms

from .helpers import KINDS, TRIGGER, node_of, nothing, run_async


def test_the_example_of_the_contract_counts():
    """tick_once(): init (lazy) and one tick; the count topic has value 1, then 2."""

    def accumulate(node):
        count = node.recv("count") or 0
        node.send("count", count + 1)

    sched = Scheduler(tick_rate=100)
    sched.add(
        Node(name="counter", tick=accumulate, rate=100, order=0, pubs=["count"], subs=["count"])
    )
    count = sched.subscribe("count")

    sched.tick_once()  # Init (lazy) + one tick
    assert count.recv() == 1

    sched.tick_once()  # Second tick
    assert count.recv() == 2


def test_tick_once_executes_exactly_one_tick_cycle_then_returns(make, deterministic, kind):
    """tick_once() executes exactly one tick cycle, then returns, for nodes of every class."""
    ticks = []
    sched = make(tick_rate=30, deterministic=deterministic)
    sched.add(node_of(kind, "node", lambda node: ticks.append(1), rate=30))

    for done in range(1, 4):
        sched.publish(TRIGGER, 1)
        sched.tick_once()
        assert len(ticks) == done


def test_tick_once_right_after_add_ticks(make, deterministic):
    """The very first tick_once() after add() initialises and ticks the node."""
    journal = []
    sched = make(tick_rate=100, deterministic=deterministic)
    sched.add(
        Node("node", lambda: journal.append("tick"), rate=100, init=lambda: journal.append("init"))
    )

    sched.tick_once()

    assert journal == ["init", "tick"]


def test_tick_once_works_without_threads(make, deterministic):
    """Testing scheduler behavior without threads: all ticks are inline on the caller's."""
    threads = set()
    sched = make(tick_rate=100, deterministic=deterministic)
    for kind in KINDS:
        sched.add(node_of(kind, kind, lambda node: threads.add(threading.get_ident())))
    sched.publish(TRIGGER, 1)
    before = threading.active_count()

    sched.tick_once()

    assert threads == {threading.get_ident()}
    assert threading.active_count() == before


def test_there_is_no_rate_control_in_single_step_mode(make):
    """No rate control in single-step mode: in normal mode every node ticks in each step."""
    ticks = []
    sched = make(tick_rate=1000)
    sched.add(Node("slow", lambda: ticks.append("slow"), rate=0.01))
    sched.add(Node("fast", lambda: ticks.append("fast"), rate=1000))

    for _ in range(3):
        sched.tick_once()

    assert ticks == ["slow", "fast"] * 3


def test_a_step_does_not_wait(make, deterministic):
    """A step takes as long as its ticks take, not a period."""
    sched = make(tick_rate=0.01, deterministic=deterministic)
    sched.add(Node("node", nothing, rate=0.01))
    begun = time.monotonic()

    for _ in range(5):
        sched.tick_once()

    assert time.monotonic() - begun < 5.0


def test_a_deterministic_step_advances_virtual_time_by_one_cycle(make):
    """Deterministic: virtual time advances one cycle and only nodes due at it tick."""
    journal = []
    sched = make(tick_rate=100, deterministic=True)
    sched.add(Node("fast", lambda: journal.append(("fast", horus.tick())), rate=100))
    sched.add(Node("slow", lambda: journal.append(("slow", horus.tick())), rate=25))

    for step in range(8):
        assert horus.now() == pytest.approx(step * 0.01) or step == 0
        sched.tick_once()
        assert horus.now() == pytest.approx((step + 1) * 0.01)

    assert [tick for name, tick in journal if name == "fast"] == list(range(8))
    assert [tick for name, tick in journal if name == "slow"] == [0, 4]


# -- selective ticking ---------------------------------------------------------------------


def pipeline(sched: Scheduler) -> list[str]:
    """Add a sensor, a controller and a motor; return the journal of their ticks."""
    journal = []
    for order, name in enumerate(("sensor", "ctrl", "motor")):
        sched.add(Node(name, lambda n: journal.append(n.name), rate=100, order=order))
    return journal


@pytest.mark.parametrize(
    "names",
    [["sensor"], ["sensor", "ctrl"], ["motor"], ("motor",), {"ctrl"}, []],
    ids=str,
)
def test_a_list_of_names_ticks_only_those_nodes(make, deterministic, names):
    """Pass a list of node names to tick only specific nodes, keeping others frozen."""
    sched = make(tick_rate=100, deterministic=deterministic)
    journal = pipeline(sched)

    for _ in range(3):
        sched.tick_once(names)

    assert journal == [name for name in ("sensor", "ctrl", "motor") if name in names] * 3


def test_selected_nodes_tick_in_order_not_as_listed(make, deterministic):
    """A selection changes who ticks, not the order."""
    sched = make(tick_rate=100, deterministic=deterministic)
    journal = pipeline(sched)

    sched.tick_once(["motor", "sensor"])

    assert journal == ["sensor", "motor"]


def test_a_name_given_twice_ticks_once(make, deterministic):
    """A tick cycle ticks a node once, however often it is named."""
    sched = make(tick_rate=100, deterministic=deterministic)
    journal = pipeline(sched)

    sched.tick_once(["sensor", "sensor"])

    assert journal == ["sensor"]


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "Event"])
def test_the_filter_is_honoured_for_every_class(make, deterministic, kind):
    """tick_once(names) does not ignore the filter, whatever the classes."""
    ticks = []
    sched = make(tick_rate=100, deterministic=deterministic)
    for name in ("wanted", "other"):
        sched.add(node_of(kind, name, lambda node: ticks.append(node.name)))

    sched.tick_once(["wanted"])
    sched.tick_once(["wanted"])

    assert ticks == ["wanted", "wanted"]


def test_the_filter_holds_event_nodes_back_too(make, deterministic):
    """An event node that is not named does not tick; its messages wait."""
    received = []
    sched = make(tick_rate=100, deterministic=deterministic)
    sched.add(Node("event", lambda n: received.append(n.recv("go")), on="go"))
    sched.add(Node("sensor", lambda n: n.send("go", 1), rate=100, pubs=["go"], order=0))

    sched.tick_once(["sensor"])
    assert received == []
    sched.tick_once(["event"])

    assert received == [1]


def test_named_nodes_tick_also_when_they_are_not_due(make):
    """Deterministic: named nodes always tick, once."""
    ticks = []
    sched = make(tick_rate=100, deterministic=True)
    sched.add(Node("slow", lambda: ticks.append(horus.tick()), rate=1))

    for _ in range(5):
        sched.tick_once(["slow"])

    assert ticks == [0, 1, 2, 3, 4]


def test_selecting_initialises_every_node_once(make, deterministic):
    """The first step initialises all nodes, also those that are kept frozen."""
    journal = []
    sched = make(tick_rate=100, deterministic=deterministic)
    for name in ("a", "b"):
        sched.add(Node(name, nothing, rate=100, init=lambda n: journal.append(n.name)))

    sched.tick_once(["a"])
    sched.tick_once(["b"])

    assert journal == ["a", "b"]


def test_unknown_names_are_an_error_that_lists_the_known_ones(make, deterministic):
    """Unknown names are an error, and then nothing ticks."""
    sched = make(tick_rate=100, deterministic=deterministic)
    journal = pipeline(sched)

    with pytest.raises(UnknownNodeError, match=r"'lidar'.*sensor, ctrl, motor"):
        sched.tick_once(["sensor", "lidar"])

    assert journal == []


def test_a_bare_string_is_refused(make):
    """A string instead of a list of names is refused with the remedy."""
    sched = make()
    pipeline(sched)
    with pytest.raises(ConfigError, match=r"names='sensor'.*list of node names"):
        sched.tick_once("sensor")


# -- around it -----------------------------------------------------------------------------


def test_messages_flow_within_a_step_in_order(make, deterministic):
    """What an earlier node sends, a later node of the same step receives."""
    received = []
    sched = make(tick_rate=100, deterministic=deterministic)
    sched.add(Node("a", lambda n: n.send("x", horus.tick()), rate=100, order=0, pubs=["x"]))
    sched.add(Node("b", lambda n: received.append(n.recv("x")), rate=100, order=1, subs=["x"]))

    for _ in range(3):
        sched.tick_once()

    assert received == [0, 1, 2]


@pytest.mark.parametrize("kind", ["BestEffort", "AsyncIo", "Rt", "Compute"])
def test_event_nodes_tick_once_per_waiting_message(make, deterministic, kind):
    """In a step an event node ticks once for each message that waits for it."""
    received = []
    sched = make(tick_rate=30, deterministic=deterministic)

    def burst(node):
        for index in range(3):
            node.send(TRIGGER, index)

    sched.add(node_of(kind, "source", burst, rate=30, order=0, pubs=[TRIGGER]))
    sched.add(node_of("Event", "event", lambda n: received.append(n.recv(TRIGGER)), order=1))

    sched.tick_once()

    assert received == [0, 1, 2]


def test_an_async_tick_runs_to_its_end_within_a_step(make):
    """In normal mode a step awaits an async tick to its end."""
    journal = []

    async def tick(node):
        journal.append("begin")
        await asyncio.sleep(5 * ms)
        journal.append("end")

    sched = make(tick_rate=100)
    sched.add(Node("node", tick, rate=100))

    sched.tick_once()

    assert journal == ["begin", "end"]


def test_tick_once_can_be_called_where_an_event_loop_runs(make, deterministic, loop):
    """tick_once() also works inside an async test, async nodes included."""
    journal = []

    async def tick(node):
        await asyncio.sleep(0)
        journal.append(node.name)

    sched = make(tick_rate=100, deterministic=deterministic)
    sched.add(Node("async", tick, rate=100))
    sched.add(Node("plain", lambda node: journal.append(node.name), rate=100))

    async def main():
        sched.tick_once()
        sched.tick_once()
        sched.stop()

    run_async(main(), loop)

    assert journal == ["async", "plain"] * 2


def test_a_node_can_stop_the_session_in_a_step(make, deterministic):
    """After request_stop() in a step, stop_reason says so and the nodes can be shut down."""
    down = []
    sched = make(tick_rate=100, deterministic=deterministic)
    sched.add(
        Node(
            "node",
            lambda node: node.request_stop("done"),
            rate=100,
            shutdown=lambda: down.append(1),
        )
    )

    sched.tick_once()
    assert sched.stop_reason == "done"
    sched.stop()

    assert down == [1]


def test_stop_after_steps_shuts_down_once_and_a_new_step_begins_anew(make, deterministic):
    """stop() ends a session of steps; the next step begins a new one with init()."""
    journal = []
    sched = make(tick_rate=100, deterministic=deterministic)
    sched.add(
        Node(
            "node",
            lambda: journal.append("tick"),
            rate=100,
            init=lambda: journal.append("init"),
            shutdown=lambda: journal.append("shutdown"),
        )
    )

    for _ in range(2):
        sched.tick_once()
        sched.tick_once()
        sched.stop()
        sched.stop()

    assert journal == ["init", "tick", "tick", "shutdown"] * 2


def test_steps_then_a_run_share_one_init(make, deterministic):
    """run() after tick_once() goes on with the nodes as they are, then shuts them down."""
    journal = []
    sched = make(tick_rate=100, deterministic=deterministic)
    sched.add(
        Node(
            "node",
            lambda: journal.append("tick"),
            rate=100,
            init=lambda: journal.append("init"),
            shutdown=lambda: journal.append("shutdown"),
        )
    )

    sched.tick_once()
    sched.run(duration=0.1)

    assert journal[:2] == ["init", "tick"]
    assert journal.count("init") == 1
    assert journal[-1] == "shutdown"
    assert len(journal) > 4


def test_nodes_added_between_steps_are_initialised_and_tick(make, deterministic):
    """A node added after the first step takes part from the next one on."""
    journal = []
    sched = make(tick_rate=100, deterministic=deterministic)
    sched.add(Node("a", lambda: journal.append("a"), rate=100))
    sched.tick_once()
    sched.add(Node("b", lambda: journal.append("b"), rate=100, init=lambda: journal.append("b0")))

    sched.tick_once()

    assert journal == ["a", "b0", "a", "b"]


def test_tick_once_inside_a_tick_is_refused(make, deterministic):
    """A step inside a step is an error, not a recursion."""
    errors = []
    sched = make(tick_rate=100, deterministic=deterministic)

    def tick(node):
        try:
            sched.tick_once()
        except StateError as exc:
            errors.append(str(exc))

    sched.add(Node("node", tick, rate=100))

    sched.tick_once()

    assert len(errors) == 1
