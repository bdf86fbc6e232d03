"""Ask for the statistics of one node.

Prints:
    Node: motor
    Priority: ...
    Total ticks: 50
    Errors: 1
"""

from __future__ import annotations

from horus import Node, Scheduler


class Motor(Node):
    """A motor controller that fails once."""

    ticks = 0

    def tick(self) -> None:
        """Fail in the tenth tick."""
        self.ticks += 1
        if self.ticks == 10:
            raise OSError("encoder timeout")


if __name__ == "__main__":
    with Scheduler(tick_rate=100, deterministic=True) as sched:
        sched.add(Motor("motor", rate=100, order=5, failure_policy="skip"))
        sched.tick_for(0.5)
        stats = sched.get_node_stats("motor")
        print(f"Node: {stats['name']}")
        print(f"Priority: {stats['priority']}")
        print(f"Total ticks: {stats['total_ticks']}")
        print(f"Errors: {stats['errors_count']}")
