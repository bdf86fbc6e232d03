"""The safe state: nodes are told to be harmless, and held until somebody clears it."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable, Sequence

from horus.errors import StateError
from horus.live import LiveNode
from horus.spec import Health

CallHooks = Callable[[Sequence[LiveNode]], None]
"""Calls the safe-state hooks of nodes, one after another, each bounded in time; returns at once."""

HOOK_TIMEOUT_S = 0.1
"""How long others wait for a safe-state hook that does not return [s]."""

_log = logging.getLogger("horus.supervisor")


class Safety:
    """Holds nodes, calls their safe-state hooks once, and lets them go again.

    A node that is held does not tick: its releases are skipped and counted. The
    gate is closed first, for all of them, and then the hooks are called: what a
    hook has commanded is not undone by a later tick.

    Thread: any.
    """

    def __init__(
        self, call_hooks: CallHooks, entered: Callable[[str], None] = lambda reason: None
    ) -> None:
        """Begin with nobody held; `entered` is told why the system has entered its safe state."""
        self._call_hooks = call_hooks
        self._entered = entered
        self._lock = threading.Lock()
        self.reason: str | None = None
        """Why the system-wide safe state was entered; None while it is not."""
        self.times_cleared = 0
        """What was seen before the last time has been dealt with."""

    @property
    def active(self) -> bool:
        """Whether the system is in its safe state."""
        return self.reason is not None

    def enter(
        self, reason: str, lives: Callable[[], Iterable[LiveNode]], times_cleared: int
    ) -> bool:
        """Enter the system-wide safe state; return False if it is in it already.

        The hook of every node is called, in shutdown order. Nodes without one
        tick on, so that they can report.

        Args:
            reason: Why.
            lives: Returns the nodes.
            times_cleared: As it was when the reason was seen.
        """
        with self._lock:
            if self.active or times_cleared != self.times_cleared:
                return False
            self.reason = reason
            # Asked for now: who begins to take part later finds the safe state active.
            owed = self._hold(sorted(lives(), key=lambda live: live.rank, reverse=True))
        self._call(owed)
        self._entered(reason)
        return True

    def join(self, live: LiveNode) -> None:
        """See to it that a node that begins to take part does not tick in the safe state."""
        with self._lock:
            owed = self._hold([live]) if self.active else []
        self._call(owed)

    def isolate(self, live: LiveNode, ticks: int) -> bool:
        """Take a frozen node out of the schedule; return False if its tick has just ended.

        Args:
            live: The node.
            ticks: Its count of ticks when it was found frozen.
        """
        standing = live.standing
        held_already = standing.held
        if not standing.isolate(ticks):
            return False
        if not held_already and standing.claim_hook():
            self._call_hooks([live])
        return True

    def clear(self, lives: Iterable[LiveNode]) -> list[str]:
        """Let the nodes tick again; return the names of those that cannot yet.

        These are isolated nodes whose tick still does not end, and nodes whose hook
        has not returned.

        Raises:
            StateError: A critical node is still frozen. Nothing has changed.
        """
        lives = tuple(lives)
        self._refuse_if_frozen(lives)
        for live in lives:
            # Hooks that have just been called have the time that they are given anyway.
            live.standing.hook_returned.wait(HOOK_TIMEOUT_S)
        remain = []
        with self._lock:
            # Again: one that froze meanwhile has found the safe state active.
            self._refuse_if_frozen(lives)
            news = self.active or any(live.standing.held for live in lives)
            self.times_cleared += self.active
            self.reason = None
            for live in lives:
                standing = live.standing
                frozen = standing.health is Health.ISOLATED and live.busy
                if standing.held and (frozen or not standing.hook_returned.is_set()):
                    remain.append(live.name)
                elif standing.held:
                    live.free()
        if news:
            still = f"; still held: {', '.join(remain)}" if remain else ""
            _log.warning("safe state cleared%s", still)
        return remain

    def reset(self) -> None:
        """Forget everything: a new session begins."""
        self.reason = None

    def _refuse_if_frozen(self, lives: Iterable[LiveNode]) -> None:
        frozen = [live.name for live in lives if _is_critical_and_frozen(live)]
        if self.active and frozen:
            raise StateError(
                f"the safe state stays: {', '.join(frozen)} is critical and still frozen"
            )

    def _hold(self, lives: Iterable[LiveNode]) -> list[LiveNode]:
        """Hold nodes that have a hook; return those whose hook is to be called."""
        able = (live for live in lives if live.standing.has_hook and live.initialized)
        held = [live for live in able if live.standing.hold()]
        return [live for live in held if live.standing.claim_hook()]

    def _call(self, owed: list[LiveNode]) -> None:
        if owed:
            self._call_hooks(owed)


def _is_critical_and_frozen(live: LiveNode) -> bool:
    if live.critical_ns is None:
        return False
    # By its health if it is due and cannot begin.
    late = live.standing.health in (Health.WARNING, Health.UNHEALTHY)
    return late or live.frozen_for(live.critical_ns)
