"""What can be measured of a scheduler, as JSON, for Prometheus and as OTLP."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

from horus import clock
from horus.clock import Timeline
from horus.registry import Registry, node_stats
from horus.spec import SchedulerSpec
from horus.topics import Bus
from horus.units import NS_PER_S

SCHEMA_VERSION = 1


class Metric(NamedTuple):
    """A quantity."""

    name: str
    description: str
    unit: str
    """By UCUM, as OTLP has it: `s`, `Hz`, `1`."""
    key: str
    """What a snapshot calls it."""
    cumulative: bool
    """Whether it only ever grows."""


_NODE = (
    Metric("horus.node.ticks", "Ticks completed", "1", "total_ticks", True),
    Metric("horus.node.errors", "Callbacks that raised", "1", "errors_count", True),
    Metric("horus.node.restarts", "Times that init() ran again", "1", "restarts", True),
    Metric("horus.node.budget_overruns", "Ticks over budget", "1", "budget_overruns", True),
    Metric("horus.node.deadline_misses", "Ticks past deadline", "1", "deadline_misses", True),
    Metric("horus.node.skipped", "Releases that were not run", "1", "skipped", True),
    Metric(
        "horus.node.order_violations", "Ticks before one to follow", "1", "order_violations", True
    ),
    Metric(
        "horus.node.watchdog_expirations",
        "Ticks that did not end in time",
        "1",
        "watchdog_expirations",
        True,
    ),
    Metric("horus.node.dropped", "Messages lost in full queues", "1", "dropped", True),
    Metric("horus.node.rate", "Ticks per second", "Hz", "achieved_rate", False),
    Metric("horus.node.tick_duration.mean", "Execution time", "s", "avg_tick_duration", False),
    Metric("horus.node.tick_duration.p99", "Execution time", "s", "p99_tick_duration", False),
    Metric("horus.node.tick_duration.max", "Execution time", "s", "max_tick_duration", False),
    Metric(
        "horus.node.start_latency.p99",
        "Time from release to start",
        "s",
        "p99_start_latency",
        False,
    ),
    Metric(
        "horus.node.start_latency.max",
        "Time from release to start",
        "s",
        "max_start_latency",
        False,
    ),
    Metric("horus.node.healthy", "1 if it is healthy", "1", "healthy", False),
)
_TOPIC = (
    Metric("horus.topic.messages", "Messages sent", "1", "sent", True),
    Metric("horus.topic.dropped", "Messages lost in full queues", "1", "dropped", True),
)
_SCHEDULER = (
    Metric("horus.uptime", "Time since the first run began", "s", "uptime", False),
    Metric("horus.cycles", "Cycles completed", "1", "cycle", True),
    Metric("horus.safe_state", "1 in the system-wide safe state", "1", "safe", False),
    Metric("horus.process.cpu", "CPU time of the process", "s", "cpu", True),
)


class Metrics:
    """Takes snapshots of a scheduler.

    Thread: any.
    """

    def __init__(
        self,
        spec: SchedulerSpec,
        timeline: Timeline,
        registry: Registry,
        bus: Bus,
        safe_state: Callable[[], str | None],
        reporting_ns: Callable[[], int],
    ) -> None:
        """Look at these; `reporting_ns` returns up to when rates are reported [ns]."""
        self._name = spec.name
        self._timeline = timeline
        self._registry = registry
        self._bus = bus
        self._safe_state = safe_state
        self._reporting_ns = reporting_ns

    def snapshot(self) -> dict[str, Any]:
        """Return everything as it is now; `docs/reference/telemetry.md` has the schema."""
        now_ns = self._reporting_ns()
        reason = self._safe_state()
        return {
            "schema": SCHEMA_VERSION,
            "timestamp": clock.wall_ns() / NS_PER_S,
            "scheduler": self._name,
            "running": now_ns != 0,
            "uptime": self._timeline.elapsed_s(),
            "cycle": self._timeline.current_cycle(),
            "cpu": clock.process_time_ns() / NS_PER_S,
            "safe": int(reason is not None),
            "safe_state_reason": reason,
            "nodes": [self._of_node(live, now_ns) for live in self._registry.in_order],
            "topics": [
                {
                    "topic": each.topic,
                    "sent": each.sent,
                    "dropped": each.dropped,
                    "publishers": each.publishers,
                    "subscribers": each.subscribers,
                }
                for each in (topic.statistics() for topic in self._bus.topics())
            ],
        }

    @staticmethod
    def _of_node(live: Any, now_ns: int) -> dict[str, Any]:
        stats = node_stats(live, now_ns)
        stats["healthy"] = int(stats["health"] == "healthy")
        return stats


def _samples(snapshot: dict[str, Any]) -> Iterator[tuple[Metric, list[tuple[str, str, float]]]]:
    """Yield each metric with the samples of it: label, what it labels, value."""
    for metrics, label, rows in (
        (_NODE, "node", [(node["name"], node) for node in snapshot["nodes"]]),
        (_TOPIC, "topic", [(topic["topic"], topic) for topic in snapshot["topics"]]),
        (_SCHEDULER, "", [("", snapshot)]),
    ):
        for metric in metrics:
            # An event node has no rate, and one that never ran none yet.
            values = ((name, row[metric.key]) for name, row in rows)
            yield metric, [(label, name, value) for name, value in values if value is not None]


def prometheus_text(snapshots: Iterable[dict[str, Any]]) -> str:
    """Return snapshots in Prometheus' text format, each sample labelled with its scheduler."""
    from prometheus_client import CollectorRegistry, generate_latest
    from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
    from prometheus_client.registry import Collector

    class Snapshots(Collector):
        def collect(self) -> Iterator[Any]:
            samples = itertools.groupby(
                sorted(
                    (
                        (metric, label, name, value, snapshot["scheduler"])
                        for snapshot in snapshots
                        for metric, found in _samples(snapshot)
                        for label, name, value in found
                    ),
                    key=lambda sample: sample[0].name,
                ),
                key=lambda sample: sample[0],
            )
            for metric, group in samples:
                kind = CounterMetricFamily if metric.cumulative else GaugeMetricFamily
                rows = list(group)
                labels = ["scheduler", *filter(None, [rows[0][1]])]
                family = kind(_prometheus_name(metric), metric.description, labels=labels)
                for _, _, name, value, scheduler in rows:
                    family.add_metric([scheduler, *filter(None, [name])], float(value))
                yield family

    registry = CollectorRegistry()
    registry.register(Snapshots())
    text: bytes = generate_latest(registry)
    return text.decode()


def _prometheus_name(metric: Metric) -> str:
    unit = {"s": "_seconds", "Hz": "_hertz"}.get(metric.unit, "")
    return metric.name.replace(".", "_") + unit


def otlp(snapshot: dict[str, Any], began_ns: int) -> dict[str, Any]:
    """Return a snapshot as an OTLP/JSON request; `began_ns` is when counting began [ns].

    Format: https://opentelemetry.io/docs/specs/otlp/#json-protobuf-encoding
    """
    now = str(int(snapshot["timestamp"] * NS_PER_S))
    metrics = []
    for metric, samples in _samples(snapshot):
        points = [
            {
                "startTimeUnixNano": str(began_ns),
                "timeUnixNano": now,
                "asDouble": float(value),
                "attributes": [_attribute(f"horus.{label}", name)] if label else [],
            }
            for label, name, value in samples
        ]
        data: dict[str, Any] = {"dataPoints": points}
        if metric.cumulative:
            data |= {"aggregationTemporality": 2, "isMonotonic": True}
        described = {"name": metric.name, "description": metric.description, "unit": metric.unit}
        metrics.append({**described, "sum" if metric.cumulative else "gauge": data})
    attributes = [
        _attribute("service.name", snapshot["scheduler"]),
        _attribute("telemetry.sdk.language", "python"),
    ]
    scope = {"scope": {"name": "horus"}, "metrics": metrics}
    return {"resourceMetrics": [{"resource": {"attributes": attributes}, "scopeMetrics": [scope]}]}


def _attribute(key: str, value: str) -> dict[str, Any]:
    return {"key": key, "value": {"stringValue": value}}
