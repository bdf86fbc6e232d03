"""The watchdog: which ticks are due or running and do not end."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

from horus.clock import FOREVER_NS, NEVER
from horus.escalation import GRADES, grade
from horus.live import LiveNode
from horus.loop.executor import Home
from horus.spec import Health

Members = Callable[[], Iterable[tuple[LiveNode, Home]]]
"""Tells the nodes that take part, each with its home."""


class Finding(NamedTuple):
    """A node whose tick does not end and has reached a further stage, or has ended at last."""

    live: LiveNode
    home: Home
    health: Health
    """What the node has come to; HEALTHY when the tick has ended."""
    critical: bool
    """Whether the timeout of a critical node is over."""
    lasted_ns: int
    """For how long the tick is due or running [ns]."""
    running: bool
    """Whether it runs; otherwise it is due and has not begun."""
    ticks: int
    """The count of ticks that have ended before it."""
    blamed: LiveNode | None
    """The node whose tick keeps this one from its thread."""


@dataclass(slots=True)
class _Vigil:
    """What is remembered of a node from one look to the next."""

    began_ns: int = NEVER
    excused_until_ns: int = NEVER
    """Until when somebody else was to blame [ns]."""
    unwatched_ns: int = 0
    """For how long nobody could look since the tick began [ns]."""


class Watchdog:
    """Measures ticks that are due or running and have not ended; never idleness.

    `look` finds what has reached one, two or three timeouts since the last look,
    and says when to look again: `next_ns`, the earliest instant at which anything
    can run out, not a fixed interval.

    Three rules keep it just:

    - A node that cannot begin because another one's tick has its thread is not to
      blame. A critical node counts all the same: its motor is not controlled. And one
      that cannot begin for another reason, because the application blocks its own event
      loop, is not what hangs: it becomes unhealthy at most.
    - When `look` itself comes late by a quarter of a timeout or more, because the
      process was suspended or something held the interpreter, that time is not
      counted, and the tick has half a timeout more to end. For a critical node it is;
      should its tick end before anybody looks, who ticks it tells (`LiveNode.check_critical`).
    - A tick that ends makes a node healthy again, unless it is isolated.

    Thread: one, except `watched`, `timeout_of` and `shortest_ns`: any.
    """

    def __init__(self, default_ns: int, members: Members) -> None:
        """Watch `members`, with a timeout of `default_ns` [ns; 0 for none] or of their own."""
        self._default_ns = default_ns
        self._members = members
        self._vigils: dict[LiveNode, _Vigil] = {}
        self.next_ns = NEVER

    def timeout_of(self, live: LiveNode) -> int | None:
        """Return the watchdog timeout of a node [ns]; None if it is not watched."""
        return live.spec.watchdog_ns or self._default_ns or live.critical_ns

    def shortest_ns(self) -> int:
        """Return the shortest timeout [ns]; `FOREVER_NS` if nobody is watched."""
        timeouts = (self.timeout_of(live) for live, _ in self._members())
        return min((timeout_ns for timeout_ns in timeouts if timeout_ns), default=FOREVER_NS)

    def watched(self) -> list[LiveNode]:
        """Return the nodes that take part."""
        return [live for live, _ in self._members()]

    def look(self, now_ns: int) -> list[Finding]:
        """Return what has run out at this instant [ns]."""
        late_ns = now_ns - self.next_ns if self.next_ns != NEVER else 0
        self.next_ns = FOREVER_NS
        members = tuple(self._members())
        holders = {
            home.thread_id(live): live
            for live, home in members
            if live.busy and (not live.is_async or home.computes(live))
        }
        findings = []
        for live, home in members:
            timeout_ns = self.timeout_of(live)
            if not timeout_ns or not live.initialized:
                continue
            if live.standing.health is Health.ISOLATED:
                # It may be let go right after this look.
                self._look_again_at(now_ns + min(timeout_ns, live.critical_ns or FOREVER_NS))
                continue
            finding = self._look_at(live, home, timeout_ns, now_ns, late_ns, holders)
            if finding is not None:
                findings.append(finding)
        if len(self._vigils) > 2 * len(members):
            self._vigils = {live: self._vigils[live] for live, _ in members if live in self._vigils}
        return findings

    def _look_at(
        self,
        live: LiveNode,
        home: Home,
        timeout_ns: int,
        now_ns: int,
        late_ns: int,
        holders: dict[int | None, LiveNode],
    ) -> Finding | None:
        ticks = live.counters.ticks  # first: if the tick ends from here on, it shows
        busy_since_ns = live.busy_since_ns
        running = busy_since_ns != NEVER
        since_ns = _begun_ns(live) if running else _due_ns(live, home, now_ns)
        began_ns = busy_since_ns if running else since_ns
        critical_ns = live.critical_ns or FOREVER_NS
        vigil = self._vigils.setdefault(live, _Vigil())
        recovered = False
        if began_ns != vigil.began_ns:
            self._vigils[live] = vigil = _Vigil(began_ns)
            recovered = live.standing.recovered()
        # A tick that is new to us may have begun at any time since we were to look.
        unseen_ns = min(late_ns, now_ns - began_ns)
        if unseen_ns > 0 and late_ns > timeout_ns // 4 and began_ns != NEVER:
            # And nobody knows since when we were not there: once, there is time to end.
            grace_ns = 0 if vigil.unwatched_ns else timeout_ns // 2
            vigil.unwatched_ns += unseen_ns + grace_ns
        if began_ns == NEVER:
            # A tick that begins right after this look.
            self._look_again_at(now_ns + min(timeout_ns, critical_ns))
            ended = Finding(live, home, Health.HEALTHY, False, 0, False, ticks, None)
            return ended if recovered else None
        blamed = holders.get(home.thread_id(live))
        if blamed is live or (running and not live.is_async):
            blamed = None  # it has its thread to itself
        if blamed is not None:
            vigil.excused_until_ns = now_ns
        counted_from_ns = max(began_ns + vigil.unwatched_ns, vigil.excused_until_ns)
        health = grade(now_ns - counted_from_ns, timeout_ns)
        next_grade_ns = counted_from_ns + (GRADES.index(health) + 1) * timeout_ns + 1
        if health is Health.ISOLATED and not running:
            health, next_grade_ns = Health.UNHEALTHY, now_ns + timeout_ns
        self._look_again_at(next_grade_ns)
        lasted_ns = now_ns - since_ns
        critical = lasted_ns > critical_ns
        # Another tick may begin right after this look.
        self._look_again_at((now_ns if critical else since_ns) + critical_ns + 1)
        worse = GRADES.index(health) > GRADES.index(live.standing.health)
        if not (worse or critical or recovered):
            return None
        health = health if worse else live.standing.health
        return Finding(live, home, health, critical, lasted_ns, running, ticks, blamed)

    def _look_again_at(self, instant_ns: int) -> None:
        self.next_ns = min(self.next_ns, instant_ns)


def _begun_ns(live: LiveNode) -> int:
    """Return since when the tick in progress was owed [ns].

    A message that waited behind another one was not owed before that one's tick ended.
    """
    context = live.tick_context
    finish_ns = context.finish_ns
    if finish_ns > context.start_ns:
        finish_ns = context.previous_ns  # it is in its safe-state hook
    return max(context.release_ns, finish_ns, live.owed_from_ns)


def _due_ns(live: LiveNode, home: Home, now_ns: int) -> int:
    """Return since when a tick is owed that has not begun [ns]; `NEVER` if none is."""
    due_ns = home.due_ns(live, now_ns)
    if due_ns is None:
        return NEVER
    owed_from_ns = max(due_ns, live.tick_context.finish_ns, live.owed_from_ns)
    return owed_from_ns if owed_from_ns <= now_ns else NEVER
