"""Logs that a person sees without configuring anything, and that never make a tick wait."""

from __future__ import annotations

import contextlib
import logging
import logging.handlers
import os
import queue
import sys
import threading
from collections.abc import Callable, Iterator

from horus.errors import describe

_root = logging.getLogger("horus")
_MOST_UNWRITTEN = 10_000
_LAST_RECORDS_S = 1.0


@contextlib.contextmanager
def visible(*, install: bool, verbose: bool) -> Iterator[None]:
    """Show horus' log on stderr while the block runs, unless logging is configured.

    Records go through a queue to a thread that writes them: a slow terminal
    costs the tick that logs nothing.

    Args:
        install: Whether a handler may be installed at all.
        verbose: Whether debug messages are shown; otherwise from info on.
    """
    level = _root.level
    installs = install and not _root.hasHandlers()
    if verbose:
        _root.setLevel(logging.DEBUG)
    elif installs and level == logging.NOTSET:
        _root.setLevel(logging.INFO)
    try:
        with _stderr_handler() if installs else contextlib.nullcontext():
            yield
    finally:
        _root.setLevel(level)


@contextlib.contextmanager
def _stderr_handler() -> Iterator[None]:
    writer = _Writer()
    handler = _BoundedHandler(writer.records)
    _root.addHandler(handler)
    writer.start()
    try:
        yield
    finally:
        _root.removeHandler(handler)
        writer.finish()


def readable(record: logging.LogRecord, format_record: Callable[[logging.LogRecord], str]) -> str:
    """Return a record in words, whatever is wrong with it."""
    try:
        return format_record(record)
    except Exception as exc:  # a message and its arguments that do not go together
        what, why = describe(record.msg), describe(exc)
        return f"{record.levelname} {record.name}: {what} cannot be formatted: {why}"


class _BoundedHandler(logging.handlers.QueueHandler):
    """Hands records to the writer; when that cannot keep up, they are dropped."""

    def __init__(self, records: queue.SimpleQueue[logging.LogRecord | None]) -> None:
        super().__init__(records)
        self._records = records

    def enqueue(self, record: logging.LogRecord) -> None:
        """Queue a record; a terminal that nobody reads must not fill the memory."""
        if self._records.qsize() < _MOST_UNWRITTEN:
            self._records.put(record)


class _Writer(threading.Thread):
    """Writes records to stderr. A daemon: stderr may block for ever.

    The process must be able to exit meanwhile. So there is no `logging.StreamHandler`,
    whose lock the exit waits for, and the process's own stderr is written to by its
    descriptor: its buffer is flushed at exit, and has a lock, too.
    """

    def __init__(self) -> None:
        super().__init__(name="horus-log", daemon=True)
        self.records: queue.SimpleQueue[logging.LogRecord | None] = queue.SimpleQueue()
        self._format = _Formatter().format

    def run(self) -> None:
        while (record := self.records.get()) is not None:
            # Gone, closed, or a full disk: there is nobody left to tell.
            with contextlib.suppress(OSError, ValueError):
                self._write(readable(record, self._format) + "\n")

    @staticmethod
    def _write(text: str) -> None:
        stream, own = sys.stderr, sys.__stderr__
        if own is not None and stream is own:
            rest = text.encode(own.encoding, "backslashreplace")
            while rest:
                rest = rest[os.write(own.fileno(), rest) :]
        elif stream is not None:  # as it is in a program without a console
            stream.write(text)
            stream.flush()

    def finish(self) -> None:
        """Let the last records be written, for as long as that may take."""
        self.records.put(None)
        self.join(_LAST_RECORDS_S)


class _Formatter(logging.Formatter):
    """`12:34:56.789 WARNING @1234 motor: message`."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        """Put a record on one line; exceptions follow below."""
        time_of_day = self.formatTime(record, "%H:%M:%S")
        source = record.name.removeprefix("horus.node.").removeprefix("horus.")
        cycle = getattr(record, "cycle", None)
        when = "" if cycle is None else f"@{cycle} "
        # What horus says about a node names it already, for handlers that show
        # nothing but the message.
        message = record.getMessage()
        named = message if message.startswith(f"{source}: ") else f"{source}: {message}"
        return f"{time_of_day}.{int(record.msecs):03d} {record.levelname:<7} {when}{named}"
