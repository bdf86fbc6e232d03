"""Compute nodes: CPU-heavy ticks on worker threads, released by the event loop.

The pool has a thread for every compute node, so that a slow node delays no
other, and a node finds itself on the same thread at every tick.
"""

from __future__ import annotations

import functools
import threading

from horus.executors.thread import NodeThread, ThreadExecutor
from horus.live import LiveNode
from horus.loop.bridge import Bridge
from horus.loop.cycle import Cycle
from horus.loop.realtime import RealTime
from horus.loop.safety import HOOK_TIMEOUT_S
from horus.loop.stacks import Stack
from horus.tick_path import build_tick
from horus.workers.process import RemoteNode


class ComputeThread(NodeThread):
    """Runs a tick when told to."""

    def __init__(self, live: LiveNode, real_time: RealTime) -> None:
        """Prepare an idle worker."""
        super().__init__(live, functools.partial(real_time.enter_worker_thread, live))
        self.posted_ns: int | None = None
        """The release that the worker is busy with [ns]; None when it is idle."""
        self._run_tick = build_tick(live)

    def tick(self, release_ns: int) -> None:
        """Run the tick of a release."""
        try:
            self._run_tick(release_ns)
        finally:
            self.posted_ns = None


class WorkerThread(ComputeThread):
    """Has ticks run in a worker process, and waits for them with the interpreter free."""

    def __init__(self, live: LiveNode, real_time: RealTime) -> None:
        """Prepare; the process comes with `init()`."""
        self.remote = RemoteNode(live, real_time, self.post)
        live.callbacks = self.remote.callbacks()
        super().__init__(live, real_time)

    def kill(self) -> None:
        """Kill the process once the safe-state hook has returned, or had its time.

        Thread: any.
        """
        self.live.standing.hook_returned.wait(HOOK_TIMEOUT_S)
        self.remote.kill()


class ComputeExecutor(ThreadExecutor[ComputeThread]):
    """Hands each release to the node's worker; one that finds it busy is skipped."""

    def __init__(self, bridge: Bridge, cycle: Cycle, real_time: RealTime) -> None:
        """Serve the nodes of one run."""
        super().__init__()
        self._bridge = bridge
        self._cycle = cycle
        self._real_time = real_time

    def make_thread(self, live: LiveNode) -> ComputeThread:
        """Return the node's thread, not started."""
        kind = WorkerThread if live.spec.process else ComputeThread
        return kind(live, self._real_time)

    def isolate(self, live: LiveNode) -> None:
        """Kill a worker process that is frozen; on a thread nothing can be cut short."""
        thread = self.find_thread(live)
        if isinstance(thread, WorkerThread):
            threading.Thread(
                target=thread.kill, name=f"horus-kill:{live.name}", daemon=True
            ).start()

    def stack(self, live: LiveNode) -> Stack:
        """Return where the node's callbacks are, in whatever process."""
        thread = self.find_thread(live)
        if isinstance(thread, WorkerThread) and live.busy and (stack := thread.remote.stack()):
            return stack
        return super().stack(live)

    def dismiss(self, live: LiveNode) -> None:
        """End the node's thread, and its process."""
        thread = self.find_thread(live)
        super().dismiss(live)
        if isinstance(thread, WorkerThread):
            thread.remote.dismiss()
            live.callbacks = live.core.callbacks

    def engage(self, live: LiveNode, from_ns: int) -> None:
        """Release the node on its grid."""
        live.enter_service()
        self._cycle.add(live, self._release, from_ns)

    def disengage(self, live: LiveNode) -> None:
        """Release the node no more."""
        live.leave_service()
        self._cycle.remove(live)

    def due_ns(self, live: LiveNode, now_ns: int) -> int | None:
        """Return the release that waits for the worker, or for the loop to hand it on."""
        thread = self.find_thread(live)
        posted_ns = None if thread is None else thread.posted_ns
        return self._cycle.due_ns(live, now_ns) if posted_ns is None else posted_ns

    def thread_id(self, live: LiveNode) -> int | None:
        """Return the worker's thread, or the loop's while that has nothing handed on."""
        thread = self.find_thread(live)
        if thread is not None and thread.posted_ns is None:
            return self._bridge.thread_id
        return super().thread_id(live)

    def retime(self, live: LiveNode) -> None:
        """Move the node to the grid of its new rate."""
        self._cycle.retime(live)

    def _release(self, live: LiveNode, release_ns: int) -> None:
        thread = self.thread_of(live)
        if thread.posted_ns is not None:
            live.counters.skipped += 1
            return
        thread.posted_ns = release_ns
        thread.post(functools.partial(thread.tick, release_ns))
