"""What telemetry costs: the CPU time of a scheduler with 100 nodes, without it and with it.

The snapshots go to another process on this machine, which is not counted. They tell quantiles of
the durations that the nodes have seen, and what those cost depends on how many different ones there
are: hence one measurement with the counters of a program that has just begun, and one with those of
a program that has run for 15 minutes.
"""

from __future__ import annotations

import contextlib
import random
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from sink import HOST

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from sizes import Series, Size

SINK = Path(__file__).resolve().with_name("sink.py")
NODES, RATE_HZ = 100, 10.0
MARGIN_S = 0.3
EXECUTION_NS, EXECUTION_SPREAD_NS, LATENCY_NS = 50_000.0, 10_000.0, 12_000.0
"""Of the ticks that aged counters have seen [ns]: mean and standard deviation of execution times,
which are normally distributed, and mean of latencies, which are exponentially so. A node has seen
286 different latencies then, in the resolution of its counters, and 241 execution times. Nodes like
those here, which do nothing, were found to have seen 273 and 27 after 12 minutes.
"""


class Variant(NamedTuple):
    """What is measured: whether there is telemetry, and how old the counters are."""

    sends: bool
    aged: bool


VARIANTS: Mapping[str, Variant] = {
    "off": Variant(sends=False, aged=False),
    "young": Variant(sends=True, aged=False),
    "aged": Variant(sends=True, aged=True),
}


@contextlib.contextmanager
def sink() -> Iterator[tuple[int, list[int]]]:
    """Run the process that telemetry goes to in the block.

    Yields its port, and a list that has the number of snapshots that came, after the block.
    """
    received: list[int] = []
    with subprocess.Popen(
        [sys.executable, "-P", str(SINK)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        port = int(process.stdout.readline())
        yield port, received
        answer, _ = process.communicate()
        received.append(int(answer))


def make_scheduler(horus: Any, size: Size, variant: Variant, port: int) -> Any:
    """Return a scheduler of nodes that do nothing."""

    def nothing(_node: Any) -> None:
        """Do nothing."""

    telemetry = {"telemetry": f"http://{HOST}:{port}/telemetry"} if variant.sends else {}
    scheduler = horus.Scheduler(tick_rate=1000.0, **telemetry)
    for index in range(NODES):
        scheduler.add(horus.Node(name=f"n{index}", tick=nothing, rate=RATE_HZ, order=index))
    if variant.aged:
        age(scheduler, size.aged_ticks)
    return scheduler


def age(scheduler: Any, ticks: int) -> None:
    """Fill the counters as so many ticks of each node would."""
    dice = random.Random(0)
    durations = [
        (
            max(0, int(dice.gauss(EXECUTION_NS, EXECUTION_SPREAD_NS))),
            int(dice.expovariate(1.0 / LATENCY_NS)),
        )
        for _ in range(ticks)
    ]
    # There is no public way to have run for hours.
    for live in scheduler._registry.in_order:
        add = live.counters.times.add
        for execution_ns, latency_ns in durations:
            add(execution_ns, latency_ns)


def cpu_percent_of(scheduler: Any, size: Size) -> float:
    """Run a scheduler and return the CPU time of the process in a window [% of a core]."""
    marks: list[tuple[int, int]] = []

    def sample() -> None:
        for wait_s in (size.telemetry_settle_s, size.telemetry_window_s):
            time.sleep(wait_s)
            marks.append((time.monotonic_ns(), time.process_time_ns()))

    sampler = threading.Thread(target=sample, daemon=True)
    sampler.start()
    scheduler.run(duration=size.telemetry_settle_s + size.telemetry_window_s + MARGIN_S)
    sampler.join()
    (opened_ns, cpu_before_ns), (closed_ns, cpu_after_ns) = marks
    return 100.0 * (cpu_after_ns - cpu_before_ns) / (closed_ns - opened_ns)


def telemetry(horus: Any, size: Size, _seconds: float) -> Series:
    """Measure the variants in turn."""
    series: Series = {f"{name}_cpu_percent": [] for name in VARIANTS}
    sending = 0
    with sink() as (port, received):
        for _ in range(size.telemetry_cycles):
            for name, variant in VARIANTS.items():
                scheduler = make_scheduler(horus, size, variant, port)
                percent = cpu_percent_of(scheduler, size)
                series[f"{name}_cpu_percent"].append(percent)
                sending += variant.sends
    series["snapshots"] = [received[0]]
    # One a second; who drops them saves CPU time.
    wanted = sending * (size.telemetry_window_s + int(size.telemetry_settle_s))
    if received[0] < wanted:
        raise RuntimeError(f"{received[0]} snapshots arrived of at least {wanted:g}")
    return series
