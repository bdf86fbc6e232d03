"""Configure the watchdog: one timeout for all nodes, a stricter one for the motor.

A tick that lasts longer is reported while it lasts; after three timeouts its node is isolated.
Ticks that end are none of the watchdog's business, so both nodes are healthy here.

Prints:
    motor   healthy
    logger  healthy
"""

from __future__ import annotations

from horus import Node, Scheduler, ms


def tick() -> None:
    """Do nothing."""


if __name__ == "__main__":
    with Scheduler(tick_rate=100, watchdog_ms=500) as sched:
        sched.add(Node(name="motor", tick=tick, rate=100, order=0, watchdog=200 * ms))
        sched.add(Node(name="logger", tick=tick, rate=10, order=100))
        sched.run(duration=0.2)
        for name, health in sched.safety_stats()["health_states"].items():
            print(f"{name:7} {health}")
