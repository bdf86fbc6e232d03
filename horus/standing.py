"""How a node stands with supervision: its health, whether it is held, whose its hook is."""

from __future__ import annotations

import threading
from collections.abc import Callable

from horus.spec import Health
from horus.stats import NodeCounters


class Standing:
    """What supervision has found out and decided about one node.

    Thread: changed by the methods, under a lock, on the threads they name; single
    attributes are read by any.
    """

    def __init__(
        self,
        counters: NodeCounters,
        close_gate: Callable[[], None],
        changed: Callable[[str, str], None],
        *,
        has_hook: bool,
    ) -> None:
        """Begin healthy and free.

        Args:
            counters: The node's.
            close_gate: Keeps the node from ticking unasked.
            changed: Told of each change: what, and to what.
            has_hook: Whether there is a safe-state hook.
        """
        self._health = Health.HEALTHY
        self._changed = changed
        self.held = False
        """Whether the node is kept from ticking until the safe state is cleared."""
        self.holds = 0
        """How often the node has been held."""
        self.alert = False
        """Whether the end of the next tick deserves a closer look."""
        self.has_hook = has_hook
        """Whether there is a safe-state hook."""
        self.hook_returned = threading.Event()
        """Whether no safe-state hook is owed or in progress."""
        self.hook_returned.set()
        self._counters = counters
        self._close_gate = close_gate
        self._lock = threading.Lock()

    @property
    def health(self) -> Health:
        """What supervision thinks of the node."""
        return self._health

    def _become(self, health: Health) -> None:
        self._health = health
        self._changed("health", health)

    def renew(self) -> None:
        """Begin again, healthy and free: a new run begins."""
        self._health = Health.HEALTHY
        self.held = self.alert = False
        self.hook_returned.set()

    # -- the watchdog ------------------------------------------------------------

    def expire(self, health: Health) -> None:
        """Take note that the watchdog has run out.

        Thread: supervisor.
        """
        with self._lock:
            self._expire(health)

    def _expire(self, health: Health) -> None:
        if self.health is Health.HEALTHY:
            self._counters.watchdog_expirations += 1
        self._become(health)
        self.alert = True

    def expired_unseen(self) -> None:
        """Take note that the watchdog would have run out, had anybody looked.

        Thread: supervisor.
        """
        with self._lock:
            self._counters.watchdog_expirations += 1

    def recovered(self) -> bool:
        """Return to health, because the tick has ended; return whether that is news.

        An isolated node stays isolated.

        Thread: the node's, or the supervisor.
        """
        with self._lock:
            if self.health in (Health.HEALTHY, Health.ISOLATED):
                return False
            self._become(Health.HEALTHY)
        return True

    def isolate(self, ticks: int) -> bool:
        """Take the node out of the schedule, unless the tick in question has ended meanwhile.

        Args:
            ticks: The count of ticks when it was found frozen.

        Thread: supervisor.
        """
        with self._lock:
            if self._counters.ticks != ticks:
                return False
            self._expire(Health.ISOLATED)
            if not self.held:
                self._hold()
        return True

    # -- the safe state ----------------------------------------------------------

    def hold(self) -> bool:
        """Let the node tick no more until `LiveNode.free`; return whether it did until now.

        Thread: supervisor.
        """
        with self._lock:
            if self.held:
                return False
            self._hold()
        return True

    def _hold(self) -> None:
        # `held` first: whoever opens the gate looks at it afterwards.
        self.held = True
        self._close_gate()
        self.holds += 1
        self._changed("held", "yes")

    def let_go(self) -> None:
        """Hold and isolate the node no more.

        A tick that lasts too long already goes on doing so.

        Thread: any.
        """
        with self._lock:
            if self.held:
                self.held = False
                self._changed("held", "no")
            if self.health is Health.ISOLATED:
                self._become(Health.HEALTHY)

    def claim_hook(self) -> bool:
        """Return whether there is a safe-state hook to call; who hears yes must call it.

        And say when it has returned, with `hook_returned` or `safe_state_entered`.
        Meanwhile nobody else does.

        Thread: any.
        """
        with self._lock:
            if not (self.has_hook and self.hook_returned.is_set()):
                return False
            self.hook_returned.clear()
        return True
