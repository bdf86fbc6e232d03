"""Raise once under each of the four failure policies.

The second tick raises. "restart" runs init() again after a pause, "skip" and "ignore" go on with
the next release, "fatal" stops the scheduler and run() raises. Virtual time: the numbers are exact.

Prints:
    skip     50 ticks, 1 init
    ignore   50 ticks, 1 init
    restart  ... ticks, 2 init
    fatal    2 ticks, 1 init, run() raised NodeError from OSError('link down')
"""

from __future__ import annotations

from horus import Node, NodeError, Scheduler


class Uploader(Node):
    """A node whose second tick fails."""

    def __init__(self, failure_policy: str) -> None:
        """Tick at 100 Hz under that policy."""
        super().__init__("uploader", rate=100, failure_policy=failure_policy)
        self.ticks = 0
        self.inits = 0

    def init(self) -> None:
        """Connect."""
        self.inits += 1

    def tick(self) -> None:
        """Fail once."""
        self.ticks += 1
        if self.ticks == 2:
            raise OSError("link down")


if __name__ == "__main__":
    for policy in ("skip", "ignore", "restart", "fatal"):
        uploader = Uploader(policy)
        sched = Scheduler(tick_rate=100, deterministic=True)
        sched.add(uploader)
        outcome = ""
        try:
            sched.run(duration=0.5)
        except NodeError as error:
            outcome = f", run() raised NodeError from {error.__cause__!r}"
        print(f"{policy:8} {uploader.ticks} ticks, {uploader.inits} init{outcome}")
