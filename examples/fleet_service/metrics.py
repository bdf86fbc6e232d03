"""A scheduler's counters in Prometheus' text format."""

from __future__ import annotations

from collections.abc import Iterable

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from horus import Scheduler

COUNTERS = {
    "total_ticks": "Ticks completed",
    "errors_count": "Callbacks that raised",
    "budget_overruns": "Ticks longer than their budget",
    "deadline_misses": "Ticks that ended after their deadline",
    "skipped": "Releases that were not run",
    "watchdog_expirations": "Ticks that did not end in time",
    "dropped": "Messages lost in full queues",
}
GAUGES = {
    "achieved_rate": "Ticks per second [Hz]",
    "avg_tick_duration": "Mean execution time [s]",
    "p99_tick_duration": "99th percentile of the execution time [s]",
    "p99_start_latency": "99th percentile of the time from release to start [s]",
}


class NodeCollector(Collector):
    """Asks the scheduler when it is asked itself."""

    def __init__(self, sched: Scheduler) -> None:
        """Collect for a scheduler."""
        self._sched = sched

    def collect(self) -> Iterable[Metric]:
        """Return a family per counter, with a sample per node."""
        nodes = self._sched.get_all_nodes()
        kinds = ((COUNTERS, CounterMetricFamily), (GAUGES, GaugeMetricFamily))
        for texts, kind in kinds:
            for key, text in texts.items():
                name = key.removeprefix("total_").removesuffix("_count")
                family = kind(f"horus_node_{name}", text, labels=["node"])
                for node in nodes:
                    family.add_metric([node["name"]], node[key] or 0.0)
                yield family
        healthy = GaugeMetricFamily("horus_node_healthy", "1 if it is", labels=["node"])
        for node in nodes:
            healthy.add_metric([node["name"]], float(node["health"] == "healthy"))
        yield healthy
        safe = self._sched.safety_stats()["safe_state"]
        yield GaugeMetricFamily("horus_safe_state", "1 in the safe state", value=float(safe))


def metrics_text(sched: Scheduler) -> bytes:
    """Return the counters as they are now."""
    registry = CollectorRegistry()
    registry.register(NodeCollector(sched))
    return generate_latest(registry)
