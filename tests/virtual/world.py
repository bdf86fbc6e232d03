"""One node, its tick path and its supervision, on a clock that only the test moves."""

from __future__ import annotations

from collections.abc import Iterable

from horus import Health, Node
from horus.clock import FOREVER_NS, SimClock, Timeline
from horus.live import LiveNode
from horus.loop.control import RunControl
from horus.loop.inspector import Inspector
from horus.loop.safety import Safety
from horus.loop.stacks import Stack
from horus.loop.watchdog import Watchdog
from horus.tick_path import build_tick

NODE_THREAD = 1


class World:
    """A node whose ticks last as long as the test says, while supervision looks on.

    Everything is what a robot runs, except the clock, and the home: nobody but
    `tick` runs the node, and supervision looks when it has asked to, or late if
    the test has suspended it.
    """

    def __init__(self, timeout_ns: int, critical_ns: int | None = None) -> None:
        """Begin at instant 1 s with a healthy node that is idle."""
        self.clock = SimClock()
        self.clock.advance_to(1_000_000_000)
        timeline = Timeline(self.clock, 1000.0)
        self.hooks = 0
        self.begun = 0
        self.due_since_ns: int | None = None
        self.thread_of_node = NODE_THREAD
        self._ends_at_ns = 0
        self._suspended_for_ns = 0
        node = Node("node", self._tick, safe_state=self._hook)
        self.seen: list[tuple[int, Health]] = []
        """What supervision has made of the node, and after how much of its tick [ns]."""
        control = RunControl(None, lambda *late: self._inspector.critical_late(*late))
        self.live = LiveNode(node, timeline, control, 0)
        if critical_ns is not None:
            self.live.make_critical(critical_ns)
        self.live.run_phase("init")
        self.live.enter_service()
        self._run_tick = build_tick(self.live)
        self.safety = Safety(self._call_hooks)
        self.watchdog = Watchdog(timeout_ns, lambda: [(self.live, self)])
        self._inspector = Inspector(
            self.watchdog, self.safety, self.clock.now_ns, lambda write: write()
        )
        self.look()

    @property
    def health(self) -> Health:
        """What supervision thinks of the node."""
        return self.live.standing.health

    @property
    def expirations(self) -> int:
        """How often the watchdog has run out."""
        return self.live.counters.watchdog_expirations

    def tick(
        self, lasts_ns: int, *, suspended_for_ns: int = 0, release_ns: int | None = None
    ) -> bool:
        """Run a tick of this length, released now or earlier; return whether it has begun.

        In the middle of it, the whole process may be suspended, in addition.
        """
        begun = self.begun
        self._ends_at_ns = self.clock.now_ns() + lasts_ns
        self._suspended_for_ns = suspended_for_ns
        self._run_tick(self.clock.now_ns() if release_ns is None else release_ns)
        return self.begun > begun

    def idle(self, for_ns: int) -> None:
        """Let time pass while nothing is owed."""
        self._pass_until(self.clock.now_ns() + for_ns)

    def suspend(self, for_ns: int) -> None:
        """Stop the process, supervision included."""
        self.clock.advance_to(self.clock.now_ns() + for_ns)

    def look(self) -> None:
        """Let supervision look, as it does at once when something has changed."""
        before = self.health
        self._inspector.inspect()
        if self.health is not before:
            since_ns = self.clock.now_ns() - self.live.tick_context.start_ns
            self.seen.append((since_ns, self.health))

    def _tick(self) -> None:
        self.begun += 1
        middle_ns = (self.clock.now_ns() + self._ends_at_ns) // 2
        self._pass_until(middle_ns)
        self.look()  # as it does at any time, when something has changed elsewhere
        self.suspend(self._suspended_for_ns)
        self._pass_until(self._ends_at_ns + self._suspended_for_ns)

    def _pass_until(self, instant_ns: int) -> None:
        while (next_ns := self._inspector.next_ns) <= instant_ns:
            assert next_ns != FOREVER_NS
            self.clock.advance_to(next_ns)
            self.look()
        self.clock.advance_to(instant_ns)

    def _hook(self) -> None:
        self.hooks += 1

    def _call_hooks(self, lives: Iterable[LiveNode]) -> None:
        for live in lives:
            live.context.copy().run(live.run_phase, "safe_state")
            live.standing.hook_returned.set()

    # -- the node's home ---------------------------------------------------------------

    def due_ns(self, live: LiveNode, now_ns: int) -> int | None:
        return self.due_since_ns

    def thread_id(self, live: LiveNode) -> int | None:
        return self.thread_of_node

    def computes(self, live: LiveNode) -> bool:
        return False

    def stack(self, live: LiveNode) -> Stack:
        return Stack()

    def isolate(self, live: LiveNode) -> None:
        pass
