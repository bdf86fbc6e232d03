"""What a scheduler records: one session for each of its own, with all of its nodes."""

from __future__ import annotations

import atexit
import contextlib
import functools
import logging
import platform
from collections.abc import Iterable, Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

from horus.clock import Timeline
from horus.errors import RecordingError, StateError
from horus.live import LiveNode
from horus.recording import sessions
from horus.recording.blackbox import Blackbox, recover_rings
from horus.recording.recorder import Recorder
from horus.recording.scribe import FORMAT
from horus.recording.session_file import SessionFile
from horus.spec import ExecutionClass, SchedulerSpec
from horus.timing import Grid, ReleaseGrid
from horus.topics import Bus
from horus.units import NS_PER_MS, NS_PER_US

_log = logging.getLogger("horus.recording")

_FLUSH_NS = 100 * NS_PER_MS
_BLACKBOX_FLUSH_NS = 25 * NS_PER_MS
"""What is in the ring survives the process: little is to be on the way there [ns]."""
_AFTERMATH_S = 0.3
"""How long after the safe state was entered the flight recorder is written [s]."""


@contextlib.contextmanager
def _told(what: str, where: Path) -> Iterator[None]:
    """Log whatever goes wrong: the robot does not need a recording."""
    try:
        yield
    except Exception as exc:
        _log.error("%s, and the robot runs on: %s: %r", what, where, exc)


class Recordings:
    """Begins to record when the scheduler's session opens, and ends it when that closes.

    Thread: `begin` and `close` are called by who drives the nodes; the others by any.
    """

    def __init__(self, spec: SchedulerSpec, timeline: Timeline, bus: Bus) -> None:
        """Describe what is recorded; nothing is yet."""
        self._spec = spec
        self._timeline = timeline
        self._bus = bus
        self._recorder: Recorder | None = None
        self._file: SessionFile | None = None
        self._blackbox: Blackbox | None = None
        self._files: list[Path] = []
        self._timed: list[LiveNode] = []

    @property
    def active(self) -> bool:
        """Whether a session is being recorded."""
        return self._file is not None

    def begin(self, lives: Iterable[LiveNode]) -> None:
        """Record a new session; if that cannot be, say so and go on without."""
        directory = self._spec.recording_directory or sessions.default_directory()
        flush_ns = _BLACKBOX_FLUSH_NS if self._spec.blackbox_mb else _FLUSH_NS
        recorder = Recorder(self._timeline, self._about(), flush_ns)
        if self._spec.recording:
            with _told("nothing is recorded", directory):
                self._files = []
                self._file = SessionFile(directory, recorder.definitions)
        if self._spec.blackbox_mb:
            with _told("there is no flight recorder", directory):
                for path in recover_rings(directory):
                    _log.warning("a run before died; what it last did is in %s", path)
                self._blackbox = Blackbox(directory, self._spec.blackbox_mb)
        sinks = [sink for sink in (self._file, self._blackbox) if sink is not None]
        if not sinks:
            return
        recorder.start(
            sinks,
            self._blackbox.refresh_size if self._blackbox else None,
            run_first=self._spec.rt and not self._timeline.deterministic,
        )
        self._recorder, self._timed = recorder, []
        recorder.grids = self._grids
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
        if live.spec.execution_class is ExecutionClass.RT:
            self._timed.append(live)
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
            self._recorder.note_fact("horus/scheduler", {**self._about(), "running": True})

    def stop(self) -> list[Path]:
        """Record no more; return the files of this session, or of the one before."""
        recorder, file, self._file = self._recorder, self._file, None
        if recorder is not None and file is not None:
            self._files.append(file.path)
            if self._blackbox is None:
                self._end(recorder)
            else:
                with _told("the session is unfinished", file.path):
                    recorder.do(functools.partial(recorder.release, file))
        return list(self._files)

    def close(self, fault: str | None) -> None:
        """End all of it; `fault` is why the run had to end, if it had to."""
        self.stop()
        recorder = self._recorder
        if recorder is not None:
            if fault is not None and self._blackbox is not None:
                with _told("the flight recorder cannot be written", self._blackbox.path):
                    self.dump(fault)
            self._end(recorder)

    # -- the flight recorder -----------------------------------------------------------

    def dump(self, reason: str) -> Path:
        """Write what the flight recorder has; return its file.

        Raises:
            StateError: There is none.
            RecordingError: It cannot be written.
        """
        recorder, blackbox = self._recorder, self._blackbox
        if recorder is None or blackbox is None:
            raise StateError("there is no flight recorder: it needs blackbox_mb=, and a run")
        recorder.note_event("dump", reason)
        try:
            path = recorder.do(blackbox.dump)
        except (OSError, TimeoutError) as exc:
            raise RecordingError(f"the flight recorder cannot be written: {exc}") from exc
        _log.warning("flight recorder written to %s: %s", path, reason)
        return path

    def dump_soon(self, reason: str, delay_s: float = 0.0) -> None:
        """Write what the flight recorder has, and do not wait for it.

        Thread: any, and signal handlers.
        """
        recorder, blackbox = self._recorder, self._blackbox
        if recorder is None or blackbox is None:
            return

        def dump() -> None:
            with _told("the flight recorder cannot be written", blackbox.path):
                _log.warning("flight recorder written to %s: %s", blackbox.dump(), reason)

        recorder.do_soon(dump, delay_s)

    def safe_state_entered(self, reason: str) -> None:
        """Record that the system is in its safe state, and write the flight recorder."""
        if self._recorder is not None:
            self._recorder.note_event("safe_state", reason)
            # Once supervision has logged what it has found, and where.
            self.dump_soon(reason, delay_s=_AFTERMATH_S)

    def _grids(self) -> set[Grid]:
        """Return when Rt nodes are released, each rate once."""
        rates_hz = {live.spec.rate_hz for live in tuple(self._timed) if not live.retired}
        return {_grid(self._timeline.epoch_ns, rate_hz) for rate_hz in rates_hz}

    def _end(self, recorder: Recorder) -> None:
        self._bus.remove_tap(recorder.note_message)
        atexit.unregister(recorder.finish)
        recorder.finish()
        self._recorder = self._file = self._blackbox = None

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
            "running": False,
            "epoch_ns": timeline.epoch_ns + timeline.wall_offset_ns,
            "cycle": timeline.cycle_at(timeline.epoch_ns),
            "horus": metadata.version("horus-scheduler"),
            "python": platform.python_version(),
            "machine": platform.node(),
        }


_grid = functools.lru_cache(256)(ReleaseGrid)
"""Asked for before each slice of what is written, and made of fractions, which takes long."""


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
