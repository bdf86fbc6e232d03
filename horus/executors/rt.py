"""Rt nodes: each on a thread of its own, on the absolute release grid."""

from __future__ import annotations

import functools

from horus.executors.thread import NodeThread, ThreadExecutor
from horus.live import LiveNode
from horus.loop.realtime import RealTime
from horus.tick_path import build_tick


class RtThread(NodeThread):
    """Sleeps until a release, ticks, and goes on to the next one.

    A late node keeps its phase: it runs for its latest release at once, earlier
    ones are skipped and counted, and the next one stays where it always was.
    """

    def __init__(self, live: LiveNode, real_time: RealTime) -> None:
        """Prepare a thread that does not release yet."""
        super().__init__(live, functools.partial(real_time.enter_node_thread, live))
        self.engaged = False
        self._run_tick = build_tick(live)
        self._timeline = live.timeline
        self._now_ns = live.timeline.now_ns
        self._grid = live.grid()
        self._index = 0
        self._release_ns = 0

    def idle(self) -> None:
        """Wait for the next release and run it."""
        if not self.engaged:
            self.park()
            return
        now_ns = self._now_ns()
        if self._release_ns >= self._timeline.end_ns:
            self.park()
            return
        early_ns = self._release_ns - now_ns
        if early_ns > 0:
            # Woken early or for a job, we come back here and look again.
            self.park(early_ns)
            return
        if -early_ns >= self.live.period_ns:
            latest = self._grid.index_at(min(now_ns, self._timeline.end_ns - 1))
            self.live.counters.skipped += latest - self._index
            self._index = latest
            self._release_ns = self._grid.at(latest)
        self._run_tick(self._release_ns)
        self._index += 1
        self._release_ns = self._grid.at(self._index)

    def engage(self, from_ns: int) -> None:
        """Begin with the first release at or after `from_ns` [ns]."""
        self._join_grid(from_ns)
        self.engaged = True

    def retime(self) -> None:
        """Move to the grid of the node's new rate; a release that is due is not lost to it."""
        if self._grid != self.live.grid():
            self._join_grid(min(self._release_ns, self._now_ns()))

    def _join_grid(self, from_ns: int) -> None:
        self._grid = self.live.grid()
        self._index = self._grid.first_from(from_ns)
        self._release_ns = self._grid.at(self._index)


class RtExecutor(ThreadExecutor[RtThread]):
    """Gives every node an `RtThread`."""

    def __init__(self, real_time: RealTime) -> None:
        """Serve the nodes of one run."""
        super().__init__()
        self._real_time = real_time

    def make_thread(self, live: LiveNode) -> RtThread:
        """Return the node's thread, not started."""
        return RtThread(live, self._real_time)

    def engage(self, live: LiveNode, from_ns: int) -> None:
        """Let the thread release the node."""
        live.enter_service()
        thread = self.thread_of(live)
        thread.post(functools.partial(thread.engage, from_ns))

    def disengage(self, live: LiveNode) -> None:
        """Let the thread begin no further tick."""
        live.leave_service()
        thread = self.thread_of(live)
        thread.engaged = False
        thread.unpark()

    def retime(self, live: LiveNode) -> None:
        """Let the thread move to the grid of the new rate."""
        thread = self.thread_of(live)
        thread.post(thread.retime)
