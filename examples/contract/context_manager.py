"""Use the scheduler as a context manager: it is stopped on the way out, whatever happens.

Prints:
    sensor connected
    sensor disconnected
    status: stopped, because the operator went home
"""

from __future__ import annotations

from horus import Node, Scheduler

sensor = Node(
    name="sensor",
    init=lambda: print("sensor connected"),
    tick=lambda node: node.send("scan", [1.0, 2.0, 3.0]),
    shutdown=lambda: print("sensor disconnected"),
    rate=100,
    pubs=["scan"],
)

if __name__ == "__main__":
    try:
        with Scheduler(tick_rate=100) as sched:
            sched.add(sensor)
            sched.tick_once()
            raise RuntimeError("the operator went home")
    except RuntimeError as error:
        print(f"status: {sched.status()}, because {error}")
