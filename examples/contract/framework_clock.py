"""Read the framework clock: a body falling under dt(), the same at any rate.

Virtual time, so that the numbers are exact; in normal mode dt() and elapsed() are measured.

Prints:
    tick  1: elapsed 0.00 s, dt 0.01 s, velocity 0.098 m/s
    tick 25: elapsed 0.24 s, dt 0.01 s, velocity 2.453 m/s
    tick 50: elapsed 0.49 s, dt 0.01 s, velocity 4.905 m/s
    cycle 49: now 0.49 s, 0.008 s of budget remaining, random number 0...
"""

from __future__ import annotations

import horus
from horus import Node, Scheduler

GRAVITY_MPS2 = 9.81


class Body(Node):
    """A falling body."""

    velocity_mps = 0.0
    ticks = 0

    def tick(self) -> None:
        """Integrate one step."""
        delta_s = horus.dt()
        self.ticks += 1
        self.velocity_mps += GRAVITY_MPS2 * delta_s
        if self.ticks in {1, 25, 50}:
            print(
                f"tick {self.ticks:2}: elapsed {horus.elapsed():.2f} s, "
                f"dt {delta_s:g} s, velocity {self.velocity_mps:.3f} m/s"
            )
        if self.ticks == 50:
            print(
                f"cycle {horus.tick()}: now {horus.now():.2f} s, "
                f"{horus.budget_remaining():g} s of budget remaining, "
                f"random number {horus.rng_float():.4f}"
            )


if __name__ == "__main__":
    sched = Scheduler(tick_rate=100, deterministic=True)
    sched.add(Body("body", rate=100))
    sched.run(duration=0.5)
