"""Draw the run: the map with everything that happened on it, and speed and clearance in time."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import matplotlib as mpl

mpl.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.patches import FancyBboxPatch, Polygon, Rectangle

from agv import layout, mission
from agv.grid import CELL_M
from agv.planner import CRUISE_MPS

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.axes import Axes

    from agv.grid import OccupancyGrid
    from agv.world import World

INK, MUTED, PAPER = "#22303c", "#7b8a97", "#f4f2ee"
RACK, RACK_EDGE, PALLET, CARTON = "#d9c7a8", "#a58c62", "#4c78a8", "#b07d48"
PLAN, REPLAN, STOP, GOOD = "#7b8a97", "#7a4fa3", "#d1343b", "#2f8f5b"


def draw(
    out: Path,
    world: World,
    grid: OccupancyGrid,
    log: mission.MissionLog,
    outcome: mission.Outcome,
) -> None:
    """Write the picture of a run as a PNG.

    Args:
        out: the file to write.
        world: for what the physics engine recorded.
        grid: for what the sensors saw.
        log: for what the nodes did.
        outcome: the judgement, for the title.
    """
    track = np.array(world.record.track).reshape(-1, 6)
    figure, (floor, timeline) = plt.subplots(
        2, 1, figsize=(13, 11), height_ratios=(4.4, 1), constrained_layout=True
    )
    figure.set_facecolor("white")
    _draw_building(floor)
    _draw_goods(floor, grid, dropped=world.record.dropped_at_s is not None)
    _draw_plans(floor, log)
    _draw_track(floor, track)
    _draw_marks(floor, log)
    _draw_timeline(timeline, track, log)
    title = f"Warehouse AGV: {'reached' if outcome.goal_reached else 'did not reach'} its goal"
    if outcome.emergency_stops and math.isfinite(outcome.stop_distance_m):
        title += (
            f"   |   stopped in {outcome.stop_distance_m:.2f} m, "
            f"never closer than {outcome.min_clearance_m:.2f} m to the pallet"
        )
    floor.set_title(
        title,
        loc="left",
        fontsize=13,
        color=INK,
        fontweight="bold",
        pad=12,
    )
    figure.savefig(out, dpi=110, bbox_inches="tight", pad_inches=0.2)
    plt.close(figure)


def _draw_building(axes: Axes) -> None:
    floor = layout.FLOOR
    axes.add_patch(Rectangle((0, 0), floor.x_max, floor.y_max, fc=PAPER, ec=INK, lw=3, zorder=0))
    for rack in layout.RACKS:
        width, depth = rack.x_max - rack.x_min, rack.y_max - rack.y_min
        axes.add_patch(
            Rectangle((rack.x_min, rack.y_min), width, depth, fc=RACK, ec=RACK_EDGE, lw=1.5)
        )
        for bay in np.arange(rack.x_min + 0.8, rack.x_max - 0.1, 0.8):
            axes.plot((bay, bay), (rack.y_min, rack.y_max), color=RACK_EDGE, lw=0.8, alpha=0.7)
        middle = rack.center[1]
        axes.plot((rack.x_min, rack.x_max), (middle, middle), color=RACK_EDGE, lw=0.8, alpha=0.7)
    axes.set(xlim=(-0.3, floor.x_max + 0.3), ylim=(-0.3, floor.y_max + 0.3), aspect="equal")
    axes.set_xlabel("x [m]", color=MUTED)
    axes.set_ylabel("y [m]", color=MUTED)
    _plain(axes)


def _draw_goods(axes: Axes, grid: OccupancyGrid, *, dropped: bool) -> None:
    goods = [("carton: camera only", layout.CARTON_AT, layout.CARTON_HALF_M, CARTON)]
    if dropped:
        goods.append(("pallet", layout.DROP_AT, layout.PALLET_HALF_M, PALLET))
    for name, (x, y), (half_x, half_y), color in goods:
        axes.add_patch(
            FancyBboxPatch(
                (x - half_x, y - half_y),
                2 * half_x,
                2 * half_y,
                boxstyle="round,pad=0,rounding_size=0.05",
                fc=color,
                ec=INK,
                lw=1.2,
                alpha=0.85,
                zorder=3,
            )
        )
        inside = half_x > 0.3
        axes.text(
            *((x, y) if inside else (x + half_x + 0.12, y + 0.18)),
            name,
            ha="center" if inside else "left",
            va="center",
            fontsize=9,
            color="white" if inside else INK,
            zorder=6,
        )
    rows, columns = np.nonzero(grid.seen())
    axes.scatter(
        (columns + 0.5) * CELL_M,
        (rows + 0.5) * CELL_M,
        s=5,
        marker="s",
        color=STOP,
        linewidths=0,
        zorder=4,
        label="seen, not on the map",
    )


def _draw_plans(axes: Axes, log: mission.MissionLog) -> None:
    if not log.plans:
        return
    first = log.plans[0][1]
    axes.plot(first[:, 0], first[:, 1], "--", color=PLAN, lw=1.8, zorder=2, label="first plan")
    released = log.find(mission.RELEASED)
    later = [path for at_s, path in log.plans if released and at_s >= released[0].at_s]
    if later:
        axes.plot(
            later[0][:, 0],
            later[0][:, 1],
            "--",
            color=REPLAN,
            lw=1.8,
            zorder=2,
            label="plan after the stop",
        )


def _draw_track(axes: Axes, track: np.ndarray) -> None:
    if len(track) < 2:
        return
    points = track[::4, 1:3]
    lines = LineCollection(
        list(np.stack((points[:-1], points[1:]), axis=1)),
        cmap="viridis",
        norm=Normalize(0.0, CRUISE_MPS),
        linewidths=4,
        capstyle="round",
        zorder=5,
    )
    lines.set_array(track[::4, 4][:-1])
    axes.add_collection(lines)
    bar = axes.figure.colorbar(lines, ax=axes, pad=0.01, shrink=0.6, aspect=30)
    bar.set_label("speed on the driven path [m/s]", color=MUTED)
    bar.outline.set_visible(False)
    bar.ax.tick_params(color=MUTED, labelcolor=MUTED)
    # The vehicle's outline, once a second of the way.
    for _, x, y, yaw, _, _ in track[::100]:
        axes.add_patch(_outline(x, y, yaw, alpha=0.35))
    axes.add_patch(_outline(*track[-1, 1:4], alpha=1.0))


def _outline(x: float, y: float, yaw: float, *, alpha: float) -> Polygon:
    length, width = layout.CHASSIS_HALF_LENGTH_M, layout.CHASSIS_HALF_WIDTH_M
    corners = np.array(
        ((-length, -width), (0.7 * length, -width), (length, 0), (0.7 * length, width))
    )
    corners = np.vstack((corners, (-length, width)))
    cos, sin = math.cos(yaw), math.sin(yaw)
    turned = corners @ np.array(((cos, sin), (-sin, cos))) + (x, y)
    return Polygon(turned, closed=True, fc="none", ec=INK, lw=1.1, alpha=alpha, zorder=6)


def _draw_marks(axes: Axes, log: mission.MissionLog) -> None:
    for (x, y), name, color, offset in (
        (layout.START, "start", INK, (0, -42)),
        (layout.GOAL, "goal", GOOD, (42, -4)),
    ):
        axes.plot(x, y, "o", ms=13, mfc="white", mec=color, mew=3, zorder=7)
        axes.annotate(
            name,
            (x, y),
            offset,
            textcoords="offset points",
            ha="center",
            color=color,
            fontweight="bold",
            zorder=8,
        )
    for event in log.find(mission.EMERGENCY_STOP):
        if event.place is None:
            continue
        axes.plot(*event.place, "X", ms=13, mfc=STOP, mec="white", mew=1.5, zorder=9)
        axes.annotate(
            f"emergency.stop at {event.at_s:.2f} s\n{event.detail}",
            event.place,
            (-30, -62),
            textcoords="offset points",
            ha="center",
            color=STOP,
            fontsize=9.5,
            arrowprops={"arrowstyle": "-", "color": STOP, "lw": 1},
            bbox={"fc": "white", "ec": STOP, "boxstyle": "round,pad=0.35", "alpha": 0.95},
            zorder=9,
        )
    axes.legend(loc="upper left", bbox_to_anchor=(0.02, 0.93), frameon=False, fontsize=9)


def _draw_timeline(axes: Axes, track: np.ndarray, log: mission.MissionLog) -> None:
    time_s, speed_mps, clearance_m = track[:, 0], track[:, 4], track[:, 5]
    axes.fill_between(time_s, speed_mps, color=GOOD, alpha=0.15, lw=0)
    axes.plot(time_s, speed_mps, color=GOOD, lw=1.8, label="speed [m/s]")
    axes.plot(time_s, clearance_m, color=PALLET, lw=1.8, label="clearance to the pallet [m]")
    top = 2.4
    for what, color in (
        (mission.EMERGENCY_STOP, STOP),
        (mission.STANDING, INK),
        (mission.RELEASED, REPLAN),
        (mission.ARRIVED, GOOD),
    ):
        for event in log.find(what):
            axes.axvline(event.at_s, color=color, lw=1.2, ls=":")
            axes.text(
                event.at_s, top, f" {what}", rotation=90, va="top", ha="right", fontsize=8,
                color=color,
            )  # fmt: skip
    axes.set(ylim=(0, top), xlim=(0, float(time_s[-1]) if len(time_s) else 1.0))
    axes.set_xlabel("time [s]", color=MUTED)
    axes.legend(loc="upper left", frameon=False, fontsize=9)
    _plain(axes)


def _plain(axes: Axes) -> None:
    axes.tick_params(color=MUTED, labelcolor=MUTED)
    for side in axes.spines.values():
        side.set_visible(False)
