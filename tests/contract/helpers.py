"""What the contract tests share: nodes of every class, and runs on a thread of their own."""

from __future__ import annotations

import asyncio
import contextlib
import inspect
import os
import re
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Coroutine, Iterator
from typing import Any, TypeVar

import uvloop

from horus import Node, Scheduler

T = TypeVar("T")

KINDS = ("BestEffort", "Event", "AsyncIo", "Rt", "Compute")
"""The execution classes, as the contract calls them."""

TRIGGER = "go"
"""The topic that the event nodes made here wait for."""

PATIENCE_S = 20.0
"""How long a noisy machine may take for what usually takes milliseconds [s]."""


def nothing(node: Node) -> None:
    """Do nothing: the tick of a node that only has to be there."""


def as_async(function: Callable[[Node], Any]) -> Callable[[Node], Any]:
    """Return `function` as a coroutine function."""
    if inspect.iscoroutinefunction(function):
        return function

    async def call(node: Node) -> Any:
        return function(node)

    return call


def node_of(
    kind: str,
    name: str,
    tick: Callable[[Node], Any] = nothing,
    *,
    rate: float = 100.0,
    **options: Any,
) -> Node:
    """Return a node of an execution class; plain callbacks become async where they must.

    BestEffort nodes run at their 30 Hz, Event nodes wait for the topic `TRIGGER`.
    """
    callbacks = {"tick": tick}
    for phase in ("init", "shutdown", "safe_state"):
        if phase in options:
            callbacks[phase] = options.pop(phase)
    if kind == "AsyncIo":
        callbacks = {phase: as_async(function) for phase, function in callbacks.items()}
    schedule: dict[str, Any] = {
        "BestEffort": {},
        "Event": {"on": TRIGGER},
        "AsyncIo": {"rate": rate},
        "Rt": {"rate": rate},
        "Compute": {"rate": rate, "compute": True},
    }[kind]
    return Node(name, **callbacks, **schedule, **options)


def wait_until(condition: Callable[[], object], patience_s: float = PATIENCE_S) -> None:
    """Return as soon as `condition()` holds; fail if it does not in time."""
    give_up_at = time.monotonic() + patience_s
    while not condition():
        assert time.monotonic() < give_up_at, f"not so within {patience_s} s"
        time.sleep(0.001)


async def until(condition: Callable[[], object]) -> None:
    """Return as soon as `condition()` holds, leaving the loop to others meanwhile."""
    for _ in range(int(PATIENCE_S / 0.001)):
        if condition():
            return
        await asyncio.sleep(0.001)
    raise AssertionError(f"not so within {PATIENCE_S} s")


@contextlib.contextmanager
def running(sched: Scheduler) -> Iterator[threading.Thread]:
    """Run a scheduler on a thread of its own while the block runs, then stop it.

    What `run()` raises is raised here.
    """
    errors: list[BaseException] = []

    def serve() -> None:
        try:
            sched.run()
        except BaseException as exc:
            errors.append(exc)

    thread = threading.Thread(target=serve, name="test-run", daemon=True)
    thread.start()
    try:
        wait_until(lambda: sched.is_running() or not thread.is_alive())
        # Past its first cycle, a run is not just starting but on its way.
        wait_until(lambda: sched.current_tick() > 0 or not thread.is_alive())
        yield thread
    finally:
        if thread.is_alive():
            sched.stop()
        thread.join(PATIENCE_S)
    assert not thread.is_alive(), "run() did not return after stop()"
    if errors:
        raise errors[0]


def run_until(
    sched: Scheduler, condition: Callable[[], object], patience_s: float = PATIENCE_S
) -> None:
    """Run a scheduler on the calling thread until `condition()` holds, then stop it.

    A noisy machine may sleep through any fixed time; what must happen is waited for.
    """
    over, met = threading.Event(), threading.Event()
    give_up_at = time.monotonic() + patience_s

    def watch() -> None:
        while not over.wait(0.001) and time.monotonic() < give_up_at:
            if condition():
                met.set()
                break
        while not over.wait(0.001):
            # A scheduler that is about to run has nothing to stop yet.
            if sched.is_running():
                sched.stop()

    watcher = threading.Thread(target=watch, name="test-watch")
    watcher.start()
    try:
        sched.run()
    finally:
        over.set()
        watcher.join()
    assert met.is_set() or condition(), f"not so within {PATIENCE_S} s"


def all_have_ticked(sched: Scheduler) -> bool:
    """Return whether every node has completed a tick."""
    return all(info["total_ticks"] > 0 for info in sched.get_all_nodes())


def run_async(work: Coroutine[Any, Any, T], loop: str) -> T:
    """Run a coroutine to its end on a loop of the given make."""
    factory = uvloop.new_event_loop if loop == "uvloop" else asyncio.new_event_loop
    with asyncio.Runner(loop_factory=factory) as runner:
        return runner.run(work)


def run_program(text: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a robot program in a process of its own, to a good end."""
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(text)],
        capture_output=True,
        env={**os.environ, **environment},
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done


def record_ticks(journal: list[Any], value: Callable[[], T]) -> Callable[[Node], None]:
    """Return a tick that appends `value()` to `journal`."""

    def tick(node: Node) -> None:
        journal.append(value())

    return tick


def named(value):
    """Return an id of a test that is the same in every process: without addresses."""
    return re.sub(r" at 0x[0-9a-f]+", "", repr(value))
