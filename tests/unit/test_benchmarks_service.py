"""The service benchmark: its statistics, its workloads, and one cheap run of each of them."""

from __future__ import annotations

import math

import pytest

from benchmarks import harness, service, service_load, service_workloads
from benchmarks.harness import OURS, ChildRun


def test_a_recovery_is_what_it_took_beyond_the_back_off() -> None:
    """The median crash counts; the documented back-off is nobody's achievement."""
    assert service.after_backoff({"recovery_ms": [900.0, 180.0, 160.0]}) == pytest.approx(80.0)


def test_requests_are_compared_pair_by_pair() -> None:
    """A machine that slows down by half between two pairs says nothing about a scheduler."""
    run = {"without_hz": [1000.0, 500.0, 1000.0], "with_hz": [980.0, 495.0, 950.0]}
    assert service.rate_with_of_without(run) == pytest.approx(98.0)


def test_every_measure_belongs_to_a_workload_that_exists() -> None:
    """The table and the workloads name each other, and no two lines share a title."""
    ours = service_workloads.CONTENDERS["horus"].workloads
    assert set(service.BENCHMARK.workloads) == set(ours)
    titles = [measure.title for measure in service.MEASURES]
    assert len(set(titles)) == len(titles)
    for contender in service.contenders(with_peers=True):
        key = "pool" if contender.label == service.POOL else "horus"
        wanted = contender.workloads or service.BENCHMARK.workloads
        assert set(wanted) == set(service_workloads.CONTENDERS[key].workloads)


def test_every_planner_has_its_lines() -> None:
    """What the workload runs and what the table names are the same."""
    assert set(service.PLANNERS) == set(service_workloads.PLANNERS)


def test_a_contender_fails_only_in_what_it_takes_part_in() -> None:
    """Elsewhere it has a dash, and this package has no such excuse."""
    runs = [ChildRun(round=1, workload="roundtrip", contender=service.POOL, error="crashed")]
    rows = harness.table_rows(runs, service.MEASURES, [OURS, service.POOL])
    cells = {row[0]: row[2:4] for row in rows}
    assert cells[service.MEASURES[0].title] == ("failed", "failed")
    assert cells[service.MEASURES[-1].title] == ("failed", "-")


def test_the_client_knows_from_the_head_how_long_an_answer_is() -> None:
    """Head and body; an unfinished head says nothing yet."""
    head = b"HTTP/1.1 200 OK\r\nContent-Length: 12\r\nServer: x\r\n\r\n"
    assert service_load.answer_length(head) == len(head) + 12
    assert service_load.answer_length(head + b"abc") == len(head) + 12
    assert service_load.answer_length(head[:-1]) is None


def test_the_client_does_not_count_errors_as_answers() -> None:
    """A service that refuses everything would be the fastest."""
    with pytest.raises(ValueError, match="500"):
        service_load.answer_length(b"HTTP/1.1 500 Oops\r\nContent-Length: 0\r\n\r\n")


def test_messages_of_a_round_trip_can_be_told_apart() -> None:
    """An answer to another question would be measured as one that came at once."""
    for kind in service_workloads.KINDS.values():
        numbers = [kind.number_of(kind.make(each)) for each in range(service_workloads.NUMBERS)]
        assert numbers == list(range(service_workloads.NUMBERS))


@pytest.mark.parametrize("workload", service.BENCHMARK.workloads)
def test_a_quick_run_of_this_package_yields_every_figure(workload: str) -> None:
    """Samples come from this checkout and reduce to finite numbers."""
    (contender,) = service.contenders(with_peers=False)
    run = harness.run_child(contender, workload, round_number=1, quick=True)
    assert run.error is None
    measures = [measure for measure in service.MEASURES if measure.workload == workload]
    assert all(math.isfinite(measure.statistic(run.series)) for measure in measures)
    text = service.BENCHMARK.report([run], [OURS], {}, only=[workload], markdown=False)
    assert "failed" not in text


def test_the_process_pool_answers_the_same_questions() -> None:
    """A peer that is measured with other messages is no peer."""
    _, pool = service.contenders(with_peers=True)
    run = harness.run_child(pool, "roundtrip", round_number=1, quick=True)
    assert run.error is None
    assert set(run.series) == {f"{name}_us" for name in service_workloads.KINDS}
