"""Measure whether recording loses anything, and what recording, replay and telemetry cost.

20,000 messages a second, dicts of three floats on 20 topics, are recorded beside a node that ticks
every millisecond; what is in the file is read and compared with what was sent. Then the costs of a
send and a tick, writing flat out, replay, the recovery of a file that was cut off, and telemetry.
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Mapping, Sequence
from importlib import metadata
from itertools import pairwise
from pathlib import Path

from benchmarks import cyclictest, peers
from benchmarks.agv_report import CYCLICTEST
from benchmarks.harness import (
    OURS,
    REPOSITORY,
    Contender,
    Measure,
    Statistic,
    Target,
    median_of,
    percentile,
)
from benchmarks.table import TableBenchmark

CHILDREN = Path(__file__).resolve().with_name("recording_workloads")
BARE_WRITER = f"mcap {metadata.version('mcap')} Writer"
MOTOR_PERIOD_US = 1000.0

Run = Mapping[str, Sequence[float]]


def percent_of(part: str, whole: str) -> Statistic:
    """Return the statistic: one number of another [%]."""
    return lambda run: 100.0 * run[part][0] / run[whole][0]


def lost(run: Run) -> float:
    """Return how many messages were sent and are not in the files."""
    return run["sent"][0] - run["recorded"][0]


def windows(run: Run, kind: str, series: str) -> list[Sequence[float]]:
    """Return a series of all windows of a kind.

    Args:
        run: All series.
        kind: The setting, and whether it records (``on``) or not (``off``), such as ``rt20_on``.
        series: What the children call it.

    Raises:
        KeyError: The contender does not tell it.
    """
    found = [
        samples
        for name, samples in run.items()
        if name.startswith(kind) and name.endswith(f"_{series}")
    ]
    if not found:
        raise KeyError(series)
    return found


def late_p99(kind: str) -> Statistic:
    """Return the statistic: 99th percentile of the motor's start latency, median window [µs]."""

    def statistic(run: Run) -> float:
        if kind == "rt20_off" and "latency_ns" in run:
            # cyclictest has no windows: nobody sends or records beside it.
            return percentile(run["latency_ns"], 99.0) / 1e3
        return statistics.median(percentile(late, 99.0) for late in windows(run, kind, "late_us"))

    return statistic


def error_p99(kind: str) -> Statistic:
    """Return the statistic: 99th percentile of how far two ticks are from 1 ms apart [µs]."""

    def of_window(starts: Sequence[float]) -> float:
        errors = [abs(after - before - MOTOR_PERIOD_US) for before, after in pairwise(starts)]
        return percentile(errors, 99.0)

    return lambda run: statistics.median(map(of_window, windows(run, kind, "start_us")))


def tick_percent(kind: str) -> Statistic:
    """Return the statistic: ticks of the motor of its releases, median window [%]."""

    def of_window(starts: Sequence[float]) -> float:
        released = round((starts[-1] - starts[0]) / MOTOR_PERIOD_US) + 1
        return 100.0 * len(starts) / released

    return lambda run: statistics.median(map(of_window, windows(run, kind, "start_us")))


def cpu_percent(kind: str) -> Statistic:
    """Return the statistic: CPU time of the process, all threads, median window [%]."""
    return lambda run: statistics.median(cpu for (cpu,) in windows(run, kind, "cpu_percent"))


def ratio(statistic: Statistic, to: Statistic) -> Statistic:
    """Return the statistic: one divided by another."""
    return lambda run: statistic(run) / to(run)


def added(variant: str, series: str = "us") -> Statistic:
    """Return the statistic: what a variant's median is above that of ``off``.

    Args:
        variant: Kind of call and name of the variant, such as ``send_recording``.
        series: What is compared.
    """
    kind, _, _ = variant.partition("_")
    return lambda run: (
        statistics.median(run[f"{variant}_{series}"])
        - statistics.median(run[f"{kind}_off_{series}"])
    )


def added_on_average(variant: str) -> Statistic:
    """Return the statistic: what a variant's mean is above that of ``off`` [µs]."""
    kind, _, _ = variant.partition("_")
    return lambda run: (
        statistics.fmean(run[f"{variant}_us"]) - statistics.fmean(run[f"{kind}_off_us"])
    )


def telemetry_percent(variant: str) -> Statistic:
    """Return the statistic: CPU time with telemetry above that without, cycle by cycle [%]."""
    return lambda run: statistics.median(
        on - off
        for on, off in zip(run[f"{variant}_cpu_percent"], run["off_cpu_percent"], strict=True)
    )


RECORDING = {"off": "not recording", "on": "recording"}
SETTINGS = {
    "rt20": "rt=True, 20 nodes send",
    "plain20": "rt=False, 20 nodes send",
    "rt1": "rt=True, one node sends",
    "plain1": "rt=False, one node sends",
}


def beside_recording(setting: str) -> tuple[Measure, ...]:
    """Return the lines about the 1 kHz node in one setting."""
    words = SETTINGS[setting]
    kinds = [(f"{setting}_{kind}", recording) for kind, recording in RECORDING.items()]
    return (
        *(
            Measure(
                title=f"1 kHz node, {words}: start latency p99, {recording}",
                unit="µs",
                workload="motor",
                statistic=late_p99(kind),
            )
            for kind, recording in kinds
        ),
        Measure(
            title=f"1 kHz node, {words}: start latency p99, recording / not",
            unit="ratio",
            workload="motor",
            statistic=ratio(late_p99(f"{setting}_on"), late_p99(f"{setting}_off")),
            target=Target(bound=1.5),
        ),
        *(
            Measure(
                title=f"1 kHz node, {words}: ticks, {recording}",
                unit="% of releases",
                workload="motor",
                statistic=tick_percent(kind),
            )
            for kind, recording in kinds
        ),
    )


def cost_of(kind: str, bound_us: float) -> tuple[Measure, ...]:
    """Return the lines about one kind of call."""
    words = {"recording": "recording", "blackbox": "flight recorder alone"}
    target = Target(bound=bound_us)
    return (
        Measure(
            title=f"a {kind}, not recorded",
            unit="µs",
            workload="cost",
            statistic=median_of(f"{kind}_off_us"),
        ),
        *(
            Measure(
                title=f"{what} adds to a {kind}",
                unit="µs",
                workload="cost",
                statistic=added(f"{kind}_{variant}"),
                target=target,
            )
            for variant, what in words.items()
        ),
        Measure(
            title=f"recording adds to a {kind} on average, waits for the interpreter included",
            unit="µs",
            workload="cost",
            statistic=added_on_average(f"{kind}_recording"),
        ),
        Measure(
            title=f"recording adds to a {kind} in CPU time, writing included",
            unit="µs",
            workload="cost",
            statistic=added(f"{kind}_recording", "cpu_us"),
        ),
    )


MEASURES = (
    Measure(
        title="messages sent while recording",
        unit="1/s",
        workload="record",
        statistic=median_of("sent_hz"),
        target=Target(bound=20_000.0, sense="at least"),
    ),
    Measure(
        title="messages sent",
        unit="% of due",
        workload="record",
        statistic=percent_of("sent", "quota"),
    ),
    Measure(
        title="messages sent that are not in the file",
        unit="in all",
        workload="record",
        statistic=lost,
        target=Target(bound=0.0),
    ),
    Measure(
        title="messages in the file",
        unit="% of sent",
        workload="record",
        statistic=percent_of("recorded", "sent"),
    ),
    *(line for setting in SETTINGS for line in beside_recording(setting)),
    *(
        Measure(
            title=f"1 kHz node, {SETTINGS['rt20']}: interval error p99, {recording}",
            unit="µs",
            workload="motor",
            statistic=error_p99(f"rt20_{kind}"),
        )
        for kind, recording in RECORDING.items()
    ),
    *(
        Measure(
            title=f"CPU, {SETTINGS['rt20']}, {recording}",
            unit="% of a core",
            workload="motor",
            statistic=cpu_percent(f"rt20_{kind}"),
        )
        for kind, recording in RECORDING.items()
    ),
    *cost_of("send", 3.0),
    *cost_of("tick", 2.0),
    Measure(
        title="encode and write a message, flat out",
        unit="µs",
        workload="write",
        statistic=median_of("write_us"),
    ),
    Measure(
        title="messages written, flat out",
        unit="1/s",
        workload="write",
        statistic=lambda run: 1e6 / statistics.median(run["write_us"]),
    ),
    Measure(
        title="a message in a file",
        unit="bytes",
        workload="write",
        statistic=median_of("message_bytes"),
    ),
    *(
        Measure(
            title=f"replay flat out, {per_tick} a tick{words}",
            unit="1/s",
            workload="replay",
            statistic=median_of(f"{series}_{per_tick}_hz"),
            target=Target(bound=50_000.0, sense="at least"),
        )
        for per_tick in ("ten", "one")
        for series, words in (("run", ""), ("whole", ", loading included"))
    ),
    Measure(
        title="recording that is cut off and recovered",
        unit="MB",
        workload="recover",
        statistic=median_of("size_mb"),
    ),
    Measure(
        title="recovery of that",
        unit="s",
        workload="recover",
        statistic=median_of("recover_s"),
        target=Target(bound=5.0),
    ),
    Measure(
        title="messages salvaged",
        unit="% of complete ones",
        workload="recover",
        statistic=percent_of("salvaged", "complete"),
        target=Target(bound=100.0, sense="at least"),
    ),
    Measure(
        title="CPU, 100 nodes at 10 Hz, no telemetry",
        unit="% of a core",
        workload="telemetry",
        statistic=median_of("off_cpu_percent"),
    ),
    *(
        Measure(
            title=f"telemetry of 100 nodes adds, {words}",
            unit="% of a core",
            workload="telemetry",
            statistic=telemetry_percent(variant),
            target=Target(bound=1.0),
        )
        for variant, words in (
            ("young", "counters of a program that has begun"),
            ("aged", "counters of one that has run for 15 min"),
        )
    ),
)


def bare_writer() -> Contender:
    """Return the writer of the mcap library, which this package depends on anyway."""
    return Contender(
        label=BARE_WRITER,
        python=Path(sys.executable),
        script=CHILDREN,
        arguments=("--contender", "mcap"),
        workloads=("write",),
    )


def contenders(*, with_peers: bool) -> list[Contender]:
    """Return this package as it is in the checkout, and who can be compared with parts of it.

    Raises:
        PeerError: The peer cannot be had.
    """
    here = Path(sys.executable)
    found = [Contender(label=OURS, python=here, import_root=REPOSITORY, script=CHILDREN)]
    if not with_peers:
        return found
    peer = peers.HORUS_ROBOTICS
    found += [
        Contender(
            label=peer.label,
            python=peer.interpreter(),
            script=CHILDREN,
            arguments=("--contender", "horus-robotics"),
            workloads=("record", "motor"),
        ),
        bare_writer(),
    ]
    if cyclictest.find() is not None:
        found.append(
            Contender(
                label=CYCLICTEST,
                python=here,
                script=Path(cyclictest.__file__),
                workloads=("motor",),
            )
        )
    return found


BENCHMARK = TableBenchmark(
    name="recording",
    description=__doc__,
    measures=MEASURES,
    contenders=contenders,
    peers_help=f"measure {peers.HORUS_ROBOTICS.requirement}, in an environment made in .bench/, "
    "the bare writer of the mcap library, and cyclictest, too",
    reading=(
        "Lower is better, except for ticks, messages per second and those in a file.\n"
        "A send and a tick are timed on their own thread, in bursts, while another one writes.\n"
        "A release that comes a period late is skipped: then it is missing from the ticks, and no "
        "start latency. cyclictest runs alone."
    ),
    rounds=3,
    seconds=30.0,
)
main = BENCHMARK.main
