"""Remove a node from a running scheduler: its shutdown() runs first.

Prints:
    nodes: ['motor', 'cloud_logger']
    cloud_logger: connection closed
    removed: True, and a second time: False
    nodes: ['motor']
"""

from __future__ import annotations

from horus import Node, Scheduler


def tick() -> None:
    """Do nothing."""


def close() -> None:
    """Say goodbye."""
    print("cloud_logger: connection closed")


if __name__ == "__main__":
    with Scheduler(tick_rate=100) as sched:
        sched.add(Node(name="motor", tick=tick, rate=100, order=0))
        sched.add(Node(name="cloud_logger", tick=tick, rate=10, order=200, shutdown=close))
        sched.tick_once()
        print(f"nodes: {sched.get_node_names()}")
        removed = sched.remove_node("cloud_logger")
        print(f"removed: {removed}, and a second time: {sched.remove_node('cloud_logger')}")
        print(f"nodes: {sched.get_node_names()}")
