"""Tick some nodes and keep the others frozen.

Prints:
    ["sensor"]:         sensor
    ["sensor", "ctrl"]: sensor ctrl
    everything:         sensor ctrl motor
    ["imu"]:            ...imu...
"""

from __future__ import annotations

from horus import HorusError, Node, Scheduler

ticked: list[str] = []


def note(node: Node) -> None:
    """Remember who ticked."""
    ticked.append(node.name)


def names() -> str:
    """Return who ticked since the last call."""
    joined = " ".join(ticked)
    ticked.clear()
    return joined


if __name__ == "__main__":
    sched = Scheduler(tick_rate=100)
    for order, name in enumerate(("sensor", "ctrl", "motor")):
        sched.add(Node(name=name, tick=note, rate=100, order=order))
    sched.tick_once(["sensor"])
    print(f'["sensor"]:         {names()}')
    sched.tick_once(["sensor", "ctrl"])
    print(f'["sensor", "ctrl"]: {names()}')
    sched.tick_once()
    print(f"everything:         {names()}")
    try:
        sched.tick_once(["imu"])
    except HorusError as error:
        print(f'["imu"]:            {error}')
    sched.stop()
