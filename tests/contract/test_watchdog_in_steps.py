"""The watchdog during `tick_once()`, and what it does not depend on."""

from __future__ import annotations

import asyncio
import logging
import threading
import time

import pytest

from horus import Node, ms
from horus.executors.rt import RtExecutor

from .freezing import (
    MARKER,
    Freezer,
    await_health,
    cleared,
    expirations,
    freezing_node,
    reports,
)
from .helpers import KINDS, PATIENCE_S, TRIGGER, node_of, running, wait_until

pytestmark = pytest.mark.realtime

TIMEOUT_MS = 100


# -- tick_once ---------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_watchdog_detects_frozen_node(make, kind, caplog):
    """Verify the watchdog catches a node that hangs: the contract's example, in every class."""

    def frozen_tick(node):
        stuck_in_the_driver()

    def stuck_in_the_driver():
        time.sleep(0.45)  # Simulate frozen node

    sched = make(tick_rate=10, watchdog_ms=100)
    sched.add(node_of(kind, "frozen", frozen_tick, rate=10, order=0))
    sched.publish(TRIGGER, 1)

    sched.tick_once()

    stats = sched.safety_stats()
    assert stats is not None
    assert stats["watchdog_expirations"] == 1
    assert stats["health_states"] == {"frozen": "isolated"}
    wait_until(lambda: len(reports(caplog)) == 3)
    assert all(MARKER in message for _, _, message in reports(caplog))


def test_a_node_that_was_isolated_in_a_step_is_skipped_in_the_next(make):
    """In steps, too, an isolated node ticks no more until clear_safe_state()."""
    sched = make(tick_rate=10, watchdog_ms=50)
    ticks, hooks, others = [], [], []

    def tick(node):
        ticks.append(1)
        if len(ticks) == 1:
            time.sleep(0.3)

    sched.add(Node("frozen", tick, safe_state=lambda: hooks.append(threading.get_ident())))
    sched.add(Node("other", lambda: others.append(1)))

    sched.tick_once()
    wait_until(lambda: hooks)
    sched.tick_once()
    sched.tick_once()
    assert len(ticks) == 1
    assert len(others) == 3
    assert hooks != [threading.get_ident()]
    assert sched.get_node_stats("frozen")["skipped"] == 2
    assert sched.clear_safe_state() == []
    sched.tick_once()

    assert len(ticks) == 2
    assert len(hooks) == 1
    assert sched.get_node_stats("frozen")["state"] == "running"


def test_a_frozen_async_tick_ends_the_step_when_it_is_isolated(make, caplog):
    """tick_once() returns although an async tick waits for ever: isolation cancels it."""
    sched = make(tick_rate=10, watchdog_ms=TIMEOUT_MS)
    hooks, cancelled, others = [], [], []

    async def tick(node):
        try:
            await stuck_in_the_driver()
        except asyncio.CancelledError:
            cancelled.append(1)
            raise

    async def stuck_in_the_driver():
        await asyncio.Event().wait()

    async def hook(node):
        hooks.append(1)

    sched.add(Node("frozen", tick, rate=10, order=0, safe_state=hook))
    sched.add(Node("other", lambda: others.append(1), order=1))

    sched.tick_once()

    assert cancelled == [1]
    assert others == [1]
    wait_until(lambda: hooks == [1] and len(reports(caplog)) == 3)
    assert all(MARKER in message for _, _, message in reports(caplog))
    sched.tick_once()
    assert cancelled == [1]
    assert others == [1, 1]
    assert expirations(sched) == 1


@pytest.mark.parametrize("is_async", [False, True], ids=["plain", "async"])
def test_an_init_that_hangs_during_a_restart_is_watched_in_steps(make, is_async):
    """A restart whose init() hangs is seen in tick_once() as it is in run()."""
    sched = make(watchdog_ms=50)
    inits = []

    def fail(node):
        raise OSError("no echo")

    async def fail_async(node):
        raise OSError("no echo")

    def init(node):
        inits.append(1)
        if len(inits) > 1:
            time.sleep(0.3)

    async def init_async(node):
        inits.append(1)
        if len(inits) > 1:
            await asyncio.sleep(PATIENCE_S)

    tick, begin = (fail_async, init_async) if is_async else (fail, init)
    sched.add(Node("frozen", tick, init=begin, failure_policy="restart"))
    sched.tick_once()
    time.sleep(120 * ms)  # the back-off

    sched.tick_once()

    assert len(inits) == 2
    assert sched.get_node_stats("frozen")["health"] == "isolated"
    assert expirations(sched) == 1


def test_shutdown_after_a_step_waits_for_the_hook(make):
    """A node that was just isolated is shut down after its hook, not during it."""
    sched = make(watchdog_ms=50)
    journal = []

    def hook(node):
        journal.append("hook")
        time.sleep(50 * ms)
        journal.append("hook ended")

    sched.add(
        Node(
            "frozen",
            lambda: time.sleep(0.18),
            safe_state=hook,
            shutdown=lambda: journal.append("shutdown"),
        )
    )
    sched.tick_once()
    assert sched.get_node_stats("frozen")["health"] == "isolated"
    sched.stop()

    wait_until(lambda: len(journal) == 3)
    assert journal == ["hook", "hook ended", "shutdown"]


def test_the_time_between_two_steps_is_not_measured(make):
    """A step that is not taken is not owed: a test may think between two tick_once()."""
    sched = make(tick_rate=1000, watchdog_ms=50)
    for kind in KINDS:
        sched.add(node_of(kind, kind))
    sched.publish(TRIGGER, 1)
    for _ in range(2):
        sched.tick_once()
        sched.publish(TRIGGER, 1)
        time.sleep(0.25)

    assert sched.safety_stats()["watchdog_expirations"] == 0


# -- supervision goes on -----------------------------------------------------------------------


class BlockedHandler(logging.Handler):
    """A log handler that hangs, as one does that writes to a terminal nobody reads."""

    def __init__(self) -> None:
        super().__init__()
        self.entered = threading.Event()
        self.unblocked = threading.Event()

    def emit(self, record: logging.LogRecord) -> None:
        self.entered.set()
        self.unblocked.wait(PATIENCE_S)


def test_a_log_handler_that_blocks_does_not_block_supervision(make):
    """Not even the log can hold it up: nodes are isolated, and hooks called, all the same."""
    sched = make(watchdog_ms=TIMEOUT_MS)
    handler = BlockedHandler()
    first, second = Freezer(), Freezer(armed=False)
    sched.add(freezing_node("Rt", first, "first"))
    sched.add(freezing_node("Compute", second, "second"))
    log = logging.getLogger("horus.node.first")
    log.addHandler(handler)
    try:
        with running(sched), first, second:
            assert handler.entered.wait(PATIENCE_S)
            await_health(sched, "first", "isolated")
            wait_until(lambda: first.hook_threads)
            second.freeze()
            await_health(sched, "second", "isolated")
            wait_until(lambda: second.hook_threads)
            assert not handler.unblocked.is_set()
            handler.unblocked.set()
    finally:
        handler.unblocked.set()
        log.removeHandler(handler)


def test_an_inspection_that_fails_is_not_the_last_one(make, monkeypatch, caplog):
    """Supervision goes on whatever happens to it: an error of our own is logged, and survived."""
    failures = []
    due_ns = RtExecutor.due_ns

    def fail_once(self, live, now_ns):
        if not failures:
            failures.append(1)
            raise KeyError(live.name)
        return due_ns(self, live, now_ns)

    monkeypatch.setattr(RtExecutor, "due_ns", fail_once)
    sched = make(watchdog_ms=TIMEOUT_MS)
    freezer = Freezer(armed=False)
    sched.add(freezing_node("Rt", freezer))
    with running(sched), freezer:
        wait_until(lambda: failures and freezer.ended)
        freezer.freeze()
        await_health(sched, "frozen", "isolated")
        wait_until(lambda: any("inspection failed" in r.getMessage() for r in caplog.records))


def test_a_node_that_was_let_go_is_watched_again(make):
    """After clear_safe_state() the watchdog looks after the node as before."""
    sched = make(watchdog_ms=TIMEOUT_MS)
    freezer = Freezer()
    sched.add(freezing_node("Rt", freezer))
    with running(sched), freezer:
        await_health(sched, "frozen", "isolated")
        # Longer than anything that supervision might still have planned to look at.
        time.sleep(3 * TIMEOUT_MS * ms)
        freezer.thaw()
        wait_until(lambda: freezer.ended == 1)
        wait_until(lambda: cleared(sched))
        wait_until(lambda: freezer.ended >= 2)
        freezer.freeze()
        await_health(sched, "frozen", "isolated")
        wait_until(lambda: len(freezer.hook_threads) == 2)

        assert expirations(sched) == 2
