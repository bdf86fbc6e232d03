"""The AGV without a scheduler: what people write at first, in its two usual forms.

Both keep absolute deadlines, so that they do not drift, and run every tick that they owe: after a
delay they catch up in a burst.
"""

from __future__ import annotations

import asyncio
import functools
import threading
import time
from typing import TYPE_CHECKING, Any

from scenario import (
    MARGIN_S,
    RATES_HZ,
    WARMUP_S,
    Mode,
    PlainNode,
    Recorder,
    make_motor,
    make_ticks,
    now_ns,
)

if TYPE_CHECKING:
    from collections import deque

    from scenario import Tick

HEAD_START_NS = 100_000_000
"""Time to get everything started before the first release, which is the same for all [ns]."""


class Plan:
    """The nodes, their functions and the instants between which they run."""

    def __init__(self, mode: Mode, seconds: float, *, awaits: bool) -> None:
        """Prepare a drive of the warm-up and ``seconds`` [s]."""
        total_s = WARMUP_S + seconds + MARGIN_S
        bus: dict[str, list[deque[Any]]] = {}
        self.nodes = {name: PlainNode(name, bus) for name in RATES_HZ}
        self.recorder = Recorder(total_s)
        motor_node = self.nodes["motor"]
        motor = make_motor(self.recorder, lambda: motor_node.release_ns)
        self.ticks = make_ticks(mode, self.recorder, motor, awaits=awaits)
        self.epoch_ns = now_ns() + HEAD_START_NS
        self.end_ns = self.epoch_ns + int(total_s * 1e9)


def run_thread(node: PlainNode, tick: Tick, epoch_ns: int, end_ns: int) -> None:
    """Tick a node at its rate from ``epoch_ns`` to ``end_ns``."""
    period_ns = round(1e9 / RATES_HZ[node.name])
    for release_ns in range(epoch_ns, end_ns, period_ns):
        delay_ns = release_ns - now_ns()
        if delay_ns > 0:
            time.sleep(delay_ns / 1e9)
        node.release_ns = release_ns
        tick(node)


def run_threads(mode: Mode, seconds: float) -> tuple[dict[str, str], dict[str, list[int]]]:
    """Drive with a thread per node; return extra facts and the raw series."""
    plan = Plan(mode, seconds, awaits=False)
    threads = [
        threading.Thread(
            target=run_thread, args=(node, plan.ticks[name], plan.epoch_ns, plan.end_ns)
        )
        for name, node in plan.nodes.items()
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return {}, plan.recorder.series(releases=True)


async def run_task(node: PlainNode, tick: Tick, epoch_ns: int, end_ns: int) -> None:
    """Tick a node at its rate, letting others have their turn before each tick."""
    period_ns = round(1e9 / RATES_HZ[node.name])
    for release_ns in range(epoch_ns, end_ns, period_ns):
        await asyncio.sleep(max(0, release_ns - now_ns()) / 1e9)
        node.release_ns = release_ns
        result = tick(node)
        if result is not None:
            await result


async def run_tasks(plan: Plan) -> None:
    """Drive with a task per node, the planner's ticks on a worker thread."""
    ticks = {**plan.ticks, "planner": functools.partial(asyncio.to_thread, plan.ticks["planner"])}
    await asyncio.gather(
        *(
            run_task(node, ticks[name], plan.epoch_ns, plan.end_ns)
            for name, node in plan.nodes.items()
        )
    )


def run_uvloop(mode: Mode, seconds: float) -> tuple[dict[str, str], dict[str, list[int]]]:
    """Drive with a task per node on uvloop; return extra facts and the raw series."""
    import uvloop

    plan = Plan(mode, seconds, awaits=True)
    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        runner.run(run_tasks(plan))
    return {}, plan.recorder.series(releases=True)
