"""Change a node's rate while it runs: slow down to save power, speed up to dock.

Virtual time, so that the numbers are exact.

Prints:
    at 100 Hz: 100 ticks in a second
    at  20 Hz:  20 ticks in a second
    at 500 Hz: 500 ticks in a second
"""

from __future__ import annotations

from horus import Node, Scheduler

ticks = 0


def read_lidar() -> None:
    """Count the reads."""
    global ticks
    ticks += 1


if __name__ == "__main__":
    with Scheduler(tick_rate=1000, deterministic=True) as sched:
        sched.add(Node(name="sensor", tick=read_lidar, rate=100, order=0))
        for rate_hz in (100, 20, 500):
            sched.set_node_rate("sensor", rate_hz)
            ticks = 0
            sched.tick_for(1.0)
            print(f"at {rate_hz:3} Hz: {ticks:3} ticks in a second")
