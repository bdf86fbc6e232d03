"""Ticks that freeze on command, in each way in which a tick of some class can freeze."""

from __future__ import annotations

import asyncio
import threading
from types import TracebackType
from typing import Any, Self

import pytest

from horus import Node, Scheduler, StateError

from .helpers import PATIENCE_S, TRIGGER, node_of, wait_until

WAYS = (
    "BestEffort",
    "Event",
    "urgent Event",
    "async Event",
    "AsyncIo",
    "AsyncIo that blocks",
    "Rt",
    "Compute",
)
"""Every class, twice where its ticks can freeze in two ways."""

ON_LOOP = ("BestEffort", "Event", "AsyncIo that blocks")
"""The ways that block the event loop."""

AWAITING = ("async Event", "AsyncIo")
"""The ways that leave the loop free and can be cancelled."""

MARKER = "stuck_in_the_driver"
"""The function that a frozen tick is in: what a report's stack has to show."""

HEALTHS = ("warning", "unhealthy", "isolated")
"""What becomes of a node whose tick does not end, stage by stage."""


class Freezer:
    """The callbacks of a node whose ticks freeze when told to, until they are thawed.

    Leaving the `with` block thaws them: what a test has frozen ends with it.
    """

    def __init__(self, *, armed: bool = True) -> None:
        """Freeze the first tick, if `armed`."""
        self._armed = armed
        self._thawed = threading.Event()
        self.ticks = 0
        self.ended = 0
        self.frozen_thread: int | None = None
        self.hook_threads: list[int] = []

    def freeze(self) -> None:
        """Let the next tick freeze."""
        self._thawed.clear()
        self._armed = True

    def thaw(self) -> None:
        """Let the frozen tick end, and no other freeze."""
        self._armed = False
        self._thawed.set()

    def tick(self, node: Node) -> None:
        """Freeze if it is time, on the thread that ticks."""
        self.ticks += 1
        if self._begins_to_freeze():
            self.stuck_in_the_driver()
        self.ended += 1

    async def tick_async(self, node: Node) -> None:
        """Freeze if it is time, in an `await`."""
        self.ticks += 1
        if self._begins_to_freeze():
            await AwaitingFreezer.stuck_in_the_driver(self._thawed)
        self.ended += 1

    async def tick_async_that_blocks(self, node: Node) -> None:
        """Freeze if it is time, with the event loop."""
        self.tick(node)

    def hook(self, node: Node) -> None:
        """Take note of who calls the safe-state hook."""
        self.hook_threads.append(threading.get_ident())

    def stuck_in_the_driver(self) -> None:
        self._thawed.wait(PATIENCE_S)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.thaw()

    def _begins_to_freeze(self) -> bool:
        armed, self._armed = self._armed, False
        if armed:
            self.frozen_thread = threading.get_ident()
        return armed


class AwaitingFreezer:
    """Where async ticks freeze, under the same name as the others."""

    @staticmethod
    async def stuck_in_the_driver(thawed: threading.Event) -> None:
        while not thawed.is_set():  # noqa: ASYNC110  (the event belongs to another thread)
            await asyncio.sleep(0.002)


def freezing_node(
    way: str, freezer: Freezer, name: str = "frozen", *, hook: bool = True, **options: Any
) -> Node:
    """Return a node that freezes in this way; its hook is the freezer's."""
    schedule: dict[str, Any] = {
        "BestEffort": {},
        "Event": {"on": TRIGGER},
        "urgent Event": {"on": TRIGGER, "deadline": 30.0},
        "async Event": {"on": TRIGGER},
        "AsyncIo": {"rate": 50},
        "AsyncIo that blocks": {"rate": 50},
        "Rt": {"rate": 50},
        "Compute": {"rate": 50, "compute": True},
    }[way]
    tick: Any = freezer.tick
    safe_state: Any = freezer.hook
    if way in AWAITING:
        tick = freezer.tick_async
    elif way == "AsyncIo that blocks":
        tick = freezer.tick_async_that_blocks
    if way in (*AWAITING, "AsyncIo that blocks"):
        safe_state = _as_coroutine(freezer)
    if hook:
        schedule["safe_state"] = safe_state
    return Node(name, tick, **schedule, **options)


def _as_coroutine(freezer: Freezer) -> Any:
    async def hook(node: Node) -> None:
        freezer.hook(node)

    return hook


def await_health(sched: Scheduler, name: str, health: str) -> None:
    """Return when a node has come to this health or, on the way down, is past it."""

    def reached() -> bool:
        now = sched.get_node_stats(name)["health"]
        if health == "healthy":
            return now == health
        return now in HEALTHS[HEALTHS.index(health) :]

    wait_until(reached)


def reports(caplog: pytest.LogCaptureFixture, name: str = "frozen") -> list[tuple[str, str, str]]:
    """Return what supervision has logged of a node: level, health and the whole message."""
    found = []
    for record in tuple(caplog.records):
        message = record.getMessage()
        if record.name == f"horus.node.{name}":
            _, _, text = message.partition(": ")
            health = "healthy" if text == "healthy again" else text.partition(":")[0]
            if health in ("healthy", *HEALTHS):
                found.append((record.levelname, health, message))
    return found


def expirations(sched: Scheduler, name: str = "frozen") -> int:
    """Return how often the watchdog has run out for a node."""
    count: int = sched.get_node_stats(name)["watchdog_expirations"]
    return count


def remaining(sched: Scheduler) -> list[str] | None:
    """Clear the safe state; return who remains held, or None if that is not possible yet.

    A tick that has just ended counts as frozen until it has been settled.
    """
    try:
        return sched.clear_safe_state()
    except StateError:
        return None


def cleared(sched: Scheduler) -> bool:
    """Clear the safe state; return whether nobody remains held."""
    return remaining(sched) == []


def in_safe_state(sched: Scheduler) -> bool:
    """Return whether the whole system is in its safe state."""
    active: bool = sched.safety_stats()["safe_state"]
    return active


class Witness:
    """Nodes around a critical one: what their ticks, hooks and shutdowns do, in order."""

    def __init__(self, sched: Scheduler) -> None:
        """Watch over a scheduler."""
        self.sched = sched
        self.ticks: dict[str, int] = {}
        self.journal: list[tuple[str, str]] = []
        self.hook_threads: dict[str, int] = {}

    def add(self, kind: str, name: str, *, hook: bool = True, **options: Any) -> None:
        """Add a node that says what happens to it."""
        self.ticks[name] = 0
        if hook:
            options["safe_state"] = self.hook
        self.sched.add(node_of(kind, name, self.tick, rate=50, shutdown=self.shutdown, **options))

    def tick(self, node: Node) -> None:
        """Count a tick."""
        self.ticks[node.name] += 1

    def hook(self, node: Node) -> None:
        """Take note of a safe-state hook, and of its thread."""
        self.hook_threads[node.name] = threading.get_ident()
        self.journal.append(("hook", node.name))

    def shutdown(self, node: Node) -> None:
        """Take note of a `shutdown()`."""
        self.journal.append(("shutdown", node.name))

    def names(self, what: str) -> list[str]:
        """Return which nodes did something, in order."""
        return [name for did, name in tuple(self.journal) if did == what]

    def all_tick(self) -> bool:
        """Return whether every node has ticked; what waits for messages gets one."""
        self.sched.publish(TRIGGER, 1)
        return all(self.ticks.values())
