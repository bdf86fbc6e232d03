"""Which node is released next: a queue over the nodes' release grids."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Mapping
from dataclasses import dataclass

from horus import clock
from horus.live import LiveNode
from horus.timing import Grid

Rank = tuple[int, int]


@dataclass(slots=True)
class _Release:
    """The next release of a node."""

    live: LiveNode
    grid: Grid
    rank: Rank
    index: int
    last_ns: int
    """The release that was handed out last [ns]."""
    cancelled: bool = False


class ReleaseQueue:
    """The upcoming release of every node, the earliest first, ties in execution order.

    Thread: one.
    """

    def __init__(self) -> None:
        """Begin with no nodes."""
        # Tuples, which the heap compares in C. The serial number keeps it from
        # ever comparing two releases.
        self._heap: list[tuple[int, Rank, int, _Release]] = []
        self._of_node: dict[LiveNode, _Release] = {}
        self._serial = itertools.count()

    @property
    def next_ns(self) -> int | None:
        """The instant of the earliest release [ns]; None without nodes."""
        while self._heap and self._heap[0][3].cancelled:
            heapq.heappop(self._heap)
        return self._heap[0][0] if self._heap else None

    def due_ns(self, live: LiveNode, now_ns: int) -> int | None:
        """Return the release of `live` that is due and was not handed out yet [ns].

        Thread: any.
        """
        release = self._of_node.get(live)
        if release is None:
            return None
        due_ns = release.grid.at(release.index)
        return due_ns if due_ns <= now_ns else None

    def add(self, live: LiveNode, rank: Rank, from_ns: int, last_ns: int = clock.NEVER) -> None:
        """Queue the first release of `live` at or after `from_ns`, and after `last_ns` [ns]."""
        self.remove(live)
        grid = live.grid()
        index = grid.first_from(max(from_ns, last_ns + 1))
        release = self._of_node[live] = _Release(live, grid, rank, index, last_ns)
        heapq.heappush(self._heap, (grid.at(index), rank, next(self._serial), release))

    def remove(self, live: LiveNode) -> None:
        """Forget `live`; unknown nodes are ignored."""
        release = self._of_node.pop(live, None)
        if release is not None:
            release.cancelled = True

    def retime(self, live: LiveNode, now_ns: int) -> None:
        """Move `live` to the grid of its present rate; unknown nodes are ignored.

        A release of the old grid that is due already is not lost to the change.
        """
        release = self._of_node.get(live)
        if release is not None and release.grid != live.grid():
            due_ns = release.grid.at(release.index)
            self.add(live, release.rank, min(due_ns, now_ns), release.last_ns)

    def rerank(self, ranks: Mapping[LiveNode, Rank]) -> None:
        """Give every node a new place in execution order."""
        self._heap = []
        for live, release in self._of_node.items():
            release.rank = ranks[live]
            entry = (release.grid.at(release.index), release.rank, next(self._serial), release)
            heapq.heappush(self._heap, entry)

    def pop_due(self, now_ns: int) -> tuple[LiveNode, int] | None:
        """Return the earliest node that is due, and the instant of its release [ns].

        A node that is late by more than a period is released for its latest
        release; the earlier ones are skipped and counted. Its phase never moves.
        """
        next_ns = self.next_ns
        if next_ns is None or next_ns > now_ns:
            return None
        release_ns, rank, serial, release = self._heap[0]
        grid = release.grid
        following_ns = grid.at(release.index + 1)
        if following_ns <= now_ns:
            latest = grid.index_at(now_ns)
            release.live.skip_late(latest - release.index, release_ns, now_ns)
            release.index = latest
            release_ns, following_ns = grid.at(latest), grid.at(latest + 1)
        release.index += 1
        release.last_ns = release_ns
        heapq.heapreplace(self._heap, (following_ns, rank, serial, release))
        return release.live, release_ns

    def put_back(self, live: LiveNode, release_ns: int) -> None:
        """Make a release [ns] that was handed out due again; unknown nodes are ignored."""
        release = self._of_node.get(live)
        if release is not None:
            self.add(live, release.rank, release_ns)

    def clear(self) -> None:
        """Forget all nodes."""
        self._heap.clear()
        self._of_node.clear()
