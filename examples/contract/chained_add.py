"""Chain `add()`: it returns the scheduler; `order` decides who runs first, not the chain.

Prints:
    added:  motor, planner, safety
    ticked: safety, motor, planner
"""

from __future__ import annotations

from horus import Node, Scheduler

ticked: list[str] = []


def note(node: Node) -> None:
    """Remember who ticked."""
    ticked.append(node.name)


if __name__ == "__main__":
    sched = Scheduler(tick_rate=1000)
    (
        sched.add(Node(name="motor", tick=note, rate=1000, order=5))
        .add(Node(name="planner", tick=note, rate=50, order=50, compute=True))
        .add(Node(name="safety", tick=note, rate=1000, order=0))
    )
    print("added: ", "motor, planner, safety")
    sched.tick_once()
    sched.stop()
    print("ticked:", ", ".join(ticked))
