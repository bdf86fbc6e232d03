"""`python -m horus`: what it prints, for people and for machines, and its exit codes."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from horus import Node, Scheduler
from horus.cli import main


@pytest.fixture
def recording(tmp_path):
    """Record two nodes for a second of virtual time."""
    sched = Scheduler(tick_rate=100, deterministic=True, recording=tmp_path / "it", name="rover")
    sched.add(Node("lidar", lambda node: node.send("scan", 1), rate=50, pubs=["scan"]))
    sched.add(Node("plain", lambda node: node.send("state", {"x": 1}), rate=10, pubs=["state"]))
    sched.run(duration=1.0)
    (path,) = sched.stop_recording()
    return path


def said(capsys, *arguments):
    """Run a command; return its exit code and what it printed."""
    code = main([str(argument) for argument in arguments])
    printed = capsys.readouterr()
    return code, printed.out, printed.err


def test_recordings_are_listed(recording, capsys, monkeypatch):
    """With their state; as a table and as JSON; of a directory or of HORUS_HOME."""
    code, out, _ = said(capsys, "recordings", recording.parent)
    assert code == 0
    assert out.splitlines()[0].split() == ["session", "state", "size", "file"]
    assert recording.stem in out
    assert "finished" in out
    recording.parent.rename(recording.parent.with_name("recordings"))
    monkeypatch.setenv("HORUS_HOME", str(recording.parent.parent))
    _, out, _ = said(capsys, "recordings", "--json")
    (row,) = json.loads(out)
    assert (row["name"], row["state"]) == (recording.stem, "finished")
    assert row["bytes"] > 0


def test_info_says_what_is_in_a_recording(recording, capsys):
    """Scheduler, topics with counts and rates, nodes."""
    code, out, _ = said(capsys, "info", recording)
    assert code == 0
    assert "rover, 1.000 s of virtual time" in out
    assert any(line.split() == ["scan", "lidar", "50", "50.0"] for line in out.splitlines())
    assert any(line.split() == ["plain", "Rt", "10", "100"] for line in out.splitlines())
    _, out, _ = said(capsys, "info", recording, "--json")
    content = json.loads(out)
    assert content["scheduler"]["name"] == "rover"
    assert {"topic": "state", "publisher": "plain", "messages": 10} in content["topics"]


def test_log_prints_what_was_logged_and_what_changed(tmp_path, capsys):
    """In the order of time, since the beginning of the recording."""
    sched = Scheduler(tick_rate=100, deterministic=True, recording=tmp_path)
    sched.add(Node("arm", lambda node: node.log_warning("low battery"), rate=10))
    sched.run(duration=0.25)
    (path,) = sched.stop_recording()
    code, out, _ = said(capsys, "log", path)
    assert code == 0
    lines = [line.split(maxsplit=3) for line in out.splitlines()]
    warned = [line for line in lines if line[2] == "WARNING" and line[3] == "arm: low battery"]
    assert [float(line[0]) for line in warned] == [0.0, 0.1, 0.2]
    assert ["state", "arm: running"] in [line[2:] for line in lines]
    assert [float(line[0]) for line in lines] == sorted(float(line[0]) for line in lines)
    _, out, _ = said(capsys, "log", path, "--json")
    rows = json.loads(out)
    assert {"log_ns": 100_000_000, "kind": "WARNING", "text": "arm: low battery"} in rows


def test_recover_salvages(recording, capsys, tmp_path):
    """It says how much; several files at once."""
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(recording.read_bytes()[:-300])
    code, out, _ = said(capsys, "recover", recording, cut)
    assert code == 0
    assert len(out.splitlines()) == 2
    cut.write_bytes(recording.read_bytes()[:-300])
    _, out, _ = said(capsys, "recover", cut, "--json")
    assert json.loads(out)["messages"] > 60


def test_diff_names_the_first_difference(recording, capsys, tmp_path):
    """Exit code 0 without one, 1 with one."""
    assert said(capsys, "diff", recording, recording) == (0, "no difference\n", "")
    sched = Scheduler(tick_rate=100, deterministic=True, recording=tmp_path / "b")
    sched.add(Node("lidar", lambda node: node.send("scan", 1), rate=50, pubs=["scan"]))
    sched.add(Node("plain", lambda node: node.send("state", {"x": 2}), rate=10, pubs=["state"]))
    sched.run(duration=1.0)
    (other,) = sched.stop_recording()
    code, out, _ = said(capsys, "diff", recording, other)
    assert code == 1
    assert out == "tick 0, topic 'state', message 1 of 'plain', .x: 1 != 2\n"
    code, out, _ = said(capsys, "diff", recording, other, "--json")
    assert (code, json.loads(out)["field"]) == (1, ".x")
    assert said(capsys, "diff", recording, other, "--topic", "scan")[0] == 0


@pytest.mark.parametrize("command", [["info"], ["recover"], ["diff", "x"]])
def test_what_is_no_recording_is_refused_without_a_traceback(command, tmp_path, capsys):
    """Exit code 2, and the reason on stderr."""
    path = tmp_path / "no.mcap"
    path.write_text("no recording")
    arguments = [str(path) if each == "x" else each for each in command]
    code, out, err = said(capsys, *arguments, path)
    assert (code, out) == (2, "")
    assert err.startswith("horus: ")
    assert "not an MCAP" in err


def test_as_a_module(recording):
    """`python -m horus` is the same."""
    done = subprocess.run(
        [sys.executable, "-m", "horus", "info", str(recording)],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert "rover" in done.stdout
