"""Test a pipeline: sensor data reaches the motor through the controller.

Prints:
    10 commands, the first one {'speed': 0.5}
"""

from __future__ import annotations

from typing import Any

from horus import Node, Scheduler


def test_sensor_to_motor_pipeline() -> list[dict[str, Any]]:
    """Every scan becomes a command within its own cycle."""
    motor_cmds: list[dict[str, Any]] = []

    def fake_sensor(node: Node) -> None:
        node.send("scan", {"ranges": [0.5, 1.0, 1.5]})

    def controller(node: Node) -> None:
        if node.has_msg("scan"):
            scan = node.recv("scan")
            node.send("cmd", {"speed": min(scan["ranges"])})

    def mock_motor(node: Node) -> None:
        if node.has_msg("cmd"):
            motor_cmds.append(node.recv("cmd"))

    sched = Scheduler(tick_rate=100, deterministic=True)
    sched.add(Node(name="sensor", tick=fake_sensor, rate=100, order=0, pubs=["scan"]))
    sched.add(Node(name="ctrl", tick=controller, rate=100, order=10, subs=["scan"], pubs=["cmd"]))
    sched.add(Node(name="motor", tick=mock_motor, rate=100, order=20, subs=["cmd"]))
    sched.tick_for(0.1)
    sched.stop()

    assert motor_cmds[0]["speed"] == 0.5
    return motor_cmds


if __name__ == "__main__":
    commands = test_sensor_to_motor_pipeline()
    print(f"{len(commands)} commands, the first one {commands[0]}")
