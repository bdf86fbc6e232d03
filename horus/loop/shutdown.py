"""Ordered shutdown: no more ticks, then `shutdown()` of each node in reverse order."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Mapping
from concurrent.futures import Future

from horus.errors import ShutdownTimeout
from horus.live import LiveNode
from horus.loop.executor import Executor
from horus.spec import NodeState
from horus.units import to_s

_log = logging.getLogger("horus.scheduler")


async def shut_down(homes: Mapping[LiveNode, Executor], timeout_ns: int) -> None:
    """Bring every node to rest, in reverse of (order, insertion) across all classes.

    1. Let no further tick begin, anywhere.
    2. Wait for the ticks in progress, all of them together at most `timeout_ns`.
    3. Node by node: run `shutdown()` in the node's home, at most `timeout_ns`
       each. A node whose home is stuck is named, its thread is left behind, and
       its `shutdown()` runs on a thread that stands in: a motor must be told to
       halt even if its last tick hangs.

    Each node's `shutdown()` is called exactly once, whatever the others do.
    """
    stuck = await quiesce(homes, timeout_ns)
    # A copy: a node that was just being removed may still take itself out.
    for live, home in sorted(homes.items(), key=lambda item: item[0].rank, reverse=True):
        if live.initialized:
            if live in stuck:
                _log.error(
                    "%s is stuck in a tick: its thread is left behind, and its shutdown() "
                    "runs on another one",
                    live.name,
                )
            shutdown = begin_shutdown(live, None if live in stuck else home)
            await _wait_for_shutdown(live, shutdown, to_s(timeout_ns))
        home.dismiss(live)


async def quiesce(homes: Mapping[LiveNode, Executor], timeout_ns: int) -> set[LiveNode]:
    """End all ticking; return the nodes whose tick in progress does not end in time."""
    for live, home in homes.items():
        home.disengage(live)
    waits = {asyncio.wrap_future(home.call(live, None)): live for live, home in homes.items()}
    if not waits:
        return set()
    _, late = await asyncio.wait(waits, timeout=to_s(timeout_ns))
    for wait in late:
        wait.cancel()
    return {waits[wait] for wait in late}


def begin_shutdown(live: LiveNode, home: Executor | None) -> Future[bool]:
    """Call a node's `shutdown()` in its home, or on a thread that stands in for it.

    Thread: loop, so that two paths to the end cannot both call it.
    """
    live.state = NodeState.STOPPING
    return _stand_in(live) if home is None else home.call(live, "shutdown")


async def _wait_for_shutdown(live: LiveNode, shutdown: Future[bool], timeout_s: float) -> None:
    try:
        await asyncio.wait_for(asyncio.wrap_future(shutdown), timeout_s)
    except TimeoutError:
        timeout = ShutdownTimeout(live.name, timeout_s)
        live.emit(logging.ERROR, str(timeout))
        live.notify_error(timeout)
    live.stopped()


def _stand_in(live: LiveNode) -> Future[bool]:
    future: Future[bool] = Future()
    # A copy: the stuck tick still holds the node's own context.
    context = live.context.copy()
    if live.is_async:
        task = asyncio.get_running_loop().create_task(
            live.run_phase_async("shutdown"), name=f"horus-shutdown:{live.name}", context=context
        )
        task.add_done_callback(lambda done: future.set_result(not done.cancelled()))
        return future

    def run() -> None:
        future.set_result(context.run(live.run_phase, "shutdown"))

    threading.Thread(target=run, name=f"horus-shutdown:{live.name}", daemon=True).start()
    return future
