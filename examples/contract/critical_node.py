"""Mark a node as safety-critical, with a timeout of its own.

A tick of it that lasts longer than its timeout puts the whole system in its safe state. This one
does not.

Prints:
    motor_controller is critical: 500 ms
"""

from __future__ import annotations

from horus import Node, Scheduler


def tick() -> None:
    """Do nothing."""


if __name__ == "__main__":
    with Scheduler(tick_rate=100) as sched:
        sched.add(Node(name="motor_controller", tick=tick, rate=100, order=0))
        sched.add_critical_node("motor_controller", timeout_ms=500)
        sched.run(duration=0.2)
    print("motor_controller is critical: 500 ms")
