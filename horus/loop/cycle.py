"""The main loop: release whatever is due, in order, then sleep until the next release."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from horus import clock
from horus.clock import Timeline
from horus.live import LiveNode
from horus.loop.releases import ReleaseQueue
from horus.loop.ticker import Ticker

GIVE_WAY_NS = 100_000
"""How much later the loop turns to its releases than Rt nodes to theirs [ns]: measured."""

Dispatch = Callable[[LiveNode, int], None]
"""Starts a tick of a node for a release [ns]: inline, as a task, or on another thread."""

HoldUp = Callable[[LiveNode, int, int], int | None]
"""Tells until when a node has to wait [ns] with a release, now; None: not at all. Calls
`run_due` should it be free earlier."""


class Cycle:
    """Releases the nodes that are driven by the event loop.

    `run_due` is the main loop's body, woken by the ticker at the earliest
    release and never in between::

        while a release is due, the earliest first, ties in execution order:
            put it back if an Rt node that comes before it is due at the same instant
            dispatch it (BestEffort nodes tick here and now; others are started)
            queue the node's next release
        arm the ticker for the earliest release

    What becomes due meanwhile waits for the next turn, so that the loop's other
    work gets one in between. And while Rt nodes run, the loop gives way: woken at the
    same instant, it would take the interpreter from them.

    Thread: loop.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, timeline: Timeline) -> None:
        """Begin with no nodes."""
        self._timeline = timeline
        self._now_ns = timeline.now_ns
        self._releases = ReleaseQueue()
        self._dispatch: dict[LiveNode, Dispatch] = {}
        self._ticker = Ticker(loop, self.run_due)
        self.hold_up: HoldUp | None = None
        """Who holds nodes up: Rt nodes, if there are any to give way to."""

    def run_due(self) -> None:
        """Dispatch every release that is due; see the class for the steps."""
        now_ns = min(self._now_ns(), self._timeline.end_ns - 1)
        held_up: list[tuple[LiveNode, int]] = []
        wake_ns = clock.FOREVER_NS
        try:
            while (due := self._releases.pop_due(now_ns)) is not None:
                live, release_ns = due
                if self.hold_up is not None:
                    until_ns = self.hold_up(live, release_ns, now_ns)
                    if until_ns is not None:
                        held_up.append(due)
                        wake_ns = min(wake_ns, until_ns)
                        continue
                try:
                    self._dispatch[live](live, release_ns)
                except KeyboardInterrupt:
                    raise
                except BaseException as exc:
                    live.broken(exc)
            self._arm(wake_ns)
        finally:
            for live, release_ns in held_up:
                self._releases.put_back(live, release_ns)

    def add(self, live: LiveNode, dispatch: Dispatch, from_ns: int) -> None:
        """Release `live` on its grid, with the first release at or after `from_ns` [ns]."""
        self._dispatch[live] = dispatch
        self._releases.add(live, live.rank, from_ns)
        self._arm()

    def remove(self, live: LiveNode) -> None:
        """Release `live` no more; unknown nodes are ignored."""
        self._releases.remove(live)
        self._dispatch.pop(live, None)

    def retime(self, live: LiveNode) -> None:
        """Move `live` to the grid of its new rate."""
        self._releases.retime(live, self._now_ns())
        self._arm()

    def due_ns(self, live: LiveNode, now_ns: int) -> int | None:
        """Return the release of `live` that waits for the loop [ns], if there is one.

        Thread: any.
        """
        due_ns = self._releases.due_ns(live, now_ns)
        return due_ns if due_ns is not None and due_ns < self._timeline.end_ns else None

    def close(self) -> None:
        """Release nothing more."""
        self._releases.clear()
        self._ticker.close()

    def _arm(self, wake_ns: int = clock.FOREVER_NS) -> None:
        """Ask to be woken for the earliest release, or at `wake_ns` if that is earlier."""
        next_ns, end_ns = self._releases.next_ns, self._timeline.end_ns
        if next_ns is not None and next_ns < end_ns:
            give_way = self.hold_up is not None and next_ns + GIVE_WAY_NS < end_ns
            wake_ns = min(wake_ns, next_ns + GIVE_WAY_NS if give_way else next_ns)
        if wake_ns < clock.FOREVER_NS:
            self._ticker.arm(wake_ns)
