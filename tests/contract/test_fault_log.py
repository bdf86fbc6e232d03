"""What is left when an extension holds the interpreter: the stacks of all threads, in a file."""

from __future__ import annotations

import ctypes
import os
import threading

import pytest

from horus import Node

from .helpers import nothing, running, wait_until

pytestmark = pytest.mark.realtime


@pytest.fixture(autouse=True)
def _home(tmp_path, monkeypatch):
    monkeypatch.setenv("HORUS_HOME", str(tmp_path / "home"))


def hold_the_interpreter(seconds: float) -> None:
    """Sleep in C without releasing the interpreter: no other Python thread runs."""
    ctypes.PyDLL(None).usleep(int(seconds * 1e6))


def once_holding(seconds, sched):
    """Return a tick that holds the interpreter once, a few ticks after there is a fault log."""
    watched_ticks = []

    def tick(node):
        if sched.fault_log is not None:
            watched_ticks.append(1)
        if len(watched_ticks) == 5:
            hold_the_interpreter(seconds)

    return tick


def test_a_tick_that_holds_the_interpreter_leaves_its_stack_in_a_file(make, caplog):
    """The stacks of all threads are written while no Python thread can run, and reported."""
    sched = make(watchdog_ms=200)
    during = []
    sched.add(Node("other", lambda node: during.append(sched.fault_log), rate=10))
    sched.add(Node("motor", once_holding(1.8, sched), rate=100))
    sched.run(duration=3.0)

    assert sched.fault_log is not None
    assert sched.fault_log in during
    assert "hold_the_interpreter" in sched.fault_log.read_text()
    assert str(sched.fault_log) in caplog.text


def test_nothing_happens_without_a_standstill(make, tmp_path):
    """A healthy run leaves no file behind, and has one while it runs."""
    sched = make(watchdog_ms=200)
    seen = []
    sched.add(Node("motor", lambda node: seen.append(sched.fault_log), rate=100))
    sched.run(duration=0.3)
    assert seen[-1] is not None
    assert seen[-1].parent == tmp_path / "home"
    assert sched.fault_log is None
    assert list((tmp_path / "home").iterdir()) == []


def test_no_file_without_a_watchdog(make, tmp_path):
    """Who sets no watchdog gets no timer and no file."""
    sched = make()
    sched.add(Node("motor", nothing, rate=100))
    sched.run(duration=0.1)
    assert sched.fault_log is None
    assert not (tmp_path / "home").exists()


def test_a_directory_that_cannot_be_written_is_reported_once(make, tmp_path, monkeypatch, caplog):
    """No place for the file: the robot runs, and says that there will be no stacks."""
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("HORUS_HOME", str(tmp_path / "file" / "below"))
    sched = make(watchdog_ms=100)
    sched.add(Node("motor", nothing, rate=100))
    sched.run(duration=0.5)
    assert sched.fault_log is None
    assert caplog.text.count("no stacks will be written") == 1
    assert sched.get_node_stats("motor")["total_ticks"] > 10


def test_two_schedulers_share_the_only_timer_of_the_process(make):
    """The second scheduler goes without a file, until the first has ended."""
    first, second = make(watchdog_ms=200, name="first"), make(watchdog_ms=200, name="second")
    for sched in (first, second):
        sched.add(Node("motor", nothing, rate=100))
    runner = threading.Thread(target=first.run)
    runner.start()
    wait_until(lambda: first.fault_log is not None)
    second.run(duration=0.2)
    assert second.fault_log is None
    first.stop()
    runner.join()

    with_timer = []
    second.add(Node("eyes", lambda node: with_timer.append(second.fault_log), rate=10))
    runner = threading.Thread(target=second.run)
    runner.start()
    try:
        wait_until(lambda: with_timer and with_timer[-1] is not None)
    finally:
        second.stop()
        runner.join()


def test_the_timer_goes_to_the_second_scheduler_when_the_first_one_ends(make):
    """Who had to go without gets the timer in the middle of its run."""
    first, second = make(watchdog_ms=200, name="first"), make(watchdog_ms=200, name="second")
    for sched in (first, second):
        sched.add(Node("motor", nothing, rate=100))
    with running(first):
        wait_until(lambda: first.fault_log is not None)
        with running(second):
            wait_until(lambda: second.get_node_stats("motor")["total_ticks"] > 10)
            assert second.fault_log is None
            first.stop()
            wait_until(lambda: second.fault_log is not None)
        assert second.fault_log is None


def test_a_full_disk_does_not_hide_a_standstill(make, tmp_path, caplog):
    """That there are no stacks is one thing, that Python stood still another."""
    home = tmp_path / "home"
    home.mkdir()
    (home / f"scheduler-{os.getpid()}.stacks").symlink_to("/dev/full")
    sched = make(watchdog_ms=100, name="scheduler")
    sched.add(Node("motor", once_holding(1.6, sched), rate=100))
    sched.run(duration=2.7)

    assert caplog.text.count("Python stood still for more than 1.00 s") == 1
    assert "could not be written" in caplog.text
