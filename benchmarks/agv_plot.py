"""Draw the start latencies of the AGV's motor: a row per contender, a column per mode."""

from __future__ import annotations

import bisect
import math
from typing import TYPE_CHECKING

from matplotlib.figure import Figure

from benchmarks.agv_report import (
    TARGETS,
    figure_of,
    figures_by_round,
    window_latencies_us,
)
from benchmarks.agv_workloads.scenario import MODES
from benchmarks.harness import OURS, format_number, percentile

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from matplotlib.axes import Axes

    from benchmarks.harness import ChildRun

LOWEST_US, HIGHEST_US, BINS_PER_DECADE = 1.0, 100_000.0, 12
OURS_COLOUR, OTHER_COLOUR, TARGET_COLOUR = "#0b5fa5", "#555555", "#b2182b"
ROW_INCHES, COLUMN_INCHES = 1.15, 5.2


def bin_edges_us() -> list[float]:
    """Return edges that are equally far apart on a logarithmic axis [µs]."""
    decades = math.log10(HIGHEST_US / LOWEST_US)
    count = round(decades * BINS_PER_DECADE)
    return [LOWEST_US * 10 ** (index / BINS_PER_DECADE) for index in range(count + 1)]


def shares_percent(latencies_us: Sequence[float], edges_us: Sequence[float]) -> list[float]:
    """Return which share of all ticks is in each bin [%].

    Latencies below or above the axis, such as those of ticks that came early, are in no bin, and
    still count as ticks.
    """
    counts = [0] * (len(edges_us) - 1)
    for latency in latencies_us:
        index = bisect.bisect_right(edges_us, latency) - 1
        if 0 <= index < len(counts):
            counts[index] += 1
    return [100.0 * count / len(latencies_us) for count in counts]


def latencies_of(runs: Sequence[ChildRun], mode: str, contender: str) -> list[float]:
    """Return the start latencies of all rounds [µs]; none if the contender does not tell them."""
    return [
        latency
        for run in runs
        if (run.workload, run.contender) == (mode, contender) and run.error is None
        for latency in window_latencies_us(run.series)
    ]


def target_us(runs: Sequence[ChildRun], mode: str) -> tuple[float, str] | None:
    """Return the bound for this package's 99th percentile [µs] and what to call it."""
    for line in TARGETS:
        if (line.mode, line.figure) != (mode, "latency_p99_us"):
            continue
        reference = line.relative_to
        if reference is None:
            return line.target.bound, f"p99 target {line.target.bound:g} µs"
        limits = figures_by_round(runs, reference.mode, reference.contender, line.figure)
        if limits:
            bound = line.target.bound * figure_of(limits).median
            factor = f"{line.target.bound:g} x {reference.whose}"
            return bound, f"p99 target {factor}: {format_number(bound)} µs"
    return None


def draw_row(axes: Axes, latencies_us: Sequence[float], label: str) -> None:
    """Draw one histogram with its name and its 99th percentile."""
    colour = OURS_COLOUR if label == OURS else OTHER_COLOUR
    edges = bin_edges_us()
    shares = shares_percent(latencies_us, edges)
    axes.stairs(shares, edges, color=colour, linewidth=1.2, baseline=None)
    p99 = percentile(latencies_us, 99.0)
    early = sum(latency < 0.0 for latency in latencies_us) / len(latencies_us)
    about = f"{label}\np99 {format_number(p99)} µs"
    if early >= 0.001:
        about += f"\n{100 * early:.1f} % early"
    axes.text(
        0.99,
        0.97,
        about,
        color=colour,
        transform=axes.transAxes,
        ha="right",
        va="top",
        size="small",
    )
    axes.plot(
        [p99], [0.0], marker=6, color=colour, transform=axes.get_xaxis_transform(), clip_on=False
    )


def draw_absence(axes: Axes) -> None:
    """Say that this contender did not run in this mode."""
    axes.text(
        0.5, 0.5, "not run", color=OTHER_COLOUR, transform=axes.transAxes, ha="center", size="small"
    )
    axes.spines["left"].set_visible(False)
    axes.tick_params(which="both", left=False)


def draw_target(column: Sequence[Axes], target: tuple[float, str]) -> None:
    """Mark a bound in all rows of a column and name it above the first."""
    bound_us, name = target
    for axes in column:
        axes.axvline(bound_us, color=TARGET_COLOUR, linewidth=0.9, linestyle=(0, (4, 3)))
    column[0].text(
        bound_us,
        1.02,
        name,
        color=TARGET_COLOUR,
        transform=column[0].get_xaxis_transform(),
        ha="center",
        va="bottom",
        fontsize="small",
    )


def style(axes: Axes, smallest_percent: float) -> None:
    """Make both axes logarithmic and take away what carries no information."""
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlim(LOWEST_US, HIGHEST_US)
    axes.set_ylim(smallest_percent / 2, 100.0)
    axes.yaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(which="minor", length=0)


def draw(runs: Sequence[ChildRun], path: Path) -> None:
    """Write a picture of the latencies of every contender that tells them."""
    modes = [mode for mode in MODES if any(run.workload == mode for run in runs)]
    ran = dict.fromkeys(run.contender for run in runs if run.workload in modes and not run.error)
    labels = [label for label in ran if any(latencies_of(runs, mode, label) for mode in modes)]
    silent = [label for label in ran if label not in labels]
    if not labels:
        return
    size = (COLUMN_INCHES * len(modes), ROW_INCHES * len(labels) + 1.2)
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(len(labels), len(modes), sharex=True, sharey=True, squeeze=False)
    ticks = max(len(latencies_of(runs, mode, label)) for mode in modes for label in labels)
    for number, mode in enumerate(modes):
        for row, label in enumerate(labels):
            style(grid[row][number], 100.0 / ticks)
            latencies = latencies_of(runs, mode, label)
            if latencies:
                draw_row(grid[row][number], latencies, label)
            else:
                draw_absence(grid[row][number])
        target = target_us(runs, mode)
        if target is not None:
            rows = [
                row[number]
                for row, label in zip(grid, labels, strict=True)
                if latencies_of(runs, mode, label)
            ]
            draw_target(rows, target)
        grid[0][number].set_title(MODES[mode].title, loc="left", pad=18.0)
        grid[-1][number].set_xlabel("start latency of the 1 kHz motor [µs]")
    figure.supylabel("ticks per bin [%]", fontsize="medium")
    # Nobody should look in vain for a contender that the tables have.
    if silent:
        figure.supxlabel(f"do not tell when a tick was due: {', '.join(silent)}", fontsize="small")
    figure.savefig(path, dpi=150)
