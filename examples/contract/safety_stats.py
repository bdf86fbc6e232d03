"""Ask for overruns, watchdog expirations and health.

Prints:
    Budget overruns: 1
    Watchdog expirations: 0
    Node health states: {'motor': 'healthy'}
"""

from __future__ import annotations

import time

from horus import Node, Scheduler, ms


class Motor(Node):
    """A motor whose first tick is slow."""

    ticks = 0

    def tick(self) -> None:
        """Work for 30 ms once."""
        self.ticks += 1
        if self.ticks == 1:
            time.sleep(30 * ms)


if __name__ == "__main__":
    with Scheduler(tick_rate=100) as sched:
        sched.add(Motor("motor", rate=10, budget=20 * ms))
        for _ in range(5):
            sched.tick_once()
        stats = sched.safety_stats()
        states = {name: str(health) for name, health in stats["health_states"].items()}
        print(f"Budget overruns: {stats['budget_overruns']}")
        print(f"Watchdog expirations: {stats['watchdog_expirations']}")
        print(f"Node health states: {states}")
