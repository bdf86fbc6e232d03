"""The warehouse AGV itself: what its seven nodes do, and what is written down of its motor.

Every contender runs these functions; only who calls them, and when, differs. They take any node
with ``has_msg``, ``recv`` and ``send``.
"""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

Tick = Callable[..., Any]

now_ns = time.monotonic_ns

WARMUP_S = 1.0
"""Time from the motor's first tick to the opening of the measured window [s]."""
MARGIN_S = 0.5
"""How much longer than the window the AGV drives [s]: the window is never cut short."""
PLANNING_S = 0.040
"""CPU time of one search for a path [s]."""
UPLOAD_S = 0.050
"""Stands for the HTTP request of the fleet report, which waits and does not compute [s]."""
EMERGENCY_RANGE_M = 0.3
LOW_BATTERY_V = 22.0
QUEUE_CAPACITY = 1024

RATES_HZ: Mapping[str, float] = {
    "safety": 1000.0,
    "lidar": 40.0,
    "planner": 10.0,
    "tracker": 100.0,
    "motor": 1000.0,
    "battery": 1.0,
    "fleet": 1.0,
}
"""The nodes in their execution order."""
RECEIVES: Mapping[str, str] = {
    "safety": "scan",
    "planner": "scan",
    "tracker": "path",
    "motor": "cmd_vel",
    "fleet": "battery",
}
"""Which topic each node listens to."""
SENDS: Mapping[str, str] = {
    "safety": "emergency.stop",
    "lidar": "scan",
    "planner": "path",
    "tracker": "cmd_vel",
    "battery": "battery",
    "fleet": "fleet.telemetry",
}


def burn(cpu_s: float) -> int:
    """Compute in pure Python for so much CPU time of this thread [s]; return the work done.

    CPU time, not elapsed time: a planner that is interrupted has as much left to do as before.
    """
    until_s = time.thread_time() + cpu_s
    cells = 0
    while time.thread_time() < until_s:
        for cell in range(100):
            cells += cell & 1
    return cells


class Recorder:
    """What the motor writes down of every tick, in lists that are there before it starts.

    Thread: ``safety_done`` is written by the safety node, everything else by the motor.
    """

    __slots__ = ("capacity", "count", "release_ns", "safety_done", "safety_seen", "start_ns")

    def __init__(self, seconds: float) -> None:
        """Make room for twice the motor's ticks in ``seconds`` [s]."""
        self.capacity = int(seconds * 2.0 * RATES_HZ["motor"])
        self.start_ns = [0] * self.capacity
        self.release_ns = [0] * self.capacity
        self.safety_seen = [0] * self.capacity
        self.safety_done = 0
        self.count = 0

    def series(self, *, releases: bool, order: bool = True) -> dict[str, list[int]]:
        """Return the raw series: starts from the first tick on, lateness, safety ticks seen.

        Args:
            releases: Whether the contender tells when a tick was due.
            order: Whether the motor can see the safety node's progress.
        """
        count = self.count
        starts = self.start_ns[:count]
        first = starts[0] if starts else 0
        series = {"start_ns": [start - first for start in starts]}
        if releases:
            late = zip(starts, self.release_ns, strict=False)
            series["latency_ns"] = [start - release for start, release in late]
        if order:
            series["safety_seen"] = self.safety_seen[:count]
        return series


def make_safety(recorder: Recorder) -> Tick:
    """Return the safety monitor; its last statement is what tells that it has completed."""

    def safety_check(node: Any) -> None:
        if node.has_msg("scan"):
            scan = node.recv("scan")
            nearest = min(scan["ranges"])
            if nearest < EMERGENCY_RANGE_M:
                node.send("emergency.stop", {"reason": "obstacle", "distance": nearest})
                node.log_warning(f"Emergency stop: obstacle at {nearest:.2f}m")
        recorder.safety_done += 1

    return safety_check


def make_motor(recorder: Recorder, release_of: Callable[[], int] | None = None) -> Tick:
    """Return the motor controller; its first statement takes the time.

    Args:
        recorder: Where times are put.
        release_of: Tells when the present tick was due [ns]; None where nothing tells it.
    """
    start_ns, release_ns = recorder.start_ns, recorder.release_ns
    safety_seen, capacity = recorder.safety_seen, recorder.capacity
    wheels = [0.0, 0.0]

    def motor_drive(node: Any) -> None:
        started_ns = now_ns()
        index = recorder.count
        if index < capacity:
            start_ns[index] = started_ns
            safety_seen[index] = recorder.safety_done
            if release_of is not None:
                release_ns[index] = release_of()
            recorder.count = index + 1
        if node.has_msg("cmd_vel"):
            cmd = node.recv("cmd_vel")
            wheels[0], wheels[1] = cmd["left"], cmd["right"]

    return motor_drive


def read_lidar(node: Any) -> None:
    """Send a scan."""
    node.send("scan", {"ranges": [1.2, 0.8, 2.5, 1.1], "angle_min": -1.57})


def plan_idle(node: Any) -> None:
    """Send a path that was not searched for."""
    if node.has_msg("scan"):
        scan = node.recv("scan")
        node.send("path", {"waypoints": [[0.0, 0.0], [1.0, 0.5], [2.0, min(scan["ranges"])]]})


def plan_busy(node: Any) -> None:
    """Compute for 40 ms in every tick, then send a path."""
    burn(PLANNING_S)
    plan_idle(node)


def track_path(node: Any) -> None:
    """Turn a path into wheel velocities."""
    if node.has_msg("path"):
        x, y = node.recv("path")["waypoints"][1]
        node.send("cmd_vel", {"left": x - 0.5 * y, "right": x + 0.5 * y})


def battery_check(node: Any) -> None:
    """Send the battery's voltage."""
    voltage = 24.1
    if voltage < LOW_BATTERY_V:
        node.log_warning(f"Low battery: {voltage:.1f}V")
    node.send("battery", {"voltage": voltage})


async def fleet_report(node: Any) -> None:
    """Upload the battery's state, awaiting the answer."""
    if node.has_msg("battery"):
        data = node.recv("battery")
        await asyncio.sleep(UPLOAD_S)
        node.send("fleet.telemetry", data)


def fleet_report_blocking(node: Any) -> None:
    """Upload the battery's state where a node has a thread or a process to itself."""
    if node.has_msg("battery"):
        data = node.recv("battery")
        time.sleep(UPLOAD_S)
        node.send("fleet.telemetry", data)


@dataclass(frozen=True, slots=True, kw_only=True)
class Mode:
    """What the planner does, and where a scheduler that has a choice runs it.

    A mode whose ``compute`` is not simply True is one for this package only.
    """

    title: str
    plan: Tick
    compute: bool | str = True


MODES: Mapping[str, Mode] = {
    "idle": Mode(title="planner idle", plan=plan_idle),
    "thread": Mode(title="planner in a thread", plan=plan_busy),
    "process": Mode(title="planner in a process", plan=plan_busy, compute="process"),
}
"""The modes of the AGV: workloads of every contender that has the choice they make."""
REACTIONS = ("baton", "estop", "watchdog")
"""Workloads of this package only, measured along with the modes: functions in ``reaction.py``."""
SOAK = "soak"
CRITICAL_TIMEOUT_MS = 100
CRITICAL_CLASSES: Mapping[str, str] = {"rt": "Rt node", "best_effort": "BestEffort node"}
"""Which critical nodes freeze in the watchdog's workload, each with its name in the tables."""


def make_ticks(mode: Mode, recorder: Recorder, motor: Tick, *, awaits: bool) -> dict[str, Tick]:
    """Return the function of every node; ``awaits`` tells whether the fleet report may."""
    return {
        "safety": make_safety(recorder),
        "lidar": read_lidar,
        "planner": mode.plan,
        "tracker": track_path,
        "motor": motor,
        "battery": battery_check,
        "fleet": fleet_report if awaits else fleet_report_blocking,
    }


class PlainNode:
    """A node for contenders that bring no messages of their own: one queue, shared by reference.

    Thread: appending to a deque and taking from it are atomic in CPython.
    """

    def __init__(self, name: str, bus: dict[str, list[deque[Any]]]) -> None:
        """Listen on ``bus``, which maps topics to the queues of those who listen."""
        self.name = name
        self.release_ns = 0
        """When the present tick was due [ns]."""
        self._bus = bus
        self._queue: deque[Any] = deque(maxlen=QUEUE_CAPACITY)
        if name in RECEIVES:
            bus.setdefault(RECEIVES[name], []).append(self._queue)

    def has_msg(self, _topic: str) -> bool:
        """Return whether a message waits."""
        return bool(self._queue)

    def recv(self, _topic: str) -> Any:
        """Return the oldest message."""
        return self._queue.popleft()

    def send(self, topic: str, message: Any) -> None:
        """Hand a message to everybody who listens."""
        for queue in self._bus.get(topic, ()):
            queue.append(message)

    def log_warning(self, message: str) -> None:
        """Print."""
        print(f"{self.name}: {message}")
