"""A thread that is the home of one node."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from typing import Generic, TypeVar

from horus.executors.base import run_into
from horus.executors.permit import make_permit
from horus.live import LiveNode
from horus.loop.stacks import Stack, stack_of_thread

T = TypeVar("T", bound="NodeThread")

_LAST_STEPS_S = 1.0
"""How long a thread may take to return once it has nothing left to do [s]."""


class NodeThread(threading.Thread):
    """Runs jobs one at a time, and whatever `idle` does in between.

    A node's `init`, ticks and `shutdown` all run here, so that what a driver
    opens in one of them works in the others. A daemon: a node that never
    returns must not keep the process from ending.

    Thread: any for `post`, `call` and `close`; the others are the thread's own.
    """

    def __init__(self, live: LiveNode, enter: Callable[[], object] = lambda: None) -> None:
        """Prepare a thread for `live`, which begins with `enter`; it runs from `start()` on."""
        super().__init__(name=f"horus:{live.name}", daemon=True)
        self.live = live
        self._enter = enter
        self._jobs: deque[Callable[[], None]] = deque()
        self._closing = False
        self._broken = False
        # Waiting for it is as exact as clock_nanosleep and, unlike that, ends when
        # there is something to do.
        self._permit = make_permit()

    def post(self, job: Callable[[], None]) -> None:
        """Run `job` after what is in progress."""
        self._jobs.append(job)
        self.unpark()

    def call(self, phase: str | None) -> Future[bool]:
        """Run one of the node's callbacks; the result tells whether it succeeded."""
        future: Future[bool] = Future()
        self.post(lambda: run_into(future, self.live, phase))
        return future

    def close(self) -> None:
        """End the thread once its jobs are done."""
        self._closing = True
        self.unpark()

    def unpark(self) -> None:
        """Wake the thread, or keep it from parking the next time."""
        self._permit.give()

    def park(self, until_ns: int | None = None) -> bool:
        """Sleep until woken, at most until an instant [ns]; return whether woken."""
        return self._permit.take(until_ns)

    def run(self) -> None:
        """Serve until closed, whatever happens: `shutdown()` is to run here, too."""
        self._enter()
        while not self._closing or self._jobs:
            try:
                if self._jobs:
                    self._jobs.popleft()()
                elif self._broken:
                    self.park()
                else:
                    self.idle()
            except BaseException as exc:
                self.live.broken(exc)
                self._broken = True

    def idle(self) -> None:
        """Do what is to be done when there is no job."""
        self.park()


class ThreadExecutor(ABC, Generic[T]):
    """Base of the executors that give each node a thread."""

    def __init__(self) -> None:
        """Begin with no threads."""
        self._threads: dict[LiveNode, T] = {}

    @abstractmethod
    def make_thread(self, live: LiveNode) -> T:
        """Return the node's thread, not started."""

    def thread_of(self, live: LiveNode) -> T:
        """Return the node's thread."""
        return self._threads[live]

    def find_thread(self, live: LiveNode) -> T | None:
        """Return the node's thread; None if it has just been dismissed.

        Thread: any.
        """
        return self._threads.get(live)

    def adopt(self, live: LiveNode) -> None:
        """Start the node's thread; it does nothing yet."""
        thread = self._threads[live] = self.make_thread(live)
        thread.start()

    def call(self, live: LiveNode, phase: str | None) -> Future[bool]:
        """Run a callback on the node's thread after what is in progress."""
        return self._threads[live].call(phase)

    def cancel(self, live: LiveNode) -> None:
        """Do nothing: a plain tick cannot be cut short."""

    def thread_id(self, live: LiveNode) -> int | None:
        """Return the node's thread."""
        thread = self.find_thread(live)
        return None if thread is None else thread.ident

    def computes(self, live: LiveNode) -> bool:
        """Return False: there are no async ticks."""
        return False

    def stack(self, live: LiveNode) -> Stack:
        """Return where the node's thread is."""
        return stack_of_thread(self.thread_id(live))

    def isolate(self, live: LiveNode) -> None:
        """Do nothing: a plain tick cannot be cut short, and nobody waits for its end."""

    def is_home(self, live: LiveNode) -> bool:
        """Return whether the calling thread is the node's."""
        return threading.current_thread() is self._threads.get(live)

    def dismiss(self, live: LiveNode) -> None:
        """End the node's thread; one that is stuck in a tick stays behind."""
        thread = self._threads.pop(live, None)
        if thread is not None:
            thread.close()
            if thread is not threading.current_thread() and not live.ticking:
                thread.join(_LAST_STEPS_S)
