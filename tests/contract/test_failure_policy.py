"""The failure_policy: what happens when a tick raises."""

from __future__ import annotations

import asyncio
import itertools
import threading

import pytest

import horus
from horus import Node, NodeError, ms

from .helpers import (
    KINDS,
    TRIGGER,
    as_async,
    node_of,
    nothing,
    run_until,
    running,
    wait_until,
)


class BrokenSensor(Exception):
    """What the nodes of these tests raise."""


def failing(*failures, journal=None):
    """Return a tick that fails at these calls (counted from 0) and records when it ran."""
    calls = []

    def tick(node):
        calls.append(node.name)
        if journal is not None:
            journal.append(round(horus.now(), 6))
        if not failures or len(calls) - 1 in failures:
            raise BrokenSensor("no echo")

    return tick


@pytest.fixture
def sched(make):
    """A deterministic scheduler of 10 cycles a second."""
    return make(tick_rate=10, deterministic=True)


POLICIES = (None, "fatal", "restart", "skip", "ignore")


# -- all of them ---------------------------------------------------------------------------


@pytest.mark.realtime
@pytest.mark.parametrize("policy", [None, "skip", "ignore"])
def test_a_raising_tick_disturbs_no_other_node(make, loop, kind, policy):
    """An exception in a tick of any class is contained: the other nodes keep ticking."""
    ticks = {"broken": 0, "other": 0}

    def fail(node):
        ticks["broken"] += 1
        raise BrokenSensor("no echo")

    def count(node):
        ticks["other"] += 1
        node.send(TRIGGER, 1)

    sched = make(tick_rate=100, loop=loop)
    sched.add(Node("other", count, rate=100, order=0, pubs=[TRIGGER]))
    sched.add(node_of(kind, "broken", fail, order=1, failure_policy=policy))

    run_until(sched, lambda: ticks["broken"] >= 3 and ticks["other"] >= 10)

    assert sched.get_node_stats("broken")["errors_count"] == ticks["broken"]
    assert sched.get_node_stats("broken")["state"] == "stopped"


@pytest.mark.parametrize("policy", POLICIES)
def test_a_type_error_in_a_tick_runs_it_once(sched, policy):
    """A TypeError in a callback does not run it twice, under no policy."""
    calls = []

    def tick(node):
        calls.append(1)
        raise TypeError("tick() takes 0 positional arguments but 1 was given")

    sched.add(Node("node", tick, rate=10, failure_policy=policy))

    if policy == "fatal":
        with pytest.raises(NodeError):
            sched.tick_once()
    else:
        sched.tick_once()

    assert calls == [1]


@pytest.mark.parametrize("policy", POLICIES)
def test_errors_are_counted(sched, policy):
    """Every exception of a tick is counted in errors_count."""
    sched.add(Node("node", failing(0), rate=10, failure_policy=policy))

    try:
        sched.tick_once()
    except NodeError:
        assert policy == "fatal"

    assert sched.get_node_stats("node")["errors_count"] == 1


def test_a_failing_node_does_not_flood_the_log(make, caplog):
    """The log of failures is rate limited: a 1 kHz node logs now and then, with a count."""
    sched = make(tick_rate=1000, deterministic=True)
    sched.add(Node("node", failing(), rate=1000))

    sched.tick_for(5.0)

    errors = [r for r in caplog.records if r.name == "horus.node.node"]
    assert 2 <= len(errors) <= 6
    assert any("999" in r.getMessage() or "1000" in r.getMessage() for r in errors)
    assert sched.get_node_stats("node")["errors_count"] == 5000


# -- none ------------------------------------------------------------------------------


def test_no_policy_means_log_with_traceback_count_and_keep_ticking(sched, caplog):
    """failure_policy=None: log with traceback, count, keep ticking."""
    times = []
    sched.add(Node("node", failing(0, journal=times), rate=10))

    sched.tick_for(0.3)

    assert times == [0.0, 0.1, 0.2]
    (record,) = [r for r in caplog.records if r.name == "horus.node.node"]
    assert record.levelname == "ERROR"
    assert record.exc_info is not None
    assert "BrokenSensor" in record.getMessage()
    assert "no echo" in record.getMessage()


# -- fatal -----------------------------------------------------------------------------


def test_fatal_stops_the_entire_scheduler(sched):
    """Policy "fatal": stop the entire scheduler, in order; no node ticks any more."""
    journal = []
    sched.add(
        Node(
            "motor",
            lambda: journal.append("motor"),
            rate=10,
            order=9,
            shutdown=lambda: journal.append("motor down"),
        )
    )
    sched.add(
        Node(
            "broken",
            failing(1),
            rate=10,
            order=0,
            failure_policy="fatal",
            shutdown=lambda: journal.append("broken down"),
        )
    )

    with pytest.raises(NodeError):
        sched.run(duration=60.0)

    assert journal == ["motor", "motor down", "broken down"]
    assert sched.status() == "stopped"


@pytest.mark.realtime
def test_fatal_raises_a_node_error_from_the_original_exception(make, loop, kind):
    """fatal: ordered shutdown, then run() raises NodeError from the original exception."""
    down = []
    sched = make(loop=loop)
    sched.add(
        node_of(
            kind,
            "broken",
            failing(),
            failure_policy="fatal",
            shutdown=lambda node: down.append(node.name),
        )
    )
    sched.publish(TRIGGER, 1)

    with pytest.raises(NodeError, match=r"broken.*BrokenSensor.*no echo") as raised:
        sched.run(duration=20.0)

    assert isinstance(raised.value.__cause__, BrokenSensor)
    assert raised.value.__cause__.__traceback__ is not None
    assert down == ["broken"]
    assert "broken" in sched.stop_reason


@pytest.mark.parametrize("step", ["tick_once", "tick_for"])
def test_fatal_raises_from_steps_too(make, deterministic, step):
    """A fatal error in tick_once() or tick_for() shuts everything down, then raises."""
    down = []
    sched = make(tick_rate=100, deterministic=deterministic)
    sched.add(Node("other", nothing, rate=100, shutdown=lambda n: down.append(n.name)))
    sched.add(
        Node(
            "broken",
            failing(),
            rate=100,
            failure_policy="fatal",
            shutdown=lambda n: down.append(n.name),
        )
    )

    with pytest.raises(NodeError, match="no echo"):
        sched.tick_once() if step == "tick_once" else sched.tick_for(20.0)

    assert down == ["broken", "other"]
    assert sched.status() == "stopped"


def test_after_a_fatal_error_the_scheduler_can_run_again(sched):
    """A failure belongs to its run: the next run starts afresh."""
    ticks = []
    sched.add(Node("broken", failing(0), rate=10, failure_policy="fatal"))
    sched.add(Node("other", lambda: ticks.append(1), rate=10))

    with pytest.raises(NodeError):
        sched.run(duration=1.0)
    ticks.clear()
    sched.run(duration=1.0)

    assert len(ticks) == 10
    assert sched.stop_reason is None


# -- restart ---------------------------------------------------------------------------


def test_restart_reinitializes_the_node_and_resumes(sched):
    """Policy "restart": re-initialize the node and resume."""
    journal = []
    fail = failing(1)

    def tick(node):
        journal.append("tick")
        fail(node)

    sched.add(
        Node(
            "node",
            tick,
            rate=10,
            failure_policy="restart",
            init=lambda: journal.append("init"),
            shutdown=lambda: journal.append("shutdown"),
        )
    )

    sched.run(duration=0.6)

    assert journal[:4] == ["init", "tick", "tick", "init"]
    assert set(journal[4:-1]) == {"tick"}
    assert journal[-1] == "shutdown"
    assert sched.get_node_stats("node")["restarts"] == 1


def test_restart_backs_off_exponentially_from_100_ms_to_5_s(make):
    """Restart runs init() with exponential back-off: 100 ms doubling to 5 s."""
    inits, ticks = [], []
    sched = make(tick_rate=100, deterministic=True)
    sched.add(
        Node(
            "node",
            failing(journal=ticks),
            rate=100,
            failure_policy="restart",
            init=lambda: inits.append(round(horus.now(), 6)),
        )
    )

    sched.tick_for(25.0)

    waits = [later - earlier for earlier, later in itertools.pairwise(inits)]
    expected = [0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 5.0, 5.0, 5.0]
    assert waits[: len(expected)] == pytest.approx(expected[: len(waits)], abs=0.0101)
    assert len(waits) >= 8


def test_a_failing_init_during_restart_is_retried_with_the_same_back_off(make):
    """During a restart a failing init() waits for the next attempt, ever longer."""
    inits = []

    def init(node):
        inits.append(round(horus.now(), 6))
        if 1 < len(inits) < 5:
            raise OSError("still unplugged")

    ticks = []
    sched = make(tick_rate=100, deterministic=True)
    sched.add(
        Node("node", failing(0, journal=ticks), rate=100, failure_policy="restart", init=init)
    )

    sched.tick_for(3.0)

    assert inits == pytest.approx([0.0, 0.1, 0.3, 0.7, 1.5], abs=0.0101)
    assert ticks[1] == pytest.approx(1.5, abs=0.0101)


def test_the_back_off_is_reset_after_a_healthy_period(make):
    """The back-off is reset after a healthy period: a later failure waits 100 ms again."""
    inits, failures = [], []
    sched = make(tick_rate=100, deterministic=True)

    def tick(node):
        again = horus.now() >= 12.0 and failures[-1] < 12.0
        if horus.now() < 1.0 or again:
            failures.append(horus.now())
            raise BrokenSensor("no echo")

    def init(node):
        inits.append(horus.now())

    sched.add(Node("node", tick, rate=100, failure_policy="restart", init=init))

    sched.tick_for(13.0)

    assert len(failures) >= 4
    assert failures[-1] == pytest.approx(12.0)
    assert inits[-1] - failures[-1] == pytest.approx(0.1, abs=0.0101)


def test_a_restarting_node_says_so(sched):
    """While it waits for its restart, the node's state is "restarting"."""
    states = []
    sched.add(Node("node", failing(0), rate=10, order=0, failure_policy="restart"))
    sched.add(Node("watch", lambda: states.append(sched.get_node_stats("node")["state"]), rate=10))

    sched.tick_for(0.5)

    assert states[0] == "restarting"
    assert states[-1] == "running"


@pytest.mark.realtime
def test_restart_works_for_every_class_in_real_time(make, loop, kind):
    """Re-initialize the node and resume, whichever class it is of."""
    journal = []
    fail = failing(0)

    def tick(node):
        journal.append("tick")
        fail(node)

    sched = make(tick_rate=100, loop=loop)
    sched.add(
        node_of(
            kind,
            "node",
            tick,
            failure_policy="restart",
            init=lambda node: journal.append("init"),
        )
    )
    sched.publish(TRIGGER, 1)
    sched.publish(TRIGGER, 2)
    with running(sched):
        wait_until(lambda: len(journal) >= 4)

    assert journal[:4] == ["init", "tick", "init", "tick"]


def test_the_messages_of_a_restarting_event_node_wait(sched):
    """Messages for an event node that restarts are not lost to the back-off."""
    received = []

    def tick(node):
        received.append((round(horus.now(), 6), node.recv("go")))
        if len(received) == 1:
            raise BrokenSensor("no echo")

    sched.add(Node("event", tick, on="go", failure_policy="restart"))
    for index in range(3):
        sched.publish("go", index)

    sched.tick_for(1.0)

    assert [message for _, message in received] == [0, 1, 2]
    assert received[1][0] == pytest.approx(0.1)


# -- skip ------------------------------------------------------------------------------


def test_skip_skips_this_tick_and_tries_again_next_cycle(sched, caplog):
    """Policy "skip": skip this tick, try again next cycle; a warning without traceback."""
    times = []
    sched.add(Node("cloud", failing(0, 1, journal=times), rate=10, failure_policy="skip"))

    sched.tick_for(0.4)

    assert times == [0.0, 0.1, 0.2, 0.3]
    records = [r for r in caplog.records if r.name == "horus.node.cloud"]
    assert records
    assert all(r.levelname == "WARNING" and r.exc_info is None for r in records)


def test_network_glitches_do_not_stop_the_robot(sched):
    """failure_policy="skip": network glitches shouldn't stop the robot."""
    drives = []

    async def upload_data(node):
        raise ConnectionError("no route to host")

    sched.add(Node("cloud_upload", upload_data, rate=10, order=200, failure_policy="skip"))
    sched.add(Node("motor", lambda: drives.append(1), rate=10))

    sched.run(duration=1.0)

    assert len(drives) == 10
    assert sched.get_node_stats("cloud_upload")["errors_count"] == 10
    assert sched.stop_reason is None


# -- ignore ----------------------------------------------------------------------------


def test_ignore_logs_the_error_and_continues(sched, caplog):
    """Policy "ignore": log the error and continue."""
    times = []
    sched.add(Node("node", failing(0, journal=times), rate=10, failure_policy="ignore"))

    sched.tick_for(0.3)

    assert times == [0.0, 0.1, 0.2]
    (record,) = [r for r in caplog.records if r.name == "horus.node.node"]
    assert record.levelname == "ERROR"
    assert "no echo" in record.getMessage()


# -- on_error --------------------------------------------------------------------------


@pytest.mark.parametrize("policy", POLICIES)
def test_on_error_is_notified_first_and_never_swallows(sched, policy):
    """on_error(node, exc) is told of every exception, and the policy applies all the same."""
    told = []

    def on_error(node, exc):
        told.append((node.name, type(exc)))
        return True

    sched.add(Node("node", failing(0), rate=10, failure_policy=policy, on_error=on_error))

    if policy == "fatal":
        with pytest.raises(NodeError):
            sched.tick_once()
    else:
        sched.tick_once()

    assert told == [("node", BrokenSensor)]
    assert sched.get_node_stats("node")["errors_count"] == 1


@pytest.mark.parametrize("phase", ["init", "tick", "shutdown"])
def test_on_error_hears_of_every_phase(sched, phase):
    """on_error is told of exceptions in init, tick and shutdown alike."""
    told = []
    callbacks = {"tick": nothing, phase: failing()}
    sched.add(Node("node", rate=10, on_error=lambda n, e: told.append(str(e)), **callbacks))

    sched.run(duration=0.05)

    assert told == ["no echo"]


def test_a_raising_on_error_does_no_harm(sched, caplog):
    """What on_error raises itself is logged and goes no further."""
    times = []

    def on_error(node, exc):
        raise ValueError("cannot cope")

    sched.add(Node("node", failing(0, journal=times), rate=10, on_error=on_error))

    sched.tick_for(0.3)

    assert len(times) == 3
    assert any("cannot cope" in r.getMessage() for r in caplog.records)


# -- async ticks -------------------------------------------------------------------------


def test_a_cancelled_error_of_the_nodes_own_making_is_an_error_like_others(sched):
    """An async tick that raises CancelledError by itself fails; the node keeps ticking."""
    ticks = []

    async def tick(node):
        ticks.append(1)
        raise asyncio.CancelledError

    sched.add(Node("node", tick, rate=10))

    sched.tick_for(0.3)

    assert len(ticks) == 3
    assert sched.get_node_stats("node")["errors_count"] == 3


@pytest.mark.realtime
def test_a_fatal_error_while_others_are_mid_tick_lets_those_end(make, loop):
    """A fatal error does not cut off the tick that another thread is in."""
    journal = []
    inside = threading.Event()

    def slow(node):
        journal.append("begin")
        inside.set()
        threading.Event().wait(50 * ms)
        journal.append("end")

    def fail(node):
        if inside.is_set():
            raise BrokenSensor("no echo")

    sched = make(loop=loop)
    sched.add(Node("slow", slow, rate=5, order=0, shutdown=lambda: journal.append("down")))
    sched.add(Node("broken", as_async(fail), rate=100, order=1, failure_policy="fatal"))

    with pytest.raises(NodeError):
        sched.run(duration=20.0)

    assert journal == ["begin", "end", "down"]


def test_every_kind_is_covered_here():
    """The classes that these tests go through are all there are."""
    assert set(KINDS) == {str(kind) for kind in horus.ExecutionClass}
