"""Compare the small costs every robot program pays: messages, ticks, wake-ups, CPU, import."""

from __future__ import annotations

import argparse
import json
import statistics
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks import harness, peers
from benchmarks.harness import (
    Contender,
    Measure,
    Statistic,
    Target,
    median_of,
    percentile_of,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

OURS = "this package"


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
WORKLOADS = tuple(dict.fromkeys(measure.workload for measure in MEASURES))


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    """Parse the options of this benchmark."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks micro", description=__doc__)
    parser.add_argument(
        "--peers",
        action="store_true",
        help=f"measure {peers.HORUS_ROBOTICS.requirement} too, in an environment made in .bench/",
    )
    parser.add_argument(
        "--json", type=harness.output_file, metavar="FILE", help="write all raw samples"
    )
    parser.add_argument("--quick", action="store_true", help="one short round: smoke, not figures")
    parser.add_argument(
        "--rounds", type=harness.at_least_one, metavar="N", help="default 5; 1 with --quick"
    )
    parser.add_argument(
        "--calm",
        type=float,
        default=100.0,
        metavar="PERCENT",
        help="repeat runs during which other processes used more than this of all CPUs",
    )
    parser.add_argument("--markdown", action="store_true", help="print the table as Markdown")
    parser.add_argument(
        "--only",
        nargs="+",
        choices=WORKLOADS,
        default=WORKLOADS,
        metavar="WORKLOAD",
        help=f"run only these: {', '.join(WORKLOADS)}",
    )
    options = parser.parse_args(argv)
    if options.rounds is None:
        options.rounds = 1 if options.quick else 5
    return options


def report(
    runs: Sequence[harness.ChildRun],
    contenders: Sequence[str],
    facts: Mapping[str, str],
    *,
    only: Sequence[str],
    markdown: bool,
) -> str:
    """Return the printed result: facts, table, and how to read it."""
    measures = [measure for measure in MEASURES if measure.workload in only]
    rows = harness.table_rows(runs, measures, contenders)
    table = harness.render_markdown(rows) if markdown else harness.render_text(rows)
    lines = harness.describe(runs, facts)
    rounds = max((run.round for run in runs), default=0)
    notes = f"Figures are medians over {rounds} round{'s' if rounds != 1 else ''}"
    notes += " (lowest-highest round)." if rounds > 1 else "."
    if len(contenders) > 1:
        notes += " ratio = this package / peer."
    notes += ' Lower is better, except for "ticks run".'
    notes = "\n".join([notes, *harness.failures(runs)])
    head = "  \n".join(lines) if markdown else "\n".join(lines)
    return f"{head}\n\n{table}\n\n{notes}"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark and return 0 if every workload of this package delivered samples."""
    options = parse(argv)
    facts = harness.machine_facts()
    contenders = [
        Contender(label=OURS, python=Path(sys.executable), import_root=harness.REPOSITORY)
    ]
    if options.peers:
        peer = peers.HORUS_ROBOTICS
        try:
            python = peer.interpreter()
        except peers.PeerError as error:
            print(error, file=sys.stderr)
            return 2
        contenders.append(Contender(label=peer.label, python=python))
    runs = harness.run_rounds(
        contenders,
        options.only,
        rounds=options.rounds,
        quick=options.quick,
        max_other_load_percent=options.calm,
        progress=lambda line: print(line, file=sys.stderr, flush=True),
    )
    labels = [contender.label for contender in contenders]
    print(report(runs, labels, facts, only=options.only, markdown=options.markdown))
    if options.json is not None:
        document = {"facts": facts, "quick": options.quick, "runs": [asdict(run) for run in runs]}
        options.json.write_text(json.dumps(document, indent=1), encoding="utf-8")
    return 1 if any(run.error for run in runs if run.contender == OURS) else 0
