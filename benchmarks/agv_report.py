"""What the samples of the AGV benchmark mean: figures per run, medians over rounds, targets.

Nothing in here runs anything or reads a clock.
"""

from __future__ import annotations

import bisect
import math
import statistics
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

from benchmarks import harness
from benchmarks.agv_workloads.scenario import MODES, SOAK, WATCHDOG_TIMEOUTS_MS
from benchmarks.harness import (
    ChildRun,
    Figure,
    Measure,
    Target,
    median_of,
    percentile,
    percentile_of,
)
from benchmarks.micro import OURS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    Series = Mapping[str, Sequence[float]]

CYCLICTEST = "cyclictest"

MOTOR_PERIOD_NS = 1_000_000
COUNTED_S = 5.0
"""Counts are given per so many seconds [s], whatever the length of the window."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MotorFigures:
    """What one run says about the motor; None for what the contender does not tell."""

    tick_percent: float | None = None
    """Motor ticks of the motor's releases in the window [%]."""
    latency_p50_us: float | None = None
    latency_p99_us: float | None = None
    latency_p999_us: float | None = None
    latency_max_us: float | None = None
    interval_error_p99_us: float | None = None
    """99th percentile of how far the time between two ticks is from 1 ms [µs]."""
    gaps_over_1_5_ms: float | None = None
    """How often per 5 s the motor was left alone for so long."""
    gaps_over_2_ms: float | None = None
    longest_gap_ms: float | None = None
    order_violations: float | None = None
    """Motor ticks per 5 s before which no safety tick had completed since the one before."""
    own_order_violations: float | None = None
    """What the scheduler itself counted, over the whole run and warm-up."""


def window(series: Series) -> slice:
    """Return which motor ticks are in the measured window.

    It opens half a period before the first tick after the warm-up: an exactly periodic motor then
    has exactly as many ticks as releases in it, whatever its phase.
    """
    starts = series["start_ns"]
    first, closes_ns = _bounds(series)
    return slice(first, bisect.bisect_left(starts, closes_ns))


def _bounds(series: Series) -> tuple[int, float]:
    """Return the index of the first tick in the window, and when the window closes [ns]."""
    starts = series["start_ns"]
    warmup_s, seconds = series["window_s"]
    first = bisect.bisect_left(starts, warmup_s * 1e9)
    opens_ns = starts[first] - MOTOR_PERIOD_NS / 2 if first < len(starts) else warmup_s * 1e9
    return first, opens_ns + seconds * 1e9


def window_latencies_us(series: Series) -> list[float]:
    """Return the start latencies in the window [µs]; of cyclictest, which has none, all."""
    latencies = series.get("latency_ns", ())
    inside = latencies[window(series)] if "start_ns" in series else latencies
    return [latency / 1e3 for latency in inside]


def motor_figures(series: Series) -> MotorFigures:
    """Reduce the raw series of one run."""
    figures = _latency_figures(window_latencies_us(series))
    if "start_ns" in series:
        figures |= _interval_figures(series)
    if "safety_seen" in series:
        figures["order_violations"] = _per_5_s(count_violations(series), series)
    if "own_order_violations" in series:
        figures["own_order_violations"] = series["own_order_violations"][0]
    return MotorFigures(**figures)


def _latency_figures(latencies_us: Sequence[float]) -> dict[str, float]:
    if not latencies_us:
        return {}
    return {
        "latency_p50_us": percentile(latencies_us, 50.0),
        "latency_p99_us": percentile(latencies_us, 99.0),
        "latency_p999_us": percentile(latencies_us, 99.9),
        "latency_max_us": max(latencies_us),
    }


def _interval_figures(series: Series) -> dict[str, float]:
    starts = series["start_ns"][window(series)]
    seconds = series["window_s"][1]
    _, closes_ns = _bounds(series)
    intervals = [after - before for before, after in pairwise(starts)]
    # A motor that stopped for good has left a gap, too.
    gaps = [*intervals, closes_ns - starts[-1]] if starts else [seconds * 1e9]
    figures = {
        "tick_percent": 100.0 * len(starts) / (seconds * 1e9 / MOTOR_PERIOD_NS),
        "gaps_over_1_5_ms": _per_5_s(sum(gap > 1.5e6 for gap in gaps), series),
        "gaps_over_2_ms": _per_5_s(sum(gap > 2.0e6 for gap in gaps), series),
        "longest_gap_ms": max(gaps) / 1e6,
    }
    if intervals:
        errors_us = [abs(interval - MOTOR_PERIOD_NS) / 1e3 for interval in intervals]
        figures["interval_error_p99_us"] = percentile(errors_us, 99.0)
    return figures


def count_violations(series: Series) -> int:
    """Count the motor ticks in the window with no safety tick completed since the one before."""
    inside = window(series)
    seen = series["safety_seen"][max(0, inside.start - 1) : inside.stop]
    return sum(before == after for before, after in pairwise(seen))


def _per_5_s(count: int, series: Series) -> float:
    return count * COUNTED_S / series["window_s"][1]


@dataclass(frozen=True, slots=True)
class Column:
    """A column of the AGV's tables."""

    title: str
    figure: str
    """Name of a field of `MotorFigures`."""
    decimals: int | None = None
    """Fixed number of decimals; None for three significant digits."""


COLUMNS = (
    Column("motor ticks %", "tick_percent", 2),
    Column("latency p50 µs", "latency_p50_us"),
    Column("p99", "latency_p99_us"),
    Column("p99.9", "latency_p999_us"),
    Column("max", "latency_max_us"),
    Column("interval error p99 µs", "interval_error_p99_us"),
    Column("gaps > 1.5 ms", "gaps_over_1_5_ms"),
    Column("> 2 ms", "gaps_over_2_ms"),
    Column("longest ms", "longest_gap_ms"),
    Column("order violations", "order_violations"),
)


def figures_by_round(
    runs: Sequence[ChildRun], mode: str, contender: str, figure: str
) -> dict[int, float]:
    """Return one figure of one contender for every round that has it."""
    figures = {
        run.round: getattr(motor_figures(run.series), figure)
        for run in runs
        if (run.workload, run.contender) == (mode, contender) and run.error is None
    }
    return {number: value for number, value in figures.items() if value is not None}


def figure_of(values: Mapping[int, float]) -> Figure:
    """Return the median and range over rounds; all nan if there is no round."""
    if not values:
        return Figure(median=math.nan, low=math.nan, high=math.nan)
    every = list(values.values())
    return Figure(median=statistics.median(every), low=min(every), high=max(every))


def agv_rows(
    runs: Sequence[ChildRun], mode: str, contenders: Sequence[str], missing: Mapping[str, str]
) -> list[tuple[str, ...]]:
    """Return a table of all contenders in one mode, medians over rounds, header first.

    Args:
        runs: All runs.
        mode: A key of ``MODES``.
        contenders: Labels in the order of the rows.
        missing: Contenders that could not be run at all, and what the table says of them.
    """
    rows = [(MODES[mode].title, *(column.title for column in COLUMNS))]
    for contender in contenders:
        ran = any(
            (run.workload, run.contender) == (mode, contender) and run.error is None for run in runs
        )
        if not ran:
            verdict = missing.get(contender, "failed")
            rows.append((contender, verdict, *("-" for _ in COLUMNS[1:])))
            continue
        cells = [
            _cell(figures_by_round(runs, mode, contender, column.figure), column)
            for column in COLUMNS
        ]
        rows.append((contender, *cells))
    return rows


def _cell(values: Mapping[int, float], column: Column) -> str:
    if not values:
        return "-"
    median = statistics.median(values.values())
    if column.decimals is not None:
        return f"{median:.{column.decimals}f}"
    return harness.format_number(median)


@dataclass(frozen=True, slots=True, kw_only=True)
class AgvTarget:
    """A bound for this package in one mode."""

    mode: str
    title: str
    unit: str
    figure: str
    target: Target
    relative: bool = False
    """Whether the figure is divided by cyclictest's of the same round."""


TARGETS = (
    AgvTarget(
        mode="thread",
        title="motor ticks",
        unit="% of releases",
        figure="tick_percent",
        target=Target(bound=99.5, sense="at least"),
    ),
    AgvTarget(
        mode="thread",
        title="order violations",
        unit="per 5 s",
        figure="order_violations",
        target=Target(bound=0.0),
    ),
    AgvTarget(
        mode="thread",
        title="start latency p99",
        unit="µs",
        figure="latency_p99_us",
        target=Target(bound=400.0),
    ),
    AgvTarget(
        mode="idle",
        title="motor ticks",
        unit="% of releases",
        figure="tick_percent",
        target=Target(bound=99.9, sense="at least"),
    ),
    AgvTarget(
        mode="idle",
        title="start latency p99",
        unit="times cyclictest's p99",
        figure="latency_p99_us",
        target=Target(bound=3.0),
        relative=True,
    ),
)


def target_figure(runs: Sequence[ChildRun], line: AgvTarget) -> Figure:
    """Return this package's figure for a target, over the rounds that have it."""
    ours = figures_by_round(runs, line.mode, OURS, line.figure)
    if line.relative:
        limit = figures_by_round(runs, line.mode, CYCLICTEST, line.figure)
        ours = {number: ours[number] / limit[number] for number in ours if limit.get(number)}
    return figure_of(ours)


def target_rows(runs: Sequence[ChildRun]) -> list[tuple[str, ...]]:
    """Return the table of targets, header first; only of modes that were run."""
    rows = [("mode", "figure", "unit", OURS, "target", "met")]
    for line in TARGETS:
        if not any(run.workload == line.mode for run in runs):
            continue
        figure = target_figure(runs, line)
        met = "yes" if line.target.met(figure.median) else "no"
        measured = not math.isnan(figure.median)
        if not measured and line.relative and figures_by_round(runs, line.mode, OURS, line.figure):
            # Without cyclictest there is nothing to compare with, which is nobody's failure.
            rows.append((MODES[line.mode].title, line.title, line.unit, "-", str(line.target), "-"))
            continue
        rows.append(
            (MODES[line.mode].title, line.title, line.unit, str(figure), str(line.target), met)
        )
    return rows


def watchdog_excess_ms(timeout_ms: int) -> harness.Statistic:
    """Return the statistic: first warning after a tick froze, less the timeout [ms].

    Infinite if the node came back without a warning.
    """
    name = f"reaction_{timeout_ms}_ms_ns"
    return lambda run: run[name][0] / 1e6 - timeout_ms if run[name] else math.inf


def _in_us(statistic: harness.Statistic) -> harness.Statistic:
    return lambda run: statistic(run) / 1e3


REACTION_MEASURES = (
    Measure(
        title="baton, end of safety to start of motor, median",
        unit="µs",
        workload="baton",
        statistic=_in_us(median_of("hop_ns")),
        target=Target(bound=25.0),
    ),
    Measure(
        title="baton, p99",
        unit="µs",
        workload="baton",
        statistic=_in_us(percentile_of("hop_ns", 99.0)),
    ),
    Measure(
        title="emergency stop past a blocked event loop, p50",
        unit="µs",
        workload="estop",
        statistic=_in_us(median_of("latency_ns")),
    ),
    Measure(
        title="emergency stop past a blocked event loop, p99",
        unit="µs",
        workload="estop",
        statistic=_in_us(percentile_of("latency_ns", 99.0)),
        target=Target(bound=300.0),
    ),
    Measure(
        title="emergency stops handled",
        unit="% of sent",
        workload="estop",
        statistic=lambda run: 100.0 * len(run["latency_ns"]) / run["sent"][0],
    ),
    *(
        Measure(
            title=f"watchdog, first warning later than its {timeout_ms} ms by",
            unit="ms",
            workload="watchdog",
            statistic=watchdog_excess_ms(timeout_ms),
            target=Target(bound=0.1 * timeout_ms + 5.0),
        )
        for timeout_ms in WATCHDOG_TIMEOUTS_MS
    ),
)


def soak_measures(names: Sequence[str], seconds: float) -> list[Measure]:
    """Return the lines of the soak's table: expirations, and ticks of due for each node."""

    def percent(name: str) -> harness.Statistic:
        return lambda run: 100.0 * run[name][0] / run[name][1]

    expirations = Measure(
        title="watchdog expirations of healthy nodes",
        unit=f"in {seconds / 60:g} min",
        workload=SOAK,
        statistic=lambda run: run["watchdog_expirations"][0],
        target=Target(bound=0.0),
    )
    ticks = [
        Measure(title=f"ticks of {name}", unit="% of due", workload=SOAK, statistic=percent(name))
        for name in names
        if name != "watchdog_expirations"
    ]
    return [expirations, *ticks]
