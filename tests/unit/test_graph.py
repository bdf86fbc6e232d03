"""Execution order from `order`, the topic graph and insertion."""

from __future__ import annotations

from dataclasses import dataclass

from hypothesis import given
from hypothesis import strategies as st

from horus.graph import Contradiction, contradictions, dataflow_order


@dataclass(frozen=True)
class Stub:
    name: str
    order: int = 100
    publishes: frozenset[str] = frozenset()
    subscribes: frozenset[str] = frozenset()


def stub(name: str, order: int = 100, pubs: str = "", subs: str = "") -> Stub:
    return Stub(name, order, frozenset(pubs.split()), frozenset(subs.split()))


def test_order_comes_first() -> None:
    """`order` decides before the graph does."""
    nodes = [stub("late", 20, pubs="x"), stub("early", 10, subs="x")]
    assert dataflow_order(nodes) == ["early", "late"]


def test_publishers_run_before_subscribers() -> None:
    """Within one order, messages flow along the graph in a single cycle."""
    nodes = [stub("c", subs="b"), stub("b", pubs="b", subs="a"), stub("a", pubs="a")]
    assert dataflow_order(nodes) == ["a", "b", "c"]


def test_insertion_breaks_ties() -> None:
    """Unconnected nodes of one order run as they were added."""
    assert dataflow_order([stub("z"), stub("a"), stub("m")]) == ["z", "a", "m"]


def test_a_feedback_cycle_is_cut_at_its_earliest_node() -> None:
    """A loop of topics runs from the node that was added first."""
    nodes = [stub("plant", pubs="y", subs="u"), stub("controller", pubs="u", subs="y")]
    assert dataflow_order(nodes) == ["plant", "controller"]


def test_a_node_may_feed_itself() -> None:
    """A node that receives its own topic waits for nobody."""
    assert dataflow_order([stub("counter", pubs="n", subs="n")]) == ["counter"]


def test_contradictions_name_topic_publisher_and_subscriber() -> None:
    """An `order` that runs a subscriber before its publisher is found."""
    nodes = [stub("safety", 0, subs="scan"), stub("lidar", 10, pubs="scan")]
    assert contradictions(nodes) == [Contradiction("scan", "lidar", "safety")]


topics = st.frozensets(st.sampled_from("abcd"), max_size=2)


@given(st.lists(st.tuples(st.integers(0, 2), topics, topics), max_size=8))
def test_every_node_runs_once_and_order_is_kept(
    shapes: list[tuple[int, frozenset[str], frozenset[str]]],
) -> None:
    """Whatever the graph, each node runs exactly once, and never before a lower order."""
    nodes = [Stub(str(i), *shape) for i, shape in enumerate(shapes)]
    by_name = {node.name: node for node in nodes}
    result = dataflow_order(nodes)
    assert sorted(result) == sorted(by_name)
    orders = [by_name[name].order for name in result]
    assert orders == sorted(orders)
