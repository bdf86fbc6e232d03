"""Where everybody is when Python itself stands still: a file that is written from C.

An extension that computes without releasing the interpreter stops every Python
thread, also those that supervise. `faulthandler` keeps a thread of its own, which
needs no interpreter: unless it is put off in time, it writes the stacks of all
threads to a file.

Source: faulthandler.dump_traceback_later in the Python library reference.
"""

from __future__ import annotations

import asyncio
import faulthandler
import functools
import logging
import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import IO

import platformdirs

from horus.loop.supervisor_thread import Report
from horus.units import NS_PER_S, readable, to_s

_log = logging.getLogger("horus.supervisor")

_SHORTEST_DELAY_NS, _LONGEST_DELAY_NS = NS_PER_S, 3600 * NS_PER_S

_owned = threading.Lock()
"""Held by the one who has the process's only timer of this kind."""


class FaultLog:
    """A file for the stacks of all threads, and the timer that has them written.

    Thread: supervisor, except `path`.
    """

    def __init__(self, scheduler: str) -> None:
        """Prepare; the file of the scheduler of this name is created when it is needed."""
        self._name = f"{scheduler}-{os.getpid()}.stacks"
        self.path: Path | None = None
        """The file; None if there is none. It stays if something was written to it."""

    async def keep_putting_off(self, timeout_ns: Callable[[], int], report: Report) -> None:
        """Put the writing off again and again; say so when it has happened.

        Args:
            timeout_ns: Returns the shortest watchdog timeout [ns]. The stacks are written
                after a standstill of two of these, and of 1 s at least.
            report: Takes what is to be logged.
        """
        while not _owned.acquire(blocking=False):  # noqa: ASYNC110  (a lock of the process)
            # Another scheduler of this process has the timer. When its run is over, it is ours.
            await asyncio.sleep(to_s(_SHORTEST_DELAY_NS))
        try:
            path = _directory() / self._name
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("wb", buffering=0) as file:
                self.path = path
                try:
                    await self._put_off(file, timeout_ns, report)
                finally:
                    faulthandler.cancel_dump_traceback_later()
                    if _size(file) == 0:
                        path.unlink(missing_ok=True)
                        self.path = None
        except OSError as exc:
            message = f"no stacks will be written if Python stands still: {exc}"
            report(functools.partial(_log.warning, message))
        finally:
            _owned.release()

    async def _put_off(
        self, file: IO[bytes], timeout_ns: Callable[[], int], report: Report
    ) -> None:
        loop = asyncio.get_running_loop()
        while True:
            delay_ns = min(max(2 * timeout_ns(), _SHORTEST_DELAY_NS), _LONGEST_DELAY_NS)
            size, began_s = _size(file), loop.time()
            # Each call ends the timer's thread and starts another: rarely, then.
            faulthandler.dump_traceback_later(to_s(delay_ns), file=file)
            await asyncio.sleep(to_s(delay_ns) / 2)
            written = _size(file) > size
            # On a full disk only our own lateness tells.
            if written or loop.time() - began_s > to_s(delay_ns):
                where = f"are in {self.path}" if written else f"could not be written to {self.path}"
                message = (
                    f"Python stood still for more than {readable(delay_ns)}; "
                    f"the stacks of all threads {where}"
                )
                report(functools.partial(_log.critical, message))


def _size(file: IO[bytes]) -> int:
    return os.fstat(file.fileno()).st_size


def _directory() -> Path:
    """Return where such files go: `$HORUS_HOME`, or the user's directory for logs."""
    home = os.environ.get("HORUS_HOME")
    return Path(home) if home else platformdirs.user_log_path("horus", appauthor=False)
