"""A robot with a node of every class, each of which fails on command.

Most have a safe-state hook and are therefore held in a safe state. The buttons have none: they
tick on, and send the messages that are the event nodes' releases.
"""

from __future__ import annotations

import asyncio
import threading
import time
from dataclasses import dataclass, field
from typing import Any

from drill.observer import Observer
from horus import Node, Scheduler, ms

WATCHDOG_S = 150 * ms
CRITICAL_S = 75 * ms
BUDGET_S, OVERRUN_S = 10 * ms, 15 * ms
BACKOFF_S = 100 * ms
"""How long horus waits before it restarts a node for the first time."""

_LONGEST_S = 30.0


class DeviceError(Exception):
    """A device does not do what it should."""


@dataclass(frozen=True, slots=True)
class Fault:
    """What goes wrong in a node's next tick."""

    kind: str
    """freeze, raise or overrun."""
    lasts_s: float = _LONGEST_S
    ended: threading.Event = field(default_factory=threading.Event)
    """Set it to end a freeze early."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """A node of the robot, as it is built."""

    name: str
    order: int
    period_s: float
    arguments: dict[str, Any]
    is_async: bool = False


PARTS = {
    "rt": Part(name="motor", order=20, period_s=1 / 50, arguments={"rate": 50}),
    "best_effort": Part(name="camera", order=60, period_s=1 / 30, arguments={}),
    "event": Part(name="gripper", order=40, period_s=1 / 20, arguments={"on": "grip"}),
    "urgent": Part(
        name="estop",
        order=10,
        period_s=1 / 20,
        arguments={"on": "bumper", "deadline": 50 * ms},
    ),
    "async": Part(name="cloud", order=200, period_s=1 / 20, arguments={"rate": 20}, is_async=True),
    "compute": Part(
        name="planner", order=50, period_s=1 / 20, arguments={"rate": 20, "compute": True}
    ),
}
"""The nodes that fail on command, by the names of the command line."""

SHUTDOWN_ORDER = [
    part.name for part in sorted(PARTS.values(), key=lambda part: part.order, reverse=True)
]


class Machine(Node):
    """Ticks, and does in the next tick what a fault says. Subclasses have the tick."""

    def __init__(self, part: Part, observer: Observer, policies: dict[str, Any]) -> None:
        """Build a part of the robot."""
        super().__init__(part.name, order=part.order, **part.arguments, **policies)
        self.ticks = 0
        self._observer = observer
        self._fault: Fault | None = None
        self._noting = False
        self._initialized = False

    def strike(self, fault: Fault) -> None:
        """Fail in the next tick."""
        self._fault = fault

    def init(self) -> None:
        """Open the device."""
        if self._initialized:
            self._observer.note("init", self.name, "init() runs again")
        self._initialized = True

    def enter_safe_state(self) -> None:
        """Switch the device off: quickly, and without asking anybody."""
        self._observer.note("hook", self.name, "enter_safe_state() is called")

    def begin(self) -> Fault | None:
        """Begin a tick; return what shall go wrong in it."""
        self.ticks += 1
        fault, self._fault = self._fault, None
        if self._noting:
            self._noting = False
            self._observer.note("tick", self.name, "ticks again")
        if fault is not None:
            self._noting = True
            self._observer.note("fault", self.name, _SYMPTOMS[fault.kind])
        return fault


class PlainMachine(Machine):
    """Has a plain tick."""

    def tick(self) -> None:
        """Ask the device."""
        fault = self.begin()
        if fault is not None:
            self.wait_for_device(fault)

    def wait_for_device(self, fault: Fault) -> None:
        """Do not return for some time, or raise."""
        if fault.kind == "raise":
            raise DeviceError("the device has gone")
        fault.ended.wait(fault.lasts_s)


class AsyncMachine(Machine):
    """Has a tick that is a coroutine."""

    async def tick(self) -> None:
        """Ask the server."""
        fault = self.begin()
        if fault is not None:
            await self.wait_for_server(fault)

    async def wait_for_server(self, fault: Fault) -> None:
        """Do not return for some time, or raise."""
        if fault.kind == "raise":
            raise DeviceError("the server has gone")
        until_s = time.monotonic() + fault.lasts_s
        try:
            # Not an asyncio.Event: it is another thread that ends the fault.
            while not fault.ended.is_set() and (left_s := until_s - time.monotonic()) > 0:  # noqa: ASYNC110
                await asyncio.sleep(min(left_s, 2 * ms))
        except asyncio.CancelledError:
            self._observer.note("cancel", self.name, "its frozen tick is cancelled")
            raise


_SYMPTOMS = {
    "freeze": "its tick does not return",
    "raise": "its tick raises",
    "overrun": f"its tick takes {OVERRUN_S / ms:g} ms, its budget is {BUDGET_S / ms:g} ms",
}


class Robot:
    """The scheduler and its nodes.

    Thread: any.
    """

    def __init__(self, observer: Observer) -> None:
        """Build the robot; it runs when its scheduler does."""
        self.scheduler = Scheduler(name="robot", watchdog_ms=round(WATCHDOG_S / ms))
        self._observer = observer
        self.machines: dict[str, Machine] = {}
        self.scheduler.add(Node("buttons", tick=_press, rate=20, order=0, pubs=["bumper", "grip"]))
        for kind in PARTS:
            self.fit(kind)

    def fit(self, kind: str, **policies: Any) -> Machine:
        """Put a new part in, in place of the one that is there."""
        part = PARTS[kind]
        if kind in self.machines:
            self.scheduler.remove_node(part.name)
        make = AsyncMachine if part.is_async else PlainMachine
        machine = self.machines[kind] = make(part, self._observer, policies)
        self.scheduler.add(machine)
        return machine

    def stats(self) -> dict[str, dict[str, Any]]:
        """Return the statistics of all nodes, by name."""
        return {stats["name"]: stats for stats in self.scheduler.get_all_nodes()}


def _press(node: Node) -> None:
    """Send the state of the buttons, 20 times a second: the event nodes' releases."""
    node.send("bumper", {"pressed": False})
    node.send("grip", {"force": 1.0})
