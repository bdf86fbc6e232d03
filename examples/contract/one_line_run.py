"""Run a sensor, a controller and a motor with one call.

Prints:
    the motor saw ... commands, the last one {'linear': 0.5, 'angular': 1.0}
"""

from __future__ import annotations

from typing import Any

import horus
from horus import Node, us

commands: list[dict[str, Any]] = []


def read_sensor(node: Node) -> None:
    """Publish a scan, ten times a second."""
    node.send("scan", {"ranges": [1.0, 2.0, 3.0]})


def navigate(node: Node) -> None:
    """Turn a scan into a command."""
    if node.has_msg("scan"):
        scan = node.recv("scan")
        node.send("cmd", {"linear": 0.5, "angular": scan["ranges"][0]})


def drive(node: Node) -> None:
    """Take the command to the motor."""
    if node.has_msg("cmd"):
        commands.append(node.recv("cmd"))


sensor = Node(name="sensor", tick=read_sensor, rate=10, order=0, pubs=["scan"])
ctrl = Node(name="controller", tick=navigate, rate=30, order=10, subs=["scan"], pubs=["cmd"])
motor = Node(name="motor", tick=drive, rate=1000, order=20, budget=300 * us, subs=["cmd"])

if __name__ == "__main__":
    horus.run(sensor, ctrl, motor, duration=0.5)
    print(f"the motor saw {len(commands)} commands, the last one {commands[-1]}")
