"""Plan for 40 ms at a time beside a 200 Hz motor: the planner has a thread of its own.

How many of its 200 releases the motor runs depends on the machine; the planner takes 40 % of one
core, and on the motor's thread it would cost the motor almost every second release.

Prints:
    the planner planned ... paths
    the motor ticked ... times in 1 s
"""

from __future__ import annotations

import time

from horus import Node, Scheduler, ms


def plan_path(node: Node) -> None:
    """Search for a path: 40 ms of pure Python."""
    if node.has_msg("map"):
        node.recv("map")
        done_at_s = time.thread_time() + 40 * ms
        cost = 0
        while time.thread_time() < done_at_s:
            cost += 1
        node.send("path", [(0, 0), (10, 10)])


def drive(node: Node) -> None:
    """Follow the newest path."""
    node.latest("path")


mapper = Node("mapper", lambda node: node.send("map", [[0, 0], [0, 1]]), rate=10, pubs=["map"])
planner = Node("planner", plan_path, rate=10, order=50, compute=True, subs=["map"], pubs=["path"])
motor = Node("motor", drive, rate=200, order=0, subs=["path"])

if __name__ == "__main__":
    sched = Scheduler(tick_rate=1000)
    sched.add(mapper).add(planner).add(motor)
    sched.run(duration=1.0)
    print(f"the planner planned {sched.get_node_stats('planner')['total_ticks']} paths")
    print(f"the motor ticked {sched.get_node_stats('motor')['total_ticks']} times in 1 s")
