"""Fail in init(): that node is excluded, the others go on.

Prints:
    camera: error
    motor: running
    the motor ticked 10 times, the camera 0 times
"""

from __future__ import annotations

from horus import Node, Scheduler


def connect() -> None:
    """Fail to connect."""
    raise OSError("no camera on /dev/video0")


if __name__ == "__main__":
    with Scheduler(tick_rate=100, deterministic=True) as sched:
        sched.add(Node("camera", lambda: None, rate=100, order=0, init=connect))
        sched.add(Node("motor", lambda: None, rate=100, order=10))
        sched.tick_for(0.1)
        for info in sched.get_all_nodes():
            print(f"{info['name']}: {info['state']}")
        motor, camera = (sched.get_node_stats(n)["total_ticks"] for n in ("motor", "camera"))
        print(f"the motor ticked {motor} times, the camera {camera} times")
