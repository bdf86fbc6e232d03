"""The nodes of a scheduler: added, found by name, counted, reported on."""

from __future__ import annotations

import threading
from collections.abc import Iterable
from typing import Any

from horus.clock import Timeline
from horus.errors import ConfigError, UnknownNodeError
from horus.live import Control, LiveNode
from horus.node import Node
from horus.spec import ExecutionClass
from horus.stats import NodeTiming, TimingReport
from horus.topics import Bus
from horus.units import to_s


class Registry:
    """All nodes of a scheduler, by name and in execution order.

    Thread: any. Readers see a tuple that is replaced, never changed.
    """

    def __init__(self, bus: Bus, timeline: Timeline) -> None:
        """Begin with no nodes."""
        self._bus = bus
        self._timeline = timeline
        self._lock = threading.Lock()
        self._by_name: dict[str, LiveNode] = {}
        self._added = 0
        self.in_order: tuple[LiveNode, ...] = ()

    def add(self, node: Node, control: Control, sequence: int | None = None) -> LiveNode:
        """Put a node into service under its name; `sequence` is its place among equals.

        Raises:
            ConfigError: The name is taken, or a topic was declared with another type.
        """
        with self._lock:
            if node.name in self._by_name:
                raise ConfigError(
                    "name", node.name, "is taken by another node; names must be unique"
                )
            place = self._added if sequence is None else sequence
            live = LiveNode(node, self._timeline, control, place)
            live.trigger = live.core.connect(self._bus)
            self._added += 1
            self._by_name[node.name] = live
            self._sort()
        return live

    def remove(self, name: str) -> LiveNode | None:
        """Forget a node; return it if there was one."""
        with self._lock:
            live = self._by_name.pop(_checked(name), None)
            self._sort()
        return live

    def renew(self) -> None:
        """Get every node ready for `init()`: a session opens."""
        with self._lock:
            for name, live in self._by_name.items():
                if live.abandoned or not live.standing.hook_returned.is_set():
                    self._by_name[name] = live.successor()
                else:
                    live.renew()
            self._sort()

    def __contains__(self, name: str) -> bool:
        """Return whether there is a node of that name."""
        return _checked(name) in self._by_name

    def get(self, name: str) -> LiveNode:
        """Return a node.

        Raises:
            UnknownNodeError: There is no node of that name.
        """
        try:
            return self._by_name[_checked(name)]
        except KeyError:
            raise UnknownNodeError(name, self.names()) from None

    def choose(self, names: Iterable[str] | None) -> list[LiveNode] | None:
        """Return the nodes of these names; None, for all nodes, stays None.

        Raises:
            UnknownNodeError: There is no node of some name.
        """
        if names is None:
            return None
        if isinstance(names, str) or not isinstance(names, Iterable):
            raise ConfigError("names", names, _names_remedy(names))
        return list(dict.fromkeys(self.get(name) for name in names))

    def names(self) -> list[str]:
        """Return the names in execution order."""
        return [live.name for live in self.in_order]

    def timing_report(self, now_ns: int) -> TimingReport:
        """Return a report on all nodes; `now_ns` is 0 when nothing runs."""
        rows = tuple(node_timing(live, now_ns) for live in self.in_order)
        return TimingReport(rows, virtual=self._timeline.deterministic)

    def safety_stats(self) -> dict[str, Any]:
        """Return the sums of what went wrong, and each node's health."""
        counters = [live.counters for live in self.in_order]
        return {
            "budget_overruns": sum(each.budget_overruns for each in counters),
            "deadline_misses": sum(each.deadline_misses for each in counters),
            "watchdog_expirations": sum(each.watchdog_expirations for each in counters),
            "skipped": sum(each.skipped for each in counters),
            "order_violations": sum(each.order_violations for each in counters),
            "health_states": {live.name: live.standing.health.value for live in self.in_order},
        }

    def _sort(self) -> None:
        self.in_order = tuple(sorted(self._by_name.values(), key=lambda live: live.rank))


def node_timing(live: LiveNode, now_ns: int) -> NodeTiming:
    """Return a node's row of the timing report; `now_ns` is 0 when nothing runs."""
    counters, times = live.counters, live.counters.times
    event = live.spec.execution_class is ExecutionClass.EVENT
    ticks = max(1, counters.ticks)
    return NodeTiming(
        name=live.name,
        execution_class=live.spec.execution_class.value,
        rate_hz=None if event else live.spec.rate_hz,
        achieved_hz=counters.achieved_hz(0 if event else live.period_ns, now_ns),
        ticks=counters.ticks,
        execution_avg_s=to_s(times.execution_total_ns) / ticks,
        execution_p99_s=times.execution_quantile_s(0.99),
        execution_max_s=to_s(times.execution_max_ns),
        start_latency_avg_s=to_s(times.latency_total_ns) / ticks,
        start_latency_p99_s=times.latency_quantile_s(0.99),
        start_latency_max_s=to_s(times.latency_max_ns),
        budget_overruns=counters.budget_overruns,
        deadline_misses=counters.deadline_misses,
        skipped=counters.skipped,
        errors=counters.errors,
    )


def node_stats(live: LiveNode, now_ns: int) -> dict[str, Any]:
    """Return a node's configuration, state and counters, as the contract shows them."""
    counters, timing = live.counters, node_timing(live, now_ns)
    return {
        "name": live.name,
        "order": live.order,
        "execution_class": timing.execution_class,
        "rate": timing.rate_hz,
        "achieved_rate": timing.achieved_hz,
        "priority": live.spec.priority,
        "state": live.reported_state.value,
        "health": live.standing.health.value,
        "total_ticks": counters.ticks,
        "errors_count": counters.errors,
        "restarts": counters.restarts,
        "budget_overruns": counters.budget_overruns,
        "deadline_misses": counters.deadline_misses,
        "skipped": counters.skipped,
        "order_violations": counters.order_violations,
        "dropped": live.core.dropped,
        "watchdog_expirations": counters.watchdog_expirations,
        "avg_tick_duration": timing.execution_avg_s,
        "p99_tick_duration": timing.execution_p99_s,
        "max_tick_duration": timing.execution_max_s,
        "p99_start_latency": timing.start_latency_p99_s,
        "max_start_latency": timing.start_latency_max_s,
    }


def _names_remedy(names: object) -> str:
    example = names if isinstance(names, str) else "motor"
    return f"must be a list of node names, e.g. [{example!r}]"


def _checked(name: object) -> str:
    if not isinstance(name, str):
        raise ConfigError("name", name, "must be a node's name")
    return name
