"""Counters: exact sums, close quantiles, honest rates."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from horus import stats
from horus.stats import NodeCounters, NodeTiming, TickTimes, TimingReport

durations = st.lists(st.integers(0, 5 * 10**9), min_size=1, max_size=300)


@given(durations, st.sampled_from([0.5, 0.9, 0.99, 1.0]))
def test_quantiles_are_close(values: list[int], fraction: float) -> None:
    """A quantile is never below the true one, and above it by a bucket at most."""
    times = TickTimes()
    for value in values:
        times.add(value, value)
    true = sorted(values)[math.ceil(fraction * len(values)) - 1]
    found = times.execution_quantile_s(fraction) * 1e9
    width = max(256, true / 32 if true < 1 << 18 else true / 16)
    assert true - 1e-3 <= found <= true + width + 1 or true >= 1 << 32
    assert found == pytest.approx(times.latency_quantile_s(fraction) * 1e9)


def test_buckets_are_few_and_without_gaps() -> None:
    """However durations are spread, telemetry has little to read."""
    units = [*range(1 << 12), *(1 << power for power in range(12, 30)), (1 << 24) - 1]
    buckets = [stats._bucket(unit) for unit in sorted(units)]
    assert buckets == sorted(buckets)
    assert set(range(buckets[1 << 11])) <= set(buckets)
    assert max(buckets) < 420
    assert stats._bucket((1 << 24) - 1) == max(buckets) - 1
    for unit in units:
        if unit < 1 << 24:
            assert (
                unit << 8 < stats._upper_edge_ns(stats._bucket(unit)) <= (unit * 17 // 16 + 1) << 8
            )


@given(durations)
def test_sums_and_maxima_are_exact(values: list[int]) -> None:
    """Averages and maxima come from exact integers, not from buckets."""
    times = TickTimes()
    for value in values:
        times.add(value, 0)
    assert times.execution_total_ns == sum(values)
    assert times.execution_max_ns == max(values)
    assert times.latency_total_ns == 0


def test_an_empty_quantile_is_zero() -> None:
    """Without ticks there is nothing to report."""
    assert TickTimes().execution_quantile_s(0.99) == 0.0


def test_achieved_rate_counts_the_last_tick_s_own_period() -> None:
    """Three ticks 10 ms apart are 100 Hz."""
    counters = NodeCounters()
    counters.ticks = 3
    counters.first_release_ns, counters.last_release_ns = 0, 20_000_000
    assert counters.achieved_hz(10_000_000, 0) == pytest.approx(100.0)


def test_achieved_rate_falls_while_a_node_hangs() -> None:
    """A node that has stopped ticking does not look as if it kept its rate."""
    counters = NodeCounters()
    counters.ticks = 3
    counters.first_release_ns, counters.last_release_ns = 0, 20_000_000
    assert counters.achieved_hz(10_000_000, 300_000_000) == pytest.approx(10.0)


def test_achieved_rate_leaves_out_the_time_between_runs() -> None:
    """A pause between two runs of a scheduler is not held against its nodes."""
    counters = NodeCounters()
    counters.ticks = 2
    counters.first_release_ns, counters.last_release_ns = 0, 10_000_000
    counters.end_span(10_000_000)
    counters.first_release_ns, counters.last_release_ns = 10**12, 10**12 + 10_000_000
    counters.ticks = 4
    assert counters.achieved_hz(10_000_000, 0) == pytest.approx(100.0)


def test_the_report_is_a_table() -> None:
    """`str(report)` has a line per node under a heading, with aligned columns."""
    row = NodeTiming(
        name="motor",
        execution_class="Rt",
        rate_hz=1000.0,
        achieved_hz=999.9,
        ticks=1000,
        execution_avg_s=1e-5,
        execution_p99_s=2e-5,
        execution_max_s=3e-5,
        start_latency_avg_s=5e-5,
        start_latency_p99_s=1e-4,
        start_latency_max_s=2e-3,
        budget_overruns=0,
        deadline_misses=1,
        skipped=2,
        errors=3,
    )
    heading, rule, line = str(TimingReport((row,))).splitlines()
    assert heading.split()[0] == "node"
    assert set(rule) == {"-"}
    assert line.split() == (
        [
            "motor",
            "Rt",
            "1000",
            "999.9",
            "1000",
            "0.010",
            "0.020",
            "0.030",
            "0.050",
            "0.100",
            "2.000",
            "0",
            "1",
            "2",
            "3",
        ]
    )
