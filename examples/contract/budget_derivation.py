"""Derive budget and deadline from the rate, or set them.

Prints:
    auto      1000 Hz: budget 800 us, deadline 950 us
    explicit  1000 Hz: budget 300 us, deadline 900 us
"""

from __future__ import annotations

from horus import Node, us


def tick() -> None:
    """Do nothing."""


if __name__ == "__main__":
    auto = Node(name="auto", tick=tick, rate=1000)
    explicit = Node(name="explicit", tick=tick, rate=1000, budget=300 * us, deadline=900 * us)
    for node in (auto, explicit):
        budget_us, deadline_us = node.budget / us, node.deadline / us
        print(
            f"{node.name:9} {node.rate:.0f} Hz: "
            f"budget {budget_us:.0f} us, deadline {deadline_us:.0f} us"
        )
