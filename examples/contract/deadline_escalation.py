"""Stop the scheduler after a number of deadline misses, all nodes taken together.

Prints:
    stop reason: ...5...
    deadline misses: ...
"""

from __future__ import annotations

import time

from horus import Node, Scheduler, ms


def always_late() -> None:
    """Take 20 ms in a 10 ms period."""
    time.sleep(20 * ms)


if __name__ == "__main__":
    sched = Scheduler(tick_rate=100, max_deadline_misses=5)
    sched.add(Node(name="motor", tick=always_late, rate=100, order=0))
    sched.run(duration=5.0)
    print(f"stop reason: {sched.stop_reason}")
    print(f"deadline misses: {sched.get_node_stats('motor')['deadline_misses']}")
