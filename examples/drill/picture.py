"""Draw the run: a lane for each node with its conditions, and how prompt the reactions were."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib as mpl

mpl.use("Agg")

import matplotlib.pyplot as plt
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from drill.bench import Record, tolerance_s
from drill.observer import Event, Observer
from drill.robot import PARTS
from horus import ms

if TYPE_CHECKING:
    from matplotlib.axes import Axes

INK, MUTED, BAND = "#22303c", "#7b8a97", "#f0f2f5"
CONDITIONS = {
    "healthy": "#cfe6d6",
    "warning": "#f7d154",
    "unhealthy": "#ee8a35",
    "isolated": "#b8243f",
    "safe_state": "#3f78b5",
    "restarting": "#9a84c6",
}
FAULTS = {"does not return": "freeze", "raises": "raise", "takes": "overrun"}
MARKS = {"freeze": "v", "raise": "X", "overrun": "D"}
CLASSES = dict(
    zip(PARTS, ("#22303c", "#b8243f", "#ee8a35", "#2f8f5b", "#3f78b5", "#8a5fb0"), strict=True)
)
LANE = 0.6


def draw(out: Path, observer: Observer, records: list[Record]) -> None:
    """Write the picture of a run as a PNG; without records, of faults by hand."""
    rows = 2 if records else 1
    figure, axes = plt.subplots(
        rows,
        1,
        figsize=(16, 4.8 * rows),
        height_ratios=(1.25, 1)[:rows],
        constrained_layout=True,
        squeeze=False,
    )
    figure.set_facecolor("white")
    _draw_lanes(axes[0][0], observer, records)
    if records:
        _draw_promptness(axes[1][0], records)
    figure.savefig(out, dpi=110)
    plt.close(figure)


def _draw_lanes(axes: Axes, observer: Observer, records: list[Record]) -> None:
    orders = {part.name: part.order for part in PARTS.values()}
    names = sorted(observer.conditions, key=lambda name: orders.get(name, 0))
    end_s = max((event.at_s for event in observer.events), default=observer.began_s + 1.0)
    end_s -= observer.began_s
    for shaded, (kind, group) in zip(
        itertools.cycle((True, False)),
        itertools.groupby(records, key=lambda record: record.kind),
        strict=False,
    ):
        drills = list(group)
        begin_s = drills[0].struck_s - observer.began_s - 0.03
        last_s = drills[-1].events[-1].at_s - observer.began_s + 0.03
        if shaded:
            axes.axvspan(begin_s, last_s, color=BAND, zorder=0)
        axes.text(
            begin_s, -0.72, f" --class {kind}", color=MUTED, fontsize=9.5, fontfamily="monospace"
        )
    for row, name in enumerate(names):
        changes = [(at_s - observer.began_s, what) for at_s, what in observer.conditions[name]]
        for (at_s, what), (until_s, _) in itertools.pairwise([*changes, (end_s, "")]):
            if what in CONDITIONS:
                axes.barh(row, until_s - at_s, LANE, at_s, color=CONDITIONS[what], zorder=2)
    for event in observer.events:
        if event.kind == "fault" and event.node in names:
            axes.plot(
                event.at_s - observer.began_s,
                names.index(event.node) - LANE / 2 - 0.1,
                MARKS[_fault(event)],
                ms=6,
                color=INK,
                mec="white",
                mew=0.5,
                zorder=4,
            )
    axes.set_yticks(range(len(names)), names, color=INK, fontsize=11)
    axes.set(xlim=(0, end_s), ylim=(len(names) - 0.5, -0.95))
    axes.set_xlabel("time [s]", color=MUTED)
    handles = [
        *(Patch(color=color, label=name.replace("_", " ")) for name, color in CONDITIONS.items()),
        *(
            Line2D([], [], marker=mark, ls="", color=INK, label=f"{fault} begins")
            for fault, mark in MARKS.items()
        ),
    ]
    axes.legend(handles=handles, ncols=9, loc="lower left", bbox_to_anchor=(0, 1.0), frameon=False)
    axes.set_title(
        "What the nodes were in while their ticks froze, raised and overran",
        loc="left",
        fontsize=13,
        fontweight="bold",
        color=INK,
        pad=32,
    )
    _plain(axes)


def _draw_promptness(axes: Axes, records: list[Record]) -> None:
    """Draw how long after its instant each reaction came that has an exact one."""
    rows: list[str] = []
    latest_ms = 0.0
    for record in records:
        for check in record.checks:
            if check.due_s is None or check.observed_s is None or "release" in check.expected:
                continue
            if "after next" in check.expected or "hooks" in check.expected:
                continue
            row = f"{check.what} ({check.expected})"
            if row not in rows:
                rows.append(row)
                limit_ms = tolerance_s(check.due_s) / ms
                axes.barh(len(rows) - 1, limit_ms, 0.7, color=BAND, zorder=1)
            late_ms = (check.observed_s - check.due_s) / ms
            latest_ms = max(latest_ms, late_ms)
            kind = list(PARTS).index(record.kind)
            axes.plot(
                late_ms,
                rows.index(row) + 0.09 * (kind - 2.5),
                "o",
                ms=5.5,
                color=CLASSES[record.kind],
                mec="white",
                mew=0.4,
                zorder=3,
            )
    axes.axvline(0, color=MUTED, lw=1, zorder=2)
    axes.set_yticks(range(len(rows)), rows, color=INK)
    axes.set_xlim(right=max(10.0, 1.2 * latest_ms))
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.set_xlabel("later than expected [ms]; grey: within 10 % + 5 ms", color=MUTED)
    kinds = dict.fromkeys(record.kind for record in records)
    handles = [Line2D([], [], marker="o", ls="", color=CLASSES[kind], label=kind) for kind in kinds]
    axes.legend(handles=handles, loc="lower right", frameon=False)
    axes.set_title(
        "How prompt the reactions were", loc="left", fontsize=13, fontweight="bold", color=INK
    )
    _plain(axes)


def _fault(event: Event) -> str:
    return next(fault for words, fault in FAULTS.items() if words in event.text)


def _plain(axes: Axes) -> None:
    axes.tick_params(color=MUTED, labelcolor=MUTED, axis="x")
    axes.tick_params(length=0, axis="y")
    for side in axes.spines.values():
        side.set_visible(False)
