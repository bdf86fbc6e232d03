"""SIGINT and SIGTERM while a run owns them."""

from __future__ import annotations

import _thread
import contextlib
import logging
import os
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType

_log = logging.getLogger("horus.scheduler")
_OWNED = (signal.SIGINT, signal.SIGTERM)


_LAST_WORDS_S = 0.3
"""How long the log may take to reach the terminal before the process ends [s]."""


@contextlib.contextmanager
def stop_on_signals(stop: Callable[[str], None]) -> Iterator[None]:
    """Turn the first SIGINT or SIGTERM into `stop(reason)`, and let a second one force exit.

    The previous handlers come back afterwards. Only the main thread can own
    signals; in another one nothing is changed.

    Python-level handlers, not `loop.add_signal_handler`: they also run while a
    node's Python code blocks the loop, and they can be put back as they were
    (`remove_signal_handler` installs the default instead).
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    received: list[int] = []

    def handle(number: int, frame: FrameType | None) -> None:
        if received:
            _force_exit(number)
        received.append(number)
        stop(f"received {signal.Signals(number).name}")

    previous = {number: signal.signal(number, handle) for number in _OWNED}
    try:
        yield
    finally:
        for number, handler in previous.items():
            # None: installed from C, out of Python's reach to put back.
            if handler is not None:
                signal.signal(number, handler)


def _force_exit(number: int) -> None:
    """End the process, with what the log still has to say if that can be said.

    The end comes first, and from C: stderr may block, and whatever the signal has
    interrupted may hold any lock.
    """
    _thread.start_new_thread(_end_process, (128 + number,))
    _thread.start_new_thread(
        _log.critical, ("%s again: exiting at once", signal.Signals(number).name)
    )
    while True:
        signal.pause()


def _end_process(code: int) -> None:
    pause = _thread.allocate_lock()
    pause.acquire()
    pause.acquire(True, _LAST_WORDS_S)
    os._exit(code)
