"""The supervisor's thread, with an event loop of its own, which no node can block."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import gc
import itertools
import logging
import threading
from collections.abc import Callable, Coroutine
from queue import SimpleQueue
from typing import Any

from horus.clock import FOREVER_NS
from horus.loop.stacks import readable_stack, stack_of_thread
from horus.loop.supervision import Supervision
from horus.units import to_s

_log = logging.getLogger("horus.supervisor")

_SECONDS_PER_FULL_COLLECTION = 60
_SHORTEST_SLEEP_S = 0.001
_LAST_REPORTS_S = 1.0
"""How long the log may take to accept the last reports [s]."""


class Supervisor:
    """Runs supervision tasks beside the run loop.

    User code can block the main loop, an application's loop or an Rt thread;
    what must happen anyway is a task here. Not even the log can hold it up: what
    there is to report is written by yet another thread.

    Thread: any for `spawn`, `poke` and `report`; `start` and `close` belong to those
    who drive the nodes.
    """

    def __init__(self, name: str, enter_thread: Callable[[], None]) -> None:
        """Prepare the thread of the scheduler called `name`; `enter_thread` sets it up."""
        self._enter_thread = enter_thread
        self._loop = asyncio.new_event_loop()
        self._tasks: set[asyncio.Task[None]] = set()
        self._poked = asyncio.Event()
        self._reports: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self._thread = threading.Thread(
            target=self._serve, name=f"horus-supervisor:{name}", daemon=True
        )
        self._reporter = threading.Thread(
            target=self._write_reports, name=f"horus-reports:{name}", daemon=True
        )

    def start(self) -> None:
        """Start the threads, unless they run."""
        if not self._thread.is_alive():
            self._reporter.start()
            self._thread.start()

    def spawn(self, work: Callable[[], Coroutine[Any, Any, None]]) -> None:
        """Run a supervision task; after `close` there is nothing left to supervise."""

        def start() -> None:
            task = self._loop.create_task(work())
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)

        self._call(start)

    def report(self, write: Callable[[], None]) -> None:
        """Log something soon; return at once."""
        self._reports.put(write)

    def poke(self) -> None:
        """Let `watch` look at once: something has changed that its next look depends on."""
        self._call(self._poked.set)

    async def watch(self, supervision: Supervision, now_ns: Callable[[], int]) -> None:
        """Inspect the nodes whenever something may have run out. Thread: supervisor."""
        while True:
            self._poked.clear()
            try:
                supervision.inspect()
            except Exception as exc:
                # Supervision goes on whatever happens to it.
                self.report(functools.partial(_log.error, "inspection failed", exc_info=exc))
            if supervision.next_ns == FOREVER_NS:
                await self._poked.wait()
                continue
            delay_s = max(_SHORTEST_SLEEP_S, to_s(supervision.next_ns - now_ns()))
            alarm = self._loop.call_later(delay_s, self._poked.set)
            await self._poked.wait()
            alarm.cancel()

    def close(self) -> None:
        """Cancel what runs, and end the threads."""
        if not self._thread.is_alive():
            self._loop.close()
            return
        self._call(self._loop.stop)
        self._thread.join()
        self._reports.put(None)
        self._reporter.join(_LAST_REPORTS_S)

    def _call(self, call: Callable[[], object]) -> None:
        with contextlib.suppress(RuntimeError):  # closed
            self._loop.call_soon_threadsafe(call)

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

    def _write_reports(self) -> None:
        while (write := self._reports.get()) is not None:
            try:
                write()
            except Exception:
                _log.exception("a report could not be logged")

    async def report_blocked_loop(
        self, loop_thread_id: int, reacted: threading.Event, patience_s: float
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
                stack = stack_of_thread(loop_thread_id)
                self.report(
                    lambda stack=stack: _log.error(  # type: ignore[misc]
                        "the event loop has not reacted to a stop for %g s; it is blocked in:\n%s",
                        patience_s,
                        readable_stack(stack),
                    )
                )


async def collect_garbage() -> None:
    """Collect garbage little and often, in place of the automatic collections.

    What a second has left behind is little, and so is the time for which other
    threads have to wait. What gets old is looked at once a minute.
    """
    for second in itertools.count(1):
        await asyncio.sleep(1.0)
        gc.collect(2 if second % _SECONDS_PER_FULL_COLLECTION == 0 else 1)
