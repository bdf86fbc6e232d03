"""Mutate the scheduler from inside a tick: a docking node speeds the lidar up and leaves.

Prints:
    dock: speeding up the lidar
    dock: done, bye
    nodes left: ['lidar'], the lidar ticked ... times
"""

from __future__ import annotations

from horus import Node, Scheduler

sched = Scheduler(tick_rate=1000)


class Dock(Node):
    """A node that reconfigures the scheduler and then removes itself."""

    ticks = 0

    def tick(self) -> None:
        """Speed the lidar up, then wait, then leave."""
        self.ticks += 1
        if self.ticks == 1:
            print("dock: speeding up the lidar")
            sched.set_node_rate("lidar", 500)
        elif self.ticks == 4:
            sched.remove_node(self.name)

    def shutdown(self) -> None:
        """Run when the node is removed."""
        print("dock: done, bye")


if __name__ == "__main__":
    sched.add(Node("lidar", lambda: None, rate=20)).add(Dock("dock", rate=20))
    sched.run(duration=0.5)
    ticks = sched.get_node_stats("lidar")["total_ticks"]
    print(f"nodes left: {sched.get_node_names()}, the lidar ticked {ticks} times")
