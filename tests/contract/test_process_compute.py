"""compute="process": a node off the interpreter of its scheduler, and otherwise the same."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import functools
import itertools
import logging
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import types
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

import horus
from horus import Node, Pub, Scheduler, Sub, WorkerDied, WorkerError, ms
from horus.workers.process import WorkerProcess

from .helpers import nothing, run_program, run_until, running, wait_until

Messages = list[Any]


@dataclass
class Pose:
    """A message class of a module that can be imported."""

    x: float
    y: float


def worker(name: str, tick: Callable[[Node], Any], **options: Any) -> Node:
    """Return a node with a process of its own."""
    return Node(name, tick, **{"rate": 100, "compute": "process", **options})


def add_sink(sched: Scheduler, *topics: str) -> Messages:
    """Add a node that collects what is sent on topics."""
    collected: Messages = []

    def collect(node: Node) -> None:
        for topic in topics:
            collected.extend(node.recv_all(topic))

    subs = [Sub(topic, capacity=10_000) for topic in topics]
    sched.add(Node("sink", collect, rate=200, order=999, subs=subs))
    return collected


class Homesick:
    """Is pickled, and not unpickled in any other process."""

    def __deepcopy__(self, memo):
        return self

    def __reduce__(self):
        return _only_in, (os.getpid(),)


def _only_in(process):
    if os.getpid() != process:
        raise ValueError("not here")
    return Homesick()


class Stubborn:
    """Is not even pickled."""

    def __deepcopy__(self, memo):
        return self

    def __reduce__(self):
        raise TypeError("not me")


class Slow:
    """Takes its time to be pickled."""

    begun, go_on = threading.Event(), threading.Event()

    def __reduce__(self):
        self.begun.set()
        self.go_on.wait(20)
        return Slow, ()


CHILD_LIVES_S = 20.0


def _keep_by_fork():
    if os.fork() == 0:
        time.sleep(CHILD_LIVES_S)
        os._exit(0)


def _keep_by_shell():
    os.system(f"sleep {CHILD_LIVES_S} >/dev/null 2>&1 &")


def stats(sched: Scheduler, name: str = "worker") -> dict[str, Any]:
    """Return a node's statistics."""
    return sched.get_node_stats(name)


# -- the same as anywhere --------------------------------------------------------------


def test_it_runs_in_another_process_with_its_closures_and_lambdas(make, caplog):
    """What init() opens is there in the ticks, and in shutdown(); all in one process."""
    sched = make()
    offset = 100
    state = {"opened": None}

    def init(node):
        state["opened"] = os.getpid()

    def tick(node):
        value = (lambda tick: tick + offset)(horus.tick())
        node.send("out", {"pid": os.getpid(), "opened": state["opened"], "value": value})

    def shutdown(node):
        ended.append(os.getpid())
        node.log_warning("shut down in %d with %s", os.getpid(), state)

    ended = []
    out = add_sink(sched, "out")
    sched.add(worker("worker", tick, init=init, shutdown=shutdown, pubs=["out"]))
    run_until(sched, lambda: len(out) >= 3)

    assert len({message["pid"] for message in out}) == 1
    assert out[0]["pid"] != os.getpid()
    assert {message["opened"] for message in out} == {out[0]["pid"]}
    assert out[0]["value"] >= offset
    pid = out[0]["pid"]
    assert f"shut down in {pid} with {{'opened': {pid}}}" in caplog.text
    assert not ended
    assert state["opened"] is None, "the state lives in the worker"


def test_messages_flow_in_order_both_ways(make):
    """Everything that was queued since the last tick travels there; answers come in order."""
    sched = make()

    def source(node):
        for number in range(5):
            node.send("in", 5 * horus.tick() + number)

    def tick(node):
        while node.has_msg("in"):
            number = node.recv("in")
            node.send("out", ("got", number))
        assert node.recv("in") is None

    out = add_sink(sched, "out")
    sched.add(Node("source", source, rate=100, order=0, pubs=["in"]))
    sched.add(worker("worker", tick, order=10, subs=[Sub("in", capacity=10_000)], pubs=["out"]))
    run_until(sched, lambda: len(out) >= 100)

    numbers = [number for _, number in out]
    assert numbers == sorted(numbers)
    assert stats(sched)["dropped"] == 0


def test_messages_that_a_tick_leaves_are_there_at_the_next(make):
    """recv() takes one; has_msg() and recv_all() know of the others; more than fit are dropped."""
    sched = make()
    sched.publish("in", 0)

    def tick(node):
        if horus.tick() == 0:
            node.send("out", "ready")
        first, waiting = node.recv("in"), node.has_msg("in")
        if first == "begin":
            node.send("out", [first, waiting])
        elif waiting:
            node.send("out", [first, node.recv_all("in")])

    out = add_sink(sched, "out")
    node = worker("worker", tick, rate=20, subs=[Sub("in", capacity=4)], pubs=["out"])
    sched.add(node)
    with running(sched):
        wait_until(lambda: "ready" in out)
        time.sleep(10 * ms)
        for message in ("lost", "begin", 1, 2, 3):
            sched.publish("in", message)
        wait_until(lambda: len(out) >= 3)
        assert out[1:3] == [["begin", True], [1, [2, 3]]]
        wait_until(lambda: stats(sched)["dropped"] == 1)


def test_latest_and_topics_that_were_not_declared(make):
    """A node may open topics as it goes: with what is newest on them."""
    sched = make()
    sched.publish("map", "newest before the run")

    def tick(node):
        node.send("out", [node.latest("map"), node.latest("other"), node.has_msg("map")])

    out = add_sink(sched, "out")
    sched.add(worker("worker", tick, pubs=["out"]))
    with running(sched):
        wait_until(lambda: len(out) >= 1)
        assert out[0][0] == "newest before the run"
        sched.publish("map", "newer")
        wait_until(lambda: out[-1][0] == "newer")
    assert out[-1][1] is None


def test_numpy_arrays_arrive_whole_and_read_only_and_leave_whole(make):
    """Large ones go through shared memory, small ones by socket: the node sees no difference."""
    sched = make()
    shapes = {"small": (4, 4), "image": (480, 640, 3), "cloud": (20_000, 3)}

    def source(node):
        for name, shape in shapes.items():
            kind = np.uint8 if name == "image" else np.float64
            node.send("in", {"name": name, "data": np.full(shape, horus.tick() % 200, kind)})

    def tick(node):
        for message in node.recv_all("in"):
            data = message["data"]
            node.send("out", {**message, "twice": data * 2, "writable": data.flags.writeable})

    out = add_sink(sched, "out")
    sched.add(Node("source", source, rate=50, order=0, pubs=["in"]))
    sched.add(worker("worker", tick, rate=50, subs=[Sub("in", capacity=100)], pubs=["out"]))
    run_until(sched, lambda: len(out) >= 30)

    for message in out:
        assert message["data"].shape == shapes[message["name"]]
        assert message["data"].dtype == (np.uint8 if message["name"] == "image" else np.float64)
        assert np.array_equal(message["twice"], message["data"] * 2)
        value = message["data"].flat[0]
        assert np.array_equal(message["data"], np.full(shapes[message["name"]], value))
    thread_flags = []
    other = make()
    other.add(Node("source", source, rate=50, order=0, pubs=["in"]))
    other.add(
        Node(
            "thread",
            lambda n: thread_flags.extend(m["data"].flags.writeable for m in n.recv_all("in")),
            rate=50,
            compute=True,
            subs=["in"],
        )
    )
    run_until(other, lambda: thread_flags)
    assert {message["writable"] for message in out} == set(thread_flags)


def test_message_classes_are_the_same_on_both_sides(make):
    """A class of a module, or one that a function defines: typed topics check them as ever."""
    sched = make()

    class Local:
        def __init__(self, value):
            self.value = value

    def source(node):
        node.send(Pose, Pose(1.0, horus.tick()))
        node.send("local", Local(horus.tick()))

    def tick(node):
        for pose in node.recv_all(Pose):
            node.send("out", Pose(pose.x + 1, pose.y))
        for local in node.recv_all("local"):
            assert type(local) is Local
            node.send("back", Local(-local.value))

    out, back = [], []
    sched.add(Node("source", source, rate=50, order=0, pubs=[Pose, Pub("local", Local)]))
    pubs = [Pub("out", Pose), Pub("back", Local)]
    sched.add(worker("worker", tick, subs=[Pose, Sub("local", Local)], pubs=pubs))
    sched.add(Node("a", lambda n: out.extend(n.recv_all("out")), rate=50, subs=["out"]))
    sched.add(Node("b", lambda n: back.extend(n.recv_all("back")), rate=50, subs=["back"]))
    run_until(sched, lambda: len(out) >= 3 and len(back) >= 3)

    assert all(type(pose) is Pose and pose.x == 2.0 for pose in out)
    assert all(type(local) is Local for local in back)


def test_the_clock_functions_answer_as_anywhere(make):
    """now(), dt(), tick(), elapsed(), budget_remaining() and rng_float(), in init() too."""
    sched = make(tick_rate=100)

    def read():
        return {
            "now": horus.now(),
            "monotonic": time.monotonic(),
            "dt": horus.dt(),
            "tick": horus.tick(),
            "elapsed": horus.elapsed(),
            "left": horus.budget_remaining(),
            "random": horus.rng_float(),
        }

    out = add_sink(sched, "out")
    beside = []
    sched.add(
        worker(
            "worker",
            lambda node: node.send("out", read()),
            init=lambda node: node.send("out", read()),
            rate=50,
            budget=5 * ms,
            pubs=["out"],
        )
    )
    sched.add(Node("beside", lambda node: beside.append(read()), rate=50))
    run_until(sched, lambda: len(out) >= 20 and len(beside) >= 20)

    assert all(0 <= each["random"] < 1 for each in out)
    assert len({each["random"] for each in out}) > 10
    for each in out[1:]:
        wall = min(beside, key=lambda other: abs(other["monotonic"] - each["monotonic"]))
        skew = (each["now"] - wall["now"]) - (each["monotonic"] - wall["monotonic"])
        assert abs(skew) < 1e-3
        assert abs(each["elapsed"] - wall["elapsed"]) < 2.0
        assert 0 <= each["left"] <= 5 * ms
    ticks = [each["tick"] for each in out]
    assert ticks == sorted(ticks)
    dts = sorted(each["dt"] for each in out[1:])
    assert dts[len(dts) // 2] == pytest.approx(20 * ms, rel=0.2)


def test_log_records_come_home(make, caplog):
    """The node's log, any logger's, with levels, arguments and tracebacks."""
    caplog.set_level(logging.INFO)
    sched = make()

    def tick(node):
        if horus.tick() == 0:
            node.log_info("node says %s", 42)
            node.log_debug("not this")
            logging.getLogger("my.driver").warning("driver says %d", 7)
            try:
                raise ValueError("inner")
            except ValueError:
                logging.getLogger("my.driver").exception("went wrong")
        node.send("out", 1)

    out = add_sink(sched, "out")
    sched.add(worker("worker", tick, pubs=["out"]))
    run_until(sched, lambda: out)

    texts = {record.getMessage(): record for record in caplog.records}
    assert texts["node says 42"].name == "horus.node.worker"
    assert texts["driver says 7"].levelno == logging.WARNING
    assert "ValueError: inner" in caplog.text
    assert not any("not this" in text for text in texts)
    assert texts["node says 42"].process != os.getpid()


def test_request_stop(make):
    """A worker may end the run."""
    sched = make()

    def tick(node):
        node.request_stop()

    sched.add(worker("worker", tick))
    sched.run(duration=20)
    assert "worker" in (sched.stop_reason or "")


def test_a_subclass_of_node_takes_its_attributes_along(make):
    """A class with tick(), init() and shutdown(); its attributes live in the worker."""

    class Counter(Node):
        def __init__(self):
            super().__init__("worker", rate=100, compute="process", pubs=["out"])
            self.count = 0

        def tick(self):
            self.count += 1
            self.send("out", self.count)

    sched = make()
    counter = Counter()
    out = add_sink(sched, "out")
    sched.add(counter)
    run_until(sched, lambda: len(out) >= 5)
    assert out[:5] == [1, 2, 3, 4, 5]
    assert counter.count == 0


# -- budgets, deadlines, policies --------------------------------------------------------


def test_budget_deadline_and_on_miss(make):
    """A tick that takes too long is counted, and the next is skipped where that was asked for."""
    sched = make()

    def tick(node):
        time.sleep(15 * ms)
        node.send("out", horus.tick())

    out = add_sink(sched, "out")
    options = {"budget": 5 * ms, "deadline": 10 * ms, "on_miss": "skip"}
    sched.add(worker("worker", tick, rate=20, pubs=["out"], **options))
    run_until(sched, lambda: len(out) >= 4)

    counted = stats(sched)
    assert counted["budget_overruns"] >= 4
    assert counted["deadline_misses"] >= 4
    assert counted["skipped"] >= 3


@pytest.mark.parametrize("policy", ["ignore", "skip", "restart", "fatal"])
def test_failure_policies(make, policy):
    """What a tick raises comes home, with its traceback there as the cause."""
    sched = make()
    errors, ticks = [], itertools.count()

    def init(node):
        node.send("out", "init")

    def tick(node):
        if next(ticks) % 2 == 0:
            raise ZeroDivisionError("in the worker")
        node.send("out", "tick")

    out = add_sink(sched, "out")
    sched.add(
        worker(
            "worker",
            tick,
            init=init,
            pubs=["out"],
            rate=50,
            failure_policy=policy,
            on_error=lambda node, exc: errors.append(exc),
        )
    )
    if policy == "fatal":
        with pytest.raises(horus.NodeError, match="in the worker"):
            sched.run(duration=20)
    else:
        run_until(sched, lambda: len(errors) >= 3)
    inits = out.count("init")
    assert all(type(error) is ZeroDivisionError for error in errors)
    assert "in tick" in str(errors[0].__cause__)
    assert inits == 1 if policy != "restart" else inits >= 2


def test_an_error_that_cannot_travel_comes_as_a_worker_error(make):
    """Its name and text do."""
    sched = make()
    errors = []

    def tick(node):
        class Odd(Exception):
            def __reduce__(self):
                raise TypeError("no")

        raise Odd("but the text comes")

    sched.add(worker("worker", tick, on_error=lambda node, exc: errors.append(exc)))
    run_until(sched, lambda: errors)
    assert isinstance(errors[0], WorkerError)
    assert "Odd: but the text comes" in str(errors[0])


def test_init_that_fails_excludes_the_node_and_leaves_no_process(make, caplog):
    """As on a thread; see `_leaves_nothing_behind`."""
    sched = make()

    def init(node):
        raise OSError("no camera")

    sched.add(worker("worker", nothing, init=init))
    sched.add(Node("other", nothing, rate=50))
    run_until(sched, lambda: stats(sched, "other")["total_ticks"] > 3)
    assert stats(sched)["total_ticks"] == 0
    assert "no camera" in caplog.text


def test_a_module_that_the_worker_cannot_import_is_named(make, caplog):
    """As by any import, and the node is excluded."""
    sched = make()
    module = types.ModuleType("made_by_hand")
    exec("def tick(node): pass", module.__dict__)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, module.__name__, module)
        sched.add(worker("worker", module.tick))
        sched.add(Node("other", nothing, rate=50))
        run_until(sched, lambda: stats(sched, "other")["total_ticks"] > 3)
    assert stats(sched)["total_ticks"] == 0
    assert "No module named 'made_by_hand'" in caplog.text


# -- what a process adds -----------------------------------------------------------------


def _exit(node):
    os._exit(3)


def _segfault(node):
    ctypes.string_at(0)


def _kill(node):
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.parametrize(
    ("crash", "status", "words"),
    [
        (_exit, 3, "exited with status 3"),
        (_segfault, -signal.SIGSEGV, "killed by SIGSEGV"),
        (_kill, -signal.SIGKILL, "killed by SIGKILL"),
    ],
)
def test_a_worker_that_crashes_is_restarted(make, caplog, crash, status, words):
    """At once, with its exit code or signal; every other node keeps its rate."""
    sched = make()
    errors, ticks = [], itertools.count()

    def tick(node):
        node.send("out", os.getpid())
        if next(ticks) == 5:
            crash(node)

    out = add_sink(sched, "out")
    sched.add(
        worker(
            "worker",
            tick,
            pubs=["out"],
            failure_policy="restart",
            on_error=lambda node, exc: errors.append(exc),
        )
    )
    sched.add(Node("motor", nothing, rate=100, order=0))
    run_until(sched, lambda: len(set(out)) >= 2)

    assert isinstance(errors[0], WorkerDied)
    assert errors[0].status == status
    assert words in str(errors[0])
    assert words in caplog.text
    assert stats(sched)["restarts"] >= 1
    motor = stats(sched, "motor")
    assert motor["total_ticks"] > motor["skipped"]


def test_a_worker_that_dies_between_two_ticks_is_restarted_at_once(make):
    """Nobody waits for the next release to find out."""
    sched = make()
    out = add_sink(sched, "out")
    sched.add(
        worker(
            "worker",
            lambda node: node.send("out", os.getpid()),
            rate=2,
            pubs=["out"],
            failure_policy="restart",
        )
    )
    with running(sched):
        wait_until(lambda: out)
        os.kill(out[0], signal.SIGKILL)
        killed_at = time.monotonic()
        wait_until(lambda: stats(sched)["errors_count"] == 1)
        assert time.monotonic() - killed_at < 0.4
        wait_until(lambda: len(set(out)) == 2)
    assert stats(sched)["restarts"] == 1


@pytest.mark.parametrize("policy", ["ignore", "skip"])
def test_a_crash_restarts_whatever_the_policy_but_fatal(make, policy):
    """A node without its process could only fail for ever."""
    sched = make()
    out = add_sink(sched, "out")
    ticks = itertools.count()

    def tick(node):
        node.send("out", os.getpid())
        if next(ticks) == 3:
            os._exit(1)

    sched.add(worker("worker", tick, pubs=["out"], failure_policy=policy))
    run_until(sched, lambda: len(set(out)) >= 2)


def test_a_crash_is_fatal_where_failures_are(make):
    """The run ends with the error."""
    sched = make()
    sched.add(worker("worker", _exit, failure_policy="fatal"))
    with pytest.raises(horus.NodeError, match="exited with status 3"):
        sched.run(duration=20)


def test_a_frozen_worker_is_killed_and_comes_back(make, caplog):
    """The watchdog reports its stack there, isolates it and kills it; cleared, it starts again."""
    sched = make()
    ticks = itertools.count()

    def hang_up_here(node):
        while True:
            pass

    def tick(node):
        node.send("out", os.getpid())
        if next(ticks) == 5:
            hang_up_here(node)

    out = add_sink(sched, "out", "hook")
    sched.add(
        worker(
            "worker",
            tick,
            pubs=["out"],
            watchdog=500 * ms,  # a slow machine holds up a good tick, too
            safe_state=lambda node: node.send("hook", ("hook", os.getpid())),
        )
    )
    with running(sched):
        wait_until(lambda: stats(sched)["health"] == "isolated")
        first = out[0]
        wait_until(lambda: not _alive(first))
        # The hook runs in the worker, beside the frozen tick.
        wait_until(lambda: ("hook", first) in out)
        assert "hang_up_here" in caplog.text, "the stack is the worker's"
        wait_until(lambda: stats(sched)["errors_count"] >= 1)
        wait_until(lambda: sched.clear_safe_state() == [])
        wait_until(lambda: isinstance(out[-1], int) and out[-1] != first)
    assert stats(sched)["restarts"] == 1


def test_a_tick_that_hangs_at_the_end_of_the_run_is_bounded(make):
    """Its shutdown() runs beside it, and then the worker is ended."""
    sched = make(shutdown_timeout=0.5)
    out = add_sink(sched, "out")

    def tick(node):
        node.send("out", os.getpid())
        time.sleep(1000)

    sched.add(worker("worker", tick, pubs=["out"], shutdown=nothing))
    with running(sched):
        wait_until(lambda: out)
        asked_at = time.monotonic()
    assert time.monotonic() - asked_at < 6
    wait_until(lambda: not _alive(out[0]))


def test_the_worker_inherits_no_socket_of_its_scheduler(make):
    """Nor any other descriptor; a port that the program listens on is free when it ends."""
    sched = make()
    listener = socket.create_server(("127.0.0.1", 0))
    os.set_inheritable(listener.fileno(), True)

    def tick(node):
        links = []
        for entry in os.listdir("/proc/self/fd"):
            with contextlib.suppress(OSError):
                links.append((int(entry), os.readlink(f"/proc/self/fd/{entry}")))
        node.send("out", [link for number, link in links if number > 2])

    out = add_sink(sched, "out")
    inode = os.fstat(listener.fileno()).st_ino
    sched.add(worker("worker", tick, pubs=["out"]))
    try:
        run_until(sched, lambda: out)
    finally:
        listener.close()
    assert f"socket:[{inode}]" not in out[0]
    assert len([link for link in out[0] if link.startswith("socket:")]) == 2


def test_workers_run_behind_the_scheduler(make):
    """At a lower priority, without real-time scheduling, in a session of their own."""
    sched = make()
    out = add_sink(sched, "out")

    def tick(node):
        node.send("out", (os.nice(0), os.sched_getscheduler(0), os.getsid(0)))

    sched.add(worker("worker", tick, pubs=["out"]))
    run_until(sched, lambda: out)
    niceness, policy, session = out[0]
    assert niceness > os.nice(0)
    assert policy == os.SCHED_OTHER
    assert session != os.getsid(0)


def test_ctrl_c_is_for_the_scheduler(make):
    """A worker shuts down in order: SIGINT does not reach it."""
    run_program("""
        import os, signal, threading, time
        from horus import Node, Scheduler

        def tick(node):
            node.send("pid", os.getpid())

        def shutdown(node):
            print("shut down in order", flush=True)

        sched = Scheduler()
        seen = []
        sched.add(Node("w", tick, rate=50, compute="process", pubs=["pid"], shutdown=shutdown))

        def interrupt(node):
            if node.recv("pid") is not None and not seen:
                seen.append(1)
                os.killpg(os.getpgid(0), signal.SIGINT)

        os.setsid() if os.getsid(0) != os.getpid() else None
        sched.add(Node("i", interrupt, rate=50, subs=["pid"]))
        sched.run(duration=10)
        assert seen
    """)


@pytest.mark.parametrize("mode", ["tick_once", "deterministic"])
def test_it_runs_inline_in_steps_and_in_virtual_time(make, mode):
    """Nothing is gained from a process there, and everything can be looked at."""
    seen = []
    sched = make(deterministic=True) if mode == "deterministic" else make()
    sched.add(worker("worker", lambda node: seen.append(os.getpid())))
    if mode == "tick_once":
        sched.tick_once()
        sched.stop()
    else:
        sched.tick_for(0.1)
        sched.stop()
    assert set(seen) == {os.getpid()}


# -- what cannot travel --------------------------------------------------------------------


class Device:
    """Holds what cannot be pickled, deeper down."""

    def __init__(self):
        self.ports = {"left": [threading.Lock()]}


def _by_closure():
    lock = threading.Lock()
    return Node("worker", lambda: lock, compute="process")


def _by_comprehension():
    locks = [threading.Lock()]
    return Node("worker", lambda: [lock for lock in locks for _ in locks], compute="process")


def _by_nested_function():
    lock = threading.Lock()

    def tick():
        return (lambda: lock)()

    return Node("worker", tick, compute="process")


def _by_default():
    return Node("worker", lambda node, lock=threading.Lock(): lock, compute="process")  # noqa: B008


def _by_partial():
    return Node("worker", functools.partial(print, threading.Lock()), compute="process")


def _by_attribute():
    class Robot(Node):
        def tick(self):
            pass

    robot = Robot("worker", compute="process")
    robot.device = Device()
    return robot


@pytest.mark.parametrize(
    ("make_node", "named"),
    [
        (_by_closure, "tick() uses 'lock', a _thread.lock,"),
        (_by_comprehension, "tick() uses 'locks', which has [0], a _thread.lock,"),
        (_by_nested_function, "tick() uses 'lock', a _thread.lock,"),
        (_by_default, "tick() uses 'lock', a _thread.lock,"),
        (_by_partial, "tick() has argument 0, a _thread.lock,"),
        (
            _by_attribute,
            "it has .device, which has .ports, which has ['left'], which has [0], a _thread.lock,",
        ),
    ],
)
def test_what_cannot_travel_is_named(make, caplog, make_node, named):
    """With the way to it, and what to do about it; nobody else is kept from running."""
    sched = make()
    sched.add(make_node())
    sched.add(Node("other", nothing, rate=50))
    run_until(sched, lambda: stats(sched, "other")["total_ticks"] > 3)
    assert named in caplog.text
    assert "make it in init()" in caplog.text


def test_an_output_that_cannot_travel_is_named(make):
    """The tick fails, and goes on with the next."""
    sched = make()
    errors = []

    def tick(node):
        if horus.tick() == 0:
            node.send("out", threading.Lock())
        node.send("out", "fine")

    out = add_sink(sched, "out")
    sched.add(worker("worker", tick, pubs=["out"], on_error=lambda n, exc: errors.append(exc)))
    run_until(sched, lambda: out and errors)
    assert "topic 'out'" in str(errors[0])


def test_an_input_that_cannot_travel_is_named_and_the_others_arrive(make):
    """The tick runs with the rest, and counts as failed."""
    sched = make()
    errors = []

    out = add_sink(sched, "out")

    def tick(node):
        for message in node.recv_all("in"):
            node.send("out", message)

    sched.add(worker("worker", tick, subs=["in"], on_error=lambda n, exc: errors.append(exc)))
    with running(sched):
        wait_until(lambda: stats(sched)["total_ticks"] > 0)
        for message in ("before", Stubborn(), "after"):
            sched.publish("in", message)
        wait_until(lambda: len(out) == 2 and errors)
    assert out == ["before", "after"]
    assert isinstance(errors[0], WorkerError)
    assert "Stubborn" in str(errors[0])
    assert stats(sched)["dropped"] == 1


@pytest.mark.parametrize("message", [Homesick(), Stubborn()], ids=lambda each: type(each).__name__)
def test_a_newest_message_that_cannot_travel_does_not_keep_a_worker_from_its_start(
    make, message, caplog
):
    """The node starts without it, and says so; an undeclared topic has none then."""
    sched = make()
    out = add_sink(sched, "out")

    def tick(node):
        node.send("out", (node.latest("in"), node.recv("undeclared"), horus.tick()))

    sched.add(worker("worker", tick, subs=["in"], pubs=["out"]))
    for topic in ("in", "undeclared"):
        sched.publish(topic, message)
    run_until(sched, lambda: len(out) >= 3)
    assert {row[:2] for row in out} == {(None, None)}
    # Questions and answers have not come out of step.
    numbers = [row[2] for row in out]
    assert numbers == sorted(set(numbers))
    assert "topic 'in' cannot" in caplog.text


def test_an_input_that_cannot_be_unpickled_fails_the_tick_and_nothing_else(make):
    """The worker goes on with the next call."""
    sched = make()
    errors = []
    out = add_sink(sched, "out")

    def tick(node):
        for message in node.recv_all("in"):
            node.send("out", (message, os.getpid()))

    sched.add(
        worker(
            "worker", tick, subs=["in"], pubs=["out"], on_error=lambda n, exc: errors.append(exc)
        )
    )
    with running(sched):
        wait_until(lambda: stats(sched)["total_ticks"] > 0)
        sched.publish("in", "before")
        wait_until(lambda: len(out) == 1)
        sched.publish("in", Homesick())
        wait_until(lambda: errors)
        sched.publish("in", "after")
        wait_until(lambda: len(out) == 2)
    assert [message for message, _ in out] == ["before", "after"]
    assert len({process for _, process in out}) == 1
    assert "not here" in str(errors[0])


def test_what_the_log_of_the_application_does_with_a_record_is_that_tick_s_error(make, caplog):
    """Messages of later ticks are still those of later ticks."""
    sched = make()
    errors = []
    out = add_sink(sched, "out")

    def refuse(record):
        if record.getMessage() == "bad":
            raise ZeroDivisionError
        return True

    ticks = itertools.count()

    def tick(node):
        number = next(ticks)
        if number % 5 == 4:
            node.log_warning("bad")
        node.send("out", number)

    sched.add(worker("worker", tick, pubs=["out"], on_error=lambda n, exc: errors.append(exc)))
    logger = logging.getLogger("horus.node.worker")
    logger.addFilter(refuse)
    try:
        run_until(sched, lambda: len(errors) >= 2 and len(out) > 12)
    finally:
        logger.removeFilter(refuse)
    assert {type(exc) for exc in errors} == {ZeroDivisionError}
    assert out == list(range(len(out)))
    assert len(errors) == len(out) // 5


def test_a_log_call_that_is_malformed_fails_no_tick(make, capfd):
    """As on a thread: it is told on stderr. What cannot travel of a record stays behind."""
    sched = make()
    errors = []
    out = add_sink(sched, "out")
    heard = []

    class Listener(logging.Handler):
        def emit(self, record):
            heard.append(record)

    def tick(node):
        logger = logging.getLogger("horus.driver")
        logger.error("%d", "x")
        logger.error("told", extra={"lock": threading.Lock(), "axle": 3})
        node.send("out", 1)

    sched.add(worker("worker", tick, pubs=["out"], on_error=lambda n, exc: errors.append(exc)))
    listener = Listener()
    logging.getLogger("horus.driver").addHandler(listener)
    try:
        run_until(sched, lambda: len(out) >= 3)
    finally:
        logging.getLogger("horus.driver").removeHandler(listener)
    assert not errors
    assert "Logging error" in capfd.readouterr().err
    assert {(record.getMessage(), record.axle) for record in heard} == {("told", 3)}


@pytest.mark.parametrize("keep", [_keep_by_fork, _keep_by_shell])
def test_a_crash_is_noticed_though_a_child_of_the_worker_lives(make, keep):
    """It holds the worker's sockets open."""
    sched = make()
    out = add_sink(sched, "out")
    ticks = itertools.count()

    def tick(node):
        node.send("out", os.getpid())
        if next(ticks) == 3:
            keep()
            os._exit(1)

    sched.add(worker("worker", tick, pubs=["out"], failure_policy="restart"))
    began = time.monotonic()
    run_until(sched, lambda: len(set(out)) >= 2)
    assert time.monotonic() - began < CHILD_LIVES_S / 2


def test_a_service_that_is_told_to_end_is_told_as_a_whole_and_workers_end_in_order(make):
    """A service manager sends SIGTERM to every process: `shutdown()` runs nevertheless."""
    sched = make()
    out = add_sink(sched, "out")
    sched.add(
        worker(
            "worker",
            lambda node: node.send("out", os.getpid()),
            shutdown=lambda node: node.send("out", "shutdown"),
            pubs=["out"],
        )
    )
    last = sched.subscribe("out", capacity=100_000)
    with running(sched):
        wait_until(lambda: out)
        for number in (signal.SIGTERM, signal.SIGINT):
            os.kill(out[0], number)
        count = len(out)
        wait_until(lambda: len(out) > count + 3)
    assert len(set(out) - {"shutdown"}) == 1
    assert last.recv_all()[-1] == "shutdown"


def test_a_worker_that_cannot_be_started_leaves_no_descriptor(make, monkeypatch, caplog):
    """The node is excluded, and the reason told."""
    before = len(os.listdir("/proc/self/fd"))

    def refuse(*args):
        raise OSError(errno.EMFILE, "too many open files")

    monkeypatch.setattr(socket, "socketpair", refuse)
    with pytest.raises(WorkerError, match="no worker process can be had"):
        WorkerProcess("worker", nothing)
    assert len(os.listdir("/proc/self/fd")) == before


def test_a_node_that_is_left_behind_while_its_worker_starts_gets_none(make, caplog):
    """A run that has ended starts no process any more."""
    sched = make(shutdown_timeout=0.2)
    slow = Slow()
    sched.add(worker("worker", lambda node: slow))
    thread = threading.Thread(target=lambda: sched.run(duration=20), daemon=True)
    thread.start()
    assert Slow.begun.wait(20)
    sched.stop()
    thread.join(20)
    assert not thread.is_alive()
    Slow.go_on.set()
    wait_until(lambda: "dismissed" in caplog.text)
    wait_until(lambda: all(each.name != "horus-worker:worker" for each in threading.enumerate()))


# -- a parent that goes, and long runs ------------------------------------------------------


def test_a_parent_that_is_killed_leaves_no_worker():
    """SIGKILL: nobody could tell the worker, and it ends at once."""
    done = run_program("""
        import os, signal, subprocess, sys, textwrap, time
        program = textwrap.dedent('''
            import os, signal, time
            import numpy as np
            from horus import Node, Scheduler
            def tick(node):
                node.send("pid", {"pid": os.getpid(), "image": np.zeros(1_000_000)})
                time.sleep(0.02)
            def die(node):
                message = node.recv("pid")
                if message:
                    print(message["pid"], flush=True)
                    os.kill(os.getpid(), signal.SIGKILL)
            sched = Scheduler()
            sched.add(Node("w", tick, rate=20, compute="process", pubs=["pid"]))
            sched.add(Node("d", die, rate=50, subs=["pid"]))
            sched.run(duration=10)
        ''')
        before = set(os.listdir("/dev/shm"))
        run = subprocess.Popen(
            [sys.executable, "-c", program], stdout=subprocess.PIPE, text=True
        )
        pid = int(run.stdout.readline())
        assert run.wait() == -signal.SIGKILL
        for _ in range(300):
            try:
                with open(f"/proc/{pid}/stat") as stat:
                    if stat.read().rpartition(")")[2].split()[0] == "Z":
                        break
            except (FileNotFoundError, ProcessLookupError):
                break
            time.sleep(0.01)
        else:
            os.kill(pid, signal.SIGKILL)
            raise SystemExit("the worker lives on")
        assert set(os.listdir("/dev/shm")) <= before
    """)
    assert done.stderr == ""


def test_the_worker_runs_with_the_interpreter_options_of_the_program(tmp_path):
    """Assertions, warnings and development mode mean the same there."""
    program = tmp_path / "robot.py"
    program.write_text(
        """
import sys
import horus
from horus import Node

def settings():
    return sys.flags.optimize, sys.flags.dont_write_bytecode, sys.warnoptions, sys._xoptions

def tell(node):
    node.send("settings", list(map(str, settings())))

def hear(node):
    print(node.recv("settings") == list(map(str, settings())), *settings()[:2])
    node.request_stop()

horus.run(
    Node("teller", tell, rate=20, compute="process", pubs=["settings"]),
    Node("hearer", hear, on="settings"),
    duration=20,
)
"""
    )
    options = ["-O", "-B", "-W", "error::ResourceWarning", "-X", "dev", "-X", "frozen_modules=off"]
    done = subprocess.run(
        [sys.executable, *options, program], capture_output=True, text=True, timeout=60
    )
    assert done.stdout.splitlines()[0] == "True 1 1", done.stderr


@pytest.mark.parametrize("kind", ["None", "Plan"])
def test_a_program_of_its_own_with_classes_in_main(tmp_path, kind):
    """No `if __name__ == "__main__"` is needed, and classes of the program travel both ways.

    Also those that topics are declared with.
    """
    program = tmp_path / "robot.py"
    program.write_text(
        """
import dataclasses, os
import horus
from horus import Node, Pub, Scheduler, Sub

@dataclasses.dataclass
class Plan:
    steps: list

def tick(node):
    plan = node.recv("ask")
    if plan is not None:
        assert type(plan) is Plan
        node.send("answer", Plan([*plan.steps, os.getpid()]))

def ask(node):
    node.send("ask", Plan([horus.tick()]))

def hear(node):
    plan = node.recv("answer")
    if plan is not None:
        assert type(plan) is Plan, type(plan)
        print("answer", plan.steps[1] != os.getpid())
        node.request_stop()

sched = Scheduler()
kind = KIND
ports = dict(subs=[Sub("ask", kind)], pubs=[Pub("answer", kind)])
sched.add(Node("asker", ask, rate=50, pubs=[Pub("ask", kind)]))
sched.add(Node("planner", tick, rate=50, compute="process", **ports))
sched.add(Node("hearer", hear, on="answer", subs=["answer"], failure_policy="fatal"))
sched.run(duration=20)
""".replace("KIND", kind)
    )
    done = run_program(f"""
        import runpy, subprocess, sys
        done = subprocess.run([sys.executable, {str(program)!r}], capture_output=True, text=True)
        sys.stderr.write(done.stderr)
        print(done.stdout)
        sys.exit(done.returncode)
    """)
    assert done.stdout.split() == ["answer", "True"]


def test_a_worker_that_floods_its_output_is_bounded(make):
    """What nobody can keep up with waits in the worker, and leaves when nobody looks any more."""
    sched = make()

    def tick(node):
        if horus.tick() == 0:
            for number in range(400):
                node.send("flood", np.full(100_000, number, np.float64))
        node.send("out", horus.tick())

    def slow(node):
        message = node.recv("flood")
        if message is not None:
            seen.append(int(message[0]))

    seen, most = [], 0
    out = add_sink(sched, "out")
    sched.add(worker("worker", tick, pubs=["flood", "out"]))
    sched.add(Node("slow", slow, rate=20, subs=[Sub("flood", capacity=2)]))
    before = len(os.listdir("/proc/self/fd"))
    with running(sched):
        give_up_at = time.monotonic() + 20
        while len(out) < 5 and time.monotonic() < give_up_at:
            most = max(most, len(os.listdir("/proc/self/fd")) - before)
            time.sleep(1 * ms)
    assert len(out) >= 5
    assert seen
    assert most < 40


@pytest.mark.parametrize("ticks", [3_000, pytest.param(10_000, marks=pytest.mark.soak)])
def test_thousands_of_ticks_with_arrays_leak_nothing(make, ticks):
    """Neither descriptors nor memory, here or there."""
    sched = make(tick_rate=1000)
    image = np.zeros(100_000, np.uint8)

    def tick(node):
        message = node.recv("in")
        if message is None:
            return
        with open("/proc/self/statm") as statm:
            pages = int(statm.read().split()[1])
        node.send("out", {"image": message, "use": (len(os.listdir("/proc/self/fd")), pages)})

    uses = []
    sched.add(Node("source", lambda node: node.send("in", image), rate=1000, order=0, pubs=["in"]))
    sched.add(worker("worker", tick, rate=1000, subs=[Sub("in", capacity=2)], pubs=["out"]))

    def hear(node):
        uses.extend(
            (*message["use"], len(os.listdir("/proc/self/fd"))) for message in node.recv_all("out")
        )

    sched.add(Node("sink", hear, rate=100, subs=[Sub("out", capacity=64)]))
    run_until(sched, lambda: len(uses) >= ticks, patience_s=60.0)

    early, late = uses[100:400], uses[-300:]
    assert max(use[0] for use in late) <= max(use[0] for use in early) + 8
    assert max(use[2] for use in late) <= max(use[2] for use in early) + 16
    pages = max(use[1] for use in late) - max(use[1] for use in early)
    assert pages * os.sysconf("SC_PAGE_SIZE") < 16e6


def test_a_hundred_runs_in_a_row_can_be_had(make):
    """Ten, to be quick: each run has a new worker, and each leaves nothing behind."""
    sched = make()
    pids = []
    sched.add(worker("worker", lambda node: node.send("pid", os.getpid()), rate=100, pubs=["pid"]))
    sched.add(Node("sink", lambda node: pids.extend(node.recv_all("pid")), rate=100, subs=["pid"]))
    for count in range(1, 6):
        run_until(sched, lambda count=count: len(set(pids)) == count)


def test_removal_and_addition_while_running(make):
    """A worker comes and goes with its node."""
    sched = make()
    out = add_sink(sched, "out")
    with running(sched):
        sched.add(worker("worker", lambda node: node.send("out", os.getpid()), pubs=["out"]))
        wait_until(lambda: out)
        sched.remove_node("worker")
        wait_until(lambda: not _alive(out[0]))


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True
