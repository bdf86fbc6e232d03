"""The AGV on whatever ``horus`` the interpreter imports: this package, or horus-robotics.

As the contract has it, with two exceptions. Nothing ends the run: ``on_miss`` is ``"warn"``, and
there is neither a watchdog nor a limit of deadline misses, since a machine that other programs
disturb misses deadlines. And the motor is pinned to core 2 only where there is one.
"""

from __future__ import annotations

import importlib
import os
from typing import TYPE_CHECKING, Any

from scenario import MARGIN_S, WARMUP_S, Mode, Recorder, make_motor, make_ticks

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from scenario import Tick

MOTOR_CORE = 2


def release_teller() -> Callable[[], int] | None:
    """Return what tells the release of the tick that asks [ns]; None if the package has none."""
    try:
        current = importlib.import_module("horus.clock").current
    except ImportError:
        return None
    return lambda: current.get().release_ns


def make_nodes(horus: Any, mode: Mode, ticks: Mapping[str, Tick]) -> list[Any]:
    """Return the contract's seven nodes."""
    node, us = horus.Node, horus.us
    pinned = {"core": MOTOR_CORE} if (os.cpu_count() or 1) > MOTOR_CORE else {}
    urgent = {"rate": 1000, "on_miss": "warn"}
    return [
        node(name="safety", tick=ticks["safety"], order=0, budget=100 * us, deadline=200 * us,
             subs=["scan"], pubs=["emergency.stop"], **urgent),
        node(name="lidar", tick=ticks["lidar"], rate=40, order=10, pubs=["scan"]),
        node(name="planner", tick=ticks["planner"], rate=10, order=50, compute=mode.compute,
             subs=["scan"], pubs=["path"]),
        node(name="tracker", tick=ticks["tracker"], rate=100, order=60,
             subs=["path"], pubs=["cmd_vel"]),
        node(name="motor", tick=ticks["motor"], order=70, budget=300 * us, deadline=900 * us,
             subs=["cmd_vel"], **urgent, **pinned),
        node(name="battery", tick=ticks["battery"], rate=1, order=100),
        node(name="fleet", tick=ticks["fleet"], rate=1, order=200, failure_policy="skip",
             subs=["battery"], pubs=["fleet.telemetry"]),
    ]  # fmt: skip


def in_words(degradation: Any) -> str:
    """Return what was refused; horus-robotics tells it as a dictionary."""
    if isinstance(degradation, dict):
        return f"{degradation.get('feature')} ({degradation.get('reason')})"
    return str(degradation)


def run(mode: Mode, seconds: float) -> tuple[dict[str, str], dict[str, list[int]]]:
    """Drive for the warm-up and ``seconds`` [s]; return extra facts and the raw series."""
    horus = importlib.import_module("horus")
    total_s = WARMUP_S + seconds + MARGIN_S
    recorder = Recorder(total_s)
    release_of = release_teller()
    ticks = make_ticks(mode, recorder, make_motor(recorder, release_of), awaits=True)
    scheduler = horus.Scheduler(tick_rate=1000, rt=True)
    for node in make_nodes(horus, mode, ticks):
        scheduler.add(node)
    scheduler.run(duration=total_s)
    refused = "; ".join(map(in_words, scheduler.degradations())) or "nothing"
    return {"refused by the system": refused}, recorder.series(releases=release_of is not None)
