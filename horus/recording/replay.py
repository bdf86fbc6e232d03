"""Replays recordings: stand-ins send again what nodes have sent, when they have sent it.

A stand-in is a node with the name, the order and the class of the one it stands in for, and
with releases at recorded instants. So everything that holds for nodes holds for replays:
order, statistics, recording. What was sent in a tick is sent at the tick's release, in
execution order; what was sent later than that (by async nodes and in worker threads or
processes) and outside of ticks, at the instant that it was sent.

An event node's stand-in ticks once per message, as the node did, if both the recording and
the replay are deterministic and that topic is replayed too.
"""

from __future__ import annotations

import asyncio
import math
import os
from bisect import bisect_left
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

from horus import clock
from horus.clock import Timeline
from horus.errors import ConfigError, RecordingError, StateError
from horus.loop.pacer import Pacer
from horus.node import Node
from horus.recording import encoding
from horus.recording.reader import RecordedMessage, RecordingReader, set_of_names
from horus.recording.recovery import open_recording
from horus.recording.scribe import EXACT
from horus.spec import ExecutionClass
from horus.timing import ReleaseGrid
from horus.units import to_s

_TICKS = "horus/ticks/"
_TIMED = (ExecutionClass.BEST_EFFORT, ExecutionClass.RT)


class _Saved(NamedTuple):
    """A message to be sent again."""

    due_ns: int
    """The release that it is sent in; for a stand-in that is not async, also when."""
    sent_ns: int
    message: RecordedMessage


@dataclass(slots=True)
class _Track:
    """What one node has sent."""

    name: str
    about: dict[str, Any] = field(default_factory=dict)
    """The node's configuration; empty for the application."""
    heard: list[tuple[RecordedMessage, bool] | None] = field(default_factory=list)
    """Each message, and whether the run had begun; None for the end of a tick."""
    early: list[RecordedMessage] = field(default_factory=list)
    """What it sent before the run, in `init()`."""
    saved: list[_Saved] = field(default_factory=list)
    tick_ends: list[int] = field(default_factory=list)
    """How much was saved by the end of each tick."""

    @property
    def is_async(self) -> bool:
        return bool(self.about.get("asynchronous", False))

    @property
    def execution_class(self) -> ExecutionClass:
        return ExecutionClass(self.about.get("execution_class", ExecutionClass.BEST_EFFORT))

    @property
    def topics(self) -> list[str]:
        sent = (saved.message.topic for saved in self.saved)
        return list(dict.fromkeys([*(message.topic for message in self.early), *sent]))

    def sort_out(self, deterministic: bool) -> None:
        """Decide what is to be sent when."""
        at_release = self.is_async or deterministic or self.execution_class in _TIMED
        latest_ns = 0
        for each in self.heard:
            if each is None:
                self.tick_ends.append(len(self.saved))
                continue
            message, started = each
            release_ns = message.release_ns
            if release_ns is None and not started:
                self.early.append(message)
                continue
            due_ns = message.sent_ns if release_ns is None or not at_release else release_ns
            latest_ns = max(latest_ns, due_ns)
            self.saved.append(_Saved(latest_ns, message.sent_ns, message))
        self.heard.clear()


@dataclass(slots=True)
class _Recording:
    """The part of a recording that is replayed."""

    path: Path
    about: dict[str, Any]
    runs: list[tuple[int, int]]
    """The first cycle of each run, and its instant [ns]."""
    tracks: list[_Track]
    last_ns: int
    """When the last tick was released or began [ns]."""

    @property
    def deterministic(self) -> bool:
        return bool(self.about["deterministic"])

    @property
    def end_ns(self) -> int:
        """The end of the last cycle [ns]."""
        _, epoch_ns = self.runs[-1]
        grid = self._grid(epoch_ns)
        return grid.at(grid.index_at(self.last_ns) + 1)

    def instant_of(self, cycle: int) -> int:
        """Return when a cycle began [ns]."""
        first, epoch_ns = next(
            (run for run in reversed(self.runs) if run[0] <= cycle), self.runs[0]
        )
        return self._grid(epoch_ns).at(cycle - first)

    def _grid(self, epoch_ns: int) -> ReleaseGrid:
        return ReleaseGrid(epoch_ns, self.about["tick_rate_hz"])


def _load(
    path: str | os.PathLike[str], nodes: Iterable[str] | None, topics: Iterable[str] | None
) -> _Recording:
    """Read the messages of some nodes, and of some topics.

    Raises:
        RecordingError: The file is no recording, is damaged, or lacks a node or a topic.
    """
    wanted_nodes, wanted_topics = set_of_names("nodes", nodes), set_of_names("topics", topics)
    all_nodes: set[str] = set()
    all_topics: set[str] = set()
    tracks: dict[str, _Track] = {}
    configurations: dict[str, dict[str, Any]] = {}
    runs: list[tuple[int, int]] = []
    last_ns = 0
    with open_recording(path) as reader:
        for entry in reader.entries():
            channel = entry.channel
            topic = channel.topic
            if channel.message_encoding == EXACT:
                message = reader.message_of(entry)
                publisher = message.publisher
                all_nodes.add(publisher)
                all_topics.add(topic)
                # What shutdown() sends is no part of a cycle.
                last_ns = max(last_ns, message.release_ns or 0)
                if wanted_nodes is not None and publisher not in wanted_nodes:
                    continue
                if wanted_topics is not None and topic not in wanted_topics:
                    continue
                track = tracks.setdefault(publisher, _Track(publisher))
                track.heard.append((message, bool(runs)))
            elif topic.startswith(_TICKS):
                last_ns = max(last_ns, entry.log_ns)
                ticked = tracks.get(topic.removeprefix(_TICKS))
                if ticked is not None:
                    ticked.heard.append(None)
            elif topic == "horus/nodes":
                found = reader.json_of(entry.data, topic)
                configurations[found["name"]] = found
            elif topic == "horus/scheduler":
                found = reader.json_of(entry.data, topic)
                if found["running"]:
                    runs.append((found["cycle"], found["epoch_ns"]))
        _refuse_unknown(reader, "node", wanted_nodes, all_nodes)
        _refuse_unknown(reader, "topic", wanted_topics, all_topics)
        about = reader.about
    # Only now: what a flight recorder has of them may come after the first messages.
    for track in tracks.values():
        track.about = configurations.get(track.name, {})
        track.sort_out(bool(about["deterministic"]))
    in_sequence = sorted(tracks.values(), key=lambda track: track.about.get("sequence", -1))
    if not runs:
        runs.append((about["cycle"], about["epoch_ns"]))
    return _Recording(reader.path, about, runs, in_sequence, last_ns)


def _refuse_unknown(
    reader: RecordingReader, kind: str, wanted: Collection[str] | None, known: Collection[str]
) -> None:
    for name in sorted(wanted or ()):
        if name not in known:
            there_are = ", ".join(sorted(known)) or "none"
            raise RecordingError(
                f"{reader.path}: no {kind} {name!r} has sent anything in it; there are: {there_are}"
                if kind == "node"
                else f"{reader.path}: nothing was sent on {kind} {name!r} in it; "
                f"there are: {there_are}"
            )


class _StandIn:
    """Sends what a node has sent.

    Thread: the callbacks, where the node's run; `plan` before that.
    """

    def __init__(
        self,
        track: _Track,
        recording: _Recording,
        timeline: Timeline,
        overrides: dict[str, Any],
        classes: encoding.Classes,
    ) -> None:
        self.recording = recording
        self._track = track
        self._timeline = timeline
        self._overrides = overrides
        self._classes = classes
        self._first = self._next = 0
        self._last = len(track.saved)
        self._whole = True
        self._base_ns = recording.runs[0][1]
        self._offset_ns = 0
        self._speed = 1.0
        self._ticks = iter(track.tick_ends)
        self.triggered = self._is_triggered()
        for topic in track.topics:
            self._check_readable(topic)
        self.node = self._make_node()

    @property
    def pending(self) -> bool:
        """Whether something is left to send."""
        return self._next < self._last

    def plan(self, from_ns: int, until_ns: int, offset_ns: int, speed: float) -> None:
        """Decide what to send when.

        Args:
            from_ns: Where to begin in the recording [ns].
            until_ns: Where to end in it [ns].
            offset_ns: When, after the epoch, the replay begins [ns].
            speed: Recorded seconds in a second.
        """
        saved = self._track.saved
        self._whole = from_ns <= self.recording.runs[0][1]
        self._first = 0 if self._whole else bisect_left(saved, from_ns, key=_due_ns)
        self._last = bisect_left(saved, until_ns, key=_due_ns)
        self._next = self._first
        self._base_ns, self._offset_ns, self._speed = from_ns, offset_ns, speed
        if not self.triggered:
            due = (self._offset(each.due_ns) for each in saved[self._first : self._last])
            self.node._horus_core.releases_ns = list(dict.fromkeys(due))

    def init(self) -> None:
        """Send what the node sent before the run."""
        self._next = self._first
        self._ticks = (end for end in self._track.tick_ends if end > self._first or self._whole)
        if self._whole:
            for message in self._track.early:
                self._send(message)

    def tick(self) -> None:
        """Send what is due."""
        for saved in self._due():
            self._send(saved.message)

    async def tick_async(self) -> None:
        """Send what is due in this tick, each message when it was sent."""
        timeline = self._timeline
        for saved in self._due():
            sent_ns = timeline.epoch_ns + self._offset(saved.sent_ns)
            wait_ns = sent_ns - timeline.now_ns()
            if wait_ns > 0:
                await asyncio.sleep(to_s(wait_ns))
            self._send(saved.message)

    def _due(self) -> Iterator[_Saved]:
        saved = self._track.saved
        if self.triggered:
            end = min(next(self._ticks, self._next), self._last)
            while self._next < end:
                self._next += 1
                yield saved[self._next - 1]
            return
        context = clock.current.get()
        assert context is not None
        now_ns = context.release_ns - self._timeline.epoch_ns
        while self._next < self._last and self._offset(saved[self._next].due_ns) <= now_ns:
            self._next += 1
            yield saved[self._next - 1]

    def _offset(self, instant_ns: int) -> int:
        """Return when after the epoch it is the turn of a recorded instant [ns]."""
        passed_ns = max(0, instant_ns - self._base_ns)
        return self._offset_ns + (passed_ns if self._speed == 1.0 else int(passed_ns / self._speed))

    def _send(self, recorded: RecordedMessage) -> None:
        message = recorded.message(self._classes)
        topic = recorded.topic
        if topic in self._overrides:
            override = self._overrides[topic]
            message = override(message) if callable(override) else override
            if message is None:
                return
        self.node.send(topic, message)

    def _is_triggered(self) -> bool:
        track, recording = self._track, self.recording
        if not (recording.deterministic and self._timeline.deterministic):
            return False
        if track.execution_class is not ExecutionClass.EVENT:
            return False
        return any(track.about["on"] in other.topics for other in recording.tracks)

    def _check_readable(self, topic: str) -> None:
        """Refuse a recording of messages that do not come back, before anything runs."""
        track = self._track
        sent = [*track.early, *(saved.message for saved in track.saved)]
        try:
            next(message for message in sent if message.topic == topic).message(self._classes)
        except RecordingError as exc:
            raise RecordingError(f"{self.recording.path}: {exc}") from exc

    def _make_node(self) -> Node:
        track = self._track
        about = track.about
        node = Node(
            track.name,
            self.tick_async if track.is_async else self.tick,
            order=about.get("order", 0),
            on=about["on"] if self.triggered else None,
            pubs=track.topics,
            init=self.init,
            failure_policy="fatal",
        )
        core = node._horus_core
        changes: dict[str, Any] = {}
        if "rate_hz" in about:
            changes["rate_hz"] = about["rate_hz"]
        if track.execution_class is ExecutionClass.RT and not track.is_async:
            changes["execution_class"] = ExecutionClass.RT
        core.spec = replace(core.spec, **changes)
        # What the node received has a say in the order among equals.
        core.subscribes = frozenset(about.get("subs", ()))
        return node


def _due_ns(saved: _Saved) -> int:
    return saved.due_ns


class Replays:
    """The recordings that a scheduler replays.

    Thread: any, but not while a run begins.
    """

    def __init__(self, timeline: Timeline, pacer: Pacer) -> None:
        """Replay nothing yet."""
        self._timeline = timeline
        self._pacer = pacer
        self._stand_ins: dict[str, _StandIn] = {}
        self._overrides: dict[str, Any] = {}
        self._start_cycle: int | None = None
        self._stop_cycle: int | None = None
        self._speed = 1.0
        self.rules_time = False
        """Whether the scheduler's time is that of the recording: a run ends with it."""

    @property
    def active(self) -> bool:
        """Whether something is left to replay."""
        return any(stand_in.pending for stand_in in self._stand_ins.values())

    def load(
        self,
        path: str | os.PathLike[str],
        nodes: Iterable[str] | None,
        topics: Iterable[str] | None,
        classes: Iterable[type],
    ) -> list[_StandIn]:
        """Return stand-ins for the nodes of a recording.

        Raises:
            ConfigError: An argument was refused.
            RecordingError: The file is no recording, is damaged, or lacks a node or a topic;
                or its messages are of classes that may not come back.
        """
        recording = _load(path, nodes, topics)
        by_name = {encoding.name_of(kind): kind for kind in classes}
        return [
            _StandIn(track, recording, self._timeline, self._overrides, by_name)
            for track in recording.tracks
        ]

    def adopt(self, stand_in: _StandIn, *, now: bool) -> None:
        """Replay with a stand-in, which is about to be added: with the run, or from now on."""
        self._stand_ins[stand_in.node.name] = stand_in
        offset_ns = 0
        if now:
            grid = self._timeline.grid
            now_ns = self._timeline.now_ns()
            offset_ns = grid.at(grid.index_at(now_ns) + 1) - grid.epoch_ns
        self._plan(stand_in, offset_ns)

    def discard(self, name: str) -> bool:
        """Replay a node no more; return whether it was replayed."""
        return self._stand_ins.pop(name, None) is not None

    def begin(self) -> int:
        """Get ready for a run; return how far into the recording it begins [ns]."""
        for stand_in in self._stand_ins.values():
            self._plan(stand_in, 0)
        if not self.rules_time or self._start_cycle is None:
            return 0
        self._timeline.count_from(self._start_cycle)
        recording = self._any_recording()
        return recording.instant_of(self._start_cycle) - recording.runs[0][1]

    def length_ns(self) -> int:
        """Return how long the replay takes [ns]."""
        spans = [self._span(stand_in.recording) for stand_in in self._stand_ins.values()]
        longest_ns = max((until_ns - from_ns for from_ns, until_ns in spans), default=0)
        return longest_ns if self._timeline.deterministic else int(longest_ns / self._speed)

    def select(self, *, start: int | None = None, stop: int | None = None) -> None:
        """Replay from a cycle on, or until before one.

        Raises:
            RecordingError: The recording has no such cycle.
        """
        recording = self._any_recording()
        for cycle in (start, stop):
            if cycle is not None and recording.instant_of(cycle) > recording.end_ns:
                raise RecordingError(f"{recording.path} ends before cycle {cycle}")
        self._start_cycle = self._start_cycle if start is None else start
        self._stop_cycle = self._stop_cycle if stop is None else stop

    def set_speed(self, speed: float, *, running: bool) -> None:
        """Change the speed; see `Scheduler.set_replay_speed`."""
        if self._timeline.deterministic:
            self._pacer.set_speed(speed)
        elif speed == math.inf:
            raise ConfigError("speed", speed, "needs deterministic=True: real time cannot hurry")
        elif running:
            raise StateError("in real time, the speed of a replay is set before the run")
        else:
            self._speed = speed

    def override(self, topic: str, override: Any) -> None:
        """Send something else on a topic; see `Scheduler.set_replay_override`."""
        self._overrides[topic] = override

    def _plan(self, stand_in: _StandIn, offset_ns: int) -> None:
        from_ns, until_ns = self._span(stand_in.recording)
        stand_in.plan(from_ns, until_ns, offset_ns, self._speed)

    def _span(self, recording: _Recording) -> tuple[int, int]:
        start, stop = self._start_cycle, self._stop_cycle
        from_ns = recording.runs[0][1] if start is None else recording.instant_of(start)
        until_ns = recording.end_ns
        if stop is not None:
            until_ns = min(until_ns, recording.instant_of(stop))
        return from_ns, max(from_ns, until_ns)

    def _any_recording(self) -> _Recording:
        if not self._stand_ins:
            raise StateError("nothing is replayed; call add_replay() first")
        return next(iter(self._stand_ins.values())).recording
