"""Node lifecycle callbacks: init, tick, shutdown, and what they may do."""

from __future__ import annotations

import logging

import pytest

from horus import Node, StateError, us

from .helpers import TRIGGER, node_of, nothing, run_until


def test_the_motor_node_of_the_contract(make, caplog, deterministic):
    """Init is called once at startup, tick every tick, shutdown once at shutdown."""
    caplog.set_level(logging.DEBUG, logger="horus")
    journal = []

    def setup_hardware(node):
        node.log_info("Connecting to motor controller...")
        node.send("status", {"state": "ready"})
        journal.append("init")

    def control(node):
        journal.append("tick")
        if node.has_msg("cmd"):
            cmd = node.recv("cmd")
            node.log_debug(f"Command: {cmd}")

    def cleanup(node):
        node.log_info("Stopping motor controller...")
        node.send("halt", {"linear": 0.0, "angular": 0.0})
        journal.append("shutdown")

    motor = Node(
        name="motor",
        init=setup_hardware,
        tick=control,
        shutdown=cleanup,
        rate=1000,
        order=5,
        budget=300 * us,
        pubs=["status", "halt"],
        subs=["cmd"],
    )
    sched = make(tick_rate=1000, deterministic=deterministic)
    sched.add(motor)
    status, halt = sched.subscribe("status"), sched.subscribe("halt")
    sched.publish("cmd", {"linear": 0.5})

    sched.run(duration=0.05)

    assert journal[0] == "init"
    assert journal[-1] == "shutdown"
    assert journal.count("init") == journal.count("shutdown") == 1
    assert set(journal[1:-1]) == {"tick"}
    assert status.recv_all() == [{"state": "ready"}]
    assert halt.recv_all() == [{"linear": 0.0, "angular": 0.0}]
    messages = [r.getMessage() for r in caplog.records if r.name == "horus.node.motor"]
    assert "Connecting to motor controller..." in messages
    assert "Command: {'linear': 0.5}" in messages
    assert messages[-1] == "Stopping motor controller..."


@pytest.mark.realtime
def test_callbacks_of_a_node_never_overlap(make, loop, kind):
    """init, ticks and shutdown of one node come one after another."""
    inside, overlaps, phases = [], [], []

    def callback(phase):
        def run(node):
            overlaps.extend(inside)
            inside.append(phase)
            phases.append(phase)
            inside.pop()

        return run

    sched = make(tick_rate=100, loop=loop)
    sched.add(
        node_of(kind, "node", callback("tick"), init=callback("init"), shutdown=callback("down"))
    )
    sched.publish(TRIGGER, 1)

    run_until(sched, lambda: "tick" in phases)

    assert overlaps == []
    assert phases[0] == "init"
    assert phases[-1] == "down"


def test_what_shutdown_sends_reaches_nodes_that_shut_down_later(make, deterministic):
    """A motor's last command, sent in shutdown(), is there for the driver that stops after it."""
    received = []
    sched = make(tick_rate=100, deterministic=deterministic)
    sched.add(
        Node(
            "driver",
            nothing,
            rate=100,
            order=0,
            subs=["wheels"],
            shutdown=lambda n: received.extend(n.recv_all("wheels")),
        )
    )
    sched.add(
        Node(
            "motor",
            nothing,
            rate=100,
            order=10,
            pubs=["wheels"],
            shutdown=lambda n: n.send("wheels", 0.0),
        )
    )

    sched.run(duration=0.03)

    assert received == [0.0]


def test_messages_outside_a_scheduler_are_refused():
    """A node that was not added to a scheduler has no topics to use: an error that says so."""
    node = Node("node", nothing)
    for use in (
        lambda: node.send("x", 1),
        lambda: node.recv("x"),
        lambda: node.has_msg("x"),
        lambda: node.latest("x"),
        node.request_stop,
    ):
        with pytest.raises(StateError, match="node"):
            use()


def test_a_node_has_the_attributes_it_was_given():
    """A node carries its own configuration, to be read back."""
    node = Node("motor", nothing, rate=200, order=7)
    assert (node.name, node.rate, node.order) == ("motor", 200, 7)
    assert "motor" in repr(node)


def test_init_may_prepare_what_tick_uses(make, deterministic):
    """State made in init() is there in tick(): callbacks share the node."""

    class Counter(Node):
        def __init__(self):
            super().__init__("counter", rate=100)
            self.count = None

        def init(self):
            self.count = 0

        def tick(self):
            self.count += 1

    sched = make(tick_rate=100, deterministic=deterministic)
    counter = Counter()
    sched.add(counter)
    for _ in range(3):
        sched.tick_once()
    assert counter.count == 3


def test_shutdown_is_not_called_without_init(make, deterministic):
    """A scheduler that never started has nothing to shut down."""
    journal = []
    sched = make(tick_rate=100, deterministic=deterministic)
    sched.add(
        Node(
            "node",
            nothing,
            rate=100,
            init=lambda: journal.append("init"),
            shutdown=lambda: journal.append("shutdown"),
        )
    )
    sched.stop()
    assert journal == []
    assert sched.status() == "stopped"
