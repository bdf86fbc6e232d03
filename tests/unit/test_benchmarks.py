"""The benchmark command: its statistics, its table, its options, and one cheap run of itself."""

from __future__ import annotations

import math
import os
import sys
import time
from pathlib import Path

import pytest

from benchmarks import __main__ as command
from benchmarks import harness, micro, workloads
from benchmarks.harness import ChildRun, Contender, Measure, Target

PERIODIC_HZ = 10.0


def child_run(number: int, contender: str, *samples: float, error: str | None = None) -> ChildRun:
    """Return a finished run of workload ``w`` with one series ``s``."""
    return ChildRun(
        round=number, workload="w", contender=contender, series={"s": samples}, error=error
    )


MEASURE = Measure(
    title="cost",
    unit="µs",
    workload="w",
    statistic=harness.median_of("s"),
    target=Target(bound=2.0),
)


@pytest.mark.parametrize(
    ("percent", "expected"), [(0.0, 1.0), (50.0, 50.0), (99.0, 99.0), (99.5, 100.0), (100.0, 100.0)]
)
def test_a_percentile_is_a_sample_that_was_measured(percent: float, expected: float) -> None:
    """The nearest-rank percentile of 1..100 is the rank itself, from unsorted samples."""
    samples = [float(value) for value in range(100, 0, -1)]
    assert harness.percentile(samples, percent) == expected


def test_the_percentile_of_one_sample_is_that_sample() -> None:
    """A single sample is every percentile of itself."""
    assert harness.percentile([7.0], 99.0) == 7.0


def test_load_by_others_leaves_out_our_own_children() -> None:
    """Of 20 CPU seconds, 8 were busy and 5 of those ours: others used 15 %."""
    before = harness.CpuTimes(busy_s=100.0, total_s=500.0, children_s=10.0)
    after = harness.CpuTimes(busy_s=108.0, total_s=520.0, children_s=15.0)
    assert harness.other_load_percent(before, after) == pytest.approx(15.0)
    assert harness.other_load_percent(before, before) is None
    assert harness.other_load_percent(None, after) is None


@pytest.mark.parametrize("phase_s", [0.0, 0.0499, 0.05, 0.0999])
def test_a_periodic_node_runs_all_its_ticks_whatever_its_phase(phase_s: float) -> None:
    """A window never cuts off or adds a tick at its edges for an exactly periodic node."""
    stamps = [phase_s + index / PERIODIC_HZ for index in range(200)]
    assert workloads.achieved_ratio([stamps], 2.0, 5.0, PERIODIC_HZ) == pytest.approx(1.0)


def test_skipped_and_silent_nodes_lower_the_tick_ratio() -> None:
    """Half the ticks count half, and a node that never ticks counts nothing."""
    full = [index / PERIODIC_HZ for index in range(200)]
    assert workloads.achieved_ratio([full, full[::2]], 2.0, 4.0, PERIODIC_HZ) == pytest.approx(0.75)
    assert workloads.achieved_ratio([full, []], 2.0, 4.0, PERIODIC_HZ) == pytest.approx(0.5)


def test_a_target_is_kept_up_to_its_bound_and_never_by_a_missing_figure() -> None:
    """Both senses include the bound; nan meets neither."""
    at_least = Target(bound=99.0, sense="at least")
    assert MEASURE.target is not None
    assert MEASURE.target.met(2.0)
    assert not MEASURE.target.met(2.01)
    assert at_least.met(99.0)
    assert not at_least.met(98.9)
    assert not at_least.met(math.nan)
    assert not MEASURE.target.met(math.nan)


def test_rounds_are_reduced_to_their_median_and_range_without_the_failed_ones() -> None:
    """Each round gives one figure; other contenders and failures do not enter."""
    runs = [
        child_run(1, "ours", 1.0, 3.0, 2.0),
        child_run(1, "peer", 100.0),
        child_run(2, "ours", 5.0),
        child_run(3, "ours", 3.0),
        child_run(4, "ours", error="crashed"),
    ]
    figure = harness.summarize(runs, MEASURE, "ours")
    assert (figure.median, figure.low, figure.high) == (3.0, 2.0, 5.0)
    assert math.isnan(harness.summarize(runs, MEASURE, "nobody").median)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (0.12345, "0.123"),
        (0.0012345, "0.0012"),
        (1.2345, "1.23"),
        (12.345, "12.3"),
        (1234.5, "1234"),
    ],
)
def test_numbers_show_three_digits_and_no_exponent(value: float, text: str) -> None:
    """Large values keep their integer digits, small ones at most four decimals."""
    assert harness.format_number(value) == text


def test_the_table_holds_this_package_to_the_target_and_divides_by_the_peer() -> None:
    """The ratio is first over second; met is judged on the first alone."""
    runs = [child_run(1, "ours", 1.5), child_run(1, "peer", 6.0)]
    header, row = harness.table_rows(runs, [MEASURE], ["ours", "peer"])
    assert header == ("measure", "unit", "ours", "peer", "ratio", "target", "met")
    assert row == ("cost", "µs", "1.50", "6.00", "0.250", "≤ 2", "yes")


def test_the_table_says_failed_instead_of_inventing_a_figure() -> None:
    """A contender without samples shows as failed, without ratio, and misses its target."""
    runs = [child_run(1, "ours", error="crashed"), child_run(1, "peer", 6.0)]
    row = harness.table_rows(runs, [MEASURE], ["ours", "peer"])[1]
    assert row == ("cost", "µs", "failed", "6.00", "-", "≤ 2", "no")
    assert harness.table_rows(runs, [MEASURE], ["ours"])[0][-2:] == ("target", "met")


def test_the_report_names_every_failed_run() -> None:
    """A median over fewer rounds than were run is not passed off as one over all."""
    runs = [child_run(1, "ours", 1.0), child_run(2, "ours", error="it crashed")]
    text = micro.BENCHMARK.report(runs, ["ours"], {}, only=[], markdown=False)
    assert "round 2, w of ours failed: it crashed" in text


def test_the_text_table_is_aligned_and_the_markdown_table_is_markdown() -> None:
    """Columns start at the same offset on every line; Markdown has a rule under its header."""
    rows = [("measure", "met"), ("a long name", "yes"), ("b", "no")]
    assert harness.render_text(rows).splitlines() == [
        "measure      met",
        "-----------  ---",
        "a long name  yes",
        "b            no",
    ]
    assert harness.render_markdown(rows).splitlines()[:2] == ["| measure | met |", "| --- | --- |"]


def test_contenders_alternate_within_each_workload(monkeypatch: pytest.MonkeyPatch) -> None:
    """Order is round, workload, contender: drift of the machine hits every contender alike."""

    def record(contender: Contender, workload: str, *, round_number: int, quick: bool) -> ChildRun:
        assert quick
        return ChildRun(round=round_number, workload=workload, contender=contender.label)

    monkeypatch.setattr(harness, "run_child", record)
    contenders = [Contender(label=label, python=Path(sys.executable)) for label in ("a", "b")]
    said: list[str] = []
    runs = harness.run_rounds(contenders, ["x", "y"], rounds=2, quick=True, progress=said.append)
    order = [(run.round, run.workload, run.contender) for run in runs]
    assert order == [(r, w, c) for r in (1, 2) for w in "xy" for c in "ab"]
    assert len(said) == len(runs)


def test_a_disturbed_run_is_repeated_and_its_calmest_attempt_counts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Repeats end with the first calm attempt; without one, the calmest is kept."""
    loads = [80.0, 60.0, 5.0, 70.0]

    def disturbed(
        contender: Contender, workload: str, *, round_number: int, quick: bool
    ) -> ChildRun:
        return ChildRun(
            round=round_number,
            workload=workload,
            contender=contender.label,
            other_load_percent=loads.pop(0) if len(loads) > 1 else loads[0],
        )

    monkeypatch.setattr(harness, "run_child", disturbed)
    contenders = [Contender(label="a", python=Path(sys.executable))]

    def run(limit: float) -> float | None:
        (only,) = harness.run_rounds(
            contenders,
            ["x"],
            rounds=1,
            quick=True,
            progress=lambda _: None,
            max_other_load_percent=limit,
        )
        return only.other_load_percent

    assert run(100.0) == 80.0
    assert run(10.0) == 5.0
    assert run(10.0) == 70.0


def test_options_default_to_five_rounds_and_quick_to_one() -> None:
    """An explicit number of rounds wins over both defaults."""
    assert micro.BENCHMARK.parse([]).rounds == 5
    assert micro.BENCHMARK.parse(["--quick"]).rounds == 1
    assert micro.BENCHMARK.parse(["--quick", "--rounds", "3"]).rounds == 3
    assert micro.BENCHMARK.parse([]).only == micro.BENCHMARK.workloads
    assert micro.BENCHMARK.parse(["--only", "event", "import"]).only == ["event", "import"]


@pytest.mark.parametrize(
    "argv",
    [["--rounds", "0"], ["--rounds", "x"], ["--only", "nothing"], ["--json", "no/such/dir/f.json"]],
)
def test_bad_options_are_refused_before_anything_is_measured(argv: list[str]) -> None:
    """The exit status is argparse's 2."""
    with pytest.raises(SystemExit) as refused:
        micro.BENCHMARK.parse(argv)
    assert refused.value.code == 2


def test_the_command_passes_options_on_to_the_benchmark_it_names() -> None:
    """Everything after the name belongs to the benchmark; an unknown name is refused."""
    options = command.parse(["micro", "--quick", "--json", "f.json"])
    assert (options.name, options.args) == ("micro", ["--quick", "--json", "f.json"])
    with pytest.raises(SystemExit) as refused:
        command.parse(["macro"])
    assert refused.value.code == 2


def test_every_measure_belongs_to_a_workload_that_exists() -> None:
    """The table and the workloads name each other, and no two lines share a title."""
    assert set(micro.BENCHMARK.workloads) == set(workloads.WORKLOADS)
    titles = [measure.title for measure in micro.MEASURES]
    assert len(set(titles)) == len(titles)


def test_a_child_that_crashes_is_reported_with_its_last_words(tmp_path: Path) -> None:
    """A package without the expected API is an error entry, not an exception of the benchmark."""
    (tmp_path / "horus").mkdir()
    (tmp_path / "horus" / "__init__.py").touch()
    contender = Contender(label="empty", python=Path(sys.executable), import_root=tmp_path)
    run = harness.run_child(contender, "event", round_number=1, quick=True)
    assert run.error is not None
    assert "Scheduler" in run.error
    assert not run.series


def test_a_contender_that_cannot_be_started_is_reported(tmp_path: Path) -> None:
    """A missing interpreter is an error entry that names it."""
    contender = Contender(label="gone", python=tmp_path / "python")
    run = harness.run_child(contender, "event", round_number=1, quick=True)
    assert run.error is not None
    assert str(tmp_path) in run.error


def test_a_child_that_hangs_is_ended_with_all_that_it_started(tmp_path: Path) -> None:
    """The time limit ends the child, and another process in a group of its own, and says so."""
    (tmp_path / "horus").mkdir()
    source = "import subprocess\nsubprocess.run(['sleep', '60'], process_group=0)\n"
    (tmp_path / "horus" / "__init__.py").write_text(source, encoding="utf-8")
    contender = Contender(label="stuck", python=Path(sys.executable), import_root=tmp_path)
    run = harness.run_child(contender, "event", round_number=1, quick=True, timeout_s=1.0)
    assert run.error == "no result within 1 s"
    until_s = time.monotonic() + 5.0
    while list(harness.processes_of(f"bench{os.getpid()}")):
        assert time.monotonic() < until_s
        time.sleep(0.01)


def test_a_quick_run_of_this_package_yields_every_figure_of_its_workload() -> None:
    """Samples come from this checkout and reduce to finite, positive numbers."""
    contender = Contender(
        label=harness.OURS, python=Path(sys.executable), import_root=harness.REPOSITORY
    )
    run = harness.run_child(contender, "tick_once", round_number=1, quick=True)
    assert run.error is None
    measures = [measure for measure in micro.MEASURES if measure.workload == "tick_once"]
    figures = [measure.statistic(run.series) for measure in measures]
    assert len(figures) == 4
    assert all(math.isfinite(figure) and figure > 0 for figure in figures)
    text = micro.BENCHMARK.report(
        [run], [harness.OURS], {"date": "today"}, only=["tick_once"], markdown=False
    )
    assert "tick_once per node, 100 nodes" in text
    assert "failed" not in text
