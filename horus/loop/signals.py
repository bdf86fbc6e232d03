"""SIGINT, SIGTERM and SIGUSR2 while a run owns them."""

from __future__ import annotations

import _thread
import contextlib
import logging
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from types import FrameType
from typing import NamedTuple

from horus.errors import CallbackInterrupted

_log = logging.getLogger("horus.scheduler")
_OWNED = (signal.SIGINT, signal.SIGTERM)

_LAST_WORDS_S = 0.3
"""How long the log may take to reach the terminal before the process ends [s]."""

InCallback = Callable[[FrameType | None], bool]


class LastAct(NamedTuple):
    """What is still done for the robot before the process is forced to end."""

    act: Callable[[], None]
    limit_s: Callable[[], float]
    """Returns how long it may take [s]."""


class SignalOwner:
    """Turns the first SIGINT or SIGTERM into a stop, and lets a second one force exit.

    With a flight recorder, SIGUSR2 has it written.

    Python-level handlers, not `loop.add_signal_handler`: they also run while a
    node's Python code blocks the loop, and they can be put back as they were
    (`remove_signal_handler` installs the default instead).
    """

    def __init__(
        self,
        stop: Callable[[str], None],
        make_safe: LastAct,
        shut_down: LastAct,
        in_callback: InCallback,
        dump: Callable[[str], None] | None = None,
    ) -> None:
        """Own the signals from `owning` on.

        Args:
            stop: Ends the run in order, for a reason.
            make_safe: Precedes every forced end.
            shut_down: Follows, unless somebody who asks a second time wants it to be over.
            in_callback: Tells whether a frame of the main thread is in a node's callback.
            dump: Writes the flight recorder, for a reason, if there is one.
        """
        self._stop = stop
        self._make_safe, self._shut_down = make_safe, shut_down
        self._in_callback = in_callback
        self._dump = dump
        self._received = 0
        self._pid = os.getpid()
        self._interrupting = False
        self.interrupted = False
        """Whether the last `interrupt` has reached the callback."""
        self.owns = False
        """Whether the signals are ours: only the main thread can own them."""

    @contextlib.contextmanager
    def owning(self) -> Iterator[None]:
        """Own the signals in the block; the previous handlers come back afterwards."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        handlers: dict[signal.Signals, Callable[[int, FrameType | None], None]] = dict.fromkeys(
            _OWNED, self._handle
        )
        if self._dump is not None:
            handlers[signal.SIGUSR2] = self._handle_dump
        previous = {number: signal.signal(number, handler) for number, handler in handlers.items()}
        self.owns = True
        try:
            yield
        finally:
            self.owns = False
            for number, handler in previous.items():
                # None: installed from C, out of Python's reach to put back.
                if handler is not None:
                    signal.signal(number, handler)

    def interrupt(self) -> None:
        """Raise `CallbackInterrupted` in the callback that occupies the main thread.

        A system call that it waits in returns early for that; if it computes in an
        extension, nothing happens until that returns. Nothing happens either where the
        callback has called something of ours: see `interrupted`, and try again.

        Thread: any other.
        """
        self.interrupted = False
        if self.owns:
            self._interrupting = True
            main = threading.main_thread().ident
            assert main is not None
            signal.pthread_kill(main, signal.SIGTERM)

    def force_exit(self, why: str) -> None:
        """End the process with the exit code of the signal that was received, else 1."""
        code = 128 + self._received if self._received else 1
        _end(code, why, (self._make_safe, self._shut_down))

    def _handle_dump(self, number: int, frame: FrameType | None) -> None:
        if self._dump is not None and os.getpid() == self._pid:
            self._dump("received SIGUSR2")

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if os.getpid() != self._pid:
            # A forked child, which is not the robot: here a signal means what it always does.
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
            return
        if self._interrupting:
            self._interrupting = False
            # Anywhere else an exception would hit what only just keeps order.
            if self._in_callback(frame):
                self.interrupted = True
                raise CallbackInterrupted
            return
        if self._received:
            _end(128 + number, f"{signal.Signals(number).name} again", (self._make_safe,))
            while True:
                signal.pause()
        self._received = number
        self._stop(f"received {signal.Signals(number).name}")


def _end(code: int, why: str, last_acts: Sequence[LastAct]) -> None:
    """End the process, after what can still be done for the robot and said to its people.

    The end is certain, and comes from C: a hook may hang, stderr may block, and
    whatever the signal has interrupted may hold any lock.
    """
    _thread.start_new_thread(_end_process, (code, last_acts))
    _thread.start_new_thread(_log.critical, ("%s: exiting at once", why))


def _end_process(code: int, last_acts: Sequence[LastAct]) -> None:
    try:
        for last_act in last_acts:
            _act(last_act)
        pause = _thread.allocate_lock()
        pause.acquire()
        pause.acquire(True, _LAST_WORDS_S)
    finally:
        os._exit(code)


def _act(last_act: LastAct) -> None:
    acted = _thread.allocate_lock()
    acted.acquire()

    def act() -> None:
        try:
            last_act.act()
        finally:
            acted.release()

    _thread.start_new_thread(act, ())
    acted.acquire(True, last_act.limit_s())
