"""Measure what a worker process costs and what it takes to come back, and a scheduler in a service.

A node with `compute="process"` answers messages, a worker crashes and is replaced, a planner
computes in a thread and in a process beside a node of the event loop, and an HTTP service answers
requests without and with an idle scheduler on its event loop.
"""

from __future__ import annotations

import statistics
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.harness import (
    OURS,
    REPOSITORY,
    Contender,
    Measure,
    Target,
    median_of,
    percentile_of,
)
from benchmarks.table import TableBenchmark

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

CHILDREN = Path(__file__).resolve().with_name("service_workloads.py")
POOL = "ProcessPoolExecutor"

RESTART_BACKOFF_MS = 100.0
"""What a node waits before its first restart, as documented [ms]."""


def after_backoff(run: Mapping[str, Sequence[float]]) -> float:
    """Return what a recovery took beyond the back-off [ms]."""
    return statistics.median(run["recovery_ms"]) - RESTART_BACKOFF_MS


def rate_with_of_without(run: Mapping[str, Sequence[float]]) -> float:
    """Return requests with a scheduler of requests without, pair by pair [%]."""
    pairs = zip(run["with_hz"], run["without_hz"], strict=True)
    return 100.0 * statistics.median(inside / alone for inside, alone in pairs)


def round_trip(title: str, series: str, target: Target) -> tuple[Measure, Measure]:
    """Return the lines about round trips of one kind of message."""
    half = Measure(
        title=f"{title} to a process and back, p50",
        unit="µs",
        workload="roundtrip",
        statistic=median_of(series),
        target=target,
    )
    tail = Measure(
        title=f"{title} to a process and back, p99",
        unit="µs",
        workload="roundtrip",
        statistic=percentile_of(series, 99.0),
    )
    return half, tail


PLANNERS = {
    "thread_python": "a planner in Python in a thread",
    "thread_library": "a planner in a library in a thread",
    "process_python": "a planner in Python in a process",
}


def beside(series: str, planner: str) -> tuple[Measure, Measure]:
    """Return the lines about one planner, which computes for 40 ms ten times a second."""
    late = Measure(
        title=f"start of a 100 Hz node beside {planner}, p99",
        unit="µs",
        workload="planner",
        statistic=percentile_of(f"{series}_late_us", 99.0),
    )
    tick = Measure(
        title=f"40 ms of {planner}, p50",
        unit="ms",
        workload="planner",
        statistic=median_of(f"{series}_tick_ms"),
    )
    return late, tick


MEASURES = (
    *round_trip("3-float dict", "dict3_us", Target(bound=400.0)),
    *round_trip("480x640x3 uint8 image", "image_us", Target(bound=1500.0)),
    Measure(
        title="crash of a worker to the first message of the next, less back-off",
        unit="ms",
        workload="crash",
        statistic=after_backoff,
        target=Target(bound=300.0),
    ),
    *(line for series, planner in PLANNERS.items() for line in beside(series, planner)),
    Measure(
        title="HTTP requests, no scheduler inside",
        unit="1/s",
        workload="embed",
        statistic=median_of("without_hz"),
    ),
    Measure(
        title="CPU of who makes the HTTP requests",
        unit="% of a core",
        workload="embed",
        statistic=median_of("asking_percent"),
    ),
    Measure(
        title="HTTP requests, ten 10 Hz nodes inside",
        unit="% of without",
        workload="embed",
        statistic=rate_with_of_without,
        target=Target(bound=97.0, sense="at least"),
    ),
)


def contenders(*, with_peers: bool) -> list[Contender]:
    """Return this package as it is in the checkout, and the standard library's process pool."""
    here = Path(sys.executable)
    found = [Contender(label=OURS, python=here, import_root=REPOSITORY, script=CHILDREN)]
    if with_peers:
        found.append(
            Contender(
                label=POOL,
                python=here,
                script=CHILDREN,
                arguments=("--contender", "pool"),
                workloads=("roundtrip",),
            )
        )
    return found


BENCHMARK = TableBenchmark(
    name="service",
    description=__doc__,
    measures=MEASURES,
    contenders=contenders,
    peers_help="measure the process pool of concurrent.futures too, called from asyncio on uvloop",
    reading="Lower is better, except for HTTP requests.",
)
main = BENCHMARK.main
