"""Counters: what a node has done and how long it took."""

from __future__ import annotations

from dataclasses import dataclass

from horus.units import to_s

_SUB_BITS = 4
_SUB_COUNT = 1 << _SUB_BITS
_BUCKETS = (64 - _SUB_BITS + 1) << _SUB_BITS


class Histogram:
    """Durations [ns] in buckets 6 % wide: exact count, mean and maximum, close quantiles.

    Constant memory however long the robot runs. Bucket widths double with every
    power of two (the scheme of HdrHistogram), 16 buckets to each.

    Thread: one writer; readers see a value or its predecessor.
    """

    __slots__ = ("_buckets", "count", "max_ns", "total_ns")

    def __init__(self) -> None:
        """Start empty."""
        self._buckets = [0] * _BUCKETS
        self.count = 0
        self.total_ns = 0
        self.max_ns = 0

    def add(self, duration_ns: int) -> None:
        """Count one duration [ns]; below zero counts as zero."""
        if duration_ns < _SUB_COUNT:
            duration_ns = max(duration_ns, 0)
            self._buckets[duration_ns] += 1
        else:
            shift = duration_ns.bit_length() - _SUB_BITS - 1
            self._buckets[(shift << _SUB_BITS) + (duration_ns >> shift)] += 1
        self.count += 1
        self.total_ns += duration_ns
        if duration_ns > self.max_ns:
            self.max_ns = duration_ns

    def mean_s(self) -> float:
        """Return the mean [s]; 0.0 when empty."""
        return to_s(self.total_ns) / self.count if self.count else 0.0

    def quantile_s(self, fraction: float) -> float:
        """Return the duration [s] that `fraction` of all durations do not exceed."""
        wanted = fraction * self.count
        seen = 0
        for index, count in enumerate(self._buckets):
            seen += count
            if count and seen >= wanted:
                return to_s(min(_upper_edge_ns(index), self.max_ns))
        return 0.0


def _upper_edge_ns(index: int) -> int:
    if index < _SUB_COUNT:
        return index
    shift = (index >> _SUB_BITS) - 1
    return (((index & (_SUB_COUNT - 1)) + _SUB_COUNT + 1) << shift) - 1


class NodeCounters:
    """What one node has done since it was added.

    Thread: written by the node's tick path alone, except `skipped`, which
    belongs to whoever releases the node.
    """

    __slots__ = (
        "budget_overruns",
        "deadline_misses",
        "errors",
        "execution",
        "first_release_ns",
        "last_release_ns",
        "restarts",
        "skipped",
        "span_ns",
        "start_latency",
        "ticks",
        "watchdog_expirations",
    )

    def __init__(self) -> None:
        """Start at zero."""
        self.ticks = 0
        self.errors = 0
        self.restarts = 0
        self.budget_overruns = 0
        self.deadline_misses = 0
        self.skipped = 0
        self.watchdog_expirations = 0
        self.first_release_ns: int | None = None
        self.last_release_ns = 0
        self.span_ns = 0
        self.execution = Histogram()
        self.start_latency = Histogram()

    def end_span(self, period_ns: int) -> None:
        """Close the time over which the achieved rate is taken: a run has ended."""
        if self.first_release_ns is not None:
            self.span_ns += self.last_release_ns + period_ns - self.first_release_ns
            self.first_release_ns = None

    def achieved_hz(self, period_ns: int, now_ns: int) -> float:
        """Return the rate [Hz] of the ticks so far; `now_ns` is 0 when nothing runs."""
        span_ns = self.span_ns
        if self.first_release_ns is not None:
            # A tick's own period belongs to it: three ticks 10 ms apart are 100 Hz.
            end_ns = max(self.last_release_ns + period_ns, now_ns)
            span_ns += end_ns - self.first_release_ns
        return self.ticks / to_s(span_ns) if span_ns else 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeTiming:
    """One node's row of a timing report; durations in seconds."""

    name: str
    execution_class: str
    rate_hz: float | None
    achieved_hz: float
    ticks: int
    execution_avg_s: float
    execution_p99_s: float
    execution_max_s: float
    start_latency_avg_s: float
    start_latency_p99_s: float
    start_latency_max_s: float
    budget_overruns: int
    deadline_misses: int
    skipped: int
    errors: int


@dataclass(frozen=True, slots=True)
class TimingReport:
    """How well each node kept its schedule; `str()` of it is a table."""

    rows: tuple[NodeTiming, ...]

    def __str__(self) -> str:
        """Lay the rows out as a table, durations in milliseconds."""
        table = [_HEADINGS, *(_cells(row) for row in self.rows)]
        widths = [max(len(line[column]) for line in table) for column in range(len(_HEADINGS))]
        lines = []
        for line in table:
            left = [cell.ljust(width) for cell, width in zip(line[:2], widths[:2], strict=True)]
            right = [cell.rjust(width) for cell, width in zip(line[2:], widths[2:], strict=True)]
            lines.append("  ".join([*left, *right]).rstrip())
        lines.insert(1, "-" * max(len(line) for line in lines))
        return "\n".join(lines)


_HEADINGS = (
    "node",
    "class",
    "asked Hz",
    "got Hz",
    "ticks",
    "exec avg",
    "p99",
    "max ms",
    "late avg",
    "p99",
    "max ms",
    "overruns",
    "misses",
    "skipped",
    "errors",
)


def _cells(row: NodeTiming) -> tuple[str, ...]:
    return (
        row.name,
        row.execution_class,
        "-" if row.rate_hz is None else f"{row.rate_hz:g}",
        f"{row.achieved_hz:.1f}",
        str(row.ticks),
        *(
            f"{seconds * 1e3:.3f}"
            for seconds in (
                row.execution_avg_s,
                row.execution_p99_s,
                row.execution_max_s,
                row.start_latency_avg_s,
                row.start_latency_p99_s,
                row.start_latency_max_s,
            )
        ),
        str(row.budget_overruns),
        str(row.deadline_misses),
        str(row.skipped),
        str(row.errors),
    )
