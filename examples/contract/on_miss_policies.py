"""Miss one deadline under each of the four `on_miss` policies.

The third tick lasts 30 ms; the deadline is 20 ms, the period 50 ms. "skip" drops the release
after it, "safe_mode" calls the node's safe-state hook, "stop" ends the run. The numbers of ticks
vary with the machine's load.

Prints:
    warn       ... ticks, 0 safe-state calls, ...
    skip       ... ticks, 0 safe-state calls, ...
    safe_mode  ... ticks, 1 safe-state calls, ...
    stop       3 ticks, 0 safe-state calls, stopped by: ...motor...
"""

from __future__ import annotations

import time

from horus import Node, Scheduler, ms


class Motor(Node):
    """A motor controller whose third tick is late."""

    def __init__(self, on_miss: str) -> None:
        """Tick at 20 Hz under that policy."""
        super().__init__("motor", rate=20, deadline=20 * ms, on_miss=on_miss)
        self.ticks = 0
        self.safe_state_calls = 0

    def tick(self) -> None:
        """Take far too long, once."""
        self.ticks += 1
        if self.ticks == 3:
            time.sleep(30 * ms)

    def enter_safe_state(self) -> None:
        """Cut the power."""
        self.safe_state_calls += 1


if __name__ == "__main__":
    for policy in ("warn", "skip", "safe_mode", "stop"):
        motor = Motor(policy)
        sched = Scheduler(tick_rate=20)
        sched.add(motor)
        sched.run(duration=0.4)
        print(
            f"{policy:10} {motor.ticks} ticks, {motor.safe_state_calls} safe-state calls, "
            f"stopped by: {sched.stop_reason}"
        )
