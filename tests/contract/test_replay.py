"""Replay: recorded messages are sent again, when they were sent, bit by bit."""

from __future__ import annotations

import asyncio
import dataclasses
import hashlib
import math
import os
import sys
import time

import pytest

import horus
from horus import Node, RecordingError, RecordingReader, Scheduler, StateError
from horus.errors import ConfigError, NodeError

from .helpers import nothing


@dataclasses.dataclass(frozen=True)
class Scan:
    """What the sensor below sends."""

    at: float
    ranges: tuple[float, ...]


def sense(node):
    """Send a scan of noise."""
    node.send("scan", Scan(horus.now(), (horus.rng_float(), float("inf"))))


def control(node):
    """Answer the newest scan with a command."""
    for scan in node.recv_all("scan"):
        node.send("cmd", {"speed": 2 * scan.ranges[0], "tick": horus.tick()})


def brake(node):
    """Brake when a command is too fast."""
    command = node.recv("cmd")
    if command["speed"] > 1.5:
        node.send("brake", command["speed"])


async def report(node):
    """Report now and 50 ms later."""
    node.send("report", "begun")
    await asyncio.sleep(0.05)
    node.send("report", node.latest("cmd"))


def hello(node):
    """Say something before the first tick."""
    node.send("hello", node.name)


NODES = {
    "sensor": {"tick": sense, "rate": 100, "order": 1, "pubs": ["scan", "hello"], "init": hello},
    "control": {"tick": control, "rate": 50, "order": 20, "subs": ["scan"], "pubs": ["cmd"]},
    "brake": {"tick": brake, "on": "cmd", "order": 0, "pubs": ["brake"]},
    "worker": {"tick": lambda node: node.send("w", 1), "rate": 20, "compute": True, "pubs": ["w"]},
    "fleet": {"tick": report, "rate": 5, "order": 50, "pubs": ["report"]},
    "plain": {"tick": lambda node: node.send("p", horus.tick()), "order": 5, "pubs": ["p"]},
}


def add_nodes(sched, names=NODES):
    """Add nodes of every class."""
    for name in names:
        sched.add(Node(name, **NODES[name]))


def messages(path, topics=None):
    """Return all messages of a recording, with everything that is known of them."""
    with RecordingReader(path) as reader:
        return list(reader.messages(topics))


def digest(path):
    """Return a hash over all messages of a recording."""
    sums = hashlib.sha256()
    for message in messages(path):
        sums.update(repr(message).encode())
    return sums.hexdigest()


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Record nodes of every class in virtual time."""
    sched = Scheduler(
        tick_rate=1000,
        deterministic=True,
        seed=3,
        recording=tmp_path_factory.mktemp("recorded"),
        name="rover",
    )
    add_nodes(sched)
    sched.run(duration=2.0)
    (path,) = sched.stop_recording()
    return path


@pytest.fixture(scope="module")
def live(tmp_path_factory):
    """Record nodes of every class in real time."""
    sched = Scheduler(tick_rate=1000, recording=tmp_path_factory.mktemp("live"))
    add_nodes(sched)
    sched.run(duration=1.0)
    (path,) = sched.stop_recording()
    return path


# -- exactly ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "live_nodes",
    [[], ["sensor"], ["control"], ["brake"], ["fleet"], ["worker", "plain"], ["control", "brake"]],
    ids=" ".join,
)
def test_a_deterministic_replay_is_bit_identical(live_nodes, recorded, tmp_path):
    """Whichever nodes are replayed and whichever run live: the same, bit for bit and in order."""
    sched = Scheduler.replay_from(recorded, recording=tmp_path)
    sched.set_replay_speed(math.inf)
    add_nodes(sched, live_nodes)
    assert sched.is_replaying()
    sched.run()
    assert not sched.is_replaying()
    (path,) = sched.stop_recording()
    assert digest(path) == digest(recorded)
    assert horus.diff(recorded, path) is None


@pytest.mark.parametrize("live_nodes", [False, True])
def test_the_warehouse_agv_replays_bit_identically(live_nodes, tmp_path):
    """The AGV example: record it, replay its sensors to its safety and planner, compare hashes."""
    sys.path.insert(0, os.path.join(os.path.dirname(__file__), "..", "..", "examples"))
    try:
        import warehouse_agv
    finally:
        sys.path.pop(0)
    run = warehouse_agv.drive_mission(deterministic=True, duration_s=3.0, recording=tmp_path / "a")
    (first,) = run.recordings
    replayed = Scheduler.replay_from(first, recording=tmp_path / "b")
    replayed.set_replay_speed(math.inf)
    if live_nodes:
        log = warehouse_agv.mission.MissionLog(clock=horus.now)
        replayed.add(warehouse_agv.SafetyMonitor(log))
        replayed.add(warehouse_agv.PathPlanner(warehouse_agv.OccupancyGrid(), log))
    replayed.run()
    (second,) = replayed.stop_recording()
    assert len(messages(first)) > 500
    assert digest(first) == digest(second)


def test_a_real_time_recording_is_replayed_in_virtual_time(live, tmp_path):
    """Every message once, in the recorded order of each topic, with a controller that is new."""
    commands = []

    def new_control(node):
        for scan in node.recv_all("scan"):
            commands.append(scan)
            node.send("cmd", {"speed": -scan.ranges[0], "tick": 0})

    sched = Scheduler.replay_from(live, ["sensor", "fleet", "worker", "plain"], recording=tmp_path)
    sched.set_replay_speed(math.inf)
    sched.add(Node("control", new_control, rate=50, order=20, subs=["scan"], pubs=["cmd"]))
    sched.run()
    (path,) = sched.stop_recording()
    for topic in ("scan", "hello", "w", "p"):
        before = [message.data for message in messages(live, [topic])]
        assert [message.data for message in messages(path, [topic])] == before
        assert before
    assert len(commands) >= len(messages(live, ["scan"])) - 1
    # Of the same release, and before the controller in execution order: no cycle later.
    new, old = messages(path, ["cmd"]), messages(live, ["cmd"])
    assert abs(len(new) - len(old)) <= 1


def test_messages_are_replayed_at_the_times_they_were_sent(live, tmp_path):
    """Relative to the first cycle, sends are where they were, to the period of their node."""
    sched = Scheduler.replay_from(live, recording=tmp_path)
    sched.set_replay_speed(math.inf)
    sched.run()
    (path,) = sched.stop_recording()

    def offsets(path):
        with RecordingReader(path) as reader:
            epoch_ns = list(reader.facts("horus/scheduler"))[1]["epoch_ns"]
            return [m.sent_ns - epoch_ns for m in reader.messages(["report"])]

    for before, after in zip(offsets(live), offsets(path), strict=True):
        assert abs(before - after) < 5_000_000


# -- beside live nodes -----------------------------------------------------------------------


def test_recorded_sensors_and_a_live_controller_in_real_time(recorded):
    """add_replay(): stand-ins beside live nodes, on the robot's own clock."""
    scans = []
    sched = Scheduler(tick_rate=1000)
    sched.add_replay(recorded, ["sensor"])
    sched.add(
        Node("new", lambda node: scans.extend(node.recv_all("scan")), rate=200, subs=["scan"])
    )
    assert sched.is_replaying()
    began = time.monotonic()
    sched.run(duration=2.3)
    assert time.monotonic() - began >= 2.2
    assert scans == [m.message() for m in messages(recorded, ["scan"])]
    assert not sched.is_replaying()


def test_a_replay_may_begin_while_the_robot_runs(recorded):
    """It begins now; the nodes that run are not disturbed."""
    got = []
    sched = Scheduler(tick_rate=1000, deterministic=True)
    sched.add(Node("new", lambda node: got.extend(node.recv_all("scan")), rate=100, subs=["scan"]))
    sched.tick_for(1.0)
    sched.add_replay(recorded, topics=["scan"])
    sched.tick_for(0.5)
    assert 45 <= len(got) <= 51
    sched.tick_for(2.0)
    assert len(got) == len(messages(recorded, ["scan"]))
    sched.stop()


def test_only_chosen_topics_are_replayed(recorded, tmp_path):
    """With topics=, what else the nodes have sent is left out."""
    sched = Scheduler.replay_from(recorded, topics=["scan", "w"], recording=tmp_path)
    sched.set_replay_speed(math.inf)
    sched.run()
    (path,) = sched.stop_recording()
    assert {message.topic for message in messages(path)} == {"scan", "w"}


def test_a_node_that_is_here_already_cannot_be_replayed_too(recorded):
    """add_replay() refuses it and adds none of the others."""
    sched = Scheduler()
    sched.add(Node("control", nothing))
    with pytest.raises(ConfigError, match=r"control.*is here already"):
        sched.add_replay(recorded)
    assert sched.get_node_names() == ["control"]


@pytest.mark.parametrize(("what", "known"), [("nodes", "sensor"), ("topics", "scan")])
def test_what_is_not_in_the_recording_is_named_with_what_is(what, known, recorded):
    """An unknown node or topic is a RecordingError, a single string a ConfigError."""
    with pytest.raises(RecordingError, match=f"'nope'.*there are.*{known}"):
        Scheduler.replay_from(recorded, **{what: ["nope"]})
    with pytest.raises(ConfigError, match=what):
        Scheduler.replay_from(recorded, **{what: "nope"})


# -- from, to, how fast, what else -----------------------------------------------------------


def test_start_and_stop_at_a_tick(recorded):
    """The replay begins in one cycle and ends before another; the clock agrees."""
    ticks, times, scans = [], [], []

    def watch(node):
        ticks.append(horus.tick())
        times.append(horus.now())
        scans.extend(node.recv_all("scan"))

    sched = Scheduler.replay_from(recorded)
    sched.set_replay_speed(math.inf)
    sched.start_at_tick(500)
    sched.stop_at_tick(700)
    sched.add(Node("watch", watch, rate=1000, order=200, subs=["scan"]))
    sched.run()
    assert ticks == list(range(500, 700))
    assert times[0] == 0.5
    assert scans == [m.message() for m in messages(recorded, ["scan"]) if 500 <= m.cycle < 700]


def test_a_cycle_beyond_the_end_is_refused(recorded):
    """start_at_tick() and stop_at_tick() say where the recording ends."""
    sched = Scheduler.replay_from(recorded)
    for choose in (sched.start_at_tick, sched.stop_at_tick):
        with pytest.raises(RecordingError, match="ends before cycle 99999"):
            choose(99999)
        with pytest.raises(ConfigError, match="cycle"):
            choose(-1)
    with pytest.raises(StateError, match="nothing is replayed"):
        Scheduler().start_at_tick(1)


@pytest.mark.parametrize("speed", [2.0, 8.0])
def test_a_replay_passes_at_the_speed_that_is_set(speed, recorded):
    """Two recorded seconds at twice the speed take one."""
    sched = Scheduler.replay_from(recorded)
    sched.set_replay_speed(speed)
    began = time.monotonic()
    sched.run()
    assert 2.0 / speed - 0.05 <= time.monotonic() - began <= 2.0 / speed + 0.75


def test_the_speed_may_change_while_replaying(recorded):
    """From a node, say: the rest passes at the new speed."""
    sched = Scheduler.replay_from(recorded)
    sched.set_replay_speed(0.01)
    changed = sched.set_replay_speed
    sched.add(Node("hurry", lambda node: changed(math.inf), rate=1000, order=0))
    began = time.monotonic()
    sched.run()
    assert time.monotonic() - began < 1.0


def test_a_paced_replay_can_be_stopped(recorded):
    """stop() ends it at once, however slow it is."""
    sched = Scheduler.replay_from(recorded)
    sched.set_replay_speed(0.01)
    sched.add(Node("stop", lambda node: sched.stop("enough"), order=0))
    began = time.monotonic()
    sched.run()
    assert time.monotonic() - began < 1.0
    assert sched.is_replaying()


@pytest.mark.parametrize("speed", [0, -1, 0.001, 101, math.nan, -math.inf, "fast", True, None])
def test_speeds_out_of_range_are_refused(speed, recorded):
    """0.01 to 100, or math.inf."""
    with pytest.raises(ConfigError, match="speed"):
        Scheduler.replay_from(recorded).set_replay_speed(speed)


def test_in_real_time_a_replay_cannot_hurry_without_end(recorded):
    """math.inf needs virtual time; 4 times the speed does not."""
    got = []
    sched = Scheduler(tick_rate=1000)
    sched.add_replay(recorded, topics=["scan"])
    with pytest.raises(ConfigError, match="deterministic=True"):
        sched.set_replay_speed(math.inf)
    sched.set_replay_speed(4)
    sched.add(Node("new", lambda node: got.extend(node.recv_all("scan")), rate=500, subs=["scan"]))
    sched.run(duration=0.7)
    assert len(got) == len(messages(recorded, ["scan"]))


def test_overrides(recorded):
    """A value, or what a function makes of each message; None sends nothing."""
    scans, commands, brakes = [], [], []

    def watch(node):
        scans.extend(node.recv_all("scan"))
        commands.extend(node.recv_all("cmd"))
        brakes.extend(node.recv_all("brake"))

    sched = Scheduler.replay_from(recorded, ["sensor", "control", "brake"])
    sched.set_replay_speed(math.inf)
    sched.set_replay_override("scan", lambda scan: dataclasses.replace(scan, ranges=(1.0,)))
    sched.set_replay_override("cmd", {"speed": 0})
    sched.set_replay_override("brake", lambda _: None)
    sched.add(Node("watch", watch, rate=100, order=99, subs=["scan", "cmd", "brake"]))
    sched.run()
    assert {scan.ranges for scan in scans} == {(1.0,)}
    assert len(scans) == len(messages(recorded, ["scan"]))
    assert commands
    assert all(command == {"speed": 0} for command in commands)
    assert brakes == []


def test_a_broken_override_ends_the_run(recorded):
    """A replay with a hole would mislead: the error is raised by run()."""
    sched = Scheduler.replay_from(recorded)
    sched.set_replay_speed(math.inf)
    sched.set_replay_override("scan", lambda scan: scan["nope"])
    with pytest.raises(NodeError, match="sensor"):
        sched.run()


def test_a_second_run_replays_again(recorded):
    """Each run() begins at the beginning."""
    counts = []
    sched = Scheduler(tick_rate=1000, deterministic=True)
    sched.add_replay(recorded, topics=["scan"])
    sched.add(
        Node("new", lambda node: counts.append(len(node.recv_all("scan"))), rate=100, subs=["scan"])
    )
    sched.run(duration=2.0)
    first = sum(counts)
    sched.run(duration=2.0)
    assert first > 100
    assert sum(counts) == 2 * first


def test_steps_need_virtual_time(recorded):
    """tick_once() replays cycle by cycle in deterministic mode, and refuses in real time."""
    sched = Scheduler.replay_from(recorded)
    sched.set_replay_speed(math.inf)
    for _ in range(11):
        sched.tick_once()
    assert sched.get_node_stats("sensor")["total_ticks"] == 2
    sched.stop()
    sched = Scheduler()
    sched.add_replay(recorded)
    with pytest.raises(StateError, match="deterministic"):
        sched.tick_once()
    with pytest.raises(StateError, match="deterministic"):
        sched.tick_for(0.1)


def test_a_replay_within_an_event_loop(recorded):
    """arun() replays too, and ends where the recording ends."""
    sched = Scheduler.replay_from(recorded)
    sched.set_replay_speed(math.inf)
    asyncio.run(sched.arun())
    assert not sched.is_replaying()
    assert sched.get_node_stats("sensor")["total_ticks"] == 200


class Opaque:
    """A class that is neither a dataclass nor a Struct."""

    def __init__(self):
        self.value = 7


def test_classes_that_are_no_data_must_be_named(tmp_path):
    """A recording cannot make instances of any class there is: only of those that are named."""
    sched = Scheduler(tick_rate=100, deterministic=True, recording=tmp_path)
    sched.add(Node("node", lambda node: node.send("it", Opaque()), rate=100, pubs=["it"]))
    sched.run(duration=0.1)
    (path,) = sched.stop_recording()
    with pytest.raises(RecordingError, match=r"topic 'it'.*Opaque.*classes="):
        Scheduler.replay_from(path)
    got = []
    replayed = Scheduler.replay_from(path, classes=[Opaque])
    replayed.set_replay_speed(math.inf)
    replayed.add(Node("new", lambda node: got.extend(node.recv_all("it")), order=200, subs=["it"]))
    replayed.run()
    assert got
    assert all(type(it) is Opaque and it.value == 7 for it in got)


def test_a_replayed_node_keeps_to_the_recording(recorded):
    """Its rate cannot be changed."""
    sched = Scheduler.replay_from(recorded)
    with pytest.raises(ConfigError, match="replayed as it was recorded"):
        sched.set_node_rate("sensor", 10)


# -- diff ------------------------------------------------------------------------------------


def record_values(directory, values, topic="t", **options):
    """Record a node that sends these values."""
    left = iter(values)
    options = {"tick_rate": 100, "deterministic": True, **options}
    sched = Scheduler(recording=directory, **options)
    sched.add(Node("node", lambda node: node.send(topic, next(left)), rate=100, pubs=[topic]))
    sched.run(duration=len(values) / 100)
    (path,) = sched.stop_recording()
    return path


@pytest.mark.parametrize(
    ("one", "two", "field", "a", "b"),
    [
        ({"x": 1}, {"x": 2}, ".x", 1, 2),
        ({"p": [1, {"q": (2, 3)}]}, {"p": [1, {"q": (2, 4)}]}, ".p[1].q[1]", 3, 4),
        ({"x": 1}, {"x": 1, "y": 2}, ".y", None, 2),
        ([1, 2], [1, 2, 3], " (length)", 2, 3),
        (Scan(0.0, (1.0,)), Scan(0.0, (2.0,)), ".ranges[0]", 1.0, 2.0),
        (1, 1.0, "", 1, 1.0),
        ({"n": math.nan, "z": 0.0}, {"n": math.nan, "z": -0.0}, ".z", 0.0, -0.0),
    ],
)
def test_the_first_difference_is_named_to_the_field(one, two, field, a, b, tmp_path):
    """Tick, topic, field and both values."""
    first = record_values(tmp_path / "a", ["same", "same", one, "end"])
    second = record_values(tmp_path / "b", ["same", "same", two, "other"])
    found = horus.diff(first, second)
    assert (found.tick, found.topic, found.publisher, found.sequence) == (2, "t", "node", 3)
    assert (found.field, repr(found.a), repr(found.b)) == (field, repr(a), repr(b))
    assert "tick 2, topic 't', message 3 of 'node'" in str(found)


def test_arrays_differ_in_an_element(tmp_path):
    """The index says which."""
    np = pytest.importorskip("numpy")
    one = np.arange(6.0).reshape(2, 3)
    two = one.copy()
    two[1, 2] = -1
    first, second = record_values(tmp_path / "a", [one]), record_values(tmp_path / "b", [two])
    found = horus.diff(first, second)
    assert (found.field, found.a, found.b) == ("[1, 2]", 5.0, -1.0)


def test_a_missing_message_is_a_difference(tmp_path):
    """The recording that ends earlier, or lacks a topic, has None there."""
    first = record_values(tmp_path / "a", [1, 2, 3])
    second = record_values(tmp_path / "b", [1, 2])
    found = horus.diff(first, second)
    assert (found.tick, found.field, found.a, found.b) == (2, "(missing)", 3, None)
    other = record_values(tmp_path / "c", [1, 2, 3], topic="u")
    assert horus.diff(first, other).field == "(missing)"
    assert horus.diff(first, first, topics=["t"]) is None


def test_a_comparison_of_nothing_is_refused(tmp_path):
    """A misspelt topic must not say that there is no difference."""
    first = record_values(tmp_path / "a", [1, 2, 3])
    second = record_values(tmp_path / "b", [1, 2])
    with pytest.raises(RecordingError, match=r"topic 'tt'; there are: t$"):
        horus.diff(first, second, topics=["t", "tt"])
    with pytest.raises(ConfigError, match="list of names"):
        horus.diff(first, second, topics="t")
    with horus.RecordingReader(first) as reader, pytest.raises(ConfigError, match="list of names"):
        reader.messages("t")


def test_a_message_of_another_cycle_is_a_difference_in_virtual_time(tmp_path):
    """The same messages, one cycle later."""
    paths = []
    for late in (0, 1):
        sched = Scheduler(tick_rate=100, deterministic=True, recording=tmp_path / str(late))

        def tick(node, late=late):
            if horus.tick() == 3 + late:
                node.send("t", "x")

        sched.add(Node("node", tick, rate=100, pubs=["t"]))
        sched.run(duration=0.1)
        paths += sched.stop_recording()
    found = horus.diff(*paths)
    assert (found.tick, found.field, found.a, found.b) == (3, "(tick)", 3, 4)


def test_diff_finds_a_changed_controller(recorded, tmp_path):
    """Replay the sensors through another controller: the first command differs."""
    sched = Scheduler.replay_from(recorded, ["sensor"], recording=tmp_path)
    sched.set_replay_speed(math.inf)

    def faster(node):
        for scan in node.recv_all("scan"):
            node.send("cmd", {"speed": 3 * scan.ranges[0], "tick": horus.tick()})

    sched.add(Node("control", faster, rate=50, order=20, subs=["scan"], pubs=["cmd"]))
    sched.run()
    (path,) = sched.stop_recording()
    found = horus.diff(recorded, path, topics=["scan", "cmd"])
    assert (found.topic, found.field, found.sequence) == ("cmd", ".speed", 1)
    assert found.b == pytest.approx(1.5 * found.a)
