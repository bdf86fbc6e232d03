"""Counters: what a node has done and how long it took."""

from __future__ import annotations

from dataclasses import dataclass

from horus.units import to_s

_UNIT_SHIFT = 8
"""Durations are counted in units of 256 ns."""
_SHORT_UNITS, _LONGEST_UNITS = 1 << 10, 1 << 24
"""262 us, and 4.3 s."""
_FINE, _COARSE = 32, 16
"""Buckets in an octave, of short durations and of the others."""
_FIRST_COARSE = _FINE + _FINE * 5
_BEYOND = _FIRST_COARSE + _COARSE * 14
"""The bucket of what lasts longer than the longest."""


class TickTimes:
    """Execution times and start latencies [ns] of a node: exact sums and maxima, close quantiles.

    Constant memory however long the robot runs, and few buckets, which telemetry reads
    every second: of 256 ns up to 8 us, then 3 % wide up to 262 us, and 6 % wide up to
    4.3 s. Both durations go in with one call of straight-line code, because every tick
    pays for it.

    Thread: one writer; readers see a value or its predecessor.
    """

    __slots__ = (
        "_executions",
        "_latencies",
        "execution_max_ns",
        "execution_total_ns",
        "latency_max_ns",
        "latency_total_ns",
    )

    def __init__(self) -> None:
        """Start empty."""
        # Sparse: a collector that walks thousands of references per node stops a
        # program of many nodes for tens of milliseconds.
        self._executions: dict[int, int] = {}
        self._latencies: dict[int, int] = {}
        self.execution_total_ns = self.execution_max_ns = 0
        self.latency_total_ns = self.latency_max_ns = 0

    def add(self, execution_ns: int, latency_ns: int) -> None:
        """Count one tick; durations are not negative."""
        units = execution_ns >> _UNIT_SHIFT
        bucket = _SHORT[units] if units < _SHORT_UNITS else _bucket(units)
        try:
            self._executions[bucket] += 1
        except KeyError:
            self._executions[bucket] = 1
        units = latency_ns >> _UNIT_SHIFT
        bucket = _SHORT[units] if units < _SHORT_UNITS else _bucket(units)
        try:
            self._latencies[bucket] += 1
        except KeyError:
            self._latencies[bucket] = 1
        self.execution_total_ns += execution_ns
        self.latency_total_ns += latency_ns
        if execution_ns > self.execution_max_ns:
            self.execution_max_ns = execution_ns
        if latency_ns > self.latency_max_ns:
            self.latency_max_ns = latency_ns

    def execution_quantile_s(self, fraction: float) -> float:
        """Return the execution time [s] that `fraction` of the ticks do not exceed."""
        return to_s(min(_quantile_ns(self._executions, fraction), self.execution_max_ns))

    def latency_quantile_s(self, fraction: float) -> float:
        """Return the start latency [s] that `fraction` of the ticks do not exceed."""
        return to_s(min(_quantile_ns(self._latencies, fraction), self.latency_max_ns))


def _bucket(units: int) -> int:
    """Return the bucket of a duration."""
    if units < _FINE:
        return units
    if units < _SHORT_UNITS:
        octave = units.bit_length() - _FINE.bit_length()
        return _FINE * octave + (units >> octave)
    if units >= _LONGEST_UNITS:
        return _BEYOND
    octave = units.bit_length() - _SHORT_UNITS.bit_length()
    return _FIRST_COARSE + _COARSE * octave + (units >> (octave + 6)) - _COARSE


_SHORT = tuple(map(_bucket, range(_SHORT_UNITS)))
"""The bucket of each short duration: looked up, it costs a tick less."""


def _quantile_ns(buckets: dict[int, int], fraction: float) -> int:
    counts = buckets.copy()  # the node goes on ticking
    if not counts:
        return 0
    total = sum(counts.values())
    wanted = fraction * total
    # From above, where a high quantile is soon found: telemetry asks for many.
    found, at_most = 0, total
    for bucket in sorted(counts, reverse=True):
        if at_most < wanted:
            break
        found = bucket
        at_most -= counts[bucket]
    return _upper_edge_ns(found)


def _upper_edge_ns(bucket: int) -> int:
    if bucket < _FINE:
        units = bucket + 1
    elif bucket < _FIRST_COARSE:
        octave, place = divmod(bucket - _FINE, _FINE)
        units = (_FINE + place + 1) << octave
    elif bucket < _BEYOND:
        octave, place = divmod(bucket - _FIRST_COARSE, _COARSE)
        units = (_COARSE + place + 1) << (octave + 6)
    else:  # the caller's exact maximum bounds it
        return 1 << 63
    return units << _UNIT_SHIFT


class NodeCounters:
    """What one node has done since it was added.

    Thread: written by the node's tick path alone, except `skipped`, which
    belongs to whoever releases the node, and `watchdog_expirations`, which belongs
    to the supervisor.
    """

    __slots__ = (
        "budget_overruns",
        "deadline_misses",
        "errors",
        "first_release_ns",
        "last_release_ns",
        "order_violations",
        "restarts",
        "skipped",
        "span_ns",
        "ticks",
        "times",
        "watchdog_expirations",
    )

    def __init__(self) -> None:
        """Start at zero."""
        self.ticks = 0
        self.errors = 0
        self.restarts = 0
        self.budget_overruns = 0
        self.deadline_misses = 0
        self.order_violations = 0
        self.skipped = 0
        self.watchdog_expirations = 0
        self.first_release_ns: int | None = None
        self.last_release_ns = 0
        self.span_ns = 0
        self.times = TickTimes()

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
    virtual: bool = False
    """Whether the times are simulated: a tick takes none but what it awaits."""

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
        if self.virtual:
            lines.append("(virtual time: a tick takes none but what it awaits)")
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
