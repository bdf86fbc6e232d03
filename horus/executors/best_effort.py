"""BestEffort nodes: one after another, in order, on the event loop's thread."""

from __future__ import annotations

from concurrent.futures import Future

from horus.executors.base import LoopExecutor
from horus.live import LiveNode
from horus.loop.bridge import Bridge
from horus.loop.cycle import Cycle
from horus.tick_path import RunTick, build_tick


class BestEffortExecutor(LoopExecutor):
    """Ticks each node inline when the cycle releases it."""

    def __init__(self, bridge: Bridge, cycle: Cycle) -> None:
        """Serve the nodes of one run."""
        super().__init__(bridge, cycle)
        self._ticks: dict[LiveNode, RunTick] = {}

    def adopt(self, live: LiveNode) -> None:
        """Build the node's tick path."""
        self._ticks[live] = build_tick(live)

    def engage(self, live: LiveNode, from_ns: int) -> None:
        """Release the node on its grid."""
        live.enter_service()
        self._cycle.add(live, self._tick, from_ns)

    def call(self, live: LiveNode, phase: str | None) -> Future[bool]:
        """Run a callback on the loop's thread."""
        return self.call_plain(live, phase)

    def dismiss(self, live: LiveNode) -> None:
        """Forget the node's tick path."""
        self._ticks.pop(live, None)

    def _tick(self, live: LiveNode, release_ns: int) -> None:
        self._ticks[live](release_ns)
