"""Which node is released next: a queue over the nodes' release grids."""

from __future__ import annotations

import heapq
from collections.abc import Mapping
from dataclasses import dataclass, field

from horus import clock
from horus.live import LiveNode
from horus.timing import ReleaseGrid

Rank = tuple[int, int]


@dataclass(slots=True, order=True)
class _Release:
    """The next release of a node; compares by instant, then execution order."""

    at_ns: int
    rank: Rank
    index: int = field(compare=False)
    grid: ReleaseGrid = field(compare=False)
    live: LiveNode = field(compare=False)
    last_ns: int = field(compare=False, default=clock.NEVER)
    """The release that was handed out last [ns]."""
    cancelled: bool = field(compare=False, default=False)


class ReleaseQueue:
    """The upcoming release of every node, the earliest first, ties in execution order.

    Thread: one.
    """

    def __init__(self) -> None:
        """Begin with no nodes."""
        self._heap: list[_Release] = []
        self._of_node: dict[LiveNode, _Release] = {}

    @property
    def next_ns(self) -> int | None:
        """The instant of the earliest release [ns]; None without nodes."""
        while self._heap and self._heap[0].cancelled:
            heapq.heappop(self._heap)
        return self._heap[0].at_ns if self._heap else None

    def add(self, live: LiveNode, rank: Rank, from_ns: int, last_ns: int = clock.NEVER) -> None:
        """Queue the first release of `live` at or after `from_ns`, and after `last_ns` [ns]."""
        self.remove(live)
        grid = live.grid()
        index = grid.first_from(max(from_ns, last_ns + 1))
        release = _Release(grid.at(index), rank, index, grid, live, last_ns)
        self._of_node[live] = release
        heapq.heappush(self._heap, release)

    def remove(self, live: LiveNode) -> None:
        """Forget `live`; unknown nodes are ignored."""
        release = self._of_node.pop(live, None)
        if release is not None:
            release.cancelled = True

    def retime(self, live: LiveNode, now_ns: int) -> None:
        """Move `live` to the grid of its present rate; unknown nodes are ignored."""
        release = self._of_node.get(live)
        if release is not None:
            self.remove(live)
            self.add(live, release.rank, now_ns, release.last_ns)

    def rerank(self, ranks: Mapping[LiveNode, Rank]) -> None:
        """Give every node a new place in execution order."""
        for live, release in self._of_node.items():
            release.rank = ranks[live]
        heapq.heapify(self._heap)

    def pop_due(self, now_ns: int) -> tuple[LiveNode, int] | None:
        """Return the earliest node that is due, and the instant of its release [ns].

        A node that is late by more than a period is released for its latest
        release; the earlier ones are skipped and counted. Its phase never moves.
        """
        next_ns = self.next_ns
        if next_ns is None or next_ns > now_ns:
            return None
        release = self._heap[0]
        latest = release.grid.index_at(now_ns)
        release.live.counters.skipped += latest - release.index
        release_ns = release.grid.at(latest)
        release.last_ns = release_ns
        release.index = latest + 1
        release.at_ns = release.grid.at(latest + 1)
        heapq.heapreplace(self._heap, release)
        return release.live, release_ns

    def clear(self) -> None:
        """Forget all nodes."""
        self._heap.clear()
        self._of_node.clear()
