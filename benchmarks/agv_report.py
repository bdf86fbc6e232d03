"""What the samples of the AGV benchmark mean: figures per run and over rounds, targets.

Nothing in here runs anything or reads a clock.
"""

from __future__ import annotations

import bisect
import math
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

from benchmarks import harness
from benchmarks.agv_workloads.scenario import CRITICAL_CLASSES, CRITICAL_TIMEOUT_MS, MODES, SOAK
from benchmarks.harness import (
    OURS,
    ChildRun,
    Figure,
    Measure,
    Target,
    median_of,
    percentile,
    percentile_of,
)

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
    over_rounds: Callable[[Iterable[float]], float] = statistics.median


COLUMNS = (
    Column("motor ticks %", "tick_percent", 2),
    Column("latency p50 µs", "latency_p50_us"),
    Column("p99", "latency_p99_us"),
    Column("p99.9", "latency_p999_us"),
    Column("max", "latency_max_us", over_rounds=max),
    Column("interval error p99 µs", "interval_error_p99_us"),
    Column("gaps > 1.5 ms", "gaps_over_1_5_ms"),
    Column("> 2 ms", "gaps_over_2_ms"),
    Column("longest ms", "longest_gap_ms", over_rounds=max),
    Column("order violations", "order_violations", over_rounds=max),
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
    runs: Sequence[ChildRun], mode: str, contenders: Sequence[str]
) -> list[tuple[str, ...]]:
    """Return a table of all contenders in one mode, header first.

    Args:
        runs: All runs.
        mode: A key of ``MODES``.
        contenders: Labels in the order of the rows; one without any run was not installed.
    """
    rows = [(MODES[mode].title, *(column.title for column in COLUMNS))]
    for contender in contenders:
        errors = [run.error for run in runs if (run.workload, run.contender) == (mode, contender)]
        if all(error is not None for error in errors):
            verdict = "failed" if errors else "not installed"
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
    value = column.over_rounds(values.values())
    if column.decimals is not None:
        return f"{value:.{column.decimals}f}"
    return harness.format_number(value)


@dataclass(frozen=True, slots=True, kw_only=True)
class Reference:
    """What a figure is divided by: the same one of somebody else, or in another mode."""

    contender: str
    mode: str
    whose: str
    """What to call it, as a possessive."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AgvTarget:
    """A bound for this package in one mode."""

    mode: str
    title: str
    unit: str
    figure: str
    target: Target
    relative_to: Reference | None = None
    """Whose figure of the same round it is divided by; None to take it as it is."""


LIMIT = Reference(contender=CYCLICTEST, mode="idle", whose=f"{CYCLICTEST}'s")
OURS_IDLE = Reference(contender=OURS, mode="idle", whose=f"{MODES['idle'].title}'s")

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
        unit=f"times {LIMIT.whose} p99",
        figure="latency_p99_us",
        target=Target(bound=3.0),
        relative_to=LIMIT,
    ),
    AgvTarget(
        mode="process",
        title="motor ticks",
        unit="% of releases",
        figure="tick_percent",
        target=Target(bound=99.9, sense="at least"),
    ),
    AgvTarget(
        mode="process",
        title="order violations",
        unit="per 5 s",
        figure="order_violations",
        target=Target(bound=0.0),
    ),
    AgvTarget(
        mode="process",
        title="start latency p99",
        unit=f"times {OURS_IDLE.whose} p99",
        figure="latency_p99_us",
        target=Target(bound=1.3),
        relative_to=OURS_IDLE,
    ),
)


def target_figure(runs: Sequence[ChildRun], line: AgvTarget) -> Figure:
    """Return this package's figure for a target, over the rounds that have it."""
    ours = figures_by_round(runs, line.mode, OURS, line.figure)
    reference = line.relative_to
    if reference is not None:
        limit = figures_by_round(runs, reference.mode, reference.contender, line.figure)
        ours = {number: ours[number] / limit[number] for number in ours if limit.get(number)}
    return figure_of(ours)


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """What was measured of a target."""

    title: str
    unit: str
    figure: Figure
    target: Target
    every_round: bool = False
    """Whether the worst round is judged instead of the median."""
    known: bool = True
    """False if there was nothing to compare with, which is nobody's failure."""

    @property
    def met(self) -> bool | None:
        """Whether the target was met; None if that is not known."""
        if not self.known:
            return None
        return self.target.met(self.figure.high if self.every_round else self.figure.median)


def verdicts(runs: Sequence[ChildRun]) -> list[Verdict]:
    """Return what was measured of the targets of all workloads that were run."""
    ran = {run.workload for run in runs}
    delivered = {(run.contender, run.workload) for run in runs if run.error is None}

    def known(reference: Reference | None) -> bool:
        return reference is None or (reference.contender, reference.mode) in delivered

    of_motor = [
        Verdict(
            title=f"{MODES[line.mode].title}: {line.title}",
            unit=line.unit,
            figure=target_figure(runs, line),
            target=line.target,
            every_round=line.target.bound == 0.0,
            known=known(line.relative_to),
        )
        for line in TARGETS
        if line.mode in ran
    ]
    of_reactions = [
        Verdict(
            title=measure.title,
            unit=measure.unit,
            figure=harness.summarize(runs, measure, OURS),
            target=measure.target,
            every_round=measure.workload == "watchdog",
        )
        for measure in REACTION_MEASURES
        if measure.workload in ran and measure.target is not None
    ]
    return of_motor + of_reactions


def target_rows(runs: Sequence[ChildRun]) -> list[tuple[str, ...]]:
    """Return the table of targets, header first."""
    words = {True: "met", False: "missed", None: "-"}
    return [
        ("target", "unit", OURS, "bound", "verdict"),
        *(
            (
                verdict.title,
                verdict.unit,
                str(verdict.figure) if verdict.known else "-",
                str(verdict.target),
                words[verdict.met],
            )
            for verdict in verdicts(runs)
        ),
    ]


def _in_us(statistic: harness.Statistic) -> harness.Statistic:
    return lambda run: statistic(run) / 1e3


def excess_ms(key: str, percent: float) -> harness.Statistic:
    """Return the statistic: a percentile of how long after its timeout the system was safe [ms].

    A freeze that nobody reacted to while it lasted counts as an infinite one.
    """

    def statistic(run: Series) -> float:
        reactions = [*run[f"{key}_ns"]]
        reactions += [math.inf] * (int(run[f"{key}_freezes"][0]) - len(reactions))
        return percentile(reactions, percent) / 1e6 - CRITICAL_TIMEOUT_MS

    return statistic


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
            title=f"frozen {words}, safe state after its timeout, {name}",
            unit="ms",
            workload="watchdog",
            statistic=excess_ms(key, percent),
            target=Target(bound=0.1 * CRITICAL_TIMEOUT_MS + 5.0) if name == "worst" else None,
        )
        for key, words in CRITICAL_CLASSES.items()
        for name, percent in (("median", 50.0), ("worst", 100.0))
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
