"""The AGV benchmark: its statistics, its tables, its options, and one short drive of our own."""

from __future__ import annotations

import importlib
import importlib.util
import json
import math
import signal
import subprocess
import sys
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

import horus
from benchmarks import agv, agv_report, cyclictest, harness, peers
from benchmarks.agv_report import CYCLICTEST, MotorFigures, motor_figures
from benchmarks.agv_workloads import scenario
from benchmarks.harness import OURS, ChildRun
from horus.spec import ExecutionClass

MS = 1_000_000
PEER = "peer"

REPORT = """\
# /dev/cpu_dma_latency set to 0us
# Histogram
000000 000000
000011 000003
000012 000005
004999 000001
# Total: 000000009
# Min Latencies: 00011
# Avg Latencies: 00012
# Max Latencies: 06186
# Histogram Overflows: 00002
# Histogram Overflow at cycle number:
# Thread 0: 01547 01700
"""


def series_of(starts_ns: Sequence[float], seconds: float = 2.0, **more: Any) -> dict[str, Any]:
    """Return the raw series of a run with a warm-up of one second."""
    return {"start_ns": list(starts_ns), "window_s": [1.0, seconds], **more}


def every_ms(count: int, phase_ns: float = 0.0) -> list[float]:
    """Return the starts of a motor that ticks exactly once a millisecond."""
    return [phase_ns + index * MS for index in range(count)]


def agv_run(number: int, contender: str, mode: str = "idle", **series: Any) -> ChildRun:
    """Return a finished drive."""
    return ChildRun(round=number, workload=mode, contender=contender, series=series)


def limit_run(number: int, p99_us: int, mode: str = "idle") -> ChildRun:
    """Return a run of cyclictest all of whose latencies are the same."""
    return agv_run(number, CYCLICTEST, mode, latency_ns=[1000 * p99_us] * 10)


def our_run(number: int, latency_us: int, mode: str = "idle", **more: Any) -> ChildRun:
    """Return a drive of this package with a perfect motor that is always equally late."""
    starts = every_ms(3500)
    series = series_of(starts, latency_ns=[1000 * latency_us] * 3500, **more)
    return agv_run(number, OURS, mode, **series)


# -- figures of one run ----------------------------------------------------------------


@pytest.mark.parametrize("phase_ns", [0.0, 0.499 * MS, 0.5 * MS, 0.999 * MS])
def test_a_periodic_motor_has_all_its_ticks_whatever_its_phase(phase_ns: float) -> None:
    """The window neither cuts off nor adds a tick at its edges; no gap, no interval error."""
    figures = motor_figures(series_of(every_ms(3500, phase_ns)))
    assert figures.tick_percent == pytest.approx(100.0)
    assert figures.interval_error_p99_us == pytest.approx(0.0)
    assert figures.gaps_over_1_5_ms == 0
    assert figures.longest_gap_ms == pytest.approx(1.0)


def test_skipped_ticks_are_missing_ticks_and_gaps_counted_per_five_seconds() -> None:
    """Three gaps of 2 ms and one of 3 ms in two seconds: 2 ms are over 1.5 ms, not over 2 ms."""
    starts = every_ms(3500)
    for skipped in (2600, 2501, 2500, 1500, 1200):
        del starts[skipped]
    figures = motor_figures(series_of(starts))
    assert figures.tick_percent == pytest.approx(99.75)
    assert figures.gaps_over_1_5_ms == pytest.approx(4 * 2.5)
    assert figures.gaps_over_2_ms == pytest.approx(1 * 2.5)
    assert figures.longest_gap_ms == pytest.approx(3.0)


def test_a_motor_that_stops_for_good_leaves_a_gap_up_to_the_end_of_the_window() -> None:
    """Half the ticks of the window, and a longest gap of the other half."""
    figures = motor_figures(series_of(every_ms(2000)))
    assert figures.tick_percent == pytest.approx(50.0)
    assert figures.longest_gap_ms == pytest.approx(1000.5)
    assert motor_figures(series_of(every_ms(500))).longest_gap_ms == pytest.approx(2000.0)
    assert motor_figures(series_of([])).tick_percent == 0.0


def test_a_burst_that_catches_up_gives_no_gap_back() -> None:
    """All ticks are run, and the figures tell that they came at the wrong time."""
    starts = [start if not 2000 <= start / MS < 2010 else 2010.0 * MS for start in every_ms(3500)]
    figures = motor_figures(series_of(starts))
    assert figures.tick_percent == pytest.approx(100.0)
    assert figures.longest_gap_ms == pytest.approx(11.0)


def test_only_latencies_inside_the_window_count() -> None:
    """A start-up that was late is not held against the contender."""
    late = [9_000_000] * 1000 + [20_000] * 1980 + [300_000] * 20 + [8_000_000] * 500
    figures = motor_figures(series_of(every_ms(3500), latency_ns=late))
    assert figures.latency_p50_us == 20.0
    assert figures.latency_p99_us == 20.0
    assert figures.latency_p999_us == 300.0
    assert figures.latency_max_us == 300.0


def test_what_a_contender_does_not_tell_is_none_and_not_zero() -> None:
    """No releases, no latency; no view of the safety node, no violations."""
    figures = motor_figures(series_of(every_ms(3500)))
    assert figures.latency_p99_us is None
    assert figures.order_violations is None


def test_cyclictest_has_latencies_and_nothing_else() -> None:
    """Without a motor there are no ticks to count."""
    figures = motor_figures(limit_run(1, 25).series)
    assert figures == MotorFigures(
        latency_p50_us=25.0, latency_p99_us=25.0, latency_p999_us=25.0, latency_max_us=25.0
    )


def test_a_motor_tick_without_a_new_safety_tick_is_an_order_violation() -> None:
    """Also at the window's first tick; several safety ticks in between are none."""
    seen = list(range(1, 3501))
    seen[500] = seen[499]  # in the warm-up
    seen[1000] = seen[999]  # the first of the window
    seen[2000] = seen[1999]
    seen[2500] = seen[2501]  # two at once, then none
    figures = motor_figures(series_of(every_ms(3500), safety_seen=seen))
    assert figures.order_violations == pytest.approx(3 * 2.5)


# -- tables ----------------------------------------------------------------------------


def test_the_table_shows_medians_over_rounds_and_a_dash_for_what_is_not_told() -> None:
    """One row per contender, in the order given."""
    runs = [our_run(1, 10), our_run(2, 30), our_run(3, 20), agv_run(1, PEER, **series_of([]))]
    header, ours, peer = agv_report.agv_rows(runs, "idle", [OURS, PEER])
    assert header[:3] == ("planner idle", "motor ticks %", "latency p50 µs")
    assert ours[:4] == (OURS, "100.00", "20.0", "20.0")
    assert peer[:3] == (PEER, "0.00", "-")


def test_what_was_worst_is_the_worst_of_all_rounds() -> None:
    """A median would hide the longest latency and the longest gap of the odd round."""
    runs = [our_run(1, 10), our_run(2, 30), our_run(3, 20)]
    header, ours = agv_report.agv_rows(runs, "idle", [OURS])
    assert ours[header.index("max")] == "30.0"
    runs[1] = agv_run(2, OURS, **series_of(every_ms(2000)))
    _, ours = agv_report.agv_rows(runs, "idle", [OURS])
    assert ours[header.index("longest ms")] == "1000"


def test_a_contender_that_failed_or_is_missing_has_a_row_that_says_so() -> None:
    """The reason is below the table."""
    crashed = ChildRun(round=1, workload="idle", contender=PEER, error="it crashed")
    missing = {CYCLICTEST: cyclictest.NOT_INSTALLED}
    text = agv.report([our_run(1, 10), crashed], missing, {"date": "today"}, markdown=False)
    lines = text.splitlines()
    assert any(line.startswith(PEER) and " failed " in line for line in lines)
    assert any(line.startswith(CYCLICTEST) and " not installed " in line for line in lines)
    assert "round 1, idle of peer failed: it crashed" in lines
    assert f"{CYCLICTEST}: {cyclictest.NOT_INSTALLED}" in lines


def test_the_report_says_what_the_system_refused() -> None:
    """Figures without real-time rights are not passed off as those with them."""
    package = {"version": "1", "refused by the system": "SCHED_FIFO"}
    refused = ChildRun(round=1, workload="idle", contender=OURS, package=package)
    lines = agv.head_lines([refused, agv_run(1, OURS, "estop")], {})
    assert f"refused by the system to {OURS}: SCHED_FIFO" in lines


def test_latency_is_judged_against_cyclictest_of_the_same_round() -> None:
    """The ratio is taken per round, and the median of the ratios counts."""
    runs = [our_run(1, 50), our_run(2, 100), limit_run(1, 25), limit_run(2, 25)]
    line = next(line for line in agv_report.TARGETS if line.relative_to is agv_report.LIMIT)
    figure = agv_report.target_figure(runs, line)
    assert (figure.median, figure.low, figure.high) == (3.0, 2.0, 4.0)
    row = agv_report.target_rows(runs)[-1]
    assert row[1:] == ("times cyclictest's p99", "3.00 (2.00-4.00)", "≤ 3", "met")


def test_without_cyclictest_there_is_no_verdict() -> None:
    """Neither met nor missed; a failed run of this package misses its targets."""
    assert agv_report.target_rows([our_run(1, 50)])[-1][2:] == ("-", "≤ 3", "-")
    crashed = ChildRun(round=1, workload="idle", contender=OURS, error="it crashed")
    runs = [crashed, limit_run(1, 25)]
    assert agv_report.target_rows(runs)[-1][2:] == ("failed", "≤ 3", "missed")


def test_a_planner_in_a_process_is_judged_against_an_idle_one_of_the_same_round() -> None:
    """1.3 times its latency is met, a little more is missed; without an idle drive, neither."""

    def verdict(latency_us: int, *more: ChildRun) -> tuple[str, ...]:
        seen = list(range(3500))
        runs = [our_run(1, latency_us, "process", safety_seen=seen), *more]
        return agv_report.target_rows(runs)[-1][1:]

    unit = "times planner idle's p99"
    assert verdict(130, our_run(1, 100)) == (unit, "1.30", "≤ 1.3", "met")
    assert verdict(131, our_run(1, 100)) == (unit, "1.31", "≤ 1.3", "missed")
    assert verdict(130) == (unit, "-", "≤ 1.3", "-")


def test_targets_of_a_busy_planner_are_met_up_to_their_bounds() -> None:
    """All ticks, 400 us and no violation are met; one violation is one too many."""
    seen = list(range(3500))
    (_, *rows) = agv_report.target_rows([our_run(1, 400, "thread", safety_seen=seen)])
    assert [row[-1] for row in rows] == ["met", "met", "met"]
    seen[2000] = seen[1999]
    (_, *rows) = agv_report.target_rows([our_run(1, 401, "thread", safety_seen=seen)])
    assert [row[-1] for row in rows] == ["met", "missed", "missed"]


def test_what_must_not_happen_must_not_happen_in_any_round() -> None:
    """One order violation in one of three rounds misses the target, and shows in the table."""
    seen = list(range(3500))
    violated = [*seen[:2000], 1999, *seen[2001:]]
    runs = [our_run(number, 50, "thread", safety_seen=seen) for number in (1, 2)]
    runs.append(our_run(3, 50, "thread", safety_seen=violated))
    order = agv_report.target_rows(runs)[2]
    assert order[2:] == ("0 (0-2.50)", "≤ 0", "missed")
    assert agv_report.agv_rows(runs, "thread", [OURS])[1][-1] == "2.50"


def test_every_freeze_must_be_reacted_to_in_time() -> None:
    """The excess is the reaction less the timeout; infinite if one freeze had no reaction."""
    worst = agv_report.excess_ms("rt", 100.0)
    assert worst({"rt_ns": [101 * MS, 108 * MS], "rt_freezes": [2]}) == pytest.approx(8.0)
    assert worst({"rt_ns": [101 * MS], "rt_freezes": [2]}) == math.inf


def test_the_targets_include_those_of_the_reactions() -> None:
    """What was not run is not in the list; measures without a bound are in the other table."""
    stops = {"latency_ns": [200_000, 301_000], "sent": [2]}
    frozen = {"rt_ns": [114 * MS] * 10, "rt_freezes": [10]}
    frozen |= {"best_effort_ns": [114 * MS] * 9, "best_effort_freezes": [10]}
    runs = [agv_run(1, OURS, "estop", **stops), agv_run(1, OURS, "watchdog", **frozen)]
    _, *rows = agv_report.target_rows(runs)
    assert [row[2:] for row in rows] == [
        ("301", "≤ 300", "missed"),
        ("14.0", "≤ 15", "met"),
        ("inf", "≤ 15", "missed"),
    ]
    text = agv.report(runs, {}, {"date": "today"}, markdown=True)
    assert "| emergency stops handled | % of sent | 100 |" in text


def test_the_soak_counts_expirations_and_the_ticks_of_due() -> None:
    """A node's series is its ticks and how many were due."""
    series = {"rt": [99, 100], "watchdog_expirations": [1]}
    run = ChildRun(round=1, workload="soak", contender=OURS, series=series)
    measures = agv_report.soak_measures(list(series), 90.0)
    _, expirations, ticks = harness.table_rows([run], measures, [OURS])
    assert expirations[1:] == ("in 1.5 min", "1.00", "≤ 0", "no")
    assert ticks[:3] == ("ticks of rt", "% of due", "99.0")


def test_the_document_has_raw_and_reduced_figures_and_is_json() -> None:
    """A target without a figure is null, and so is its verdict: JSON has no nan."""
    runs = [our_run(1, 50), ChildRun(round=1, workload="idle", contender=PEER, error="crashed")]
    text = json.dumps(agv.document(runs, {}, {"date": "today"}, 2.0), allow_nan=False)
    whole = json.loads(text)
    assert whole["runs"][0]["figures"]["latency_p99_us"] == 50.0
    assert len(whole["runs"][0]["series"]["start_ns"]) == 3500
    ticks, latency = whole["targets"]
    assert (ticks["figure"]["median"], ticks["met"]) == (100.0, True)
    assert (latency["figure"]["median"], latency["met"]) == (None, None)


def test_the_picture_has_a_share_of_all_ticks_in_each_bin(tmp_path: Path) -> None:
    """Early ticks are in no bin and still count; the picture is written."""
    plot = pytest.importorskip("benchmarks.agv_plot")
    assert plot.shares_percent([-5.0, 2.0, 20.0, 20.0], [1.0, 10.0, 100.0]) == [25.0, 50.0]
    edges = plot.bin_edges_us()
    assert (edges[0], edges[-1]) == (1.0, pytest.approx(100_000.0))
    path = tmp_path / "agv.png"
    plot.draw([our_run(1, 50), limit_run(1, 25), agv_run(1, PEER, **series_of([0.0]))], path)
    assert path.read_bytes().startswith(b"\x89PNG")


# -- cyclictest ------------------------------------------------------------------------


def test_the_histogram_of_cyclictest_becomes_samples() -> None:
    """Every wake-up is one sample; those beyond the histogram count as the longest."""
    latencies = cyclictest.parse_report(REPORT)
    assert latencies.histogram == {11: 3, 12: 5, 4999: 1}
    assert (latencies.overflows, latencies.max_us) == (2, 6186)
    expected_us = [11] * 3 + [12] * 5 + [4999] + [6186] * 2
    assert latencies.samples_ns() == [1000 * us for us in expected_us]


@pytest.mark.parametrize("text", ["", "# Histogram\n# Total: 000000000\n", "no permission\n"])
def test_a_run_of_cyclictest_that_measured_nothing_is_an_error(text: str) -> None:
    """Zero samples are not zero latency."""
    with pytest.raises(ValueError, match="no histogram"):
        cyclictest.parse_report(text)


def test_cyclictest_runs_for_whole_seconds_with_the_motors_period() -> None:
    """One SCHED_FIFO thread that wakes up every 1000 us, at least for a second."""
    call = cyclictest.command("/usr/bin/cyclictest", 0.2)
    assert call[-2:] == ["-D", "1"]
    assert {"-t1", "-p80", "-i1000", "-m"} <= set(call)


# -- options and contenders ------------------------------------------------------------


def test_options_default_to_three_rounds_of_five_seconds() -> None:
    """Everything but the soak is run, without peers."""
    options = agv.parse([])
    assert (options.rounds, options.seconds, options.peers, options.soak) == (3, 5.0, False, None)
    assert options.only == ("idle", "thread", "process", "baton", "estop", "watchdog")


@pytest.mark.parametrize(
    "argv",
    [
        ["--seconds", "0"],
        ["--seconds", "nan"],
        ["--rounds", "0"],
        ["--soak", "-1"],
        ["--only", "gpu"],
        ["--plot", "no/such/dir/agv.png"],
    ],
)
def test_bad_options_are_refused_before_anything_is_measured(argv: list[str]) -> None:
    """The exit status is argparse's 2."""
    with pytest.raises(SystemExit) as refused:
        agv.parse(argv)
    assert refused.value.code == 2


def test_a_contender_that_cannot_be_installed_does_not_end_the_run(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It is named with the reason; the others are measured."""

    def refuse(_peer: peers.Peer) -> Path:
        raise peers.PeerError("no network")

    monkeypatch.setattr(peers.Peer, "interpreter", refuse)
    monkeypatch.setattr(cyclictest, "find", lambda: None)
    found, missing = agv.find_contenders(1.0, with_peers=True)
    assert [contender.label for contender in found] == [OURS, agv.THREADS, agv.UVLOOP]
    assert missing == {
        peers.HORUS_ROBOTICS.label: "no network",
        peers.DORA.label: "no network",
        CYCLICTEST: cyclictest.NOT_INSTALLED,
    }


def test_only_this_package_is_measured_in_what_only_it_has(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A contender takes part in the workloads it names, and in all if it names none."""

    def record(
        contender: harness.Contender, workload: str, *, round_number: int, quick: bool
    ) -> ChildRun:
        assert not quick
        return ChildRun(round=round_number, workload=workload, contender=contender.label)

    monkeypatch.setattr(harness, "run_child", record)
    monkeypatch.setattr(cyclictest, "find", lambda: None)
    found, _ = agv.find_contenders(1.0, with_peers=False)
    found.append(agv.other_contender(PEER, Path(sys.executable), "threads", 1.0))
    runs = harness.run_rounds(
        found, ["idle", "process", "estop"], rounds=1, quick=False, progress=lambda _: None
    )
    order = [(run.workload, run.contender) for run in runs]
    assert order == [("idle", OURS), ("idle", PEER), ("process", OURS), ("estop", OURS)]


@pytest.mark.parametrize(("crashed", "status"), [(OURS, 1), (PEER, 0)])
def test_the_exit_status_tells_whether_this_package_was_measured(
    monkeypatch: pytest.MonkeyPatch, crashed: str, status: int
) -> None:
    """A peer that fails is reported, and no failure of the benchmark."""
    runs = [
        our_run(1, 50),
        ChildRun(round=2, workload="idle", contender=crashed, error="it crashed"),
    ]
    monkeypatch.setattr(harness, "run_rounds", lambda *_args, **_options: runs)
    assert agv.main(["--only", "idle"]) == status


def test_without_matplotlib_there_is_no_picture_and_everything_else(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It is said before anything is measured."""
    monkeypatch.setattr(importlib.util, "find_spec", lambda _name: None)
    monkeypatch.setattr(harness, "run_rounds", lambda *_args, **_options: [our_run(1, 50)])
    path, samples = tmp_path / "agv.png", tmp_path / "agv.json"
    assert agv.main(["--only", "idle", "--plot", str(path), "--json", str(samples)]) == 0
    assert "matplotlib is not installed" in capsys.readouterr().err
    assert not path.exists()
    assert json.loads(samples.read_text(encoding="utf-8"))["runs"]


@pytest.mark.parametrize(("expirations", "status"), [(0, 0), (1, 1)])
def test_a_soak_fails_if_a_healthy_node_was_reported_frozen(
    monkeypatch: pytest.MonkeyPatch, expirations: int, status: int
) -> None:
    """It runs for the minutes asked for, and nothing else is run."""

    def run(contender: harness.Contender, workload: str, **_options: object) -> ChildRun:
        assert contender.arguments[-2:] == ("--seconds", "90.0")
        series = {"rt": [99, 100], "watchdog_expirations": [expirations]}
        return ChildRun(round=1, workload=workload, contender=contender.label, series=series)

    monkeypatch.setattr(harness, "run_child", run)
    assert agv.main(["--soak", "1.5"]) == status


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupted_run_takes_its_children_along(number: signal.Signals, status: int) -> None:
    """The exit status is the shell's for a signal, and there is no traceback."""
    command = [sys.executable, "-m", "benchmarks", "agv", "--seconds", "30", "--only", "thread"]
    with subprocess.Popen(
        command, cwd=harness.REPOSITORY, stderr=subprocess.PIPE, text=True
    ) as run:
        assert run.stderr is not None
        assert any("thread" in line for line in run.stderr)
        namespace = f"bench{run.pid}"
        wait_until(lambda: list(harness.processes_of(namespace)))
        run.send_signal(number)
        _, said = run.communicate(timeout=10.0)
    assert run.returncode == status
    assert "Traceback" not in said
    wait_until(lambda: not list(harness.processes_of(namespace)))


def wait_until(condition: Callable[[], object]) -> None:
    """Fail if this does not come true within a few seconds."""
    until_s = time.monotonic() + 5.0
    while not condition():
        assert time.monotonic() < until_s
        time.sleep(0.01)


# -- the scenario ----------------------------------------------------------------------


def test_the_planner_burns_processor_time_and_not_elapsed_time() -> None:
    """At least what was asked for, on this thread."""
    before_s = time.thread_time()
    assert scenario.burn(0.005) > 0
    assert time.thread_time() - before_s >= 0.005


def test_the_recorder_keeps_starts_releases_and_the_safety_ticks_seen() -> None:
    """Starts count from the first one; a full recorder takes no more."""
    bus: dict[str, list[deque[Any]]] = {}
    motor_node, safety_node, tracker = (
        scenario.PlainNode(name, bus) for name in ("motor", "safety", "tracker")
    )
    recorder = scenario.Recorder(0.001)
    assert recorder.capacity == 2
    releases = iter([5, 7])
    motor = scenario.make_motor(recorder, lambda: next(releases))
    safety = scenario.make_safety(recorder)
    tracker.send("cmd_vel", {"left": 1.0, "right": 2.0})
    safety(safety_node)
    for _ in range(3):
        motor(motor_node)
    starts = recorder.start_ns[:2]
    assert recorder.series(releases=True) == {
        "start_ns": [0, starts[1] - starts[0]],
        "latency_ns": [starts[0] - 5, starts[1] - 7],
        "safety_seen": [1, 1],
    }
    assert set(recorder.series(releases=False, order=False)) == {"start_ns"}
    assert not motor_node.has_msg("cmd_vel")


def test_messages_flow_from_the_lidar_to_the_motor() -> None:
    """Scan, path and cmd_vel pass through the nodes that the contract names."""
    bus: dict[str, list[deque[Any]]] = {}
    nodes = {name: scenario.PlainNode(name, bus) for name in scenario.RATES_HZ}
    recorder = scenario.Recorder(1.0)
    ticks = scenario.make_ticks(
        scenario.MODES["idle"], recorder, scenario.make_motor(recorder), awaits=False
    )
    for name in ("lidar", "safety", "planner", "tracker"):
        ticks[name](nodes[name])
    assert recorder.safety_done == 1
    assert nodes["motor"].recv("cmd_vel") == {"left": 0.75, "right": 1.25}


def test_every_node_of_the_dora_dataflow_is_ticked_and_fed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Timers have the nodes' rates, and whatever one listens to, another one sends."""
    monkeypatch.syspath_prepend(str(agv.CHILDREN))
    dora_agv = importlib.import_module("dora_agv")
    nodes = dora_agv.dataflow("thread", 1.0, Path("motor.json"))["nodes"]
    assert [node["id"] for node in nodes] == list(scenario.RATES_HZ)
    outputs = {f"{node['id']}/{topic}" for node in nodes for topic in node.get("outputs", ())}
    for node in nodes:
        timer, *sources = node["inputs"].values()
        period_ms = int(timer.removeprefix("dora/timer/millis/"))
        assert scenario.RATES_HZ[node["id"]] * period_ms == 1000
        assert outputs.issuperset(sources)


def test_the_soak_has_nodes_of_every_class_from_one_kilohertz_to_one_in_five_seconds(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A class that is not there would not be watched."""
    monkeypatch.syspath_prepend(str(agv.CHILDREN))
    nodes = importlib.import_module("reaction").soak_nodes(Counter())
    scheduler = horus.Scheduler()
    for node, _ in nodes:
        scheduler.add(node)
    classes = {row.execution_class for row in scheduler.timing_report().rows}
    assert classes == {each.value for each in ExecutionClass}
    rates_hz = [rate_hz for _, rate_hz in nodes]
    assert (min(rates_hz), max(rates_hz)) == (0.2, 1000.0)


@pytest.mark.realtime
def test_a_frozen_node_is_reacted_to_while_it_is_frozen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not before its timeout, which counts from the release; the node blocks the event loop."""
    monkeypatch.syspath_prepend(str(agv.CHILDREN))
    freeze_once = importlib.import_module("reaction").freeze_once
    (reaction_ns,) = freeze_once(None, time.sleep)
    # The reaction is measured from the tick's start, which a loaded machine puts off.
    assert reaction_ns >= 0.5 * scenario.CRITICAL_TIMEOUT_MS * MS


@pytest.mark.parametrize("mode", ["thread", "process"])
def test_a_short_drive_of_this_package_yields_every_figure(mode: str) -> None:
    """Samples come from this checkout; the planner computes meanwhile."""
    run = harness.run_child(agv.our_contender(0.3), mode, round_number=1, quick=False)
    assert run.error is None
    figures = motor_figures(run.series)
    assert all(getattr(figures, name) is not None for name in MotorFigures.__slots__)
    assert figures.tick_percent is not None
    assert figures.tick_percent > 0
    text = agv.report([run], {}, {"date": "today"}, markdown=True)
    assert f"| planner in a {mode}: motor ticks |" in text
    assert "failed" not in text
