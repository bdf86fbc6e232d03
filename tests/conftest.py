"""Fixtures for all tests: what a test acquires, it gives back."""

from __future__ import annotations

import gc
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator

import pytest

from horus import Scheduler

_GRACE_S = 2.0

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # A shell starts what it runs in the background so, and the tests' programs would be deaf, too.
    signal.signal(signal.SIGINT, signal.default_int_handler)


def _threads() -> set[threading.Thread]:
    return {thread for thread in threading.enumerate() if thread.is_alive()}


def _descriptors() -> int:
    return len(os.listdir("/proc/self/fd"))


@pytest.fixture(scope="session")
def loops_are_loaded() -> None:
    """Run once on each loop: uvloop keeps a few descriptors from its first use on."""
    for loop in ("uvloop", "asyncio"):
        Scheduler(loop=loop).run(0.001)


@pytest.fixture
def leaves_nothing_behind(loops_are_loaded: None) -> Iterator[None]:
    """Fail a test that leaves a thread, a descriptor, a handler or a switch interval behind."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    interval = sys.getswitchinterval()
    threads = _threads()
    gc.collect()
    descriptors = _descriptors()
    yield
    deadline = time.monotonic() + _GRACE_S
    while time.monotonic() < deadline:
        gc.collect()
        if _threads() <= threads and _descriptors() <= descriptors:
            break
        time.sleep(0.02)
    assert _threads() - threads == set()
    assert _descriptors() <= descriptors
    assert sys.getswitchinterval() == interval
    for number, handler in handlers.items():
        assert signal.getsignal(number) is handler
