"""Compare the small costs every robot program pays: messages, ticks, wake-ups, CPU, import."""

from __future__ import annotations

import statistics
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks import peers
from benchmarks.harness import (
    OURS,
    REPOSITORY,
    Contender,
    Measure,
    Statistic,
    Target,
    median_of,
    percentile_of,
)
from benchmarks.table import TableBenchmark

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence


def overhead_per_tick(run: Mapping[str, Sequence[float]]) -> float:
    """Return what a tick costs beyond calling its function, from the 100-node cycle [µs]."""
    ticked, bare = (statistics.median(run[name]) for name in ("nodes100_us", "nodes100_bare_us"))
    return ticked - bare


def import_cost_of(series: str) -> Statistic:
    """Return the statistic: best import minus best bare start of the same interpreter [ms]."""
    return lambda run: min(run[series]) - min(run["bare_ms"])


def tick_percent(run: Mapping[str, Sequence[float]]) -> float:
    """Return ticks run of ticks due [%]."""
    return 100.0 * run["tick_ratio"][0]


MEASURES = (
    Measure(
        title="topic round trip, float",
        unit="µs",
        workload="topics",
        statistic=median_of("float_us"),
    ),
    Measure(
        title="topic round trip, 3-float dict",
        unit="µs",
        workload="topics",
        statistic=median_of("dict3_us"),
        target=Target(bound=2.2),
    ),
    Measure(
        title="topic round trip, 3-float dict to 5 subscribers",
        unit="µs",
        workload="topics",
        statistic=median_of("dict3_to5_us"),
    ),
    Measure(
        title="topic round trip, 360-float scan",
        unit="µs",
        workload="topics",
        statistic=median_of("scan360_us"),
        target=Target(bound=12.0),
    ),
    Measure(
        title="topic round trip, 1 kB string",
        unit="µs",
        workload="topics",
        statistic=median_of("str1k_us"),
    ),
    *(
        Measure(
            title=f"{title}, 100 sent before they are received",
            unit="µs",
            workload="topics",
            statistic=median_of(series),
        )
        for title, series in (
            ("3-float dict", "dict3_burst_us"),
            ("360-float scan", "scan360_burst_us"),
        )
    ),
    *(
        Measure(
            title=f"tick_once per node, {nodes} node{'s' if nodes > 1 else ''}",
            unit="µs",
            workload="tick_once",
            statistic=median_of(f"nodes{nodes}_us"),
        )
        for nodes in (1, 10, 100)
    ),
    Measure(
        title="scheduler overhead per tick (100 nodes, bare call subtracted)",
        unit="µs",
        workload="tick_once",
        statistic=overhead_per_tick,
        target=Target(bound=1.0),
    ),
    Measure(
        title="event latency, p50",
        unit="µs",
        workload="event",
        statistic=median_of("latency_us"),
        target=Target(bound=60.0),
    ),
    Measure(
        title="event latency, p99",
        unit="µs",
        workload="event",
        statistic=percentile_of("latency_us", 99.0),
    ),
    Measure(
        title="bare thread wake-up, p50 (what the machine allows)",
        unit="µs",
        workload="event",
        statistic=median_of("bare_wakeup_us"),
    ),
    Measure(
        title="CPU, ten 10 Hz nodes",
        unit="% of a core",
        workload="idle",
        statistic=median_of("cpu_percent"),
        target=Target(bound=1.0),
    ),
    Measure(
        title="CPU, ten 500 Hz nodes",
        unit="% of a core",
        workload="loaded",
        statistic=median_of("cpu_percent"),
    ),
    Measure(
        title="ticks run, ten 500 Hz nodes",
        unit="% of due",
        workload="loaded",
        statistic=tick_percent,
    ),
    Measure(
        title="CPU, 500 async nodes at 10 Hz, 50 ms await",
        unit="% of a core",
        workload="async500",
        statistic=median_of("cpu_percent"),
        target=Target(bound=30.0),
    ),
    Measure(
        title="ticks run, 500 async nodes at 10 Hz, 50 ms await",
        unit="% of due",
        workload="async500",
        statistic=tick_percent,
        target=Target(bound=99.0, sense="at least"),
    ),
    Measure(
        title="import horus",
        unit="ms",
        workload="import",
        statistic=import_cost_of("import_ms"),
        target=Target(bound=60.0),
    ),
    Measure(
        title="from horus import Node, Scheduler",
        unit="ms",
        workload="import",
        statistic=import_cost_of("import_names_ms"),
    ),
)


def contenders(*, with_peers: bool) -> list[Contender]:
    """Return this package as it is in the checkout, and the peer.

    Raises:
        PeerError: The peer cannot be had.
    """
    found = [Contender(label=OURS, python=Path(sys.executable), import_root=REPOSITORY)]
    if with_peers:
        peer = peers.HORUS_ROBOTICS
        found.append(Contender(label=peer.label, python=peer.interpreter()))
    return found


BENCHMARK = TableBenchmark(
    name="micro",
    description=__doc__,
    measures=MEASURES,
    contenders=contenders,
    peers_help=f"measure {peers.HORUS_ROBOTICS.requirement} too, in an environment made in .bench/",
    reading='Lower is better, except for "ticks run".',
)
main = BENCHMARK.main
