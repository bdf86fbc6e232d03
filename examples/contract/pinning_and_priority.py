"""Pin a node to a core and ask for a thread priority; both are hints without `rt=True`.

Prints:
    asked for core ... and priority 80
    the motor's thread may run on cores [...]
"""

from __future__ import annotations

import os

from horus import Node, Scheduler, us

seen: list[set[int]] = []


def motor_ctrl() -> None:
    """Note where this thread may run."""
    seen.append(os.sched_getaffinity(0))


if __name__ == "__main__":
    core = max(os.sched_getaffinity(0))
    motor = Node(
        name="motor",
        tick=motor_ctrl,
        rate=1000,
        order=0,
        budget=300 * us,
        core=core,
        priority=80,  # SCHED_FIFO, needs rt=True and root or CAP_SYS_NICE
    )
    sched = Scheduler(tick_rate=1000)
    sched.add(motor)
    sched.run(duration=0.2)
    print(f"asked for core {core} and priority 80")
    print(f"the motor's thread may run on cores {sorted(seen[-1])}")
