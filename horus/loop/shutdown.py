"""Ordered shutdown: no more ticks, then `shutdown()` of each node in reverse order."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Collection, Mapping
from concurrent.futures import Future

from horus.errors import ShutdownTimeout
from horus.live import LiveNode
from horus.loop.executor import Executor
from horus.units import to_s

_HOOK_PATIENCE_MS = 100
"""How long `shutdown()` of a node waits for its safe-state hook [ms]."""


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
    for _ in range(_HOOK_PATIENCE_MS):
        if live.hook_returned.is_set():
            break
        await asyncio.sleep(0.001)
    shutdown = asyncio.wrap_future(begin_shutdown(live, home))
    done, _ = await asyncio.wait([shutdown], timeout=to_s(timeout_ns))
    if not done:
        live.abandoned = True
        timeout = ShutdownTimeout(live.name, to_s(timeout_ns))
        live.emit(logging.ERROR, str(timeout))
        live.notify_error(timeout)
    live.stopped()


def begin_shutdown(live: LiveNode, home: Executor | None) -> Future[bool]:
    """Call a node's `shutdown()`, if that is owed, in its home; without one, elsewhere.

    Thread: any; the node sees to it that only one caller gets through.
    """
    if home is None:
        live.abandoned = True
        live.emit(
            logging.ERROR,
            "its last callback does not end; it is left behind, and shutdown() runs elsewhere",
        )
    if not live.claim_shutdown():
        nothing: Future[bool] = Future()
        nothing.set_result(True)
        return nothing
    return _stand_in(live) if home is None else home.call(live, "shutdown")


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
