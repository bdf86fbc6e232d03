"""What recording adds to a send and to a tick, on the thread that sends or ticks.

Bursts of a few hundred are timed as a whole, and follow each other so that there are 20,000 a
second on average. What is measured is the call itself, while the thread that writes is at its work:
when the two meet, the sender waits for the interpreter as it would in a robot, at the switch
interval that the scheduler sets while Rt nodes run. Most bursts end before they meet, so that the
median is the call alone; the mean has the rest. What the thread that writes does beside it is in
the CPU time of the process, which is taken over whole blocks, until everything is written.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

from session import home
from traffic import MESSAGE_RATE_HZ, make_message

if TYPE_CHECKING:
    from collections.abc import Mapping

    from sizes import Series, Size

now_ns = time.perf_counter_ns

BURST = 400
"""Sends, or ticks, that are timed as one."""
BURST_PERIOD_S = BURST / MESSAGE_RATE_HZ
NODES = 100
"""Nodes that tick in a cycle."""
SETTLE_S = 0.3
"""Time after the last burst of a block until everything is written for sure [s]."""
SWITCH_INTERVAL_S = 50e-6
"""That of the interpreter while Rt nodes run [s]."""

VARIANTS: Mapping[str, Mapping[str, Any]] = {
    "off": {},
    "recording": {"recording": True},
    "blackbox": {"blackbox_mb": 16},
}

Burst = Callable[[], int]
"""Sends or ticks ``BURST`` times, and returns how long that took [ns]."""


def make_send_burst(horus: Any, scheduler: Any) -> Burst:
    """Return what sends dicts of three floats to one subscriber."""
    messages = [make_message(number) for number in range(BURST)]
    took_ns: list[int] = []

    def send_all(node: Any) -> None:
        send = node.send
        started_ns = now_ns()
        for message in messages:
            send("pose", message)
        took_ns.append(now_ns() - started_ns)

    def ignore(_node: Any) -> None:
        """Leave the newest message where it is."""

    scheduler.add(horus.Node(name="source", tick=send_all, order=0, pubs=["pose"]))
    # One that keeps the latest: a queue that overflows would be measured, too.
    newest = horus.Sub("pose", capacity=1)
    scheduler.add(horus.Node(name="sink", tick=ignore, order=1, subs=[newest]))

    def burst() -> int:
        scheduler.tick_once()
        return took_ns.pop()

    return burst


def make_tick_burst(horus: Any, scheduler: Any) -> Burst:
    """Return what ticks nodes that do nothing."""

    def nothing(_node: Any) -> None:
        """Do nothing."""

    for index in range(NODES):
        scheduler.add(horus.Node(name=f"n{index}", tick=nothing, order=index))
    cycles = range(BURST // NODES)

    def burst() -> int:
        started_ns = now_ns()
        for _ in cycles:
            scheduler.tick_once()
        return now_ns() - started_ns

    return burst


MAKERS: Mapping[str, Callable[[Any, Any], Burst]] = {
    "send": make_send_burst,
    "tick": make_tick_burst,
}


def run_block(burst: Burst, bursts: int) -> tuple[list[float], float]:
    """Return the time of each call [µs], burst by burst, and the CPU time per call [µs]."""
    took_us: list[float] = []
    cpu_before_ns, due_ns = time.process_time_ns(), now_ns()
    for _ in range(bursts):
        took_us.append(burst() / BURST / 1e3)
        due_ns += round(1e9 * BURST_PERIOD_S)
        time.sleep(max(0, due_ns - now_ns()) / 1e9)
    time.sleep(SETTLE_S)
    cpu_ns = time.process_time_ns() - cpu_before_ns
    return took_us, cpu_ns / (bursts * BURST) / 1e3


def cost(horus: Any, size: Size, _seconds: float) -> Series:
    """Measure sends and ticks without recording, with it, and with the flight recorder only."""
    series: Series = {}
    interval_s = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    try:
        for kind, make_burst in MAKERS.items():
            series |= compare(horus, size, kind, make_burst)
    finally:
        sys.setswitchinterval(interval_s)
    return series


def compare(horus: Any, size: Size, kind: str, make_burst: Callable[[Any, Any], Burst]) -> Series:
    """Measure the variants block by block, in turn; all of their sessions are open."""
    series: Series = {}
    with ExitStack() as ending:
        ending.enter_context(home())
        bursts: dict[str, Burst] = {}
        for variant, options in VARIANTS.items():
            scheduler = ending.enter_context(horus.Scheduler(tick_rate=1000.0, **options))
            bursts[variant] = make_burst(horus, scheduler)
            # The first block opens the session and fills caches: it does not count.
            run_block(bursts[variant], 1)
            for what in ("us", "cpu_us"):
                series[f"{kind}_{variant}_{what}"] = []
        for _ in range(size.blocks):
            for variant, burst in bursts.items():
                took_us, cpu_us = run_block(burst, size.bursts)
                name = f"{kind}_{variant}"
                series[f"{name}_us"] += took_us
                series[f"{name}_cpu_us"].append(cpu_us)
    return series
