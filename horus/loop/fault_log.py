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
        self._file: IO[bytes] | None = None
        self._size = 0
        self.path: Path | None = None
        """The file; None if there is none. It stays if something was written to it."""

    async def keep_putting_off(self, timeout_ns: Callable[[], int], report: Report) -> None:
        """Put the writing off again and again; say so when it has happened.

        Args:
            timeout_ns: Returns the shortest watchdog timeout [ns]. The stacks are written
                after a standstill of two of these, and of 1 s at least.
            report: Takes what is to be logged.
        """
        try:
            while self._open(report):
                delay_ns = min(max(2 * timeout_ns(), _SHORTEST_DELAY_NS), _LONGEST_DELAY_NS)
                assert self._file is not None
                # Each call ends the timer's thread and starts another: rarely, then.
                faulthandler.dump_traceback_later(to_s(delay_ns), file=self._file)
                await asyncio.sleep(to_s(delay_ns) / 2)
                size = os.fstat(self._file.fileno()).st_size
                if size > self._size:
                    self._size = size
                    message = (
                        f"Python stood still for more than {readable(delay_ns)}; "
                        f"the stacks of all threads are in {self.path}"
                    )
                    report(functools.partial(_log.critical, message))
        finally:
            self._close()

    def _open(self, report: Report) -> bool:
        """Open the file, once; return whether there is one."""
        if self._file is not None:
            return True
        if not _owned.acquire(blocking=False):
            return False
        try:
            path = _directory() / self._name
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("wb", buffering=0)
        except OSError as exc:
            _owned.release()
            message = f"no stacks will be written if Python stands still: {exc}"
            report(functools.partial(_log.warning, message))
            return False
        self.path, self._size = path, 0
        return True

    def _close(self) -> None:
        if self._file is None or self.path is None:
            return
        faulthandler.cancel_dump_traceback_later()
        self._size = os.fstat(self._file.fileno()).st_size
        self._file.close()
        self._file = None
        _owned.release()
        if self._size == 0:
            self.path.unlink(missing_ok=True)
            self.path = None


def _directory() -> Path:
    """Return where such files go: `$HORUS_HOME`, or the user's directory for logs."""
    home = os.environ.get("HORUS_HOME")
    return Path(home) if home else platformdirs.user_log_path("horus", appauthor=False)
