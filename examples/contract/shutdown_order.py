"""Shut down in reverse order: motors halt before the sensors that guide them disconnect.

Prints:
    init: sensor planner motor
    shutdown: motor planner sensor
"""

from __future__ import annotations

from horus import Node, Scheduler

started: list[str] = []
stopped: list[str] = []


class Device(Node):
    """A node that notes its init and its shutdown."""

    def init(self) -> None:
        """Note the start."""
        started.append(self.name)

    def tick(self) -> None:
        """Stop the run from the motor's tick, as an emergency would."""
        if self.name == "motor":
            self.request_stop("emergency stop")

    def shutdown(self) -> None:
        """Note the end."""
        stopped.append(self.name)


if __name__ == "__main__":
    sched = Scheduler(tick_rate=100)
    sched.add(Device("motor", rate=100, order=20))  # the order of adding does not matter
    sched.add(Device("sensor", rate=100, order=10))
    sched.add(Device("planner", rate=10, order=15, compute=True))
    sched.run(duration=5.0)
    print("init:", *started)
    print("shutdown:", *stopped)
