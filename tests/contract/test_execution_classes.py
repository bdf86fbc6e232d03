"""Execution classes: inferred from a node's configuration, never set."""

from __future__ import annotations

import functools
import inspect

import pytest

from horus import ConfigError, ExecutionClass, Node, ms, us

from .helpers import named, nothing


async def tick_async(node: Node) -> None:
    """Do nothing, asynchronously."""


class AsyncCallable:
    """An object whose call is a coroutine."""

    async def __call__(self, node: Node) -> None:
        """Do nothing."""


@pytest.mark.parametrize(
    ("configuration", "expected"),
    [
        ({}, ExecutionClass.BEST_EFFORT),
        ({"order": 5, "failure_policy": "skip"}, ExecutionClass.BEST_EFFORT),
        ({"rate": 100}, ExecutionClass.RT),
        ({"rate": 30}, ExecutionClass.RT),
        ({"budget": 300 * us}, ExecutionClass.RT),
        ({"deadline": 5 * ms}, ExecutionClass.RT),
        ({"rate": 1000, "budget": 300 * us, "deadline": 900 * us}, ExecutionClass.RT),
        ({"compute": True}, ExecutionClass.COMPUTE),
        ({"compute": "thread"}, ExecutionClass.COMPUTE),
        ({"compute": True, "rate": 10}, ExecutionClass.COMPUTE),
        ({"compute": True, "rate": 10, "budget": 40 * ms}, ExecutionClass.COMPUTE),
        ({"on": "emergency.stop"}, ExecutionClass.EVENT),
        ({"on": "emergency.stop", "budget": 1 * ms}, ExecutionClass.EVENT),
        ({"on": "emergency.stop", "tick": tick_async}, ExecutionClass.EVENT),
        ({"tick": tick_async}, ExecutionClass.ASYNC_IO),
        ({"tick": tick_async, "rate": 1}, ExecutionClass.ASYNC_IO),
        ({"tick": tick_async, "rate": 1, "deadline": 0.5}, ExecutionClass.ASYNC_IO),
        ({"tick": functools.partial(tick_async), "rate": 1}, ExecutionClass.ASYNC_IO),
        ({"tick": AsyncCallable(), "rate": 1}, ExecutionClass.ASYNC_IO),
    ],
    ids=named,
)
def test_the_execution_class_is_inferred_from_the_configuration(make, configuration, expected):
    """The scheduler assigns each node an execution class based on its configuration."""
    node = Node("node", **{"tick": nothing, **configuration})
    assert node.execution_class is expected

    sched = make(deterministic=True)
    sched.add(node)
    assert sched.get_all_nodes()[0]["execution_class"] == expected


def test_the_class_names_are_those_of_the_contract():
    """The assigned classes are Rt, Compute, Event, AsyncIo and BestEffort."""
    assert {str(member) for member in ExecutionClass} == {
        "Rt",
        "Compute",
        "Event",
        "AsyncIo",
        "BestEffort",
    }


@pytest.mark.parametrize("argument", ["rt", "execution_class"])
def test_you_do_not_set_the_class_directly(argument):
    """There is no rt=True on individual nodes: the class is inferred."""
    assert argument not in inspect.signature(Node).parameters
    with pytest.raises(TypeError):
        Node("node", nothing, **{argument: True})


@pytest.mark.parametrize(
    ("configuration", "words"),
    [
        ({"compute": True, "on": "scan"}, ["on='scan'", "compute"]),
        ({"compute": True, "tick": tick_async}, ["compute=True", "async", "def tick"]),
        ({"on": "scan", "rate": 10}, ["rate=10", "messages"]),
    ],
    ids=named,
)
def test_contradicting_configurations_are_errors_that_say_why(configuration, words):
    """Compute with on, compute with async, and on with rate are errors that say why."""
    with pytest.raises(ConfigError) as refused:
        Node("node", **{"tick": nothing, **configuration})
    assert all(word in str(refused.value) for word in words)


@pytest.mark.parametrize("value", ["fork", "", 1, None])
def test_other_kinds_of_compute_are_refused(value):
    """A kind that does not exist raises plainly instead of running somewhere else."""
    with pytest.raises(ConfigError, match=r"compute=.*must be True, False, 'thread' or 'process'"):
        Node("node", nothing, compute=value)


@pytest.mark.parametrize("phase", ["init", "shutdown", "safe_state"])
def test_async_callbacks_need_an_async_tick(phase):
    """An async init, shutdown or safe_state beside a plain tick is refused: no loop runs it."""
    with pytest.raises(ConfigError, match=phase):
        Node("node", nothing, **{phase: tick_async})
    Node("node", tick_async, **{phase: tick_async})


def test_a_tick_that_returns_a_coroutine_by_mistake_is_told(make, caplog):
    """A plain function that returns a coroutine is an error of the node, not a leak."""
    sched = make(tick_rate=100, deterministic=True)
    sched.add(Node("node", lambda node: tick_async(node), rate=100))

    sched.tick_once()

    assert sched.get_node_stats("node")["errors_count"] == 1
    assert any("async def" in record.getMessage() for record in caplog.records)
