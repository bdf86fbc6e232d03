"""What a scheduler records: one session for each of its own, with all of its nodes."""

from __future__ import annotations

import atexit
import functools
import logging
import platform
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path
from typing import Any

from horus.clock import Timeline
from horus.live import LiveNode
from horus.recording import sessions
from horus.recording.recorder import Recorder
from horus.recording.scribe import FORMAT
from horus.spec import ExecutionClass, SchedulerSpec
from horus.topics import Bus
from horus.units import NS_PER_US

_log = logging.getLogger("horus.recording")


class Recordings:
    """Begins a recording when the scheduler's session opens, and ends it when that closes.

    Thread: `begin` and `end` are called by who drives the nodes; the others by any.
    """

    def __init__(self, spec: SchedulerSpec, timeline: Timeline, bus: Bus) -> None:
        """Describe what is recorded; nothing is yet."""
        self._spec = spec
        self._timeline = timeline
        self._bus = bus
        self._recorder: Recorder | None = None
        self._files: list[Path] = []

    @property
    def active(self) -> bool:
        """Whether a session is being recorded."""
        return self._recorder is not None

    def begin(self, lives: Iterable[LiveNode]) -> None:
        """Record a new session; if its file cannot be made, say so and go on without."""
        directory = self._spec.recording_directory or sessions.default_directory()
        try:
            recorder = Recorder(directory, self._timeline, self._about())
        except Exception as exc:  # whatever it is: the robot does not need a recording
            _log.error("nothing is recorded, and the robot runs on: %s: %r", directory, exc)
            return
        self._files = []
        self._recorder = recorder
        # A program that ends without ending its session should not leave half a file.
        atexit.register(recorder.finish)
        for live in lives:
            self.join(live)
        self._bus.add_tap(recorder.note_message)

    def join(self, live: LiveNode) -> None:
        """Record a node, before it ticks."""
        recorder = self._recorder
        if recorder is None:
            return
        live.note_tick = recorder.tick_noter(live.name)
        live.note_change = functools.partial(self._note_change, recorder, live.name)
        loop_only = live.spec.execution_class is ExecutionClass.BEST_EFFORT
        if self._spec.recording_blocks and loop_only:
            recorder.patient |= {live.name}
        self.describe(live)

    def describe(self, live: LiveNode) -> None:
        """Record a node's configuration, which is new or has changed."""
        if self._recorder is not None:
            self._recorder.note_fact("horus/nodes", _configuration(live))

    def run_begins(self) -> None:
        """Record that the release grid begins anew."""
        if self._recorder is not None:
            self._recorder.note_fact("horus/scheduler", self._about())

    def stop(self) -> list[Path]:
        """Record no more; return the files of this session, or of the one before."""
        recorder, self._recorder = self._recorder, None
        if recorder is not None:
            self._bus.remove_tap(recorder.note_message)
            atexit.unregister(recorder.finish)
            recorder.finish()
            self._files.append(recorder.path)
        return list(self._files)

    @staticmethod
    def _note_change(recorder: Recorder, node: str, what: str, value: str) -> None:
        recorder.note_event(what, value, node)

    def _about(self) -> dict[str, Any]:
        spec, timeline = self._spec, self._timeline
        return {
            "format": FORMAT,
            "name": spec.name,
            "tick_rate_hz": spec.tick_rate_hz,
            "deterministic": spec.deterministic,
            "seed": spec.seed,
            "rt": spec.rt,
            "epoch_ns": timeline.epoch_ns + timeline.wall_offset_ns,
            "cycle": timeline.cycle_at(timeline.epoch_ns),
            "horus": metadata.version("horus-scheduler"),
            "python": platform.python_version(),
            "machine": platform.node(),
        }


def _configuration(live: LiveNode) -> dict[str, Any]:
    spec = live.spec
    return {
        "name": spec.name,
        "order": spec.order,
        "execution_class": spec.execution_class.value,
        "rate_hz": spec.rate_hz,
        "on": spec.on,
        "budget_us": None if spec.budget_ns is None else spec.budget_ns / NS_PER_US,
        "deadline_us": None if spec.deadline_ns is None else spec.deadline_ns / NS_PER_US,
        "on_miss": spec.on_miss.value,
        "failure_policy": None if spec.failure_policy is None else spec.failure_policy.value,
        "asynchronous": live.is_async,
        "pubs": sorted(live.publishes),
        "subs": sorted(live.subscribes),
        "sequence": live.sequence,
    }
