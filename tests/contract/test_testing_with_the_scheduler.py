"""Testing with the scheduler: the examples of the contract, as they stand there."""

from __future__ import annotations

from horus import Node, Scheduler


def test_counter_node():
    """Test that counter increments each tick."""
    results = []

    def counter_tick(node):
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

    assert results == [1, 2, 3]


def test_sensor_to_motor_pipeline():
    """Test that sensor data flows through the controller to the motor."""
    motor_cmds = []

    def fake_sensor(node):
        node.send("scan", {"ranges": [0.5, 1.0, 1.5]})

    def controller(node):
        if node.has_msg("scan"):
            scan = node.recv("scan")
            node.send("cmd", {"speed": min(scan["ranges"])})

    def mock_motor(node):
        if node.has_msg("cmd"):
            motor_cmds.append(node.recv("cmd"))

    sched = Scheduler(tick_rate=100, deterministic=True)
    sched.add(Node(name="sensor", tick=fake_sensor, rate=100, order=0, pubs=["scan"]))
    sched.add(Node(name="ctrl", tick=controller, rate=100, order=10, subs=["scan"], pubs=["cmd"]))
    sched.add(Node(name="motor", tick=mock_motor, rate=100, order=20, subs=["cmd"]))

    # Run enough ticks for data to flow through the pipeline
    sched.tick_for(0.1)

    assert len(motor_cmds) > 0
    assert motor_cmds[0]["speed"] == 0.5


def test_ten_seconds_of_behaviour_are_tested_without_waiting_ten_seconds():
    """A slow process is observed at full speed: a battery drains in simulated minutes."""
    voltage = [24.0]
    warnings = []

    def battery_check(node):
        voltage[0] -= 0.5
        if voltage[0] < 22.0:
            warnings.append(voltage[0])
            node.request_stop("low battery")

    sched = Scheduler(tick_rate=10, deterministic=True)
    sched.add(Node(name="battery", tick=battery_check, rate=1, order=100))

    sched.run(duration=60.0)

    assert warnings == [21.5]
    assert sched.stop_reason == "low battery"
