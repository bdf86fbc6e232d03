"""The way into the event loop from other threads: one wake-up for many calls."""

from __future__ import annotations

import asyncio
import logging
import os
import threading
from collections import deque
from collections.abc import Callable

_log = logging.getLogger("horus.scheduler")


class Bridge:
    """Runs callbacks on the loop's thread; calls made while it wakes share one wake-up.

    A thousand messages from a motor thread would otherwise be a thousand
    `call_soon_threadsafe`, each with a lock and a write of its own.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        """Attach to `loop`, whose thread this must be."""
        self.loop = loop
        self.thread_id: int | None = threading.get_ident()
        """The thread that runs the loop; None while it stands still."""
        self._calls: deque[Callable[[], object]] = deque()
        self._awake = False
        self._fd: int | None = None
        self._closed = False
        if hasattr(os, "eventfd"):
            self._fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
            loop.add_reader(self._fd, self._on_readable)

    def on_loop_thread(self) -> bool:
        """Return whether the calling thread is the loop's."""
        return threading.get_ident() == self.thread_id

    def attach(self) -> None:
        """Take note that the calling thread runs the loop from now on."""
        self.thread_id = threading.get_ident()

    def detach(self) -> None:
        """Take note that nobody runs the loop: all calls wait until somebody does."""
        self.thread_id = None

    def run(self, call: Callable[[], object]) -> None:
        """Run `call` on the loop's thread: at once when already there, else soon.

        Thread: any.
        """
        if self.on_loop_thread():
            call()
        else:
            self.post(call)

    def post(self, call: Callable[[], object]) -> None:
        """Run `call` on the loop's thread soon; after `close`, here and now.

        Thread: any.
        """
        self._calls.append(call)
        if self._closed:
            self._drain()
            return
        # Append first, then look: the reader clears the flag before it drains,
        # so a call is either seen by the drain or writes a wake-up of its own.
        if not self._awake:
            self._awake = True
            self._wake()

    def close(self) -> None:
        """Run what is waiting and detach from the loop."""
        self._closed = True
        self._drain()
        if self._fd is not None:
            self.loop.remove_reader(self._fd)
            os.close(self._fd)
            self._fd = None

    def _wake(self) -> None:
        if self._closed:
            return
        try:
            if self._fd is not None:
                os.eventfd_write(self._fd, 1)
            else:
                self.loop.call_soon_threadsafe(self._drain)
        except (OSError, RuntimeError):
            # Closed between the look and the write: the run is over, and with it
            # whatever the call was about.
            if not self._closed:
                raise

    def _on_readable(self) -> None:
        if self._fd is not None:
            os.eventfd_read(self._fd)
        self._drain()

    def _drain(self) -> None:
        self._awake = False
        # Bounded by what waits now, so that a flood leaves the loop its turn.
        for _ in range(len(self._calls)):
            try:
                self._calls.popleft()()
            except Exception:
                # The others behind it may be an emergency stop.
                _log.exception("a call into the event loop failed")
        if self._calls and not self._awake and not self._closed:
            self._awake = True
            self._wake()
