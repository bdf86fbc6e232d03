"""Ordered shutdown: no more ticks, then `shutdown()` of each node in reverse order."""

from __future__ import annotations

import asyncio
import concurrent.futures
import functools
import logging
import threading
from collections.abc import Collection, Mapping
from concurrent.futures import Future

from horus.errors import ShutdownTimeout
from horus.live import LiveNode
from horus.loop.executor import Executor
from horus.loop.safety import HOOK_TIMEOUT_S
from horus.loop.supervisor_thread import Report
from horus.units import to_s

_HOME_PATIENCE_S = 0.1
"""How long the homes may take to answer when the event loop does not [s]."""


async def quiesce(
    homes: Mapping[LiveNode, Executor], timeout_ns: int, *, cancel: bool
) -> set[LiveNode]:
    """End all ticking; return the nodes whose home is not free in time.

    No further tick begins, anywhere; what is in progress has `timeout_ns`, all of it
    together. With `cancel`, async ticks are cut short.
    """
    for live, home in homes.items():
        home.disengage(live)
        if cancel:
            home.cancel(live)
    waits = {asyncio.wrap_future(home.call(live, None)): live for live, home in homes.items()}
    if not waits:
        return set()
    _, late = await asyncio.wait(waits, timeout=to_s(timeout_ns))
    for wait in late:
        wait.cancel()
    return {waits[wait] for wait in late}


async def shut_down(
    homes: Mapping[LiveNode, Executor], stuck: Collection[LiveNode], timeout_ns: int
) -> None:
    """Call `shutdown()` of each node in reverse of (order, insertion), across all classes.

    Node by node, in the node's home, at most `timeout_ns` each. A node whose home
    is stuck is named and left behind, and its `shutdown()` runs elsewhere: a motor
    must be told to halt even if its last tick hangs. Each node's `shutdown()` is
    called exactly once, whatever the others do.
    """
    # A copy: a node that was just being removed may still take itself out.
    for live, home in sorted(homes.items(), key=lambda item: item[0].rank, reverse=True):
        await _shut_down_one(live, None if live in stuck else home, timeout_ns)


async def _shut_down_one(live: LiveNode, home: Executor | None, timeout_ns: int) -> None:
    await hook_over(live)
    if home is None:
        leave_behind(live)
    shutdown = asyncio.wrap_future(begin_shutdown(live, home))
    done, _ = await asyncio.wait([shutdown], timeout=to_s(timeout_ns))
    if not done:
        _give_up(live, timeout_ns)
    live.stopped()


def shut_down_without_loop(
    homes: Mapping[LiveNode, Executor], timeout_ns: int, report: Report
) -> None:
    """Do what is left of `shut_down` although the event loop does not come back.

    Thread: any other.
    """
    waits = {home.call(live, None): live for live, home in homes.items()}
    _, late = concurrent.futures.wait(waits, _HOME_PATIENCE_S)
    for wait in late:
        wait.cancel()
    stuck = {waits[wait] for wait in late}
    for live, home in sorted(homes.items(), key=lambda item: item[0].rank, reverse=True):
        if not live.initialized:
            continue
        if live in stuck:
            report(functools.partial(leave_behind, live))
        shutdown = begin_shutdown(live, None if live in stuck else home)
        _, late = concurrent.futures.wait([shutdown], to_s(timeout_ns))
        if late:
            report(functools.partial(_give_up, live, timeout_ns))


async def hook_over(live: LiveNode) -> None:
    """Wait for a node's safe-state hook, for as long as others do."""
    for _ in range(round(HOOK_TIMEOUT_S * 1000)):
        if live.standing.hook_returned.is_set():
            return
        await asyncio.sleep(0.001)


def leave_behind(live: LiveNode) -> None:
    """Let nobody wait any more for a node whose home is stuck."""
    live.abandoned = True
    live.emit(
        logging.ERROR,
        "its last callback does not end; it is left behind, and shutdown() runs elsewhere",
    )


def _give_up(live: LiveNode, timeout_ns: int) -> None:
    live.abandoned = True
    timeout = ShutdownTimeout(live.name, to_s(timeout_ns))
    live.emit(logging.ERROR, str(timeout))
    live.notify_error(timeout)


def begin_shutdown(live: LiveNode, home: Executor | None) -> Future[bool]:
    """Call a node's `shutdown()`, if that is owed, in its home; without one, elsewhere.

    Thread: any; the node sees to it that only one caller gets through.
    """
    if not live.claim_shutdown():
        nothing: Future[bool] = Future()
        nothing.set_result(True)
        return nothing
    return _stand_in(live) if home is None else home.call(live, "shutdown")


def _stand_in(live: LiveNode) -> Future[bool]:
    future: Future[bool] = Future()
    # A copy: the stuck tick still holds the node's own context.
    context, name = live.context.copy(), f"horus-shutdown:{live.name}"
    if live.is_async and asyncio._get_running_loop() is not None:
        task = asyncio.get_running_loop().create_task(
            live.run_phase_async("shutdown"), name=name, context=context
        )
        task.add_done_callback(lambda done: future.set_result(not done.cancelled()))
        return future

    def run() -> None:
        if live.is_async:
            future.set_result(context.run(asyncio.run, live.run_phase_async("shutdown")))
        else:
            future.set_result(context.run(live.run_phase, "shutdown"))

    threading.Thread(target=run, name=name, daemon=True).start()
    return future
