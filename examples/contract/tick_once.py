"""Run one tick at a time, without threads or timing.

Prints:
    after the first tick_once():  count is 1
    after the second tick_once(): count is 2
"""

from __future__ import annotations

from horus import Node, Scheduler


def accumulate(node: Node) -> None:
    """Add one to a counter that lives on a topic."""
    count = node.recv("count") or 0
    node.send("count", count + 1)


counter = Node(name="counter", tick=accumulate, rate=100, order=0, pubs=["count"], subs=["count"])

if __name__ == "__main__":
    sched = Scheduler(tick_rate=100)
    sched.add(counter)
    sched.tick_once()  # init() (lazy) and one tick
    print(f"after the first tick_once():  count is {counter.latest('count')}")
    sched.tick_once()
    print(f"after the second tick_once(): count is {counter.latest('count')}")
    sched.stop()
