"""Run twice in virtual time: the same numbers, and ten simulated seconds in a blink.

Prints:
    1000 ticks of exactly 0.01 s
    the second run is identical: True
"""

from __future__ import annotations

import horus
from horus import Node, Scheduler


def simulate() -> list[tuple[float, float, float]]:
    """Return what a node saw in ten simulated seconds: dt, time, and a random number."""
    seen: list[tuple[float, float, float]] = []

    def sim_tick() -> None:
        seen.append((horus.dt(), horus.elapsed(), horus.rng_float()))

    with Scheduler(tick_rate=100, deterministic=True) as sched:
        sched.add(Node(name="sim_sensor", tick=sim_tick, rate=100, order=0))
        for _ in range(1000):
            sched.tick_once()
    return seen


if __name__ == "__main__":
    first, second = simulate(), simulate()
    assert {dt_s for dt_s, _, _ in first} == {0.01}
    print(f"{len(first)} ticks of exactly 0.01 s")
    print(f"the second run is identical: {first == second}")
