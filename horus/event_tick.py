"""Event nodes: one tick uses up one message."""

from __future__ import annotations

from horus.live import LiveNode
from horus.spec import NodeState


class EventTick:
    """Sees to it that a tick of an event node uses up its message, exactly one.

    Also if the tick does not ask for it. A node that has not ticked because it was
    to restart first, or is out of service, leaves its message to wait.
    """

    def __init__(self, live: LiveNode) -> None:
        """Look at the node before the tick."""
        assert live.trigger is not None
        self._live = live
        self._trigger = live.trigger
        self._received = live.trigger.received
        self._ticks = live.counters.ticks

    def settle(self) -> None:
        """Discard the message after the tick, if it was due and is still there."""
        live = self._live
        waits = live.retired or live.state is NodeState.RESTARTING
        if waits and live.counters.ticks == self._ticks:
            return
        if self._trigger.received == self._received:
            self._trigger.discard()
