"""horus.run(): the one-liner."""

from __future__ import annotations

import inspect
import os
import signal
import threading
import time

import pytest

import horus
from horus import ConfigError, Node, Scheduler, us

from .helpers import nothing

PARAMETERS = {
    "duration": None,
    "tick_rate": 1000.0,
    "rt": False,
    "deterministic": False,
    "blackbox_mb": 0,
    "watchdog_ms": 0,
    "recording": False,
    "name": None,
    "cores": None,
    "max_deadline_misses": None,
    "verbose": False,
    "telemetry": None,
}
"""Every keyword argument of horus.run() that the contract lists, with its default."""


@pytest.mark.realtime
def test_the_one_liner_of_the_contract_runs():
    """For most programs, horus.run() is all you need: sensor to controller to motor."""
    driven = []

    def read_sensor(node):
        node.send("scan", {"ranges": [1.0, 2.0, 3.0]})

    def navigate(node):
        if node.has_msg("scan"):
            scan = node.recv("scan")
            node.send("cmd", {"linear": 0.5, "angular": scan["ranges"][0]})

    def drive(node):
        if node.has_msg("cmd"):
            cmd = node.recv("cmd")
            driven.append(cmd)
            node.log_info(f"Driving: linear={cmd['linear']}")

    sensor = horus.Node(name="sensor", tick=read_sensor, rate=10, order=0, pubs=["scan"])
    ctrl = horus.Node(
        name="controller", tick=navigate, rate=30, order=10, subs=["scan"], pubs=["cmd"]
    )
    motor = horus.Node(name="motor", tick=drive, rate=1000, order=20, budget=300 * us, subs=["cmd"])

    horus.run(sensor, ctrl, motor, rt=True, watchdog_ms=500, duration=0.4)

    assert driven[0] == {"linear": 0.5, "angular": 1.0}
    assert 3 <= len(driven) <= 5


def test_run_creates_a_scheduler_adds_all_nodes_and_calls_run():
    """horus.run() creates a Scheduler behind the scenes, adds all nodes, and calls run()."""
    journal = []
    nodes = [
        Node(name, lambda n: journal.append(n.name), rate=100, order=order)
        for order, name in enumerate("abc")
    ]

    outcome = horus.run(*nodes, deterministic=True, tick_rate=100, duration=0.02)

    assert journal == ["a", "b", "c"] * 2
    assert outcome is None


@pytest.mark.parametrize(("name", "default"), PARAMETERS.items())
def test_every_scheduler_level_parameter_is_available_as_a_keyword_argument(name, default):
    """Every scheduler-level parameter is available as a keyword argument of run()."""
    ticks = []
    options = {"deterministic": True, "duration": 0.05, name: default}
    if name == "duration":
        options["duration"] = 0.05

    horus.run(Node("node", lambda: ticks.append(1), rate=100), **options)

    assert ticks


@pytest.mark.parametrize(("name", "default"), PARAMETERS.items())
def test_the_defaults_are_those_of_the_contract(name, default):
    """The default of every keyword argument of run() is the one the contract lists."""
    known = {
        **inspect.signature(Scheduler.__init__).parameters,
        **inspect.signature(horus.run).parameters,
    }
    assert known[name].default == default
    assert known[name].kind is inspect.Parameter.KEYWORD_ONLY


def test_an_unknown_keyword_argument_is_refused():
    """A misspelt option of run() is an error, not silence."""
    with pytest.raises(TypeError, match="tickrate"):
        horus.run(Node("node", nothing), tickrate=100, duration=0.01)


@pytest.mark.realtime
def test_duration_is_in_seconds():
    """duration: seconds."""
    begun = time.monotonic()
    horus.run(Node("node", nothing, rate=100), duration=0.3)
    assert 0.3 <= time.monotonic() - begun < 2.0


@pytest.mark.realtime
def test_without_a_duration_run_goes_on_until_ctrl_c():
    """None = forever: run until Ctrl+C."""
    ticked = threading.Event()

    def interrupt():
        ticked.wait()
        time.sleep(0.2)
        os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=interrupt)
    thread.start()
    begun = time.monotonic()

    horus.run(Node("node", ticked.set))

    thread.join()
    assert time.monotonic() - begun >= 0.2


def test_a_node_can_end_the_run():
    """A node calling node.request_stop() ends horus.run()."""
    ticks = []

    def tick(node):
        ticks.append(horus.tick())
        if len(ticks) == 3:
            node.request_stop()

    horus.run(Node("node", tick, rate=100), deterministic=True, tick_rate=100)

    assert ticks == [0, 1, 2]


def test_run_without_nodes_runs_for_its_time():
    """No nodes is no error: there is just nothing to do."""
    horus.run(duration=0.01)
    horus.run(duration=0.01, deterministic=True)


def test_run_can_be_called_again_with_the_same_nodes():
    """Nodes are plain values: the same ones can be run again."""
    ticks = []
    node = Node("node", lambda: ticks.append(1), rate=100)

    for _ in range(2):
        horus.run(node, deterministic=True, duration=0.03)

    assert len(ticks) == 6


def test_run_refuses_what_is_not_a_node():
    """What is not a Node is refused with the argument and the value."""
    with pytest.raises(ConfigError, match=r"node=\[.*must be a Node"):
        horus.run([Node("node", nothing)], duration=0.01)
