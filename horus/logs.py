"""Logs that a person sees without configuring anything, and that never make a tick wait."""

from __future__ import annotations

import contextlib
import logging
import logging.handlers
import queue
import sys
import threading
from collections.abc import Iterator

_root = logging.getLogger("horus")
_unwritten: queue.SimpleQueue[logging.LogRecord] = queue.SimpleQueue()
_LAST_RECORD_S = 0.05


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
    screen = logging.StreamHandler(sys.stderr)
    screen.setFormatter(_Formatter())
    writer = logging.handlers.QueueListener(_unwritten, screen)
    handler = logging.handlers.QueueHandler(_unwritten)
    _root.addHandler(handler)
    writer.start()
    try:
        yield
    finally:
        _root.removeHandler(handler)
        writer.stop()


def flush(timeout_s: float = 0.5) -> None:
    """Wait until what was logged is written, at most `timeout_s` [s]."""
    pause = threading.Event()
    for _ in range(int(timeout_s / _LAST_RECORD_S)):
        # An empty queue is not enough: its last record is still on its way.
        drained = _unwritten.empty()
        pause.wait(_LAST_RECORD_S)
        if drained:
            break
    logging.shutdown()


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
