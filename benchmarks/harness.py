"""Run workloads in child interpreters, reduce their samples, and print the result as a table."""

from __future__ import annotations

import argparse
import contextlib
import datetime
import json
import math
import os
import platform
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple, TypedDict

REPOSITORY = Path(__file__).resolve().parent.parent
WORKLOADS = Path(__file__).resolve().with_name("workloads.py")
SHARED_MEMORY = Path("/dev/shm")
NAMESPACE = "HORUS_NAMESPACE"

OURS = "this package"

CALM_ATTEMPTS = 6
"""How often a workload is run at most to find the machine undisturbed."""

Statistic = Callable[[Mapping[str, Sequence[float]]], float]
"""Reduce the raw series of one child run to one figure."""


class ChildError(RuntimeError):
    """A workload did not deliver samples: it crashed, timed out or measured the wrong package."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Contender:
    """A package under test: where to find the interpreter that imports it."""

    label: str
    python: Path
    import_root: Path | None = None
    """Directory put on the import path; None when the package is installed for ``python``."""
    script: Path = WORKLOADS
    """What runs the workloads: called as ``script NAME [arguments] --out FILE``."""
    arguments: tuple[str, ...] = ()
    timeout_s: float = 180.0
    """How long one workload may take [s]."""
    workloads: tuple[str, ...] | None = None
    """The workloads it takes part in; None for all."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """A bound a figure must meet, in the figure's own unit."""

    bound: float
    sense: Literal["at most", "at least"] = "at most"

    def met(self, value: float) -> bool:
        """Return whether ``value`` keeps the bound; a missing figure (nan) never does."""
        return value <= self.bound if self.sense == "at most" else value >= self.bound

    def __str__(self) -> str:
        return f"{'≤' if self.sense == 'at most' else '≥'} {self.bound:g}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Measure:
    """One line of the table: which workload's samples, reduced how, to be compared with what."""

    title: str
    unit: str
    workload: str
    statistic: Statistic
    target: Target | None = None

    def figure(self, run: ChildRun) -> float | None:
        """Return the figure of a run that delivered; None if its contender does not tell it."""
        try:
            return self.statistic(run.series)
        except KeyError:
            return None


@dataclass(frozen=True, slots=True, kw_only=True)
class ChildRun:
    """What one child run delivered: raw series, or the reason why there are none."""

    round: int
    workload: str
    contender: str
    package: Mapping[str, str] = field(default_factory=dict)
    series: Mapping[str, Sequence[float]] = field(default_factory=dict)
    other_load_percent: float | None = None
    """CPU time of everything else on the machine meanwhile, of all CPUs [%]; None if unknown."""
    error: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Figure:
    """A measure of one contender over all rounds."""

    median: float
    low: float
    high: float

    def __str__(self) -> str:
        if math.isnan(self.median):
            return "failed"
        text = format_number(self.median)
        if self.low == self.high:
            return text
        return f"{text} ({format_number(self.low)}-{format_number(self.high)})"


def median_of(series: str) -> Statistic:
    """Return the statistic that takes the median of one series."""
    return lambda run: statistics.median(run[series])


def percentile_of(series: str, percent: float) -> Statistic:
    """Return the statistic that takes a percentile of one series."""
    return lambda run: percentile(run[series], percent)


def percentile(samples: Sequence[float], percent: float) -> float:
    """Return the nearest-rank percentile: the smallest sample that ``percent`` of them stay below.

    Interpolating percentiles invents values between samples, which in the tail of a latency
    distribution can be values that never occur.
    """
    ordered = sorted(samples)
    rank = math.ceil(percent / 100.0 * len(ordered))
    return ordered[max(rank, 1) - 1]


def run_child(
    contender: Contender,
    workload: str,
    *,
    round_number: int,
    quick: bool,
    timeout_s: float | None = None,
) -> ChildRun:
    """Run one workload in the contender's interpreter and return its samples or its error."""
    before = cpu_times()
    try:
        limit_s = contender.timeout_s if timeout_s is None else timeout_s
        result = _spawn(contender, workload, quick=quick, timeout_s=limit_s)
    except ChildError as error:
        return ChildRun(
            round=round_number, workload=workload, contender=contender.label, error=str(error)
        )
    return ChildRun(
        round=round_number,
        workload=workload,
        contender=contender.label,
        package=result["package"],
        series=result["series"],
        other_load_percent=other_load_percent(before, cpu_times()),
    )


class CpuTimes(NamedTuple):
    """CPU time since boot, in seconds over all CPUs, and that of this process's ended children."""

    busy_s: float
    total_s: float
    children_s: float


def cpu_times() -> CpuTimes | None:
    """Return the machine's CPU times; None where the kernel does not publish them."""
    try:
        first_line = Path("/proc/stat").read_text(encoding="ascii").split("\n", 1)[0]
    except OSError:
        return None
    # user, nice, system, idle, iowait, irq, softirq, steal; guest time is part of user.
    fields = [int(field) / os.sysconf("SC_CLK_TCK") for field in first_line.split()[1:9]]
    idle_s = fields[3] + fields[4]
    times = os.times()
    return CpuTimes(
        busy_s=sum(fields) - idle_s,
        total_s=sum(fields),
        children_s=times.children_user + times.children_system,
    )


def other_load_percent(before: CpuTimes | None, after: CpuTimes | None) -> float | None:
    """Return the share of all CPUs that processes other than our children used between two looks.

    Time stolen by a hypervisor counts as used by others, since the children did not get it.
    """
    if before is None or after is None or after.total_s <= before.total_s:
        return None
    others_s = (after.busy_s - before.busy_s) - (after.children_s - before.children_s)
    return 100.0 * max(0.0, others_s) / (after.total_s - before.total_s)


class _Result(TypedDict):
    package: dict[str, str]
    series: dict[str, list[float]]


def _spawn(contender: Contender, workload: str, *, quick: bool, timeout_s: float) -> _Result:
    with tempfile.TemporaryDirectory(prefix="horus-bench-") as scratch:
        out = Path(scratch, "samples.json")
        # -P keeps the script's directory off the import path: the checkout beside it must not be
        # what a contender installed elsewhere imports.
        command = [str(contender.python), "-P", str(contender.script), workload]
        command += [*contender.arguments, "--out", str(out)]
        if quick:
            command.append("--quick")
        namespace = f"bench{os.getpid()}"
        # The namespace separates the shared memory of packages that use it from anything else on
        # the machine; leftovers of one run would be messages to the next.
        # PYTHON* variables of the caller would bend the figures: without byte code files, say, an
        # import is mostly compilation.
        environment = {key: value for key, value in os.environ.items() if key[:6] != "PYTHON"}
        environment[NAMESPACE] = namespace
        if contender.import_root is not None:
            environment["PYTHONPATH"] = str(contender.import_root)
        try:
            child = subprocess.run(
                command,
                cwd=scratch,
                env=environment,
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                errors="replace",
                timeout=timeout_s,
                check=False,
            )
        except subprocess.TimeoutExpired as expired:
            raise ChildError(f"no result within {timeout_s:g} s") from expired
        except OSError as error:
            raise ChildError(f"cannot start {contender.python}: {error}") from error
        finally:
            # However this ends, be it by Ctrl-C: contenders start processes of their own, some in
            # process groups of their own.
            _end_all(namespace)
            shutil.rmtree(SHARED_MEMORY / f"horus_{namespace}", ignore_errors=True)
        if child.returncode != 0 or not out.exists():
            tail = " | ".join(child.stderr.strip().splitlines()[-3:])
            raise ChildError(f"exit status {child.returncode}: {tail}")
        result: _Result = json.loads(out.read_text(encoding="utf-8"))
    root = contender.import_root
    imported = Path(result["package"]["file"]).resolve()
    if root is not None and not imported.is_relative_to(root.resolve()):
        raise ChildError(f"measured {imported} instead of the package in {root}")
    return result


def processes_of(namespace: str) -> Iterator[int]:
    """Find what runs for a namespace, where the kernel tells the environments of processes."""
    setting = f"{NAMESPACE}={namespace}".encode()
    for environment in Path("/proc").glob("[0-9]*/environ"):
        # Others end meanwhile, or are not ours to look at.
        with contextlib.suppress(OSError):
            if setting in environment.read_bytes().split(b"\0"):
                yield int(environment.parent.name)


def _end_all(namespace: str) -> None:
    killed: set[int] = set()
    while left := set(processes_of(namespace)) - killed:
        for pid in left:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        # Again, for what those had started in the meantime.
        killed |= left


def run_rounds(
    contenders: Sequence[Contender],
    workloads: Sequence[str],
    *,
    rounds: int,
    quick: bool,
    progress: Callable[[str], None],
    max_other_load_percent: float = 100.0,
) -> list[ChildRun]:
    """Run every workload on every contender in turn, ``rounds`` times.

    The contenders alternate within each workload, so that a machine that slows down or speeds up
    over the minutes of a run does so for all of them. A run disturbed by more load from others
    than ``max_other_load_percent`` is repeated a few times; what counts is its calmest attempt,
    chosen by that load alone and not by what was measured.
    """
    runs: list[ChildRun] = []
    for number in range(1, rounds + 1):
        for workload in workloads:
            for contender in contenders:
                if contender.workloads is not None and workload not in contender.workloads:
                    continue
                progress(f"round {number}/{rounds}  {workload}  {contender.label}")
                run = run_child(contender, workload, round_number=number, quick=quick)
                for _ in range(CALM_ATTEMPTS - 1):
                    if run.error is not None or _load(run) <= max_other_load_percent:
                        break
                    progress(f"  others used {_load(run):.0f} % of all CPUs; once more")
                    again = run_child(contender, workload, round_number=number, quick=quick)
                    run = min(run, again, key=_load)
                if run.error is not None:
                    progress(f"  failed: {run.error}")
                runs.append(run)
    return runs


def _load(run: ChildRun) -> float:
    if run.error is not None:
        return math.inf
    return 0.0 if run.other_load_percent is None else run.other_load_percent


def summarize(runs: Sequence[ChildRun], measure: Measure, contender: str) -> Figure:
    """Reduce each round to one figure and return their median and range."""
    told = [
        measure.figure(run)
        for run in runs
        if run.workload == measure.workload and run.contender == contender and run.error is None
    ]
    figures = [figure for figure in told if figure is not None]
    if not figures:
        return Figure(median=math.nan, low=math.nan, high=math.nan)
    return Figure(median=statistics.median(figures), low=min(figures), high=max(figures))


def format_number(value: float) -> str:
    """Format with three significant digits and no exponent."""
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    digits = max(0, 2 - math.floor(math.log10(abs(value))))
    return f"{value:.{min(digits, 4)}f}"


HEADER = ("measure", "unit")


def table_rows(
    runs: Sequence[ChildRun], measures: Sequence[Measure], contenders: Sequence[str]
) -> list[tuple[str, ...]]:
    """Return the table's cells, header first; the first contender is the one held to the targets.

    The ratio column, present when there is a second contender, is first divided by second, or by
    the next one that has the figure.
    """
    ratio = len(contenders) > 1
    header = (*HEADER, *contenders, *(("ratio",) if ratio else ()), "target", "met")
    rows = [header]
    for measure in measures:
        figures = [summarize(runs, measure, contender) for contender in contenders]
        own = figures[0].median
        taking_part = {
            run.contender
            for run in runs
            if run.workload == measure.workload
            and (run.error is not None or measure.figure(run) is not None)
        }
        # A contender fails in what it takes part in only.
        shown = [
            str(figure) if label == contenders[0] or label in taking_part else "-"
            for label, figure in zip(contenders, figures, strict=True)
        ]
        cells = [measure.title, measure.unit, *shown]
        if ratio:
            others = (each.median for each in figures[1:] if not math.isnan(each.median))
            other = next(others, math.nan)
            comparable = not (math.isnan(own) or math.isnan(other) or other == 0)
            cells.append(format_number(own / other) if comparable else "-")
        target = measure.target
        cells += ("-", "-") if target is None else (str(target), "yes" if target.met(own) else "no")
        rows.append(tuple(cells))
    return rows


def render_text(rows: Sequence[Sequence[str]]) -> str:
    """Render rows as an aligned plain-text table with a rule under the header."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]
    lines.insert(1, "  ".join("-" * width for width in widths))
    return "\n".join(lines)


def render_markdown(rows: Sequence[Sequence[str]]) -> str:
    """Render rows as a Markdown table."""
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    lines.insert(1, "| " + " | ".join("---" for _ in rows[0]) + " |")
    return "\n".join(lines)


def processor_name() -> str:
    """Return the processor's model name as the kernel reports it, or the architecture."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.machine()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def describe(runs: Sequence[ChildRun], facts: Mapping[str, str]) -> list[str]:
    """Return the lines above a result: the machine, what was measured, and who disturbed it."""
    lines = [f"{name}: {value}" for name, value in facts.items()]
    packages = {run.contender: run.package for run in runs if run.package}
    for label, package in packages.items():
        python = f" on Python {package['python']}" if "python" in package else ""
        lines.append(f"{label}: version {package['version']}{python}")
    loads = [run.other_load_percent for run in runs if run.other_load_percent is not None]
    if loads:
        lines.append(
            f"other processes meanwhile: {statistics.median(loads):.0f} % of all CPUs in the "
            f"median run, {max(loads):.0f} % in the worst"
        )
    return lines


def failures(runs: Sequence[ChildRun]) -> list[str]:
    """Return one line per failed run."""
    return [
        f"round {run.round}, {run.workload} of {run.contender} failed: {run.error}"
        for run in runs
        if run.error is not None
    ]


def at_least_one(text: str) -> int:
    """Parse an option that counts something."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1, not {value}")
    return value


def positive(text: str) -> float:
    """Parse an option that is a length of time."""
    value = float(text)
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"must be positive, not {text}")
    return value


def output_file(text: str) -> Path:
    """Parse the name of a file to write.

    A directory that does not exist is found out now rather than after minutes of measuring.
    """
    path = Path(text)
    if not path.absolute().parent.is_dir():
        raise argparse.ArgumentTypeError(f"no directory {path.absolute().parent}")
    return path


def machine_facts() -> dict[str, str]:
    """Return what a reader needs to judge the figures: machine, date, interpreter, command."""
    facts = {
        "machine": f"{processor_name()}, {os.cpu_count()} CPUs, {platform.machine()}",
        "system": f"{platform.system()} {platform.release()}",
        "python": f"{platform.python_implementation()} {platform.python_version()}",
        "date": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "command": " ".join(["python", "-m", "benchmarks", *sys.argv[1:]]),
    }
    if hasattr(os, "getloadavg"):
        facts["load average at start"] = f"{os.getloadavg()[0]:.2f}"
    return facts
