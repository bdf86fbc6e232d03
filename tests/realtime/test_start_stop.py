"""Starting and stopping leaves the process as it was, however often and whatever happened."""

from __future__ import annotations

import asyncio
import gc
import logging
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from typing import Any, ClassVar, Literal

import pytest

from horus import Node, NodeError, Scheduler
from horus.os_rt import timer_slack_ns

pytestmark = [
    pytest.mark.realtime,
    pytest.mark.skipif(sys.platform != "linux", reason="reads /proc"),
]

GRACE_S = 3.0


def status(*fields: str) -> dict[str, str]:
    """Return fields of /proc/self/status."""
    with open("/proc/self/status", encoding="ascii") as lines:
        pairs = dict(line.rstrip("\n").split(":\t", 1) for line in lines if ":\t" in line)
    return {field: pairs[field].strip() for field in fields}


def tuning() -> dict[str, Any]:
    """Return what real-time scheduling may change of this process and thread."""
    return {
        "policy": os.sched_getscheduler(0),
        "priority": os.sched_getparam(0).sched_priority,
        "niceness": os.getpriority(os.PRIO_PROCESS, threading.get_native_id()),
        "cores": os.sched_getaffinity(0),
        "timer slack": timer_slack_ns(),
        "locked memory": status("VmLck"),
        "automatic collection": (gc.isenabled(), gc.get_threshold(), gc.get_freeze_count()),
        "switch interval": sys.getswitchinterval(),
    }


TUNING = tuning() if sys.platform == "linux" else {}
"""What they were before the first run of this process."""


def settings() -> dict[str, Any]:
    """Return everything of this process and thread that a run may change."""
    wakeup_fd = signal.set_wakeup_fd(-1)
    signal.set_wakeup_fd(wakeup_fd)
    log = logging.getLogger("horus")
    return {
        "signal handlers": {
            number: signal.getsignal(number) for number in sorted(signal.valid_signals())
        },
        "signals": status("SigCgt", "SigIgn", "SigBlk"),
        "wake-up descriptor": wakeup_fd,
        "log": (log.level, list(log.handlers), list(logging.getLogger().handlers)),
        "excepthooks": (sys.excepthook, threading.excepthook, sys.unraisablehook),
        **tuning(),
    }


def belongings() -> tuple[set[int], dict[str, int], str]:
    """Return what is held open: threads as the kernel counts them, descriptors, children."""
    open_files: dict[str, int] = {}
    for descriptor in os.listdir("/proc/self/fd"):
        try:
            target = os.readlink(f"/proc/self/fd/{descriptor}").partition(":[")[0]
        except FileNotFoundError:  # the listing's own
            continue
        open_files[target] = open_files.get(target, 0) + 1
    with open(f"/proc/self/task/{threading.get_native_id()}/children", encoding="ascii") as file:
        return {int(task) for task in os.listdir("/proc/self/task")}, open_files, file.read()


class Unchanged:
    """A block after which the process is what it was before."""

    def __enter__(self) -> None:
        gc.collect()
        self._settings, self._belongings = settings(), belongings()

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is not None:
            return
        assert settings() == self._settings
        assert tuning() == TUNING
        give_up_at = time.monotonic() + GRACE_S
        while belongings() != self._belongings and time.monotonic() < give_up_at:
            gc.collect()
            time.sleep(0.01)
        assert belongings() == self._belongings


@pytest.fixture(scope="module", autouse=True)
def _warmed_up() -> None:
    """Open what a process opens once and keeps."""
    for loop in ("uvloop", "asyncio"):
        for _ in range(2):
            mixed(loop=loop, rt=True, watchdog_ms=500).run(0.05)


async def breathe(node: Node) -> None:
    """Let go of the loop for a moment."""
    await asyncio.sleep(0.0005)


def mixed(**options: Any) -> Scheduler:
    """Return a scheduler with nodes of every class, one of them critical."""
    sched = Scheduler(**options)
    for node in (
        Node("rt", lambda node: node.send("t", 1), rate=500, pubs="t", safe_state=lambda: None),
        Node("pinned", lambda: None, rate=200, core=0, priority=60),
        Node("best_effort", lambda: None),
        Node("event", lambda: None, on="t"),
        Node("urgent", lambda: None, on="t", budget=0.1),
        Node("async_event", breathe, on="t"),
        Node("async", breathe, rate=200, watchdog=0.3),
        Node("compute", lambda: None, rate=200, compute=True),
    ):
        sched.add(node)
    sched.add_critical_node("rt", timeout_ms=400)
    return sched


@pytest.mark.parametrize("loop", ["uvloop", "asyncio"])
def test_a_hundred_starts_and_stops_leave_the_process_as_it_was(loop: str) -> None:
    """Mixed classes, a watchdog and rt=True: nothing is left behind, and nothing is changed."""
    # In a process of its own: to lock the memory of this one, a hundred times, takes long.
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        pool.submit(start_and_stop_fifty_times, loop).result()


def start_and_stop_fifty_times(loop: str) -> None:
    """Compare what the process is and has before and after."""
    mixed(loop=loop, rt=True, watchdog_ms=500).run(0.05)
    sched = mixed(loop=loop, rt=True, watchdog_ms=500, cores=[0])
    during: list[dict[str, Any]] = []
    sched.add(Node("witness", lambda: during or during.append(settings())))
    sched.run(0.3)
    with Unchanged():
        for _ in range(50):
            sched.run(0.004)

    stats = sched.get_all_nodes()
    assert all(info["total_ticks"] > 0 for info in stats)
    assert sched.safety_stats()["watchdog_expirations"] == 0
    # It was not for want of anything to change.
    assert during[0]["switch interval"] < sys.getswitchinterval()
    assert during[0]["signals"] != settings()["signals"]
    for name in ("automatic collection", "cores", "timer slack"):
        assert during[0][name] != TUNING[name], name
    if sched.capabilities()["memory_locking"]:
        assert during[0]["locked memory"] != settings()["locked memory"]


def test_a_scheduler_that_is_new_each_time_leaves_nothing_either() -> None:
    """Not even what is made once per scheduler stays when the scheduler goes."""
    with Unchanged():
        for _ in range(10):
            mixed(rt=True, watchdog_ms=500).run(0.004)


def freeze(sched: Scheduler) -> None:
    """Isolate a node, with the whole system in its safe state, then let it end."""
    sched.add(Node("frozen", lambda: time.sleep(0.05), rate=1, watchdog=0.01))
    sched.add_critical_node("frozen", timeout_ms=5)
    sched.run(0.1)
    assert sched.safety_stats()["safe_state"] is True


def fail(sched: Scheduler) -> None:
    """End with a fatal error."""

    def broken(node: Node) -> None:
        raise OSError("no echo")

    sched.add(Node("broken", broken, rate=100, failure_policy="fatal"))
    with pytest.raises(NodeError):
        sched.run(5.0)


def interrupt(sched: Scheduler) -> None:
    """End with a signal."""
    sched.add(Node("killer", lambda: os.kill(os.getpid(), signal.SIGINT), rate=0.1))
    sched.run(5.0)
    assert "SIGINT" in (sched.stop_reason or "")


class EventEnteredSlowly(asyncio.Event):
    """An event in which a signal comes between the look at the flag and the wait for it."""

    signals: ClassVar[list[int]] = [signal.SIGINT]

    async def wait(self) -> Literal[True]:
        if self._value:
            return True
        if threading.current_thread() is threading.main_thread() and self.signals:
            signal.raise_signal(self.signals.pop())
        future = self._get_loop().create_future()
        self._waiters.append(future)
        await future
        return True


def test_a_signal_that_interrupts_the_beginning_of_the_wait_is_not_lost(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A handler runs wherever the main thread is: not even there does a stop get lost."""
    sched = Scheduler()
    with monkeypatch.context() as patch:
        patch.setattr("horus.loop.runtime.asyncio.Event", EventEnteredSlowly)
        began = time.monotonic()
        sched.run(10.0)

    assert "SIGINT" in (sched.stop_reason or "")
    assert time.monotonic() - began < 5.0


def cancel(sched: Scheduler) -> None:
    """Run in an application that is cancelled."""

    async def main() -> None:
        run = asyncio.ensure_future(sched.arun())
        await asyncio.sleep(0.02)
        run.cancel()
        with pytest.raises(asyncio.CancelledError):
            await run

    asyncio.run(main())


def step(sched: Scheduler) -> None:
    """Take steps, of both kinds."""
    sched.tick_once()
    sched.tick_for(0.01)
    sched.tick_once(["rt"])
    sched.stop()


def run_elsewhere(sched: Scheduler) -> None:
    """Run in a thread that is not the main one."""
    runner = threading.Thread(target=sched.run)
    runner.start()
    while not sched.is_running():
        time.sleep(0.001)
    sched.stop()
    runner.join()


@pytest.mark.parametrize("end", [freeze, fail, interrupt, cancel, step, run_elsewhere])
def test_every_way_to_end_leaves_the_process_as_it_was(end: Callable[[Scheduler], None]) -> None:
    """Isolation, a fatal error, a signal, a cancellation, steps: all of it is undone."""
    end(mixed(rt=True, watchdog_ms=500))
    with Unchanged():
        for _ in range(2):
            end(mixed(rt=True, watchdog_ms=500))


@pytest.mark.parametrize("first_to_end", ["first to begin", "last to begin"])
def test_runs_that_share_an_event_loop_give_its_thread_back(first_to_end: str) -> None:
    """In whatever order they end, the application's thread is what it was before both."""

    async def main() -> None:
        first = Scheduler(name="first", rt=True, cores=[0])
        second = Scheduler(name="second", rt=True, cores=[max(os.sched_getaffinity(0))])
        runs = [asyncio.ensure_future(first.arun())]
        await asyncio.sleep(0.02)
        runs.append(asyncio.ensure_future(second.arun()))
        await asyncio.sleep(0.02)
        assert timer_slack_ns() != TUNING["timer slack"]
        ends = [first, second] if first_to_end == "first to begin" else [second, first]
        for sched in ends:
            sched.stop()
            await runs[sched is second]

    with Unchanged():
        asyncio.run(main())


def test_two_schedulers_at_once_give_back_what_they_share() -> None:
    """Memory locks, garbage collection and the switch interval outlast the first to end."""
    with Unchanged():
        interval = sys.getswitchinterval()
        long, short = mixed(rt=True, name="long"), mixed(rt=True, name="short")
        runner = threading.Thread(target=long.run)
        runner.start()
        while not long.current_tick():
            time.sleep(0.001)
        short.run(0.02)
        assert sys.getswitchinterval() < interval
        assert not gc.isenabled()
        if long.capabilities()["memory_locking"]:
            assert status("VmLck") != {"VmLck": "0 kB"}
        long.stop()
        runner.join()
