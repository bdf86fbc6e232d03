"""The recording benchmark: its statistics, what its workloads verify, and a cheap run of each."""

from __future__ import annotations

import importlib
import math
import struct
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import horus
from benchmarks import harness, recording
from benchmarks.agv_report import CYCLICTEST
from benchmarks.harness import OURS, ChildRun
from benchmarks.table import lasting


@pytest.fixture
def module(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return what imports a module of the children, which find each other on the import path."""
    monkeypatch.syspath_prepend(str(recording.CHILDREN))

    def load(name: str) -> ModuleType:
        return importlib.import_module(name)

    return load


def motor_run(contender: str, **series: Sequence[float]) -> ChildRun:
    """Return a finished run of the workload with the 1 kHz node."""
    return ChildRun(round=1, workload="motor", contender=contender, series=series)


# -- statistics ------------------------------------------------------------------------


def test_what_was_sent_and_is_not_in_the_files_is_lost() -> None:
    """Counted, so that one message of a million is not rounded away."""
    run = {"sent": [1_000_000], "recorded": [999_999]}
    assert recording.lost(run) == 1
    assert recording.percent_of("recorded", "sent")(run) == pytest.approx(99.9999)


def test_latencies_are_those_of_the_median_window() -> None:
    """One window that others disturbed says nothing about recording."""
    run = {
        "rt20_off0_late_us": [10.0] * 100,
        "rt20_off1_late_us": [12.0] * 100,
        "rt20_off2_late_us": [900.0] * 100,
        "rt20_on0_late_us": [15.0] * 98 + [18.0] * 2,
    }
    off, on = recording.late_p99("rt20_off"), recording.late_p99("rt20_on")
    assert (off(run), on(run)) == (12.0, 18.0)
    assert recording.ratio(on, off)(run) == pytest.approx(1.5)


def test_cyclictest_is_compared_with_who_does_not_record() -> None:
    """It has no windows; nothing is said where it has no figure."""
    runs = [motor_run(CYCLICTEST, latency_ns=[9_000] * 10)]
    runs.append(motor_run(OURS, rt20_off0_late_us=[18.0] * 10, rt20_on0_late_us=[27.0] * 10))
    measures = recording.beside_recording("rt20")[:3]
    _, off, on, ratio = harness.table_rows(runs, measures, [OURS, CYCLICTEST])
    assert off[2:5] == ("18.0", "9.00", "2.00")
    assert on[2:5] == ("27.0", "-", "-")
    assert ratio[2:] == ("1.50", "-", "-", "≤ 1.5", "yes")


def test_interval_errors_are_distances_from_a_millisecond() -> None:
    """Too short is as wrong as too long."""
    run = {"rt20_on0_start_us": [0.0, 1000.0, 1900.0, 3000.0]}
    assert recording.error_p99("rt20_on")(run) == pytest.approx(100.0)


def test_a_tick_that_was_skipped_is_missing_from_the_releases() -> None:
    """A node that skips what it is late for is never late by more than a period."""
    run = {"rt1_on0_start_us": [0.0, 1010.0, 2990.0, 4000.0]}
    assert recording.tick_percent("rt1_on")(run) == pytest.approx(80.0)


def test_what_recording_adds_is_the_difference_of_medians() -> None:
    """The mean is told beside it; it has the bursts that met the thread that writes."""
    run = {
        "send_off_us": [1.0, 1.0, 1.0],
        "send_recording_us": [2.5, 2.5, 40.0],
        "send_off_cpu_us": [1.5],
        "send_recording_cpu_us": [6.0],
    }
    assert recording.added("send_recording")(run) == pytest.approx(1.5)
    assert recording.added("send_recording", "cpu_us")(run) == pytest.approx(4.5)
    assert recording.added_on_average("send_recording")(run) == pytest.approx(14.0)


def test_telemetry_is_compared_cycle_by_cycle() -> None:
    """A machine that slows down between two cycles says nothing about telemetry."""
    run = {"off_cpu_percent": [5.0, 50.0, 5.0], "young_cpu_percent": [5.5, 50.6, 7.0]}
    assert recording.telemetry_percent("young")(run) == pytest.approx(0.6)


# -- the table and the options ----------------------------------------------------------


def test_every_measure_belongs_to_a_workload_that_exists(module: Any) -> None:
    """The table and the workloads name each other, and no two lines share a title."""
    known = importlib.import_module("benchmarks.recording_workloads.__main__").CONTENDERS
    assert set(recording.BENCHMARK.workloads) == set(known["horus"].workloads)
    titles = [measure.title for measure in recording.MEASURES]
    assert len(set(titles)) == len(titles)
    assert set(recording.SETTINGS) == set(module("session").SETTINGS)
    for contender in known.values():
        for name, function in contender.workloads.values():
            assert callable(getattr(module(name), function))


def test_the_children_are_told_how_long_to_run() -> None:
    """The seconds asked for count, less with --quick, and the children get the time for it."""
    assert recording.BENCHMARK.parse([]).seconds == 30.0
    assert recording.BENCHMARK.parse(["--quick"]).seconds == 1.0
    assert recording.BENCHMARK.parse(["--quick", "--seconds", "2"]).seconds == 2.0
    (contender,) = recording.contenders(with_peers=False)
    longer = lasting(contender, 100.0)
    assert longer.arguments[-2:] == ("--seconds", "100")
    assert longer.timeout_s > contender.timeout_s + 200.0


@pytest.mark.parametrize("seconds", ["0", "-1", "inf", "nan"])
def test_a_run_has_a_length(seconds: str) -> None:
    """Nothing else is accepted."""
    with pytest.raises(SystemExit) as refused:
        recording.BENCHMARK.parse(["--seconds", seconds])
    assert refused.value.code == 2


# -- what the workloads verify ----------------------------------------------------------


def test_a_source_that_was_held_up_sends_what_is_due(module: Any) -> None:
    """And never more than its quota: the rate is what was asked for."""
    traffic = module("traffic")
    clock_ns = [0]
    source = traffic.Source(3, 45, rate_hz=100.0, clock_ns=lambda: clock_ns[0])
    sent: list[Any] = []

    class Node:
        def send(self, topic: str, message: Any) -> None:
            assert topic == "pose3"
            sent.append(traffic.number_of(message))

    counts = []
    for at_ms in (0, 10, 30, 60):
        clock_ns[0] = at_ms * 1_000_000
        source.tick(Node())
        counts.append(len(sent))
    assert counts == [10, 20, 40, 45]
    assert sent == source.numbers() == [20 * count + 3 for count in range(45)]


@pytest.mark.parametrize(
    ("found", "said"), [([0, 20, 20], "twice"), ([20, 0], "out of order"), ([0, 7], "never sent")]
)
def test_a_recording_that_is_wrong_is_no_figure(module: Any, found: list[int], said: str) -> None:
    """Messages that are in a file twice would hide the loss of others."""
    source = module("traffic").make_sources(1.0)[0]
    source.sent = 3
    assert module("session").intact(source, [0, 40]) == 2
    with pytest.raises(RuntimeError, match=said):
        module("session").intact(source, found)


def test_messages_are_found_in_a_file_of_horus_robotics_wherever_they_are(module: Any) -> None:
    """Once each, though a file may have them as input and as output; other files are refused."""
    session = module("session")
    packed = [b"\x83\xa5theta\xc2\xa1x\xcb" + struct.pack(">d", x) for x in (21.0, 2570.0)]
    data = session.UNCOMPRESSED + b"..".join([packed[0], *packed])
    assert session.numbers_in_bytes(data) == {21, 2570}
    with pytest.raises(RuntimeError, match="not known"):
        session.numbers_in_bytes(b"HORUS\0\2\0\0\0" + data)


def test_a_lost_message_is_missed(module: Any, tmp_path: Path) -> None:
    """What is in a file is found by reading it: what was cut off is not there."""
    session, files = module("session"), module("files")
    with session.home():
        path = files.record_virtual(horus, 4000)
        found = session.numbers_in(horus, [path])
        assert sum(map(len, found.values())) == 4000
        large = files.repeat(path.read_bytes(), 0)
        cut = len(large.head) + large.chunks[1][0] - 1
        with path.open("r+b") as file:
            file.truncate(cut)
        horus.recover(path)
        found = session.numbers_in(horus, [path])
        assert sum(map(len, found.values())) < 4000
        assert files.read_all(horus, path) == large.complete_before(cut)


# -- one cheap run ----------------------------------------------------------------------


@pytest.mark.parametrize("workload", recording.BENCHMARK.workloads)
def test_a_quick_run_of_this_package_yields_every_figure(workload: str) -> None:
    """Samples come from this checkout and reduce to finite numbers."""
    (contender,) = recording.contenders(with_peers=False)
    contender = lasting(contender, 0.3)
    run = harness.run_child(contender, workload, round_number=1, quick=True)
    assert run.error is None
    measures = [measure for measure in recording.MEASURES if measure.workload == workload]
    assert all(math.isfinite(measure.statistic(run.series)) for measure in measures)
    text = recording.BENCHMARK.report([run], [OURS], {}, only=[workload], markdown=False)
    assert "failed" not in text


def test_the_bare_writer_writes_the_same_messages() -> None:
    """A peer that is measured with other messages is no peer."""
    bare = lasting(recording.bare_writer(), 0.3)
    run = harness.run_child(bare, "write", round_number=1, quick=True)
    assert run.error is None
    assert set(run.series) == {"write_us", "message_bytes"}
