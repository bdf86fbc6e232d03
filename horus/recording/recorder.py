"""Records a session: taps that cost a tick little, a bounded queue, and one thread that writes."""

from __future__ import annotations

import contextlib
import logging
import os
import threading
from collections import deque
from collections.abc import Callable, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

import zstandard

from horus import clock
from horus.clock import NEVER, Timeline
from horus.live import NoteTick
from horus.recording import mcap_file, sessions
from horus.recording.scribe import Fact, Item, Log, Message, Scribe, Tick
from horus.snapshot import Frozen
from horus.topics import Publisher
from horus.units import NS_PER_MS, NS_PER_S

_log = logging.getLogger("horus.recording")

MOST_UNWRITTEN = 65_536
"""Items that may wait to be written."""
_LONGEST_STALL_NS = 3 * NS_PER_S
"""How long writing may stand still before items are dropped [ns]: large ones fill the memory."""
_DRAIN_PERIOD_S = 0.025
_FLUSH_PERIOD_NS = 100 * NS_PER_MS
"""At most so much later is in the file what was recorded [ns]; a full chunk is written at once."""
_SYNC_PERIOD_NS = 1 * NS_PER_S
"""At most so much later it survives a power cut [ns], unless the disk is slow."""
_FINISH_TIMEOUT_S = 5.0
"""How long the end of a run waits for the last items to be written [s]."""


class Recorder:
    """Records into one file, from its construction to `finish`.

    What happens is queued on the thread that it happens on, in the order in which it does, and
    written by one thread. When that does not keep up, because the disk does not, items are
    dropped and counted, and the loss is recorded and logged; in virtual time, which can wait,
    and for nodes that are `patient`, the sender waits instead.

    Thread: any.
    """

    def __init__(self, directory: Path, timeline: Timeline, about: Mapping[str, Any]) -> None:
        """Begin a session.

        Args:
            directory: Where its file goes.
            timeline: The scheduler's time.
            about: The scheduler's configuration.

        Raises:
            OSError: The file cannot be made or written.
        """
        self.path, descriptor = sessions.create(directory)
        self.patient: frozenset[str] = frozenset()
        """The nodes that wait rather than lose a message."""
        self._timeline = timeline
        self._now_ns = timeline.now_ns
        self._queue: deque[Item] = deque()
        self._lock = threading.Lock()
        self._lost = 0
        self._recording = True
        self._ending = threading.Event()
        self._progress_ns = self._told_ns = clock.monotonic_ns()
        self._told_lost = 0
        self._told_of: set[str] = set()
        self._file = _Session(descriptor, self.path)
        try:
            self._file.begin()
        except BaseException:
            self._file.close()
            raise
        self._scribe = Scribe(self._file, timeline.wall_offset_ns)
        self._handler = _LogHandler(self.note_log)
        logging.getLogger("horus").addHandler(self._handler)
        self.note_fact("horus/scheduler", about)
        self._thread = threading.Thread(target=self._write, name="horus-recorder", daemon=True)
        self._thread.start()

    @property
    def lost(self) -> int:
        """How many items were dropped, because writing them did not keep up or failed."""
        return self._lost + self._file.lost

    # -- what happens --------------------------------------------------------------------

    def note_message(self, publisher: Publisher, frozen: Frozen) -> None:
        """Take note of a message; a tap of the bus."""
        context = clock.current.get()
        if context is None or context.timeline is not self._timeline:
            release_ns, cycle, node = NEVER, self._timeline.current_cycle(), ""
        else:
            release_ns = context.release_ns if context.ticking else NEVER
            cycle, node = context.cycle(), context.node
        now_ns = self._now_ns()
        self._put(Message(now_ns, release_ns, cycle, publisher, publisher.sent, frozen), node)

    def tick_noter(self, node: str) -> NoteTick:
        """Return what takes note of the ticks of a node."""
        put, cycle_at = self._put, self._timeline.cycle_at

        def note_tick(
            release_ns: int,
            start_ns: int,
            finish_ns: int,
            over_budget_ns: int,
            past_deadline_ns: int,
            failed: bool,
        ) -> None:
            put(
                Tick(
                    node,
                    cycle_at(release_ns),
                    release_ns,
                    start_ns,
                    finish_ns,
                    over_budget_ns,
                    past_deadline_ns,
                    failed,
                ),
                "",
            )

        return note_tick

    def note_event(self, kind: str, text: str, node: str = "") -> None:
        """Take note of a change."""
        self.note_fact("horus/events", {"kind": kind, "node": node, "text": text})

    def note_fact(self, channel: str, content: Mapping[str, Any]) -> None:
        """Take note of something that has a channel of its own."""
        self._put(Fact(channel, self._now_ns(), content), "")

    def note_log(self, record: logging.LogRecord, text: str) -> None:
        """Take note of a log record, and how it reads."""
        self._put(Log(self._now_ns(), record, text), "")

    def _put(self, item: Item, node: str) -> None:
        if not self._recording:
            return
        queue = self._queue
        if len(queue) >= MOST_UNWRITTEN or self._is_stuck():
            if self._timeline.deterministic or node in self.patient:
                self._wait_for_room()
            else:
                with self._lock:
                    self._lost += 1
                return
        queue.append(item)

    def _is_stuck(self) -> bool:
        # Of the OS clock, not the timeline's: simulated time runs as fast as it likes.
        return clock.monotonic_ns() - self._progress_ns > _LONGEST_STALL_NS

    def _wait_for_room(self) -> None:
        while self._recording and (len(self._queue) >= MOST_UNWRITTEN or self._is_stuck()):
            if not self._thread.is_alive():
                return
            self._ending.wait(0.001)

    # -- the thread that writes ----------------------------------------------------------

    def finish(self) -> None:
        """Write what is left, and the end of the file; record no more."""
        self._recording = False
        logging.getLogger("horus").removeHandler(self._handler)
        self._ending.set()
        self._thread.join(_FINISH_TIMEOUT_S)
        if self._thread.is_alive():
            _log.error(
                "%s: %d items could not be written within %g s; the session is unfinished",
                self.path,
                len(self._queue),
                _FINISH_TIMEOUT_S,
            )

    def _write(self) -> None:
        try:
            while not self._ending.wait(_DRAIN_PERIOD_S):
                self._drain()
                self._tell_losses()
            self._drain()
            self._tell_losses(finally_=True)
            self._file.finish()
        finally:
            self._recording = False
            self._file.close()

    def _drain(self) -> None:
        """Write what waits now."""
        queue, write, file = self._queue, self._scribe.write, self._file
        for _ in range(len(queue)):
            write(queue.popleft())
            if file.full:
                file.flush()
                self._progress_ns = clock.monotonic_ns()
        file.flush_if_due()
        self._progress_ns = clock.monotonic_ns()

    def _tell_losses(self, *, finally_: bool = False) -> None:
        """Say what was lost since this was said before, once a second."""
        now_ns = clock.monotonic_ns()
        if now_ns - self._told_ns < NS_PER_S and not finally_:
            return
        self._told_ns = now_ns
        for topic, reason in self._scribe.refused.items():
            if topic not in self._told_of:
                self._told_of.add(topic)
                _log.error("messages of topic %r are not recorded: %s", topic, reason)
        lost, self._told_lost = self._lost - self._told_lost, self._lost
        if lost:
            text = f"{lost} items were lost, because writing does not keep up"
            content = {"kind": "lost", "node": "", "text": text}
            self._scribe.write(Fact("horus/events", self._now_ns(), content))
            _log.error("%s: %s", self.path, text)


class _Session:
    """The file of a session, chunk by chunk; that it cannot be written is told once.

    Thread: one at a time.
    """

    def __init__(self, descriptor: int, path: Path) -> None:
        self.lost = 0
        """How many items were in chunks that could not be written."""
        self._descriptor = descriptor
        self._path = path
        self._file = mcap_file.AppendedFile(descriptor)
        self._summary = mcap_file.Summary()
        self._chunk = mcap_file.ChunkBuilder(self._summary)
        self.define = self._summary.define
        self.add_message = self._chunk.add_message
        self._compressor = zstandard.ZstdCompressor(level=1)
        self._failing = False
        self._flushed_ns = self._synced_ns = clock.monotonic_ns()

    @property
    def full(self) -> bool:
        return self._chunk.size >= mcap_file.CHUNK_SIZE

    def begin(self) -> None:
        mcap_file.begin(self._file, f"horus {metadata.version('horus-scheduler')}")

    def flush_if_due(self) -> None:
        now_ns = clock.monotonic_ns()
        if self._chunk.size and now_ns - self._flushed_ns >= _FLUSH_PERIOD_NS:
            self.flush()
        if now_ns - self._synced_ns >= _SYNC_PERIOD_NS:
            self._synced_ns = now_ns
            with contextlib.suppress(OSError):  # told when writing fails
                self._file.sync()

    def flush(self) -> None:
        """Write what was gathered; if that fails, it is lost, and the next may fare better."""
        self._flushed_ns = clock.monotonic_ns()
        chunk, index = self._chunk.take(self._compressor)
        try:
            mcap_file.append_chunk(self._file, self._summary, chunk, index)
        except OSError as exc:
            self.lost += sum(len(entries) // 2 for entries in index.values())
            if not self._failing:
                self._failing = True
                _log.error("%s cannot be written, and the robot runs on: %s", self._path, exc)
        else:
            if self._failing:
                self._failing = False
                _log.warning("%s can be written again; %d items were lost", self._path, self.lost)

    def finish(self) -> None:
        """Write the end."""
        self.flush()
        try:
            self._file.append(self._summary.end(self._file.size))
            self._file.sync()
        except OSError as exc:
            if not self._failing:
                _log.error("%s is unfinished: %s", self._path, exc)

    def close(self) -> None:
        """Close it, which gives its lock back."""
        os.close(self._descriptor)


class _LogHandler(logging.Handler):
    """Has log records recorded."""

    def __init__(self, note: Callable[[logging.LogRecord, str], None]) -> None:
        super().__init__()
        self._note = note
        self._format = logging.Formatter().format

    def emit(self, record: logging.LogRecord) -> None:
        """Put it in words now: its arguments may change."""
        try:
            text = self._format(record)
        except Exception as exc:  # a message and its arguments that do not go together
            text = f"{record.msg!r} cannot be formatted: {exc!r}"
        self._note(record, text)
