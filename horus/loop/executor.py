"""What the run loop knows of an executor: a home for the nodes of one class."""

from __future__ import annotations

from concurrent.futures import Future
from typing import Protocol

from horus.live import LiveNode
from horus.loop.stacks import Stack


class Home(Protocol):
    """What supervision asks of the place where a node runs.

    Thread: any.
    """

    def due_ns(self, live: LiveNode, now_ns: int) -> int | None:
        """Return the earliest release whose tick is due and has not begun [ns], if there is one."""

    def thread_id(self, live: LiveNode) -> int | None:
        """Return the thread that runs the node's callbacks; None while nobody does."""

    def computes(self, live: LiveNode) -> bool:
        """Return whether an async tick has the thread at this moment: it does not await."""

    def stack(self, live: LiveNode) -> Stack:
        """Return where the node's callbacks are, or what keeps them from their thread."""

    def isolate(self, live: LiveNode) -> None:
        """Let nobody wait for a frozen node, and cut its tick short where that is possible."""


class Executor(Home, Protocol):
    """Runs the callbacks of its nodes, each node's one at a time, in the node's home.

    The home is a thread: the event loop's for BestEffort, Event and AsyncIo
    nodes, a thread of the node's own for Rt and Compute. A node goes through
    `adopt`, `call("init")`, `engage`, ticks, `disengage`, `call("shutdown")`,
    `dismiss`, in this order.
    """

    def adopt(self, live: LiveNode) -> None:
        """Give the node a home.

        Thread: loop.
        """

    def engage(self, live: LiveNode, from_ns: int) -> None:
        """Let ticks begin, with the first release at or after `from_ns` [ns].

        Thread: loop.
        """

    def disengage(self, live: LiveNode) -> None:
        """Let no further tick begin; a tick in progress goes on.

        Thread: loop.
        """

    def cancel(self, live: LiveNode) -> None:
        """Cut a tick in progress short, where that is possible: it awaits something.

        Thread: loop.
        """

    def call(self, live: LiveNode, phase: str | None) -> Future[bool]:
        """Run a callback in the node's home once no tick is in progress.

        The result tells whether it succeeded; the future never holds an
        exception of the callback. None runs nothing: the future is done when
        the home is free.

        Thread: any.
        """

    def retime(self, live: LiveNode) -> None:
        """Adopt the node's changed rate.

        Thread: loop.
        """

    def is_home(self, live: LiveNode) -> bool:
        """Return whether the calling thread is the node's home.

        Thread: any.
        """

    def dismiss(self, live: LiveNode) -> None:
        """Take the home away.

        Thread: loop.
        """
