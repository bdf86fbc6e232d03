"""Records a session: taps that cost a tick little, a bounded queue, and one thread that writes."""

from __future__ import annotations

import contextlib
import logging
import sys
import threading
from collections import deque
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any, Protocol, TypeVar

import zstandard
from mcap.records import Chunk

from horus import clock, os_rt
from horus.clock import FOREVER_NS, NEVER, Timeline
from horus.live import NoteTick
from horus.logs import readable
from horus.recording import mcap_file
from horus.recording.gaps import LONGEST_NS, SHORTEST_NS, next_gap
from horus.recording.scribe import Fact, Item, Log, Message, Scribe, Tick
from horus.snapshot import Frozen
from horus.timing import Grid
from horus.topics import Publisher
from horus.units import NS_PER_MS, NS_PER_S, NS_PER_US, to_ns, to_s

_log = logging.getLogger("horus.recording")
T = TypeVar("T")

_make: Any = tuple.__new__
"""`_make(Tick, fields)` is `Tick(*fields)` in half the time."""

MOST_UNWRITTEN = 65_536
"""Items that may wait to be written."""
MOST_UNWRITTEN_BYTES = 256_000_000
"""How much large messages that wait to be written may come to [bytes]."""
_FEW = 1024
"""Below so many items it is not looked at whether there is room for another: there is."""
_LARGE = 1024
"""From this size on a message is large [bytes]: `MOST_UNWRITTEN` bounds the others well enough."""
_LONGEST_STALL_NS = 3 * NS_PER_S
"""How long writing may stand still before items are dropped [ns]: it may be so for good."""
_DRAIN_PERIOD_NS = 25 * NS_PER_MS
_FLUSH_NS = 600 * NS_PER_US
"""How long it takes to compress and write a chunk, about [ns]."""
_NAP_NS = 200 * NS_PER_US
_HURRY = MOST_UNWRITTEN // 16
"""From so many items in the queue on, the writer gives way to nobody."""
_SYNC_PERIOD_NS = 1 * NS_PER_S
"""At most so much later it survives a power cut [ns], unless the disk is slow."""
_FINISH_TIMEOUT_S = 5.0
"""How long the end of a run waits for the last items to be written [s]."""


class Sink(Protocol):
    """Where chunks go. Thread: one at a time."""

    lost: int
    """How many items were in chunks that it could not take."""

    def write(self, chunk: Chunk, index: mcap_file.Index) -> int:
        """Take a chunk; return its size [bytes]. Never raises."""

    def sync(self) -> None:
        """Have what was written survive a power cut, if it is made for that."""

    def finish(self) -> None:
        """Take note that this was all."""

    def close(self) -> None:
        """Give back what it holds."""


class _Job:
    """Something to be done by the thread that writes, at its turn."""

    def __init__(self, work: Callable[[], Any], due_ns: int) -> None:
        self.due_ns = due_ns
        self.done = threading.Event()
        self.result: Any = None
        self.error: Exception | None = None
        self._work = work

    def run(self) -> None:
        try:
            self.result = self._work()
        except Exception as exc:
            self.error = exc
        finally:
            self.done.set()


class Recorder:
    """Records into sinks, from `start` to `finish`.

    What happens is queued on the thread that it happens on, in the order in which it does, and
    written by one thread. When that does not keep up, because the disk does not, items are
    dropped and counted, and the loss is recorded and logged; in virtual time, which can wait,
    and for nodes that are `patient`, the sender waits instead.

    Thread: any.
    """

    def __init__(self, timeline: Timeline, about: Mapping[str, Any], flush_ns: int) -> None:
        """Begin to queue; `start` begins to write.

        Args:
            timeline: The scheduler's time.
            about: The scheduler's configuration.
            flush_ns: At most so much later a sink has what happens [ns]; a full chunk at once.
        """
        self.patient: frozenset[str] = frozenset()
        """The nodes that wait rather than lose a message."""
        self.grids: Callable[[], Collection[Grid]] = tuple
        """Returns the releases between which to write."""
        self._timeline = timeline
        self._now_ns = timeline.now_ns
        self._queue: deque[Item | _Job] = deque()
        self._jobs: list[_Job] = []
        self._lock = threading.Lock()
        self._lost = self._unwritable = self._large_bytes = 0
        self._sizes: dict[Publisher, int] = {}
        self._recording = True
        self._ending = threading.Event()
        self._progress_ns = self._told_ns = clock.monotonic_ns()
        self._told_lost = 0
        self._told_unwritable = False
        self._told_of: set[str] = set()
        self._chunks = _Chunks(flush_ns)
        self._scribe = Scribe(self._chunks, timeline.wall_offset_ns)
        self._configuration: dict[tuple[str, str], Fact] = {}
        self._run_first = False
        self._refresh_size: int | None = None
        self._refreshed_at = 0
        self._handler = _LogHandler(self.note_log)
        self._thread = threading.Thread(target=self._write, name="horus-recorder", daemon=True)
        self.note_fact("horus/scheduler", about)

    @property
    def definitions(self) -> mcap_file.Definitions:
        """The schemas and channels that the chunks refer to."""
        return self._chunks.definitions

    @property
    def lost(self) -> int:
        """How many items were dropped, because writing them did not keep up or failed."""
        return self._lost + self._unwritable + sum(sink.lost for sink in self._chunks.sinks)

    def start(
        self, sinks: Iterable[Sink], refresh_size: int | None = None, *, run_first: bool = False
    ) -> None:
        """Write to sinks, which it owns from now on.

        Args:
            sinks: Where chunks go.
            refresh_size: After so many bytes the configuration is written again.
            run_first: Whether to see that no other program takes the core of the thread that
                writes, which would keep the interpreter from real-time threads meanwhile.
        """
        self._run_first = run_first
        self._chunks.sinks.extend(sinks)
        self._refresh_size = refresh_size
        logging.getLogger("horus").addHandler(self._handler)
        self._thread.start()

    # -- what happens --------------------------------------------------------------------

    def note_message(self, publisher: Publisher, frozen: Frozen) -> None:
        """Take note of a message; a tap of the bus."""
        context = clock.current.get()
        if context is None or context.timeline is not self._timeline:
            release_ns, cycle, node = NEVER, self._timeline.current_cycle(), ""
        else:
            release_ns = context.release_ns if context.ticking else NEVER
            cycle, node = context.cycle(), context.node
        # As large as those before it: to look into each would take too long.
        size = self._sizes.get(publisher)
        if size is None:
            size = sys.getsizeof(frozen[0])
        if size < _LARGE:
            size = 0
        fields = (self._now_ns(), release_ns, cycle, publisher, publisher.sent, frozen, size)
        message: Message = _make(Message, fields)
        self._put(message, node, size)

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
            fields = (
                node,
                cycle_at(release_ns),
                release_ns,
                start_ns,
                finish_ns,
                over_budget_ns,
                past_deadline_ns,
                failed,
            )
            put(_make(Tick, fields), node)

        return note_tick

    def note_event(self, kind: str, text: str, node: str = "") -> None:
        """Take note of a change."""
        self.note_fact("horus/events", {"kind": kind, "node": node, "text": text})

    def note_fact(self, channel: str, content: Mapping[str, Any]) -> None:
        """Take note of something that has a channel of its own."""
        fact = Fact(channel, self._now_ns(), content)
        if channel != "horus/events":
            self._configuration[channel, content["name"]] = fact
        self._put(fact, "")

    def note_log(self, record: logging.LogRecord, text: str) -> None:
        """Take note of a log record, and how it reads."""
        self._put(Log(self._now_ns(), record, text), "")

    def _put(self, item: Item, node: str, size: int = 0) -> None:
        if not self._recording:
            return
        # Who writes does not wait for itself: it logs, and runs code of the application.
        if (
            (size or len(self._queue) >= _FEW)
            and self._has_no_room()
            and threading.current_thread() is not self._thread
        ):
            if self._timeline.deterministic or node in self.patient:
                self._wait_for_room()
            else:
                with self._lock:
                    self._lost += 1
                return
        if size:
            with self._lock:
                self._large_bytes += size
        self._queue.append(item)

    def _has_no_room(self) -> bool:
        # Of the OS clock, not the timeline's: simulated time runs as fast as it likes.
        return (
            len(self._queue) >= MOST_UNWRITTEN
            or self._large_bytes >= MOST_UNWRITTEN_BYTES
            or clock.monotonic_ns() - self._progress_ns > _LONGEST_STALL_NS
        )

    def _wait_for_room(self) -> None:
        while self._recording and self._has_no_room():
            if not self._thread.is_alive():
                return
            self._ending.wait(0.001)

    # -- the thread that writes ----------------------------------------------------------

    def do(self, work: Callable[[], T], timeout_s: float = _FINISH_TIMEOUT_S) -> T:
        """Have something done with the sinks, once what has happened so far is in them.

        Raises:
            TimeoutError: It was not done in time: writing does not keep up.
            Exception: What `work` raises.
        """
        job = self.do_soon(work)
        if not job.done.wait(timeout_s):
            raise TimeoutError(f"recording did not come to it within {timeout_s:g} s")
        if job.error is not None:
            raise job.error
        result: T = job.result
        return result

    def do_soon(self, work: Callable[[], Any], delay_s: float = 0.0) -> _Job:
        """Have something done with the sinks; do not wait for it.

        Thread: any, and signal handlers.
        """
        job = _Job(work, clock.monotonic_ns() + to_ns(delay_s))
        self._queue.append(job)
        return job

    def release(self, sink: Sink) -> None:
        """Let a sink go: it gets its end, and nothing more.

        Thread: within `do`.
        """
        self._chunks.sinks.remove(sink)
        try:
            sink.finish()
        finally:
            sink.close()

    def finish(self) -> None:
        """Write what is left, and give each sink its end; record no more."""
        self._recording = False
        logging.getLogger("horus").removeHandler(self._handler)
        self._ending.set()
        self._thread.join(_FINISH_TIMEOUT_S)
        if self._thread.is_alive():
            _log.error(
                "%d items could not be recorded within %g s; the session is unfinished",
                len(self._queue),
                _FINISH_TIMEOUT_S,
            )

    def _write(self) -> None:
        if self._run_first:
            with contextlib.suppress(OSError):  # `degradations()` tells of it
                os_rt.run_first()
        try:
            while not self._ending.is_set():
                self._give_way(nap_ns=_DRAIN_PERIOD_NS)
                self._drain()
                self._tell_losses()
            self._drain()
            self._do_jobs(FOREVER_NS)
            self._tell_losses(finally_=True)
            self._chunks.flush()
        finally:
            self._recording = False
            for sink in list(self._chunks.sinks):
                self.release(sink)

    def _drain(self) -> None:
        """Write what waits now."""
        queue, chunks = self._queue, self._chunks
        monotonic_ns, gap_ends_ns = clock.monotonic_ns, self._give_way()
        for _ in range(len(queue)):
            if monotonic_ns() >= gap_ends_ns:
                gap_ends_ns = self._give_way(nap_ns=_NAP_NS)
            item = queue.popleft()
            if isinstance(item, _Job):
                self._jobs.append(item)
                self._do_jobs(clock.monotonic_ns())
                continue
            self._write_item(item)
            if chunks.full:
                gap_ends_ns = self._give_way(_FLUSH_NS)
                chunks.flush()
                self._refresh()
                self._progress_ns = clock.monotonic_ns()
        if self._jobs:
            self._do_jobs(clock.monotonic_ns())
        chunks.flush_if_due()
        self._refresh()
        self._progress_ns = clock.monotonic_ns()

    def _write_item(self, item: Item) -> None:
        try:
            size = self._scribe.write(item)
        except Exception:  # whatever it is, the others are written
            self._unwritable += 1
            if not self._told_unwritable:
                self._told_unwritable = True
                _log.exception("%s cannot be recorded, nor can others perhaps", type(item).__name__)
            size = 0
        if type(item) is Message:
            # The largest of late: a publisher's messages need not be of one size.
            known = self._sizes.get(item.publisher, 0)
            self._sizes[item.publisher] = max(size, known - known // 8)
            if item.size:
                with self._lock:
                    self._large_bytes -= item.size

    def _give_way(self, least_ns: int = SHORTEST_NS, nap_ns: int = 0) -> int:
        """Sleep until a gap between releases begins; return when it ends [ns].

        Args:
            least_ns: How long it has to be [ns].
            nap_ns: How long to sleep at least [ns].
        """
        now_ns = clock.monotonic_ns()
        if len(self._queue) >= _HURRY:
            return now_ns + LONGEST_NS
        begin_ns, end_ns = now_ns + nap_ns, FOREVER_NS
        if not self._timeline.deterministic:
            begin_ns, end_ns = next_gap(self.grids(), begin_ns, least_ns)
        if begin_ns > now_ns:
            self._ending.wait(to_s(begin_ns - now_ns))
        return end_ns

    def _do_jobs(self, now_ns: int) -> None:
        due = [job for job in self._jobs if job.due_ns <= now_ns]
        self._jobs = [job for job in self._jobs if job.due_ns > now_ns]
        for job in due:
            self._chunks.flush()
            job.run()

    def _refresh(self) -> None:
        """Write the configuration again, where what is old is overwritten."""
        size, written = self._refresh_size, self._chunks.written
        if size is not None and written - self._refreshed_at >= size:
            self._refreshed_at = written
            for fact in list(self._configuration.values()):
                self._write_item(fact._replace(at_ns=self._now_ns()))

    def _tell_losses(self, *, finally_: bool = False) -> None:
        """Say what was lost since this was said before, once a second."""
        now_ns = clock.monotonic_ns()
        if now_ns - self._told_ns < NS_PER_S and not finally_:
            return
        self._told_ns = now_ns
        for topic, reason in self._scribe.refused.items():
            if topic not in self._told_of:
                self._told_of.add(topic)
                _log.error("messages of topic %r %s", topic, reason)
        lost, self._told_lost = self._lost - self._told_lost, self._lost
        if lost:
            text = f"{lost} items were lost, because writing does not keep up"
            content = {"kind": "lost", "node": "", "text": text}
            self._write_item(Fact("horus/events", self._now_ns(), content))
            _log.error("%s", text)


class _Chunks:
    """Gathers records in chunks, and hands these to the sinks.

    Thread: one at a time.
    """

    def __init__(self, flush_ns: int) -> None:
        self.definitions = mcap_file.Definitions()
        self.sinks: list[Sink] = []
        self._chunk = mcap_file.ChunkBuilder(self.definitions)
        self.define = self.definitions.define
        self.add_message = self._chunk.add_message
        self._compressor = zstandard.ZstdCompressor(level=1)
        self._flush_ns = flush_ns
        self._flushed_ns = self._synced_ns = clock.monotonic_ns()
        self.written = 0
        """How much was written to the last sink [bytes]."""

    @property
    def full(self) -> bool:
        return self._chunk.size >= mcap_file.CHUNK_SIZE

    def flush_if_due(self) -> None:
        now_ns = clock.monotonic_ns()
        if now_ns - self._flushed_ns >= self._flush_ns:
            self.flush()
        if now_ns - self._synced_ns >= _SYNC_PERIOD_NS:
            self._synced_ns = now_ns
            for sink in self.sinks:
                sink.sync()

    def flush(self) -> None:
        """Hand over what was gathered."""
        self._flushed_ns = clock.monotonic_ns()
        if not self._chunk.size:
            return
        chunk, index = self._chunk.take(self._compressor)
        for sink in self.sinks:
            self.written += sink.write(chunk, index)


class _LogHandler(logging.Handler):
    """Has log records recorded."""

    def __init__(self, note: Callable[[logging.LogRecord, str], None]) -> None:
        super().__init__()
        self._note = note
        self._format = logging.Formatter().format

    def handle(self, record: logging.LogRecord) -> bool:
        """Take note of a record, without a lock: in virtual time this waits for the writer.

        And the writer logs, too.
        """
        # In words now: its arguments may change.
        self._note(record, readable(record, self._format))
        # Shown as it would be if nothing were recorded.
        last = logging.lastResort
        if last is not None and record.levelno >= last.level and self._is_alone(record):
            last.handle(record)
        return True

    def _is_alone(self, record: logging.LogRecord) -> bool:
        """Return whether nobody shows the record, and no other recorder comes before this one."""
        first: logging.Handler | None = None
        logger: logging.Logger | None = logging.getLogger(record.name)
        while logger is not None:
            for handler in logger.handlers:
                if not isinstance(handler, _LogHandler):
                    return False
                first = first or handler
            logger = logger.parent if logger.propagate else None
        return first is self
