"""The flight recorder: the last moments are in a file, however the run ends."""

from __future__ import annotations

import asyncio
import math
import os
import signal
import subprocess
import sys
import textwrap
import threading
import time

import pytest

import horus
from horus import Node, RecordingReader, Scheduler, StateError
from horus.errors import NodeError

from .helpers import PATIENCE_S, nothing


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch):
    """Keep recordings in a directory of the test's own."""
    monkeypatch.setenv("HORUS_HOME", str(tmp_path))
    return tmp_path / "recordings"


def dumps(home):
    """Return what the flight recorder has written."""
    return sorted(home.glob("blackbox_*.mcap"))


def messages(path, topic):
    """Return the messages of a topic."""
    with RecordingReader(path) as reader:
        return [recorded.message() for recorded in reader.messages([topic])]


def facts(path, channel):
    """Return what is in a JSON channel."""
    with RecordingReader(path) as reader:
        return list(reader.facts(channel))


def counting(topic="count", pad=0):
    """Return a tick that sends 1, 2, 3…."""
    sent = iter(range(1, 10**9))

    def tick(node):
        node.send(topic, (next(sent), os.urandom(pad)))

    return tick


def test_a_fatal_stop_writes_the_flight_recorder(home):
    """What happened until the failure is there, the failure included."""

    def fail(node):
        if horus.tick() == 300:
            raise RuntimeError("the gripper is jammed")

    sched = Scheduler(tick_rate=1000, blackbox_mb=16)
    sched.add(Node("count", counting(), rate=100, order=1, pubs=["count"]))
    sched.add(Node("bad", fail, rate=1000, order=2, failure_policy="fatal"))
    with pytest.raises(NodeError):
        sched.run(duration=20)
    (path,) = dumps(home)
    counts = [count for count, _ in messages(path, "count")]
    assert counts == list(range(1, len(counts) + 1))
    assert len(counts) >= 25
    assert any("gripper is jammed" in event["text"] for event in facts(path, "horus/events"))
    assert {node["name"] for node in facts(path, "horus/nodes")} == {"count", "bad"}
    assert not list(home.glob("*.ring"))
    assert [session.path for session in sched.list_recordings()] == [path]


@pytest.mark.parametrize(
    "options",
    [{"on_miss": "stop"}, {"max_deadline_misses": 3}],
    ids=["on_miss", "max_deadline_misses"],
)
def test_a_stop_because_of_missed_deadlines_writes_it(options, home):
    """on_miss="stop" and max_deadline_misses end a run because something is wrong."""
    node = {key: value for key, value in options.items() if key == "on_miss"}
    sched = Scheduler(
        tick_rate=100,
        blackbox_mb=1,
        **{key: value for key, value in options.items() if key not in node},
    )
    sched.add(Node("slow", lambda _: time.sleep(0.03), rate=50, deadline=0.01, **node))
    sched.run(duration=PATIENCE_S)
    (path,) = dumps(home)
    assert any(tick["past_deadline_us"] > 0 for tick in facts(path, "horus/ticks/slow"))


def test_an_orderly_end_leaves_nothing(home):
    """Neither a session nor the ring."""
    sched = Scheduler(tick_rate=100, blackbox_mb=1)
    sched.add(Node("count", counting(), rate=100, pubs=["count"]))
    sched.run(duration=0.2)
    assert list(home.iterdir()) == []


def test_a_critical_freeze_writes_it_with_the_stack(home):
    """The frozen thread's stack is in the log that was recorded."""
    frozen = threading.Event()

    def freeze_here(node):
        if horus.tick() > 100:
            frozen.wait(1.2)
            node.request_stop("thawed")

    sched = Scheduler(tick_rate=100, blackbox_mb=1, watchdog_ms=200)
    sched.add(Node("arm", freeze_here, rate=100, safe_state=nothing))
    sched.add_critical_node("arm", timeout_ms=100)
    sched.run(duration=PATIENCE_S)
    (path,) = dumps(home)
    logs = [log["message"] for log in facts(path, "horus/log")]
    assert any("freeze_here" in log and "frozen.wait(1.2)" in log for log in logs)
    assert any(event["kind"] == "safe_state" for event in facts(path, "horus/events"))


def test_dump_blackbox(home):
    """On demand, from outside and from a callback, as often as one likes."""
    written = []

    def tick(node):
        if horus.tick() == 50:
            written.append(sched.dump_blackbox())

    sched = Scheduler(tick_rate=100, blackbox_mb=1)
    sched.add(Node("count", counting(), rate=100, order=1, pubs=["count"]))
    sched.add(Node("ask", tick, rate=100, order=2))

    async def main():
        async with sched:
            await sched.wait_node("count", ticks=60)
            written.append(await asyncio.to_thread(sched.dump_blackbox, "for the report"))

    asyncio.run(main())
    assert dumps(home) == sorted(written)
    first, second = (messages(path, "count") for path in written)
    assert 0 < len(first) < len(second)
    assert any(event["text"] == "for the report" for event in facts(written[1], "horus/events"))


def test_without_a_flight_recorder_there_is_nothing_to_dump():
    """StateError, also while nothing runs."""
    for sched in (Scheduler(), Scheduler(blackbox_mb=1)):
        with pytest.raises(StateError, match="blackbox_mb"):
            sched.dump_blackbox()


def test_sigusr2_writes_it(home):
    """While run() owns the signals; afterwards the signal is what it was."""
    before = signal.getsignal(signal.SIGUSR2)

    def tick(node):
        if horus.tick() == 30:
            os.kill(os.getpid(), signal.SIGUSR2)

    sched = Scheduler(tick_rate=100, blackbox_mb=1)
    sched.add(Node("count", counting(), rate=100, order=1, pubs=["count"]))
    sched.add(Node("signal", tick, rate=100, order=2))
    sched.run(duration=1.0)
    (path,) = dumps(home)
    assert 20 <= len(messages(path, "count")) <= 80
    assert signal.getsignal(signal.SIGUSR2) is before


_DIES = """
    import ctypes, os, signal, sys
    from horus import Node, Scheduler
    sent = 0
    def tick(node):
        global sent
        sent += 1
        node.send("count", (sent, os.urandom(1500)))
        if sent == 1200:
            print(sent, flush=True)
            if sys.argv[1] == "kill":
                os.kill(os.getpid(), signal.SIGKILL)
            ctypes.string_at(0)
    sched = Scheduler(tick_rate=1000, blackbox_mb=1, recording="rec" in sys.argv[2:])
    sched.add(Node("count", tick, rate=1000, pubs=["count"]))
    sched.run(duration=60)
"""


@pytest.mark.parametrize("also", [[], ["rec"]], ids=["alone", "beside a recording"])
@pytest.mark.parametrize("how", ["kill", "segfault"])
def test_a_hard_death_is_recovered_at_the_next_start(how, also, home, caplog):
    """After SIGKILL or a segfault, the next run of any scheduler writes the session."""
    died = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(_DIES), how, *also],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert died.returncode in (-signal.SIGKILL, -signal.SIGSEGV), died.stderr
    (ring,) = home.glob("*.ring")
    assert ring.stat().st_size == 1_000_000
    sched = Scheduler(tick_rate=100, deterministic=True, blackbox_mb=1)
    sched.add(Node("node", nothing))
    sched.run(duration=0.1)
    (path,) = dumps(home)
    assert str(path) in caplog.text
    assert not list(home.glob("*.ring"))
    counts = [count for count, _ in messages(path, "count")]
    assert counts == list(range(counts[0], counts[-1] + 1))
    assert counts[0] > 1  # a ring of 1 MB does not hold all 1200
    assert len(counts) > 400
    assert counts[-1] > 1050
    assert {node["name"] for node in facts(path, "horus/nodes")} == {"count"}
    assert facts(path, "horus/scheduler")[0]["tick_rate_hz"] == 1000


def test_a_ring_of_a_process_that_lives_is_left_alone(home):
    """Two schedulers, each with its own."""
    one, two = (Scheduler(deterministic=True, blackbox_mb=1, name=name) for name in ("a", "b"))
    for sched in (one, two):
        sched.add(Node("node", counting(), pubs=["count"]))
        sched.tick_once()
    assert len(list(home.glob("*.ring"))) == 2
    assert len(messages(one.dump_blackbox(), "count")) == 1
    for sched in (one, two):
        sched.stop()
    assert not list(home.glob("*.ring"))


def test_the_flight_recorder_goes_on_when_recording_stops(home):
    """stop_recording() ends the session only."""
    sched = Scheduler(tick_rate=100, deterministic=True, recording=True, blackbox_mb=1)
    sched.add(Node("count", counting(), rate=100, pubs=["count"]))
    sched.tick_for(0.1)
    (path,) = sched.stop_recording()
    assert not sched.is_recording()
    sched.tick_for(0.1)
    dumped = sched.dump_blackbox()
    sched.stop()
    assert len(messages(path, "count")) == 10
    assert len(messages(dumped, "count")) == 20


def test_what_was_dumped_can_be_replayed(home):
    """A dump is a recording like any other, though it begins in the middle."""
    sched = Scheduler(tick_rate=1000, deterministic=True, blackbox_mb=1)
    sched.add(Node("count", counting(pad=300), rate=1000, pubs=["count"]))
    sched.tick_for(6.0)
    path = sched.dump_blackbox()
    sched.stop()
    expected = messages(path, "count")
    assert expected[0][0] > 1000
    got = []
    replayed = Scheduler.replay_from(path)
    replayed.set_replay_speed(math.inf)
    hear = lambda node: got.extend(node.recv_all("count"))  # noqa: E731
    replayed.add(Node("new", hear, rate=1000, order=200, subs=["count"]))
    replayed.run()
    assert got == expected


def test_its_memory_stays_within_its_size(home):
    """A ring that is 36 MB larger costs the process those and 10 % at most."""
    script = """
        import os, resource, time
        from horus import Node, Scheduler
        def rss():
            with open("/proc/self/statm") as file:
                return int(file.read().split()[1]) * resource.getpagesize()
        sched = Scheduler(tick_rate=1000, deterministic=True, blackbox_mb=SIZE)
        sched.add(Node("n", lambda node: node.send("t", os.urandom(10_000)), rate=1000, pubs=["t"]))
        sched.tick_for(0.3)
        before = rss()
        for _ in range(30):
            sched.tick_for(0.2)
            time.sleep(0.03)  # what waits to be written is not the ring's
        print(rss() - before)
        sched.stop()
    """

    def growth(size):
        run = subprocess.run(
            [sys.executable, "-c", textwrap.dedent(script).replace("SIZE", str(size))],
            capture_output=True,
            text=True,
            timeout=120,
            check=True,
        )
        return int(run.stdout)

    assert growth(40) - growth(4) <= 36e6 * 1.1


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can mount a small disk")
def test_no_room_for_the_ring_leaves_the_robot_running(tmp_path, monkeypatch, caplog):
    """It is told once, and nothing is killed by a page that finds no room."""
    disk = tmp_path / "disk"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "none", disk]).returncode:
        pytest.skip("mounting is not allowed here")
    try:
        monkeypatch.setenv("HORUS_HOME", str(disk))
        sched = Scheduler(tick_rate=100, deterministic=True, blackbox_mb=16)
        sched.add(Node("count", counting(), rate=100, pubs=["count"]))
        sched.run(duration=0.2)
        assert sched.get_node_stats("count")["total_ticks"] == 20
        told = [r for r in caplog.records if "there is no flight recorder" in r.getMessage()]
        assert len(told) == 1
        assert "No space left" in told[0].getMessage()
        assert not list(disk.rglob("*.ring"))
    finally:
        subprocess.run(["umount", disk], check=True)
