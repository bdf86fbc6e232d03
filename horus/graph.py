"""The topic graph: who feeds whom, and the execution order that follows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol


class GraphNode(Protocol):
    """What the graph needs to know of a node."""

    @property
    def name(self) -> str:
        """Unique name."""
        ...

    @property
    def order(self) -> int:
        """Execution order; lower runs earlier."""
        ...

    @property
    def publishes(self) -> frozenset[str]:
        """Declared topics it sends."""
        ...

    @property
    def subscribes(self) -> frozenset[str]:
        """Declared topics it receives."""
        ...


class Contradiction(NamedTuple):
    """A subscriber whose `order` puts it before its publisher."""

    topic: str
    publisher: str
    subscriber: str


def dataflow_order(nodes: Sequence[GraphNode]) -> list[str]:
    """Return the names by `order`, then publishers before subscribers, then as given.

    The graph decides only between nodes of equal `order`. A feedback cycle is
    cut at its earliest node, which then runs first.
    """
    result: list[str] = []
    for order in sorted({node.order for node in nodes}):
        result += _publishers_first([node for node in nodes if node.order == order])
    return result


def _publishers_first(group: list[GraphNode]) -> list[str]:
    waiting = list(group)
    done: list[str] = []
    while waiting:
        # The first node that needs nothing from those still waiting; within a
        # feedback cycle there is none, and the earliest is taken.
        chosen = next((node for node in waiting if not _needs_any(node, waiting)), waiting[0])
        waiting.remove(chosen)
        done.append(chosen.name)
    return done


def _needs_any(node: GraphNode, others: list[GraphNode]) -> bool:
    return any(
        other is not node and not node.subscribes.isdisjoint(other.publishes) for other in others
    )


def contradictions(nodes: Sequence[GraphNode]) -> list[Contradiction]:
    """Return the edges that run against `order`: the message arrives a cycle later."""
    return [
        Contradiction(topic, publisher.name, subscriber.name)
        for publisher in nodes
        for subscriber in nodes
        if subscriber.order < publisher.order
        for topic in sorted(publisher.publishes & subscriber.subscribes)
    ]
