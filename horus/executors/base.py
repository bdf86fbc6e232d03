"""What executors have in common."""

from __future__ import annotations

from concurrent.futures import Future

from horus.live import LiveNode
from horus.loop.bridge import Bridge
from horus.loop.cycle import Cycle
from horus.loop.stacks import Stack, stack_of_thread


def run_into(future: Future[bool], live: LiveNode, phase: str | None) -> None:
    """Run a plain node's callback and put its success into `future`."""
    if future.set_running_or_notify_cancel():
        future.set_result(True if phase is None else live.run_phase(phase))


class LoopExecutor:
    """Base of the executors whose nodes live on the event loop's thread."""

    def __init__(self, bridge: Bridge, cycle: Cycle) -> None:
        """Serve the nodes of one run."""
        self._bridge = bridge
        self._loop = bridge.loop
        self._cycle = cycle

    def is_home(self, live: LiveNode) -> bool:
        """Return whether the calling thread is the event loop's."""
        return self._bridge.on_loop_thread()

    def thread_id(self, live: LiveNode) -> int | None:
        """Return the event loop's thread."""
        return self._bridge.thread_id

    def due_ns(self, live: LiveNode, now_ns: int) -> int | None:
        """Return the release that waits for the loop."""
        return self._cycle.due_ns(live, now_ns)

    def computes(self, live: LiveNode) -> bool:
        """Return False: there are no async ticks."""
        return False

    def stack(self, live: LiveNode) -> Stack:
        """Return where the loop's thread is."""
        return stack_of_thread(self._bridge.thread_id)

    def isolate(self, live: LiveNode) -> None:
        """Do nothing: a plain tick cannot be cut short, and nobody waits for its end."""

    def retime(self, live: LiveNode) -> None:
        """Move the node to the grid of its new rate."""
        self._cycle.retime(live)

    def disengage(self, live: LiveNode) -> None:
        """Release the node no more."""
        live.leave_service()
        self._cycle.remove(live)

    def cancel(self, live: LiveNode) -> None:
        """Do nothing: a plain tick cannot be cut short."""

    def dismiss(self, live: LiveNode) -> None:
        """Do nothing: the loop's thread is not this executor's to end."""

    def call_plain(self, live: LiveNode, phase: str | None) -> Future[bool]:
        """Run a plain callback on the loop: now, or when its thread is free."""
        future: Future[bool] = Future()

        def run() -> None:
            run_into(future, live, phase)

        if not self._bridge.on_loop_thread():
            self._bridge.post(run)
        elif live.ticking:
            # The node's own tick is on the stack below us.
            self._loop.call_soon(run)
        else:
            run()
        return future
