"""Fixtures of the contract tests; one fails whatever leaves something behind."""

from __future__ import annotations

import asyncio
import gc
import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import pytest

from horus import Node, Scheduler

from .helpers import KINDS, nothing, run_async

_LINGER_S = 3.0
"""How long threads and descriptors may take to go away after a test [s]."""


class _Belongings(NamedTuple):
    """What a test could leave behind."""

    threads: frozenset[threading.Thread]
    descriptors: int
    children: str
    settings: dict[str, Any]


def _take_stock() -> _Belongings:
    wakeup_fd = signal.set_wakeup_fd(-1)
    if wakeup_fd != -1:
        signal.set_wakeup_fd(wakeup_fd)
    horus_log = logging.getLogger("horus")
    pid = os.getpid()
    with open(f"/proc/{pid}/task/{pid}/children") as children:
        return _Belongings(
            threads=frozenset(threading.enumerate()),
            # One of them is the listing's own, each time.
            descriptors=len(os.listdir("/proc/self/fd")),
            children=children.read(),
            settings={
                "SIGINT handler": signal.getsignal(signal.SIGINT),
                "SIGTERM handler": signal.getsignal(signal.SIGTERM),
                "signal wakeup descriptor": wakeup_fd,
                "switch interval": sys.getswitchinterval(),
                "automatic garbage collection": gc.isenabled(),
                "CPU affinity": os.sched_getaffinity(0),
                "horus log handlers": list(horus_log.handlers),
                "horus log level": horus_log.level,
            },
        )


def _is_clean(before: _Belongings, after: _Belongings) -> bool:
    return (
        after.threads <= before.threads
        and after.descriptors <= before.descriptors
        and after.children == before.children
    )


def _open_loops() -> list[asyncio.AbstractEventLoop]:
    return [
        thing
        for thing in gc.get_objects()
        if isinstance(thing, asyncio.AbstractEventLoop) and not thing.is_closed()
    ]


@pytest.fixture(scope="session", autouse=True)
def _warmed_up() -> None:
    """Open what the process opens once and keeps, before anything is counted."""

    async def nap() -> None:
        await asyncio.sleep(0)

    for loop in ("asyncio", "uvloop"):
        run_async(nap(), loop)
        scheduler = Scheduler(loop=loop)
        for node in (Node("rt", nothing, rate=100), Node("best_effort", nothing)):
            scheduler.add(node)
        scheduler.run(duration=0.01)


@pytest.fixture(autouse=True)
def _leaves_nothing_behind(_warmed_up: None) -> Iterator[None]:
    """Fail a test that leaks a thread, loop, descriptor, process, signal handler or setting."""
    before = _take_stock()
    yield
    after = _take_stock()
    give_up_at = time.monotonic() + _LINGER_S
    while not _is_clean(before, after) and time.monotonic() < give_up_at:
        gc.collect()
        time.sleep(0.01)
        after = _take_stock()
    leaked = after.threads - before.threads
    assert not leaked, f"threads left behind: {sorted(thread.name for thread in leaked)}"
    assert after.descriptors <= before.descriptors, (
        f"descriptors left open: {before.descriptors} before, {after.descriptors} after; "
        f"event loops still open: {_open_loops()}"
    )
    assert after.children == before.children, "child processes left behind"
    assert after.settings == before.settings, "process settings changed"


@pytest.fixture
def make() -> Iterator[Callable[..., Scheduler]]:
    """Return a maker of schedulers that are stopped when the test ends."""
    made: list[Scheduler] = []

    def build(**options: Any) -> Scheduler:
        made.append(Scheduler(**options))
        return made[-1]

    yield build
    for scheduler in made:
        scheduler.stop()


@pytest.fixture(params=("asyncio", "uvloop"))
def loop(request: pytest.FixtureRequest) -> str:
    """Name each event loop that `run()` can use."""
    return request.param


@pytest.fixture(params=KINDS)
def kind(request: pytest.FixtureRequest) -> str:
    """Name each execution class."""
    return request.param


@pytest.fixture(params=(False, True), ids=("normal", "deterministic"))
def deterministic(request: pytest.FixtureRequest) -> bool:
    """Choose each mode of a scheduler."""
    return request.param
