"""Recording: everything that happens is in a file that others open, whatever happens to it."""

from __future__ import annotations

import asyncio
import collections
import json
import logging
import os
import shutil
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

import horus
from horus import Node, RecordingError, Scheduler
from horus.errors import ConfigError
from horus.recording.reader import RecordingReader

from .helpers import KINDS, node_of, nothing
from .test_unprivileged import run_without

CAP_DAC_OVERRIDE = 1


def read(path, topic=None):
    """Return the messages of a recording, decoded."""
    with RecordingReader(path) as reader:
        topics = None if topic is None else [topic]
        return [recorded.message() for recorded in reader.messages(topics)]


def facts(path, channel):
    """Return what is in a JSON channel of a recording."""
    with RecordingReader(path) as reader:
        return list(reader.facts(channel))


def counting(topic="count"):
    """Return a tick that sends 1, 2, 3…."""
    sent = iter(range(1, 10**9))

    def tick(node):
        node.send(topic, next(sent))

    return tick


def record(directory, *nodes, ticks=10, **options):
    """Record some nodes in virtual time and return the file."""
    options = {"tick_rate": 100, "deterministic": True, **options}
    sched = Scheduler(recording=directory, **options)
    for node in nodes:
        sched.add(node)
    sched.tick_for(ticks / 100)
    (path,) = sched.stop_recording()
    sched.stop()
    return path


# -- the contract's examples -----------------------------------------------------------------


def test_recording_a_session_as_the_contract_shows(monkeypatch, tmp_path):
    """Record, check the status, stop, list and delete, with the calls of the contract."""
    monkeypatch.setenv("HORUS_HOME", str(tmp_path))
    was_recording = []
    sched = Scheduler(tick_rate=100, recording=True)
    sched.add(Node(name="sensor", tick=counting(), rate=100, pubs=["count"]))
    sched.add(
        Node(name="watch", tick=lambda node: was_recording.append(sched.is_recording()), rate=100)
    )
    assert not sched.is_recording()
    sched.run(duration=0.3)
    assert was_recording
    assert all(was_recording)
    assert not sched.is_recording()
    files = sched.stop_recording()
    assert [file.parent for file in files] == [tmp_path / "recordings"]
    (recording,) = sched.list_recordings()
    assert recording == files[0].stem
    assert recording.startswith(f"session_{time.strftime('%Y')}_")
    assert recording.state == "finished"
    counts = read(files[0], "count")
    assert counts == list(range(1, len(counts) + 1))
    assert len(counts) >= 10
    sched.delete_recording(recording)
    assert sched.list_recordings() == []
    assert not files[0].exists()


def test_recordings_go_where_the_user_keeps_data(monkeypatch, tmp_path):
    """Without HORUS_HOME, sessions live under the user data directory."""
    monkeypatch.delenv("HORUS_HOME", raising=False)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    sched = Scheduler(recording=True, deterministic=True)
    sched.add(Node("node", nothing))
    sched.tick_once()
    (path,) = sched.stop_recording()
    assert path.parent == tmp_path / "horus" / "recordings"


# -- what is in a recording ------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_every_class_of_node_is_recorded(kind, tmp_path):
    """Messages of Rt, Event, AsyncIo, Compute and BestEffort nodes are all there, in order."""
    sched = Scheduler(tick_rate=200, recording=tmp_path)
    sched.add(node_of(kind, "it", counting(), pubs=["count"], order=200))
    sched.add(Node("trigger", lambda node: node.send("go", 1), rate=100, order=0, pubs=["go"]))
    sched.run(duration=0.5)
    (path,) = sched.stop_recording()
    counts = read(path, "count")
    assert counts == list(range(1, len(counts) + 1))
    assert len(counts) >= 5
    ticks = facts(path, "horus/ticks/it")
    assert len(ticks) >= len(counts)
    assert all(tick["execution_time_us"] >= 0 and not tick["failed"] for tick in ticks)


def test_a_node_in_a_process_of_its_own_is_recorded(tmp_path):
    """What a worker process sends is recorded like everything else."""
    sched = Scheduler(tick_rate=100, recording=tmp_path)
    sched.add(Node("it", counting(), rate=50, compute="process", pubs=["count"]))

    async def main():
        async with sched:
            await sched.wait_node("it", ticks=5)

    asyncio.run(main())
    (path,) = sched.stop_recording()
    counts = read(path, "count")
    assert counts == list(range(1, len(counts) + 1))
    assert len(counts) >= 5


def test_each_message_has_its_cycle_release_sender_and_number(tmp_path):
    """A message's record says when, in which cycle, by whom and which in number it was sent."""
    path = record(
        tmp_path,
        Node("left", lambda node: node.send("both", "left"), rate=100, order=1, pubs=["both"]),
        Node("right", lambda node: node.send("both", "right"), rate=50, order=2, pubs=["both"]),
        ticks=4,
    )
    with RecordingReader(path) as reader:
        messages = list(reader.messages(["both"]))
        epoch_ns = reader.about["epoch_ns"]
    assert [(m.publisher, m.sequence, m.cycle) for m in messages] == [
        ("left", 1, 0),
        ("right", 1, 0),
        ("left", 2, 1),
        ("left", 3, 2),
        ("right", 2, 2),
        ("left", 4, 3),
    ]
    assert [m.release_ns - epoch_ns for m in messages if m.publisher == "left"] == [
        10_000_000 * cycle for cycle in range(4)
    ]
    assert all(m.sent_ns >= m.release_ns for m in messages)


def test_messages_of_the_application_are_recorded_as_its_own(tmp_path):
    """What the application publishes is recorded, and was sent in no tick."""
    sched = Scheduler(tick_rate=100, deterministic=True, recording=tmp_path)
    sched.add(Node("node", nothing))
    sched.tick_once()
    sched.publish("goal", (1.0, 2.0))
    sched.tick_once()
    (path,) = sched.stop_recording()
    with RecordingReader(path) as reader:
        (message,) = reader.messages(["goal"])
    assert message.publisher == "application"
    assert message.release_ns is None
    assert message.message() == (1.0, 2.0)


def test_misses_failures_changes_logs_and_configuration_are_recorded(tmp_path):
    """What goes wrong is in the recording, and how the scheduler and its nodes are set up."""

    def fail(node):
        logging.getLogger("horus.test").warning("the %s is hot", "motor")
        raise RuntimeError("no")

    path = record(
        tmp_path,
        Node("bad", fail, rate=100, failure_policy="skip"),
        Node("slow", lambda node: horus.clock.current.get(), rate=50, budget=0.001),
        ticks=6,
        name="rover",
    )
    about = facts(path, "horus/scheduler")[0]
    assert about["name"] == "rover"
    assert about["tick_rate_hz"] == 100
    assert about["deterministic"] is True
    nodes = {node["name"]: node for node in facts(path, "horus/nodes")}
    assert nodes["slow"]["rate_hz"] == 50
    assert nodes["slow"]["budget_us"] == 1000
    assert nodes["bad"]["failure_policy"] == "skip"
    assert any(tick["failed"] for tick in facts(path, "horus/ticks/bad"))
    events = {(event["kind"], event["node"]) for event in facts(path, "horus/events")}
    assert ("state", "bad") in events
    logs = facts(path, "horus/log")
    assert any(log["message"] == "the motor is hot" and log["level"] == 3 for log in logs)


def test_the_mcap_library_opens_a_recording(tmp_path):
    """The library reads it without help, checks every sum, and finds JSON where it says so."""
    path = record(tmp_path, Node("node", counting(), rate=100, pubs=["count"]), ticks=100)
    found = collections.Counter()
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        for schema, channel, message in reader.iter_messages():
            found[channel.topic] += 1
            if channel.message_encoding == "json":
                content = json.loads(message.data)
                assert schema.encoding == "jsonschema"
                assert set(json.loads(schema.data).get("required", ())) <= content.keys()
    assert found["count"] == 100
    assert summary.statistics.message_count == found.total()
    by_topic = {
        summary.channels[c].topic: n for c, n in summary.statistics.channel_message_counts.items()
    }
    assert by_topic == dict(found)


def test_numpy_arrays_and_nan_survive(tmp_path):
    """Arrays, nan, inf, tuples and bytes come back as what they were."""
    sent = {"a": np.arange(6, dtype=">i2").reshape(2, 3), "b": (float("inf"), b"\0"), "c": {1: "x"}}
    path = record(tmp_path, Node("n", lambda node: node.send("t", sent), pubs=["t"]), ticks=1)
    (got,) = read(path, "t")
    assert got["a"].dtype == sent["a"].dtype
    np.testing.assert_array_equal(got["a"], sent["a"])
    assert (got["b"], got["c"]) == (sent["b"], sent["c"])


def test_what_cannot_be_recorded_is_told_once_and_the_rest_is(tmp_path, caplog):
    """A message with no form as data is reported by topic, once; all others are recorded."""

    def tick(node):
        node.send("odd", object())
        node.send("fine", 1)

    path = record(tmp_path, Node("node", tick, rate=100, pubs=["odd", "fine"]), ticks=5)
    assert read(path) == [1] * 5
    told = [r.getMessage() for r in caplog.records if "not recorded" in r.getMessage()]
    assert len(told) == 1
    assert "'odd'" in told[0]
    assert "object" in told[0]


# -- when it begins and ends -----------------------------------------------------------------


def test_recording_can_be_stopped_mid_run(tmp_path):
    """stop_recording() in a tick ends the file there; the nodes tick on."""
    sched = Scheduler(tick_rate=100, deterministic=True, recording=tmp_path)
    files = []

    def stop(node):
        if horus.tick() == 5:
            files.extend(sched.stop_recording())

    sched.add(Node("count", counting(), rate=100, order=1, pubs=["count"]))
    sched.add(Node("stop", stop, rate=100, order=2))
    sched.tick_for(0.2)
    assert sched.get_node_stats("count")["total_ticks"] == 20
    assert len(read(files[0], "count")) in (5, 6)
    assert sched.stop_recording() == files
    assert not sched.is_recording()
    sched.stop()
    assert sched.stop_recording() == files


def test_each_run_is_a_session_of_its_own(tmp_path):
    """Two runs make two files."""
    sched = Scheduler(tick_rate=100, recording=tmp_path)
    sched.add(Node("count", counting(), rate=100, pubs=["count"]))
    for _ in range(2):
        sched.run(duration=0.1)
    first, second = sched.list_recordings()
    assert read(first.path, "count")[-1] + 1 == read(second.path, "count")[0]


def test_two_schedulers_record_side_by_side(tmp_path):
    """Each has its own file, with its own messages only."""
    one, two = (
        Scheduler(tick_rate=100, deterministic=True, recording=tmp_path, name=name)
        for name in ("one", "two")
    )
    for sched in (one, two):
        sched.add(Node("count", counting(), rate=100, pubs=["count"]))
    for _ in range(5):
        one.tick_once()
    two.tick_once()
    assert len(read(one.stop_recording()[0])) == 5
    assert len(read(two.stop_recording()[0])) == 1


def test_a_node_added_while_recording_is_recorded(tmp_path):
    """Nodes that join later are in the recording from then on, and removed ones stay in it."""
    sched = Scheduler(tick_rate=100, deterministic=True, recording=tmp_path)
    sched.add(Node("early", counting("early"), rate=100, pubs=["early"]))
    sched.tick_once()
    sched.add(Node("late", counting("late"), rate=100, pubs=["late"]))
    sched.remove_node("early")
    sched.tick_once()
    (path,) = sched.stop_recording()
    assert [len(read(path, topic)) for topic in ("early", "late")] == [1, 1]
    assert {node["name"] for node in facts(path, "horus/nodes")} == {"early", "late"}


# -- listing and deleting --------------------------------------------------------------------

BAD_NAMES = [
    "../../etc/passwd",
    "",
    "/etc/passwd",
    "a\0b",
    "a/b",
    "..",
    ".",
    ".hidden",
    "a\nb",
    "-rf",
    "x" * 300,
    None,
    7,
    b"session",
    Path("session"),
]


@pytest.mark.parametrize("name", BAD_NAMES, ids=repr)
def test_names_are_names_and_not_paths(name, tmp_path):
    """What is no name is refused by delete_recording, and nothing is deleted."""
    inside = tmp_path / "recordings"
    record(inside, Node("node", nothing))
    (tmp_path / "victim.mcap").write_bytes(b"x")
    before = sorted(tmp_path.rglob("*"))
    sched = Scheduler(recording=inside)
    with pytest.raises(RecordingError, match="no name of a session"):
        sched.delete_recording(name)
    assert sorted(tmp_path.rglob("*")) == before


def test_deleting_what_is_not_there_names_what_is(tmp_path):
    """A RecordingError that lists the sessions there are."""
    path = record(tmp_path, Node("node", nothing))
    with pytest.raises(RecordingError, match=f"(?s)'nope'.*{path.stem}"):
        Scheduler(recording=tmp_path).delete_recording("nope")


def test_a_session_that_is_being_recorded_is_not_deleted(tmp_path):
    """It says so instead; once it is finished, it can be deleted."""
    sched = Scheduler(tick_rate=100, deterministic=True, recording=tmp_path)
    sched.add(Node("node", nothing))
    sched.tick_once()
    (session,) = sched.list_recordings()
    assert session.state == "recording"
    with pytest.raises(RecordingError, match="being recorded"):
        sched.delete_recording(session)
    sched.stop_recording()
    sched.delete_recording(session)
    assert sched.list_recordings() == []


@pytest.mark.parametrize("recording", [1, None, "", "a\0b", b"x", 1.5], ids=repr)
def test_recording_must_be_a_flag_or_a_directory(recording):
    """Anything else is refused at construction."""
    with pytest.raises(ConfigError, match="recording"):
        Scheduler(recording=recording)


def test_backpressure_must_be_drop_or_block():
    """Anything else is refused at construction."""
    with pytest.raises(ConfigError, match="'drop' or 'block'"):
        Scheduler(recording_backpressure="wait")


# -- faults ----------------------------------------------------------------------------------


def test_a_directory_that_cannot_be_made_leaves_the_robot_running(tmp_path, caplog):
    """The error is reported once; the nodes tick."""
    (tmp_path / "file").write_text("in the way")
    sched = Scheduler(tick_rate=100, deterministic=True, recording=tmp_path / "file" / "sub")
    sched.add(Node("node", nothing, rate=100))
    sched.tick_for(0.1)
    assert sched.get_node_stats("node")["total_ticks"] == 10
    assert not sched.is_recording()
    assert sched.stop_recording() == []
    assert len([r for r in caplog.records if "nothing is recorded" in r.getMessage()]) == 1


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can mount a small disk")
def test_a_full_disk_leaves_the_robot_running_and_the_recording_readable(tmp_path, caplog):
    """Disk full: told once, what was written stays readable, and recording goes on after it."""
    disk = tmp_path / "disk"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "none", disk]).returncode:
        pytest.skip("mounting is not allowed here")
    try:
        sched = Scheduler(tick_rate=1000, recording=disk)
        noise = iter(lambda: os.urandom(20_000), None)
        sched.add(Node("n", lambda node: node.send("noise", next(noise)), rate=200, pubs=["noise"]))
        sched.run(duration=1.5)
        assert sched.get_node_stats("n")["total_ticks"] >= 100
        (path,) = sched.stop_recording()
        told = [r for r in caplog.records if "cannot be written" in r.getMessage()]
        assert len(told) == 1
        assert "No space left" in told[0].getMessage()
        assert [session.path for session in sched.list_recordings()] == [path]
        shutil.copy(path, tmp_path / path.name)
    finally:
        subprocess.run(["umount", disk], check=True)
    with horus.open_recording(tmp_path / path.name) as reader:
        assert len(list(reader.messages(["noise"]))) >= 20


def test_a_deleted_directory_leaves_the_robot_running(tmp_path, caplog):
    """The directory vanishes during the run: told once, and the nodes tick on."""
    directory = tmp_path / "recordings"
    sched = Scheduler(tick_rate=100, recording=directory)

    def delete(node):
        if horus.tick() == 10:
            shutil.rmtree(directory)

    sched.add(Node("node", delete, rate=100))
    sched.run(duration=0.8)
    assert sched.get_node_stats("node")["total_ticks"] >= 40
    told = [r for r in caplog.records if "cannot be written" in r.getMessage()]
    assert len(told) == 1
    assert "deleted" in told[0].getMessage()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give rights away")
def test_a_directory_one_may_not_write_leaves_the_robot_running(tmp_path):
    """A read-only directory: told, and the nodes tick."""
    tmp_path.chmod(0o555)
    program = f"""
        import logging
        from horus import Node, Scheduler
        logging.basicConfig(format="%(message)s", filename={str(tmp_path.parent / "log")!r})
        sched = Scheduler(tick_rate=100, recording={str(tmp_path)!r})
        sched.add(Node("node", lambda node: None, rate=100))
        sched.run(duration=0.3)
        print(sched.get_node_stats("node")["total_ticks"] >= 10, sched.stop_recording())
    """
    assert run_without(program, CAP_DAC_OVERRIDE).stdout.strip() == "True []"
    told = (tmp_path.parent / "log").read_text().splitlines()
    assert [line for line in told if "nothing is recorded" in line and "denied" in line] == told


_KILLED = """
    import os, signal, sys, time
    from horus import Node, Scheduler
    sent = []
    def tick(node):
        sent.append(time.monotonic())
        node.send("count", len(sent))
        if len(sent) == 1000:
            settled = sum(moment < sent[-1] - 0.2 for moment in sent)
            print(len(sent), settled, flush=True)
            if sys.argv[2] == "kill":
                os.kill(os.getpid(), signal.SIGKILL)
            import ctypes
            ctypes.string_at(0)
    sched = Scheduler(tick_rate=1000, recording=sys.argv[1])
    sched.add(Node("count", tick, rate=1000, pubs=["count"]))
    sched.run(duration=30)
"""


@pytest.mark.parametrize("how", ["kill", "segfault"])
def test_a_process_that_dies_leaves_what_is_older_than_200_ms(how, tmp_path):
    """After SIGKILL or a segfault, everything sent more than 200 ms before is salvaged."""
    script = textwrap.dedent(_KILLED)
    run = subprocess.run(
        [sys.executable, "-c", script, str(tmp_path), how],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert run.returncode in (-signal.SIGKILL, -signal.SIGSEGV), run.stderr
    sent, settled = map(int, run.stdout.split())
    (session,) = Scheduler(recording=tmp_path).list_recordings()
    assert session.state == "unfinished"
    with pytest.raises(RecordingError, match=r"horus\.recover"):
        RecordingReader(session.path)
    recovered = horus.recover(session.path)
    counts = read(recovered.path, "count")
    assert counts == list(range(1, len(counts) + 1))
    assert settled <= len(counts) <= sent
    (session,) = Scheduler(recording=tmp_path).list_recordings()
    assert session.finished


def test_a_program_that_ends_without_ending_its_session_leaves_a_finished_file(tmp_path):
    """An interpreter that exits between two tick_once() calls finishes the recording."""
    script = """
        import sys
        from horus import Node, Scheduler
        sched = Scheduler(recording=sys.argv[1], deterministic=True)
        sched.add(Node("count", lambda node: node.send("count", 1), pubs=["count"]))
        sched.tick_once()
    """
    subprocess.run(
        [sys.executable, "-c", textwrap.dedent(script), str(tmp_path)], check=True, timeout=60
    )
    (session,) = Scheduler(recording=tmp_path).list_recordings()
    assert session.finished
    assert read(session.path) == [1]


def test_a_recording_that_is_not_there_or_not_finished_is_called_so(tmp_path):
    """Nobody is told to recover what is missing, or still written."""
    with pytest.raises(RecordingError, match="there is no file"):
        horus.open_recording(tmp_path / "session.mcap")
    with pytest.raises(RecordingError, match="there is no file"):
        RecordingReader(tmp_path / "session.mcap")
    sched = Scheduler(recording=tmp_path, deterministic=True)
    sched.add(Node("node", nothing))
    sched.tick_once()
    (path,) = tmp_path.glob("*.mcap")
    for open_it in (horus.open_recording, RecordingReader):
        with pytest.raises(RecordingError, match="is being recorded"):
            open_it(path)
    sched.stop()
