"""Test one node: three ticks, three results.

Prints:
    [1, 2, 3]
"""

from __future__ import annotations

from horus import Node, Scheduler


def test_counter_node() -> list[int]:
    """The counter increments each tick."""
    results: list[int] = []

    def counter_tick(node: Node) -> None:
        count = (node.recv("count") or 0) + 1
        node.send("count", count)
        results.append(count)

    sched = Scheduler(tick_rate=100, deterministic=True)
    sched.add(
        Node(name="counter", tick=counter_tick, rate=100, order=0, pubs=["count"], subs=["count"])
    )
    sched.tick_once()
    sched.tick_once()
    sched.tick_once()
    sched.stop()

    assert results == [1, 2, 3]
    return results


if __name__ == "__main__":
    print(test_counter_node())
