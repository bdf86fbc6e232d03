"""Run for a while, then look: real time in normal mode, virtual time in deterministic mode.

Prints:
    normal:        sensor ... ticks, motor ... ticks in ... s
    deterministic: sensor 100 ticks, motor 1000 ticks in ... s
    sensor alone:  sensor 150 ticks, motor 1000 ticks
"""

from __future__ import annotations

import time
from collections import Counter

from horus import Node, Scheduler

ticks: Counter[str] = Counter()


def count(node: Node) -> None:
    """Count this node's ticks."""
    ticks[node.name] += 1


def build(*, deterministic: bool) -> Scheduler:
    """Return a scheduler with a sensor at 100 Hz and a motor at 1 kHz."""
    ticks.clear()
    sched = Scheduler(tick_rate=1000, deterministic=deterministic)
    sched.add(Node(name="sensor", tick=count, rate=100, order=0))
    return sched.add(Node(name="motor", tick=count, rate=1000, order=10))


def report(label: str, started_s: float | None = None) -> None:
    """Print the counters and how long it took."""
    took = "" if started_s is None else f" in {time.perf_counter() - started_s:.3f} s"
    print(f"{label:14} sensor {ticks['sensor']} ticks, motor {ticks['motor']} ticks{took}")


if __name__ == "__main__":
    with build(deterministic=False) as sched:
        started_s = time.perf_counter()
        sched.tick_for(0.3)
        report("normal:", started_s)

    with build(deterministic=True) as sched:
        started_s = time.perf_counter()
        sched.tick_for(1.0)
        report("deterministic:", started_s)
        sched.tick_for(0.5, ["sensor"])
        report("sensor alone:")
