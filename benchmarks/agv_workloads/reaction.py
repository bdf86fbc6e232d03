"""How fast this package reacts: baton, emergency stop, watchdog; and that it stays calm.

Each function runs a schedule of its own in real time and returns raw samples. Unlike the AGV these
use what only this package has, such as the release of a tick.
"""

from __future__ import annotations

import asyncio
import logging
import math
import random
import time
from collections import Counter
from typing import TYPE_CHECKING, Any

from horus_agv import make_nodes, release_teller
from scenario import (
    MARGIN_S,
    MODES,
    WARMUP_S,
    WATCHDOG_TIMEOUTS_MS,
    Recorder,
    burn,
    make_motor,
    make_ticks,
    now_ns,
)

import horus
from horus import Node, Scheduler, ms

if TYPE_CHECKING:
    from collections.abc import Callable

Series = dict[str, list[int]]

STOP_TOPIC = "estop"
STOP_RATE_HZ = 50.0
STOP_JITTER_S = 0.010
"""Longest delay of a message behind the tick's start [s]: half a period."""
BLOCKING_S = 0.100

FREEZE_TIMEOUTS = 5
"""How many times its timeout a node freezes."""

SOAK_WATCHDOG_MS = 100


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
    scheduler.add(
        Node(
            name="brake",
            tick=handle,
            on=STOP_TOPIC,
            order=1,
            priority=90,
            deadline=1 * ms,
            subs=[STOP_TOPIC],
        )
    )
    scheduler.add(Node(name="logger", tick=block, order=200))
    scheduler.run(duration=seconds)
    return {"latency_ns": latencies, "sent": [sent]}


class FirstWarning(logging.Handler):
    """Notes when each log record at warning level or above was made."""

    def __init__(self) -> None:
        """Listen to everything from warnings on."""
        super().__init__(logging.WARNING)
        self.made_ns: list[int] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Note the time."""
        self.made_ns.append(now_ns())


def freeze_once(timeout_ms: int) -> tuple[int | None, int]:
    """Freeze a node once; return the time to the first warning [ns], and expirations counted.

    Only a record made while the tick is frozen counts: what is said afterwards is of no help.
    """
    freeze_s = FREEZE_TIMEOUTS * timeout_ms / 1e3
    frozen_ns: list[int] = []
    healthy_ticks = 0

    def tick(_node: Node) -> None:
        nonlocal healthy_ticks
        if frozen_ns or healthy_ticks < 10:
            healthy_ticks += 1
            return
        frozen_ns.append(now_ns())
        time.sleep(freeze_s)
        frozen_ns.append(now_ns())

    def beat(_node: Node) -> None:
        """Stand for the rest of the robot."""

    warnings = FirstWarning()
    logger = logging.getLogger("horus.node.frozen")
    logger.addHandler(warnings)
    try:
        scheduler = Scheduler(tick_rate=1000, rt=True, watchdog_ms=timeout_ms)
        scheduler.add(Node(name="frozen", tick=tick, rate=20.0, order=10))
        scheduler.add(Node(name="motor", tick=beat, rate=1000.0, order=70))
        scheduler.run(duration=10 / 20.0 + freeze_s + 1.0)
    finally:
        logger.removeHandler(warnings)
    start_ns, end_ns = frozen_ns
    in_time = [made - start_ns for made in warnings.made_ns if start_ns <= made < end_ns]
    expirations = scheduler.safety_stats()["watchdog_expirations"]
    return (in_time[0] if in_time else None), expirations


def watchdog(_seconds: float) -> Series:
    """Time from the start of a frozen tick to the first warning [ns], for each timeout.

    A series is empty if the node came back without having been reported.
    """
    series: Series = {}
    for timeout_ms in WATCHDOG_TIMEOUTS_MS:
        reaction_ns, expirations = freeze_once(timeout_ms)
        series[f"reaction_{timeout_ms}_ms_ns"] = [] if reaction_ns is None else [reaction_ns]
        series[f"expirations_{timeout_ms}_ms"] = [expirations]
    return series


def soak_nodes(ticks: Counter[str]) -> list[tuple[Node, float]]:
    """Return healthy nodes of every class that count their ticks, each with its rate [Hz]."""

    def count(node: Any) -> None:
        ticks[node.name] += 1

    def compute(node: Any) -> None:
        count(node)
        burn(0.010)

    async def poll(node: Any) -> None:
        count(node)
        await asyncio.sleep(0.020)

    def sender(topic: str) -> Callable[[Any], None]:
        def send(node: Any) -> None:
            count(node)
            node.send(topic, {"ok": True})

        return send

    def receiver(topic: str) -> Callable[[Any], None]:
        def receive(node: Any) -> None:
            count(node)
            node.recv(topic)

        return receive

    often, seldom = 10.0, 0.2
    timed: list[tuple[str, Callable[[Any], Any], float, dict[str, Any]]] = [
        ("rt_1000_hz", count, 1000.0, {}),
        ("rt_100_hz", count, 100.0, {}),
        ("rt_10_hz", sender("report"), often, {}),
        ("rt_0.2_hz", sender("alarm"), seldom, {}),
        ("compute_10_hz", compute, often, {"compute": True}),
        ("compute_0.2_hz", compute, seldom, {"compute": True}),
        ("async_20_hz", poll, 20.0, {}),
        ("async_0.2_hz", poll, seldom, {}),
    ]
    nodes = [
        (Node(name=name, tick=tick, rate=rate_hz, order=order, **how), rate_hz)
        for order, (name, tick, rate_hz, how) in enumerate(timed)
    ]
    nodes += [
        (Node(name="best_effort", tick=count), 30.0),
        (Node(name="event_10_hz", tick=receiver("report"), on="report"), often),
        (Node(name="urgent_0.2_hz", tick=receiver("alarm"), on="alarm", priority=90), seldom),
    ]
    return nodes


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
        node.name: [ticks[node.name], math.ceil(round(rate_hz * seconds, 6))]
        for node, rate_hz in nodes
    }
    series["watchdog_expirations"] = [scheduler.safety_stats()["watchdog_expirations"]]
    return series
