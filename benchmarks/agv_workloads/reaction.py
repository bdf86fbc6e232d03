"""How fast this package reacts: baton, emergency stop, watchdog; and that it stays calm.

Each function runs a schedule of its own in real time and returns raw samples. Unlike the AGV these
use what only this package has, such as the release of a tick.
"""

from __future__ import annotations

import asyncio
import math
import random
import time
from collections import Counter
from collections.abc import Callable

from horus_agv import make_nodes, release_teller
from scenario import (
    CRITICAL_CLASSES,
    CRITICAL_TIMEOUT_MS,
    MARGIN_S,
    MODES,
    WARMUP_S,
    Recorder,
    burn,
    make_motor,
    make_ticks,
    now_ns,
)

import horus
from horus import Node, Scheduler, ms

Series = dict[str, list[int]]

STOP_TOPIC = "estop"
STOP_RATE_HZ = 50.0
STOP_JITTER_S = 0.010
"""Longest delay of a message behind the tick's start [s]: half a period."""
BLOCKING_S = 0.100

FREEZES_OF_A_KIND = 5
FROZEN_RATE_HZ = 20.0
HEALTHY_S, FREEZE_S, AFTERWARDS_S = 0.2, 0.3, 0.1

SOAK_WATCHDOG_MS = 100
OFTEN_HZ, SELDOM_HZ = 10.0, 0.2


def baton(seconds: float) -> Series:
    """Time the hop from safety to motor in the AGV, planner idle [ns].

    From the last statement of the safety node's tick to the first one of the motor's tick for the
    same release.
    """
    total_s = WARMUP_S + seconds + MARGIN_S
    recorder = Recorder(total_s)
    release_of = release_teller()
    assert release_of is not None
    ticks = make_ticks(MODES["idle"], recorder, make_motor(recorder, release_of), awaits=True)
    safety = ticks["safety"]
    ended_ns: dict[int, int] = {}

    def timed_safety(node: Node) -> None:
        safety(node)
        ended_ns[release_of()] = now_ns()

    scheduler = Scheduler(tick_rate=1000, rt=True)
    for node in make_nodes(horus, MODES["idle"], {**ticks, "safety": timed_safety}):
        scheduler.add(node)
    scheduler.run(duration=total_s)
    opens_ns = recorder.start_ns[0] + int(WARMUP_S * 1e9)
    closes_ns = opens_ns + int(seconds * 1e9)
    starts = zip(recorder.start_ns[: recorder.count], recorder.release_ns, strict=False)
    hops = [
        start - ended_ns[release]
        for start, release in starts
        # A motor that did not wait, or whose safety node skipped the release, took no baton.
        if opens_ns <= start < closes_ns and ended_ns.get(release, start) < start
    ]
    if not hops:
        raise RuntimeError(f"no baton was handed on; the motor ticked {recorder.count} times")
    return {"hop_ns": hops}


def estop(seconds: float) -> Series:
    """Time an emergency stop past a blocked event loop [ns].

    From just before ``send``, in the tick of an Rt node at 50 Hz, to the first statement of the
    handler: an event node with a priority and a deadline. Meanwhile a BestEffort node blocks the
    event loop for 100 ms again and again.
    """
    latencies: list[int] = []
    jitter = random.Random(0)
    sent = 0

    def handle(node: Node) -> None:
        handled_ns = now_ns()
        latencies.append(handled_ns - node.recv(STOP_TOPIC)["sent_ns"])

    def watch(node: Node) -> None:
        nonlocal sent
        time.sleep(jitter.uniform(0.0, STOP_JITTER_S))
        sent += 1
        node.send(STOP_TOPIC, {"reason": "bumper", "sent_ns": now_ns()})

    def block(_node: Node) -> None:
        time.sleep(BLOCKING_S)

    scheduler = Scheduler(tick_rate=1000, rt=True)
    scheduler.add(Node(name="bumper", tick=watch, rate=STOP_RATE_HZ, order=0, pubs=[STOP_TOPIC]))
    urgent = {"priority": 90, "deadline": 1 * ms}
    scheduler.add(Node(name="brake", tick=handle, on=STOP_TOPIC, order=1, **urgent))
    scheduler.add(Node(name="logger", tick=block, order=200))
    scheduler.run(duration=seconds)
    if not latencies:
        raise RuntimeError(f"no emergency stop was handled; {sent} were sent")
    return {"latency_ns": latencies, "sent": [sent]}


def busy_wait(seconds: float) -> None:
    """Compute for so long [s], where a sleep would leave the interpreter to others."""
    end_ns = now_ns() + int(seconds * 1e9)
    while now_ns() < end_ns:
        pass


def freeze_once(rate_hz: float | None, freeze: Callable[[float], None]) -> list[int]:
    """Freeze a critical node; return how long after the tick's start all nodes were safe [ns].

    That is when the last safe-state hook was entered: the node's own, and that of a motor at 1 kHz
    beside it. A list without an item if that was not before the tick came back.
    """
    begins_ns = now_ns() + int(HEALTHY_S * 1e9)
    frozen_ns: list[int] = []
    hooks_ns: list[int] = []

    def tick(_node: Node) -> None:
        if not frozen_ns and now_ns() >= begins_ns:
            frozen_ns.append(now_ns())
            freeze(FREEZE_S)
            frozen_ns.append(now_ns())

    def beat(_node: Node) -> None:
        """Stand for the rest of the robot."""

    def make_safe(_node: Node) -> None:
        hooks_ns.append(now_ns())

    scheduler = Scheduler(tick_rate=1000, rt=True)
    scheduler.add(Node(name="frozen", tick=tick, rate=rate_hz, order=10, safe_state=make_safe))
    scheduler.add(Node(name="motor", tick=beat, rate=1000.0, order=70, safe_state=make_safe))
    scheduler.add_critical_node("frozen", timeout_ms=CRITICAL_TIMEOUT_MS)
    scheduler.run(duration=HEALTHY_S + FREEZE_S + AFTERWARDS_S)
    if len(frozen_ns) < 2:
        raise RuntimeError(f"the node did not freeze for {FREEZE_S} s, or never came back")
    start_ns, end_ns = frozen_ns
    safe = len(hooks_ns) == 2 and max(hooks_ns) < end_ns
    return [max(hooks_ns) - start_ns] if safe else []


def watchdog(_seconds: float) -> Series:
    """Time from the start of a critical node's frozen tick until all nodes are safe [ns].

    The tick blocks a thread of the node's own, or the event loop; it sleeps half of the times, and
    computes in the others.
    """
    series: Series = {}
    for key in CRITICAL_CLASSES:
        rate_hz = FROZEN_RATE_HZ if key == "rt" else None
        freezes = [time.sleep, busy_wait] * FREEZES_OF_A_KIND
        series[f"{key}_freezes"] = [len(freezes)]
        series[f"{key}_ns"] = [
            reaction_ns for freeze in freezes for reaction_ns in freeze_once(rate_hz, freeze)
        ]
    return series


def soak_nodes(ticks: Counter[str]) -> list[tuple[Node, float]]:
    """Return healthy nodes of every class that count their ticks, each with its rate [Hz]."""

    def count(node: Node) -> None:
        ticks[node.name] += 1

    def compute(node: Node) -> None:
        count(node)
        burn(0.010)

    async def poll(node: Node) -> None:
        count(node)
        await asyncio.sleep(0.020)

    def send(node: Node) -> None:
        count(node)
        node.send(node.name, {"ok": True})

    def receive(node: Node) -> None:
        count(node)
        node.recv(f"rt_{node.name}")

    nodes: list[tuple[Node, float]] = [
        (Node(name=name, tick=tick, rate=rate_hz, compute=tick is compute), rate_hz)
        for tick, rates_hz in (
            (count, {"rt_motor": 1000.0, "rt_tracker": 100.0}),
            (send, {"rt_event": OFTEN_HZ, "rt_urgent": SELDOM_HZ}),
            (compute, {"compute_often": OFTEN_HZ, "compute_seldom": SELDOM_HZ}),
            (poll, {"async_often": 20.0, "async_seldom": SELDOM_HZ}),
        )
        for name, rate_hz in rates_hz.items()
    ]
    # The last two are released by what the nodes named after them send.
    return [
        *nodes,
        (Node(name="best_effort", tick=count), 30.0),
        (Node(name="event", tick=receive, on="rt_event"), OFTEN_HZ),
        (Node(name="urgent", tick=receive, on="rt_urgent", priority=90), SELDOM_HZ),
    ]


def soak(seconds: float) -> Series:
    """Run a healthy schedule under a watchdog; return its expirations and each node's ticks.

    A node's series is its ticks and how many were due; the first is due at the very start.
    """
    ticks: Counter[str] = Counter()
    nodes = soak_nodes(ticks)
    scheduler = Scheduler(tick_rate=1000, rt=True, watchdog_ms=SOAK_WATCHDOG_MS)
    for node, _ in nodes:
        scheduler.add(node)
    scheduler.run(duration=seconds)
    series = {
        f"{node.name}, {rate_hz:g} Hz": [ticks[node.name], math.ceil(round(rate_hz * seconds, 6))]
        for node, rate_hz in nodes
    }
    series["watchdog_expirations"] = [scheduler.safety_stats()["watchdog_expirations"]]
    return series
