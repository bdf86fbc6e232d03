"""Change a node's budget while it runs; the argument is in microseconds.

Prints:
    budget   500 us: 3 overruns in 3 ticks
    budget 90000 us: 0 overruns in 3 ticks
"""

from __future__ import annotations

import time

from horus import Node, Scheduler, ms, us


def motor_ctrl() -> None:
    """Work for 2 ms."""
    time.sleep(2 * ms)


if __name__ == "__main__":
    with Scheduler(tick_rate=1000) as sched:
        sched.add(Node(name="motor", tick=motor_ctrl, rate=10, budget=50 * us))
        overruns = 0
        for budget_us in (500, 90_000):
            sched.set_tick_budget("motor", budget_us)
            for _ in range(3):
                sched.tick_once()
            total = sched.safety_stats()["budget_overruns"]
            print(f"budget {budget_us:5} us: {total - overruns} overruns in 3 ticks")
            overruns = total
