"""A thread with an event loop of its own, which no node can block."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
from collections.abc import Callable, Coroutine
from queue import SimpleQueue
from typing import Any

from horus.loop.daemon_pool import DaemonPool

_log = logging.getLogger("horus.supervisor")

Report = Callable[[Callable[[], None]], None]
"""Writes to the log from a place where that may take as long as it likes."""

_LAST_REPORTS_S = 1.0
"""How long the log may take to accept the last reports [s]."""


class SupervisorThread:
    """Runs tasks beside the run loop.

    User code can block the main loop, an application's loop or an Rt thread; what
    must happen anyway is a task here. Not even the log can hold it up: what there is
    to report is written by yet another thread.

    Thread: any, except `start` and `close`, which belong to those who drive the nodes.
    """

    def __init__(self, name: str, enter_thread: Callable[[], None]) -> None:
        """Prepare the thread of the scheduler called `name`; `enter_thread` sets it up."""
        self._enter_thread = enter_thread
        self.loop = asyncio.new_event_loop()
        self.loop.set_default_executor(DaemonPool("horus-supervisor-work"))
        self._tasks: set[asyncio.Task[None]] = set()
        self._reports: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self._thread = threading.Thread(
            target=self._serve, name=f"horus-supervisor:{name}", daemon=True
        )
        self._reporter = threading.Thread(
            target=self._write_reports, name=f"horus-reports:{name}", daemon=True
        )

    def start(self) -> None:
        """Start."""
        self._reporter.start()
        self._thread.start()

    def spawn(self, work: Callable[[], Coroutine[Any, Any, None]]) -> None:
        """Run a task; after `close` there is nothing left to supervise."""

        def start() -> None:
            task = self.loop.create_task(work())
            self._tasks.add(task)
            task.add_done_callback(self._ended)

        self.call(start)

    def call(self, call: Callable[[], object]) -> None:
        """Call something on the thread, soon."""
        with contextlib.suppress(RuntimeError):  # closed
            self.loop.call_soon_threadsafe(call)

    def report(self, write: Callable[[], None]) -> None:
        """Log something soon; return at once."""
        self._reports.put(write)

    def close(self) -> None:
        """Cancel what runs, and end."""
        if not self._thread.is_alive():
            self.loop.close()
            return
        self.call(self.loop.stop)
        self._thread.join()
        self._reports.put(None)
        self._reporter.join(_LAST_REPORTS_S)

    def _ended(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            self.report(lambda: _log.error("a supervision task has failed", exc_info=error))

    def _serve(self) -> None:
        self._enter_thread()
        try:
            self.loop.run_forever()
        finally:
            pending = asyncio.all_tasks(self.loop)
            for task in pending:
                task.cancel()
            if pending:
                self.loop.run_until_complete(asyncio.gather(*pending, return_exceptions=True))
            self.loop.close()

    def _write_reports(self) -> None:
        while (write := self._reports.get()) is not None:
            try:
                write()
            except Exception:
                _log.exception("a report could not be logged")
