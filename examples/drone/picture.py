"""Draw the flight: the square from above, and height, error and thrusts in time."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import matplotlib as mpl

mpl.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.patches import Circle

from drone import airframe, world
from drone.course import CORNERS_M, SIDE_M, SIDES
from drone.flight_log import FAILSAFE, STALLED

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.axes import Axes

    from drone.flight_log import FlightLog, Outcome
    from drone.world import World

INK, MUTED, PAPER, BAND = "#22303c", "#7b8a97", "#f6f5f1", "#eef1f4"
COMMANDED, FLOWN, TROUBLE, GOOD, WIND = "#8a97a3", "#1f6fb2", "#d1343b", "#2f8f5b", "#5b9bb5"
THRUSTS = ("#1f6fb2", "#e08a1e", "#2f8f5b", "#7a4fa3")
GLYPH_EVERY_M = 1.0
PROPELLER_M = 0.1
MARGIN_M = 1.0


def draw(out: Path, flown: World, log: FlightLog, outcome: Outcome) -> None:
    """Write the picture of a flight as a PNG.

    Args:
        out: the file to write.
        flown: for what the physics engine recorded.
        log: for what the nodes did.
        outcome: the judgement, for the commanded path and the title.
    """
    track = np.array(flown.record.track).reshape(-1, 10)
    figure, axes = plt.subplot_mosaic(
        [["map", "height"], ["map", "error"], ["map", "thrust"]],
        figsize=(16, 9),
        width_ratios=(1.15, 1),
        constrained_layout=True,
    )
    figure.set_facecolor("white")
    _draw_map(axes["map"], track, outcome)
    _draw_height(axes["height"], track, outcome)
    _draw_error(axes["error"], outcome)
    _draw_thrust(axes["thrust"], track)
    for name in ("height", "error", "thrust"):
        _draw_legs(axes[name], outcome, named=name == "height")
        _draw_events(axes[name], log, named=name == "height")
        axes[name].set_xlim(0, float(track[-1, 0]))
        axes[name].tick_params(labelbottom=name == "thrust")
    axes["thrust"].set_xlabel("time [s]", color=MUTED)
    figure.suptitle(_title(outcome), x=0.012, ha="left", fontsize=14, color=INK, fontweight="bold")
    figure.savefig(out, dpi=110, bbox_inches="tight", pad_inches=0.2)
    plt.close(figure)


def _title(outcome: Outcome) -> str:
    title = f"Quadrotor: {'flew' if outcome.square_flown else 'did not fly'} its square"
    if math.isfinite(outcome.rms_m):
        title += (
            f"   |   off its reference by {100 * outcome.rms_m:.1f} cm RMS, "
            f"{100 * outcome.max_m:.1f} cm at most"
        )
    if outcome.failsafe:
        title += "   |   brought down by the ESC"
    return title


def _draw_map(axes: Axes, track: np.ndarray, outcome: Outcome) -> None:
    reach = (
        min(-MARGIN_M, float(track[:, 1:3].min()) - 0.3),
        max(SIDE_M + MARGIN_M, float(track[:, 1:3].max()) + 0.3),
    )
    axes.set(xlim=reach, ylim=reach, aspect="equal", facecolor=PAPER)
    axes.grid(color="white", lw=1.5)
    axes.set_axisbelow(True)
    axes.add_patch(Circle(CORNERS_M[0][:2], 0.36, fc="none", ec=GOOD, lw=2.5, zorder=1))
    axes.annotate(
        "takeoff and landing", CORNERS_M[0][:2], (0, -42), textcoords="offset points",
        ha="center", color=GOOD, fontweight="bold",
    )  # fmt: skip
    commanded = outcome.tracking.commanded_m
    axes.plot(
        commanded[:, 0], commanded[:, 1], "--", color=COMMANDED, lw=2, zorder=2, label="commanded"
    )
    _draw_path(axes, track)
    for x, y, _ in CORNERS_M:
        axes.plot(x, y, "s", ms=9, mfc="white", mec=INK, mew=1.8, zorder=4)
    _draw_drones(axes, track)
    _draw_wind(axes)
    axes.set_xlabel("x [m]", color=MUTED)
    axes.set_ylabel("y [m]", color=MUTED)
    axes.legend(loc="upper left", frameon=False, fontsize=10)
    _plain(axes)


def _draw_path(axes: Axes, track: np.ndarray) -> None:
    points = track[:, 1:3]
    path = LineCollection(
        list(np.stack((points[:-1], points[1:]), axis=1)),
        cmap="viridis",
        linewidths=4,
        capstyle="round",
        zorder=3,
    )
    path.set_array(track[:-1, 4])
    axes.add_collection(path)
    place = axes.inset_axes((0.45, 0.075, 0.48, 0.018))
    bar = axes.figure.colorbar(path, cax=place, orientation="horizontal")
    bar.set_label("speed on the flown path [m/s]", color=MUTED)
    bar.outline.set_visible(False)
    bar.ax.tick_params(color=MUTED, labelcolor=MUTED)


def _draw_drones(axes: Axes, track: np.ndarray) -> None:
    """Draw the drone along its way, and where it stands in the end."""
    last = track[0]
    for row in track:
        if math.dist(row[1:3], last[1:3]) >= GLYPH_EVERY_M:
            last = row
            _draw_drone(axes, *row[1:3], alpha=0.4)
    _draw_drone(axes, *track[-1, 1:3], alpha=1.0)


def _draw_drone(axes: Axes, x: float, y: float, *, alpha: float) -> None:
    for rotor in airframe.ROTORS:
        arm_x, arm_y = rotor.x_sign * airframe.ARM_M, rotor.y_sign * airframe.ARM_M
        axes.plot((x, x + arm_x), (y, y + arm_y), color=INK, lw=1.4, alpha=alpha, zorder=5)
        axes.add_patch(
            Circle((x + arm_x, y + arm_y), PROPELLER_M, fc="none", ec=INK, lw=1.2, alpha=alpha,
                   zorder=5)
        )  # fmt: skip


def _draw_wind(axes: Axes) -> None:
    x, y = SIDE_M / 2 - 0.5, SIDE_M / 2 - 0.2
    speed = math.hypot(*world.BREEZE_MPS)
    length = 1.0 / speed
    axes.annotate(
        "",
        (x + length * world.BREEZE_MPS[0], y + length * world.BREEZE_MPS[1]),
        (x, y),
        arrowprops={"arrowstyle": "-|>", "color": WIND, "lw": 3, "mutation_scale": 24},
    )
    axes.text(
        x + 0.5, y - 0.25,
        f"wind {speed:.1f} m/s, one gust of {speed + world.GUST_MPS:.1f} m/s",
        ha="center", va="top", color=WIND, fontsize=10,
    )  # fmt: skip


def _draw_height(axes: Axes, track: np.ndarray, outcome: Outcome) -> None:
    tracking = outcome.tracking
    axes.plot(track[:, 0], track[:, 3], color=FLOWN, lw=2.2, label="flown")
    axes.plot(
        tracking.time_s, tracking.commanded_m[:, 2], "--", color=INK, lw=1.2, label="commanded"
    )
    axes.set_ylim(0, 1.25 * float(track[:, 3].max(initial=1.0)))
    axes.set_title("height [m]", loc="left", fontsize=11, color=INK)
    axes.legend(loc="lower center", ncols=2, frameon=False, fontsize=9)
    _plain(axes)


def _draw_error(axes: Axes, outcome: Outcome) -> None:
    tracking = outcome.tracking
    axes.fill_between(tracking.time_s, 100 * tracking.error_m, color=TROUBLE, alpha=0.15, lw=0)
    axes.plot(tracking.time_s, 100 * tracking.error_m, color=TROUBLE, lw=1.6)
    if math.isfinite(outcome.rms_m):
        axes.axhline(100 * outcome.rms_m, color=INK, lw=1.2, ls="--")
        axes.text(
            0.995, 100 * outcome.rms_m, f"RMS {100 * outcome.rms_m:.1f} cm", va="bottom",
            ha="right", color=INK, fontsize=9, transform=axes.get_yaxis_transform(),
        )  # fmt: skip
    axes.set_ylim(bottom=0)
    axes.set_title("tracking error: from where it should be now [cm]", loc="left", fontsize=11,
                   color=INK)  # fmt: skip
    _plain(axes)


def _draw_thrust(axes: Axes, track: np.ndarray) -> None:
    for rotor, color, thrust_n in zip(airframe.ROTORS, THRUSTS, track[:, 6:10].T, strict=True):
        label = rotor.name.replace("_", " ")
        axes.plot(track[:, 0], thrust_n, color=color, lw=1.2, alpha=0.85, label=label)
    axes.axhline(airframe.HOVER_THRUST_N, color=INK, lw=1, ls=":")
    axes.set_ylim(0, 1.35 * max(airframe.HOVER_THRUST_N, float(track[:, 6:10].max())))
    axes.set_title("thrust of each rotor [N]; dotted: hovering", loc="left", fontsize=11, color=INK)
    axes.legend(loc="upper center", ncols=4, frameon=False, fontsize=9)
    _plain(axes)


def _draw_legs(axes: Axes, outcome: Outcome, *, named: bool) -> None:
    """Shade every other leg."""
    tracking = outcome.tracking
    for index, name in enumerate(dict.fromkeys(tracking.leg.tolist())):
        times_s = tracking.time_s[tracking.leg == name]
        begin_s, end_s = float(times_s[0]), float(times_s[-1])
        if index % 2 == 0:
            axes.axvspan(begin_s, end_s, color=BAND, lw=0, zorder=0)
        if named:
            axes.text(
                (begin_s + end_s) / 2, 0.96, name, ha="center", va="top", fontsize=9,
                color=GOOD if name in SIDES else MUTED, transform=axes.get_xaxis_transform(),
            )  # fmt: skip
    begin_s, end_s = world.GUST_BEGIN_S, world.GUST_BEGIN_S + world.GUST_LENGTH_S
    if float(tracking.time_s.max(initial=0.0)) > begin_s and not named:
        axes.axvspan(begin_s, end_s, ymax=0.035, color=WIND, lw=0)
        axes.text(
            end_s, 0.015, " gust", color=WIND, fontsize=9, transform=axes.get_xaxis_transform()
        )


def _draw_events(axes: Axes, log: FlightLog, *, named: bool) -> None:
    for what in (STALLED, FAILSAFE):
        for event in log.find(what):
            axes.axvline(event.at_s, color=TROUBLE, lw=1.4, ls=":")
            if named:
                axes.text(
                    event.at_s, 0.5, f"{what} ", rotation=90, va="center", ha="right", fontsize=9,
                    color=TROUBLE, transform=axes.get_xaxis_transform(),
                )  # fmt: skip


def _plain(axes: Axes) -> None:
    axes.tick_params(color=MUTED, labelcolor=MUTED)
    for side in axes.spines.values():
        side.set_visible(False)
