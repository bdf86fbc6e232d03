"""The watchdog in deterministic mode: async ticks that await too long, at exact instants."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import horus
from horus import Node, Scheduler

pytestmark = pytest.mark.usefixtures("leaves_nothing_behind")

FOREVER_S = 1000.0
STAGES = ("warning", "unhealthy", "isolated")
Trace = list[tuple[Any, ...]]


class Reports(logging.Handler):
    """What supervision logs, each with its instant in virtual time."""

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self.entries: Trace = []

    def emit(self, record: logging.LogRecord) -> None:
        name, _, text = record.getMessage().partition(": ")
        head = text.partition(":")[0]
        if head in (*STAGES, "healthy again") or record.levelno == logging.CRITICAL:
            self.entries.append((round(horus.now(), 6), record.levelname, name, head))


@pytest.fixture
def reports() -> Iterator[Reports]:
    """Collect what supervision reports."""
    handler, log = Reports(), logging.getLogger("horus")
    level = log.level
    log.addHandler(handler)
    log.setLevel(logging.INFO)
    yield handler
    log.removeHandler(handler)
    log.setLevel(level)


def script(*waits_s: float, journal: Trace | None = None) -> Callable[[Node], Any]:
    """Return an async tick that awaits these durations [s], one per tick, then none."""
    remaining = list(waits_s)

    async def tick(node: Node) -> None:
        if journal is not None:
            journal.append(("tick", round(horus.now(), 6)))
        await asyncio.sleep(remaining.pop(0) if remaining else 0)

    return tick


def note(journal: Trace, what: str) -> Callable[[Node], None]:
    """Return a callback that notes the instant at which it is called."""

    def callback(node: Node) -> None:
        journal.append((what, round(horus.now(), 6)))

    return callback


def note_async(journal: Trace, what: str) -> Callable[[Node], Any]:
    """Return the same as a coroutine function."""

    async def callback(node: Node) -> None:
        journal.append((what, round(horus.now(), 6)))

    return callback


def frozen(journal: Trace, *waits_s: float, **options: Any) -> Node:
    """Return an async node of 1 Hz whose ticks await these durations; see `script`."""
    options.setdefault("safe_state", note_async(journal, "hook"))
    options.setdefault("rate", 1)
    return Node("frozen", script(*waits_s, journal=journal), **options)


# -- the table -------------------------------------------------------------------------------------


def test_the_rows_of_the_table_come_at_their_instants(reports: Reports) -> None:
    """1x, 2x and 3x the timeout after the tick began, to the nanosecond; then no tick more."""
    journal: Trace = []
    others: list[float] = []
    sched = Scheduler(tick_rate=100, deterministic=True, watchdog_ms=200)
    sched.add(frozen(journal, 0, 0, FOREVER_S))
    sched.add(Node("other", lambda: others.append(horus.now()), rate=100))
    sched.run(5.0)

    assert reports.entries == [
        (2.2, "WARNING", "frozen", "warning"),
        (2.4, "ERROR", "frozen", "unhealthy"),
        (2.6, "ERROR", "frozen", "isolated"),
    ]
    assert journal == [("tick", 0.0), ("tick", 1.0), ("tick", 2.0), ("hook", 2.6)]
    assert len(others) == 500
    stats = sched.get_node_stats("frozen")
    assert (stats["total_ticks"], stats["skipped"]) == (2, 2)
    assert stats["watchdog_expirations"] == 1
    assert stats["health"] == "isolated"


def test_the_stages_begin_right_after_their_timeouts() -> None:
    """A tick that takes exactly one, two or three timeouts has not come to the next stage."""
    for timeouts, expired, health in ((1, 0, "healthy"), (2, 1, "healthy"), (3, 1, "healthy")):
        sched = Scheduler(deterministic=True, watchdog_ms=200)
        sched.add(frozen([], 0.2 * timeouts, rate=0.5))
        sched.run(1.9)
        stats = sched.get_node_stats("frozen")
        assert (stats["watchdog_expirations"], stats["health"]) == (expired, health)
        assert stats["total_ticks"] == 1


def test_each_release_while_frozen_is_skipped_and_counted(reports: Reports) -> None:
    """2x: its releases go by. What is not run is counted, before and after isolation."""
    journal: Trace = []
    sched = Scheduler(tick_rate=100, deterministic=True, watchdog_ms=250)
    sched.add(frozen(journal, FOREVER_S, rate=10))
    sched.run(2.0)

    assert [entry[0] for entry in reports.entries] == [0.25, 0.5, 0.75]
    stats = sched.get_node_stats("frozen")
    assert (stats["total_ticks"], stats["skipped"]) == (0, 19)


def test_a_tick_that_returns_is_healthy_again_at_that_instant(reports: Reports) -> None:
    """A tick that returns while not isolated restores Healthy; expirations are cumulative."""
    sched = Scheduler(tick_rate=100, deterministic=True, watchdog_ms=100)
    sched.add(frozen([], 0.15, 0.05, 0.25, 0.1, 0.299))
    sched.run(6.0)

    assert reports.entries == [
        (0.1, "WARNING", "frozen", "warning"),
        (0.15, "INFO", "frozen", "healthy again"),
        (2.1, "WARNING", "frozen", "warning"),
        (2.2, "ERROR", "frozen", "unhealthy"),
        (2.25, "INFO", "frozen", "healthy again"),
        (4.1, "WARNING", "frozen", "warning"),
        (4.2, "ERROR", "frozen", "unhealthy"),
        (4.299, "INFO", "frozen", "healthy again"),
    ]
    assert sched.safety_stats()["watchdog_expirations"] == 3
    assert sched.get_node_stats("frozen")["total_ticks"] == 6


def test_timeouts_of_nodes_and_of_the_scheduler(reports: Reports) -> None:
    """A node's own watchdog overrides the global one, in either direction."""
    sched = Scheduler(deterministic=True, watchdog_ms=100)
    for name, watchdog in (("global", None), ("strict", 0.03), ("patient", 0.7)):
        sched.add(Node(name, script(FOREVER_S), rate=1, watchdog=watchdog))
    sched.run(1.0)

    assert [entry[0] for entry in reports.entries if entry[2] == "strict"] == [0.03, 0.06, 0.09]
    assert [entry[0] for entry in reports.entries if entry[2] == "global"] == [0.1, 0.2, 0.3]
    assert [entry[0] for entry in reports.entries if entry[2] == "patient"] == [0.7]


def test_event_nodes_are_watched_from_the_start_of_their_ticks(reports: Reports) -> None:
    """Of three messages at once, each async tick has its own time; only the second freezes."""
    journal: Trace = []
    sched = Scheduler(deterministic=True, watchdog_ms=100)
    sched.add(Node("frozen", script(0.09, FOREVER_S, journal=journal), on="go"))
    for index in range(3):
        sched.publish("go", index)
    sched.run(1.0)

    assert journal == [("tick", 0.0), ("tick", 0.09)]
    assert [entry[0] for entry in reports.entries] == [0.19, 0.29, 0.39]
    assert sched.get_node_stats("frozen")["skipped"] == 1


def test_a_frozen_tick_is_watched_across_steps(reports: Reports) -> None:
    """tick_once() and tick_for() move the same time: a tick that waits in between is watched."""
    journal: Trace = []
    sched = Scheduler(tick_rate=10, deterministic=True, watchdog_ms=250)
    sched.add(frozen(journal, FOREVER_S))
    sched.tick_once()
    sched.tick_for(0.15)
    assert reports.entries == []
    sched.tick_once()
    sched.tick_for(0.45)
    sched.stop()

    assert [entry[0] for entry in reports.entries] == [0.25, 0.5]
    assert journal == [("tick", 0.0)]


# -- letting go, and the whole system --------------------------------------------------------------


def test_an_isolated_node_that_is_let_go_is_watched_as_before(reports: Reports) -> None:
    """After clear_safe_state() it ticks at its next release, and its next freeze is found."""
    journal: Trace = []
    sched = Scheduler(tick_rate=10, deterministic=True, watchdog_ms=100)
    sched.add(frozen(journal, FOREVER_S, 0, FOREVER_S))
    sched.tick_for(5.5)
    assert sched.clear_safe_state() == []
    sched.tick_for(4.5)
    sched.stop()

    assert [entry for entry in journal if entry[0] == "tick"] == [
        ("tick", 0.0),
        ("tick", 6.0),
        ("tick", 7.0),
    ]
    assert [entry[1] for entry in journal if entry[0] == "hook"] == [0.3, 7.3]
    assert [entry[0] for entry in reports.entries] == [0.1, 0.2, 0.3, 7.1, 7.2, 7.3]
    assert sched.get_node_stats("frozen")["watchdog_expirations"] == 2


def test_a_critical_node_puts_the_system_in_its_safe_state_at_its_timeout(reports: Reports) -> None:
    """Hooks run inline, at that instant, in shutdown order; held until it is cleared."""
    journal: Trace = []
    sched = Scheduler(tick_rate=100, deterministic=True, watchdog_ms=5000)
    sched.add(frozen(journal, 0, FOREVER_S, order=0))
    for name, order in (("motor", 20), ("arm", 10)):
        sched.add(Node(name, note(journal, name), rate=2, order=order, safe_state=halt(journal)))
    sched.add(Node("reporter", note(journal, "reporter"), rate=2, order=30))
    sched.add_critical_node("frozen", timeout_ms=750)
    sched.tick_for(3.0)

    entered = [entry for entry in journal if entry[1] == 1.75]
    assert entered == [("halt motor", 1.75), ("halt arm", 1.75), ("hook", 1.75)]
    assert [entry[1] for entry in journal if entry[0] == "motor"] == [0.0, 0.5, 1.0, 1.5]
    assert [entry[1] for entry in journal if entry[0] == "reporter"] == [0.0, 0.5, 1, 1.5, 2, 2.5]
    assert sched.get_node_stats("motor")["skipped"] == 2
    assert sched.safety_stats()["safe_state"] is True
    with pytest.raises(horus.StateError, match="still frozen"):
        sched.clear_safe_state()
    sched.stop()
    assert [entry[1] for entry in reports.entries] == ["CRITICAL", "WARNING"]


def halt(journal: Trace) -> Callable[[Node], None]:
    def hook(node: Node) -> None:
        journal.append((f"halt {node.name}", round(horus.now(), 6)))

    return hook


def test_the_system_leaves_its_safe_state_when_it_is_cleared() -> None:
    """Once the critical tick has returned, clear_safe_state() lets all nodes tick again."""
    journal: Trace = []
    sched = Scheduler(tick_rate=100, deterministic=True)
    sched.add(frozen(journal, 1.5, order=0))
    sched.add(Node("motor", note(journal, "motor"), rate=2, safe_state=halt(journal)))
    sched.add_critical_node("frozen", timeout_ms=600)
    sched.tick_for(3.75)
    assert [entry[1] for entry in journal if entry[0] == "motor"] == [0.0, 0.5]
    assert sched.clear_safe_state() == []
    sched.tick_for(1.0)
    sched.stop()

    assert [entry[1] for entry in journal if entry[0] == "motor"] == [0.0, 0.5, 4.0, 4.5]
    assert [entry[1] for entry in journal if entry[0] == "tick"] == [0.0, 4.0]


def test_a_restart_whose_init_hangs_is_isolated(reports: Reports) -> None:
    """An async init() that runs again in place of a tick is watched like the tick."""
    inits: list[float] = []

    async def init(node: Node) -> None:
        inits.append(horus.now())
        await asyncio.sleep(FOREVER_S if len(inits) > 1 else 0)

    async def fail(node: Node) -> None:
        raise OSError("no echo")

    sched = Scheduler(tick_rate=10, deterministic=True, watchdog_ms=100)
    sched.add(Node("frozen", fail, rate=10, init=init, failure_policy="restart"))
    sched.run(1.0)

    assert inits == pytest.approx([0.0, 0.1])
    assert [entry[0] for entry in reports.entries] == [0.2, 0.3, 0.4]
    assert sched.get_node_stats("frozen")["restarts"] == 0


def test_a_node_that_comes_later_is_watched_from_its_first_tick(reports: Reports) -> None:
    """Also if nobody was watched before: the rows come at their instants."""
    sched = Scheduler(tick_rate=10, deterministic=True)
    sched.add(Node("busy", script(*[0.9] * 10), rate=1))
    sched.tick_for(2.0)
    sched.add(frozen([], FOREVER_S, watchdog=0.15))
    sched.tick_for(1.0)
    sched.stop()

    assert [entry[0] for entry in reports.entries] == [2.15, 2.3, 2.45]


def test_a_node_that_becomes_critical_during_its_tick_is_so_at_its_timeout(
    reports: Reports,
) -> None:
    """add_critical_node() counts from the release, not from when somebody next looks."""
    sched = Scheduler(tick_rate=10, deterministic=True, watchdog_ms=5000)
    sched.add(frozen([], FOREVER_S))
    sched.add(
        Node("late", lambda: sched.add_critical_node("frozen", timeout_ms=650), rate=2, order=1)
    )
    sched.tick_for(0.1)
    sched.add_critical_node("frozen", timeout_ms=700)
    sched.tick_for(2.0)
    sched.stop()

    assert [entry[0] for entry in reports.entries if entry[1] == "CRITICAL"] == [0.65]


# -- reproducible ----------------------------------------------------------------------------------


def drill(reports: Reports, watchdog_ms: int) -> Trace:
    """Run a graph of every class with freezes at random and return everything observable."""
    trace: Trace = []
    reports.entries = trace

    def seen(name: str) -> Callable[[Node], None]:
        def callback(node: Node) -> None:
            trace.append((name, horus.now(), horus.tick(), horus.rng_float()))
            node.send("go", horus.rng_float())

        return callback

    async def flaky(node: Node) -> None:
        trace.append((node.name, horus.now()))
        node.recv("go")
        await asyncio.sleep(0.4 * horus.rng_float())
        trace.append((node.name, "ended", horus.now()))

    sched = Scheduler(tick_rate=100, deterministic=True, watchdog_ms=watchdog_ms, seed=7)
    for node in (
        Node("motor", seen("motor"), rate=10, pubs="go", safe_state=halt(trace)),
        Node("planner", seen("planner"), rate=3, compute=True, pubs="go", safe_state=halt(trace)),
        Node("uploader", flaky, rate=5, safe_state=note_async(trace, "hook of uploader")),
        Node("waiter", flaky, on="go", safe_state=note_async(trace, "hook of waiter")),
    ):
        sched.add(node)
    sched.add_critical_node("waiter", timeout_ms=390)
    for _ in range(20):
        sched.tick_for(1.0)
        try:
            trace.append(tuple(sched.clear_safe_state()))
        except horus.StateError as exc:
            trace.append((str(exc),))
        trace.append(tuple(sched.safety_stats().values()))
    sched.stop()
    return trace


def test_two_drills_give_the_same_trace(reports: Reports) -> None:
    """Freezes, isolations, hooks and what is reported replay bit by bit."""
    first, second = drill(reports, 120), drill(reports, 120)
    assert first == second
    assert {entry[3] for entry in first if len(entry) == 4 and entry[1] == "ERROR"} == {
        "unhealthy",
        "isolated",
    }


@settings(max_examples=15, deadline=None)
@given(
    st.lists(
        st.tuples(st.floats(0.2, 200), st.floats(0.0, 0.95)),
        min_size=1,
        max_size=5,
    ),
    st.integers(20, 500),
)
def test_a_healthy_schedule_is_the_same_with_and_without_a_watchdog(
    nodes: list[tuple[float, float]], watchdog_ms: int
) -> None:
    """Ticks shorter than the timeout, at any rates: nothing escalates, and no tick moves."""

    def run(watchdog_ms: int, limit_ms: int) -> tuple[Trace, dict[str, Any]]:
        trace: Trace = []

        def make_tick(wait_s: float) -> Callable[[Node], Any]:
            async def tick(node: Node) -> None:
                trace.append((node.name, horus.now()))
                await asyncio.sleep(wait_s)
                trace.append((node.name, "ended", horus.now()))

            return tick

        sched = Scheduler(deterministic=True, watchdog_ms=watchdog_ms)
        for index, (rate, fraction) in enumerate(nodes):
            tick = make_tick(fraction * limit_ms / 1000)
            sched.add(Node(f"n{index}", tick, rate=rate, on_miss="warn"))
        sched.run(3.0)
        return trace, sched.safety_stats()

    watched, stats = run(watchdog_ms, watchdog_ms)
    unwatched, _ = run(0, watchdog_ms)
    assert stats["watchdog_expirations"] == 0
    assert set(stats["health_states"].values()) == {"healthy"}
    assert watched == unwatched
