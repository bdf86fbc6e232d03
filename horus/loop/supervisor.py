"""Supervision: a thread with an event loop of its own, which no node can block."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import itertools
import logging
import sys
import threading
import traceback
from collections.abc import Callable, Coroutine
from typing import Any

_log = logging.getLogger("horus.supervisor")

_SECONDS_PER_FULL_COLLECTION = 60


class Supervisor:
    """Runs supervision tasks beside the run loop.

    User code can block the main loop, an application's loop or an Rt thread;
    what must happen anyway is a task here.

    Thread: any for `spawn`; `start` and `close` belong to the run loop.
    """

    def __init__(self, name: str, enter_thread: Callable[[], None]) -> None:
        """Prepare the thread of the scheduler called `name`; `enter_thread` sets it up."""
        self._enter_thread = enter_thread
        self._loop = asyncio.new_event_loop()
        self._tasks: set[asyncio.Task[None]] = set()
        self._thread = threading.Thread(
            target=self._serve, name=f"horus-supervisor:{name}", daemon=True
        )

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def spawn(self, work: Callable[[], Coroutine[Any, Any, None]]) -> None:
        """Run a supervision task; after `close` there is nothing left to supervise."""

        def start() -> None:
            task = self._loop.create_task(work())
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)

        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(start)

    def close(self) -> None:
        """Cancel what runs and end the thread."""
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()

    def _serve(self) -> None:
        self._enter_thread()
        try:
            self._loop.run_forever()
        finally:
            pending = asyncio.all_tasks(self._loop)
            for task in pending:
                task.cancel()
            if pending:
                self._loop.run_until_complete(asyncio.gather(*pending, return_exceptions=True))
            self._loop.close()


async def report_blocked_loop(
    loop_thread_id: int, reacted: threading.Event, patience_s: float
) -> None:
    """Say where the event loop is stuck when it does not react to a stop.

    Args:
        loop_thread_id: The thread that was asked to stop.
        reacted: Set by the loop when it begins to stop.
        patience_s: How long to wait before each message [s].
    """
    while not reacted.is_set():
        await asyncio.sleep(patience_s)
        if not reacted.is_set():
            _log.error(
                "the event loop has not reacted to a stop for %g s; it is blocked in:\n%s",
                patience_s,
                stack_of(loop_thread_id),
            )


async def collect_garbage() -> None:
    """Collect garbage little and often, in place of the automatic collections.

    What a second has left behind is little, and so is the time for which other
    threads have to wait. What gets old is looked at once a minute.
    """
    for second in itertools.count(1):
        await asyncio.sleep(1.0)
        gc.collect(2 if second % _SECONDS_PER_FULL_COLLECTION == 0 else 1)


def stack_of(thread_id: int) -> str:
    """Return the current Python stack of a thread, innermost call last."""
    frame = sys._current_frames().get(thread_id)
    return "  (no such thread)" if frame is None else "".join(traceback.format_stack(frame))
