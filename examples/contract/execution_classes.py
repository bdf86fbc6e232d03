"""Let the scheduler infer where each node runs.

Prints:
    motor    rate, budget or deadline  Rt
    planner  compute=True              Compute
    estop    on="emergency.stop"       Event
    cloud    async def tick            AsyncIo
    logger   none of them              BestEffort
"""

from __future__ import annotations

from horus import Node


def tick() -> None:
    """Do nothing."""


async def upload() -> None:
    """Do nothing, asynchronously."""


REASONS = {
    "motor": "rate, budget or deadline",
    "planner": "compute=True",
    "estop": 'on="emergency.stop"',
    "cloud": "async def tick",
    "logger": "none of them",
}

if __name__ == "__main__":
    nodes = [
        Node(name="motor", tick=tick, rate=1000),
        Node(name="planner", tick=tick, rate=10, compute=True),
        Node(name="estop", tick=tick, on="emergency.stop"),
        Node(name="cloud", tick=upload, rate=1),
        Node(name="logger", tick=tick),
    ]
    for node in nodes:
        print(f"{node.name:8} {REASONS[node.name]:25} {node.execution_class}")
