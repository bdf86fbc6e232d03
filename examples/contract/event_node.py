"""Sleep until a message arrives: an emergency stop.

Prints:
    E-STOP: {'reason': 'obstacle', 'distance': 0.25}
    stop reason: ...obstacle ahead...
    the lidar ticked 5 times
"""

from __future__ import annotations

from horus import Node, Scheduler

ranges_m = [2.0, 1.5, 1.0, 0.5, 0.25]


def read_lidar(node: Node) -> None:
    """Publish an emergency when something is closer than 30 cm."""
    nearest_m = ranges_m.pop(0)
    if nearest_m < 0.3:
        node.send("emergency.stop", {"reason": "obstacle", "distance": nearest_m})


def handle_estop(node: Node) -> None:
    """Stop everything."""
    print(f"E-STOP: {node.recv('emergency.stop')}")
    node.request_stop("obstacle ahead")


lidar = Node(name="lidar", tick=read_lidar, rate=20, order=10, pubs=["emergency.stop"])
estop = Node(
    name="estop",
    tick=handle_estop,
    on="emergency.stop",  # wakes when a message arrives, not before
    order=0,
    subs=["emergency.stop"],
)

if __name__ == "__main__":
    sched = Scheduler(tick_rate=100)
    sched.add(lidar).add(estop)
    sched.run(duration=5.0)
    print(f"stop reason: {sched.stop_reason}")
    print(f"the lidar ticked {sched.get_node_stats('lidar')['total_ticks']} times")
