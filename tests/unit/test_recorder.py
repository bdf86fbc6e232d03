"""The queue between ticks and the thread that writes: bounded, in order, honest about losses."""

from __future__ import annotations

import json
import logging
import os
import threading
import time
import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import pytest
from mcap.records import Channel, Chunk

from horus import Node, RecordingReader, Scheduler
from horus.clock import MonotonicClock, SimClock, Timeline
from horus.recording import recorder as module
from horus.recording.encoding import decode
from horus.recording.mcap_file import (
    CHUNK_SIZE,
    Definitions,
    Index,
    Summary,
    chunk_index,
    packed,
)
from horus.recording.reader import RECORD_HEAD, Entry, entries_of, unpack
from horus.recording.recorder import Recorder
from horus.recording.scribe import ENVELOPE
from horus.recording.session_file import SessionFile
from horus.topics import Bus

ROOM = 100
"""Items that may wait in these tests."""
PATIENCE_S = 10.0


class Disk:
    """A sink that can be made to stand still."""

    def __init__(self) -> None:
        self.lost = 0
        self.chunks: list[Chunk] = []
        self.flows = threading.Event()
        self.flows.set()
        self.reached = threading.Event()
        self.closed = False

    def write(self, chunk: Chunk, index: Index) -> int:
        self.reached.set()
        assert self.flows.wait(PATIENCE_S)
        self.chunks.append(chunk)
        return len(chunk.data)

    def sync(self) -> None: ...

    def finish(self) -> None: ...

    def close(self) -> None:
        self.closed = True

    def entries(self) -> Iterator[Entry]:
        for chunk in self.chunks:
            _, data = unpack(packed(chunk)[RECORD_HEAD.size :])
            yield from entries_of(data)

    def messages(self) -> list[int]:
        return [
            decode(bytes(entry.data[ENVELOPE.size :]))
            for entry in self.entries()
            if entry.channel.topic == "count"
        ]

    def facts(self, channel: str) -> list[dict[str, str]]:
        return [json.loads(bytes(e.data)) for e in self.entries() if e.channel.topic == channel]

    def losses(self) -> list[str]:
        return [fact["text"] for fact in self.facts("horus/events") if fact["kind"] == "lost"]


class Rig:
    """A recorder between a bus and a disk."""

    def __init__(self, timeline: Timeline, refresh_size: int | None = None) -> None:
        self.disk = Disk()
        self.recorder = Recorder(timeline, {"name": "rig"}, flush_ns=0)
        self.recorder.start([self.disk], refresh_size)
        bus = Bus()
        bus.add_tap(self.recorder.note_message)
        self.publisher = bus.topic("count").publisher("node")

    def send(self, count: int) -> None:
        for _ in range(count):
            self.publisher.send(self.publisher.sent + 1)

    def stall(self) -> None:
        """Have the writer stand in the middle of writing, with an empty queue behind it."""
        self.disk.flows.clear()
        self.disk.reached.clear()
        self.send(1)
        assert self.disk.reached.wait(PATIENCE_S)

    def finish(self) -> None:
        self.disk.flows.set()
        self.recorder.finish()


@pytest.fixture(autouse=True)
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have room looked for from the first item on."""
    monkeypatch.setattr(module, "_FEW", 0)


@pytest.fixture
def live(monkeypatch: pytest.MonkeyPatch) -> Iterator[Rig]:
    monkeypatch.setattr(module, "MOST_UNWRITTEN", ROOM)
    rig = Rig(Timeline(MonotonicClock(), 100))
    yield rig
    rig.finish()


@pytest.fixture
def simulated(monkeypatch: pytest.MonkeyPatch) -> Iterator[Rig]:
    monkeypatch.setattr(module, "MOST_UNWRITTEN", ROOM)
    rig = Rig(Timeline(SimClock(), 100, seed=0))
    yield rig
    rig.finish()


def test_what_finds_no_room_is_counted_recorded_and_logged(
    live: Rig, caplog: pytest.LogCaptureFixture
) -> None:
    """The oldest are kept in order, the others are lost, and file and log say how many."""
    live.stall()
    live.send(5 * ROOM)
    assert live.recorder.lost == 4 * ROOM
    live.finish()
    assert live.disk.messages() == list(range(1, ROOM + 2))
    assert live.disk.losses() == ["400 items were lost, because writing does not keep up"]
    told = [record for record in caplog.records if "were lost" in record.getMessage()]
    assert len(told) == 1
    assert live.disk.closed


def test_sending_never_waits_for_the_disk(live: Rig) -> None:
    """A sender is not held up, however long the disk stands still."""
    live.stall()
    began = time.monotonic()
    live.send(1000)
    assert time.monotonic() - began < 1.0


def test_a_disk_that_stands_still_too_long_costs_new_messages_though_there_is_room(
    live: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Large messages would fill the memory before they are many."""
    monkeypatch.setattr(module, "_LONGEST_STALL_NS", 50_000_000)
    live.stall()
    time.sleep(0.2)
    live.send(3)
    assert live.recorder.lost == 3
    live.disk.flows.set()
    for _ in range(2):  # the second one is done after the writer has come to the end of its queue
        live.recorder.do(lambda: None)
    live.send(2)
    live.finish()
    assert live.recorder.lost == 3
    assert live.disk.messages() == [1, 5, 6]


def test_the_first_few_items_of_a_long_standstill_are_kept(
    live: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They cannot fill the memory, so nobody looks how long it has lasted."""
    monkeypatch.setattr(module, "_FEW", 2)
    monkeypatch.setattr(module, "_LONGEST_STALL_NS", 50_000_000)
    live.stall()
    time.sleep(0.2)
    live.send(5)
    assert live.recorder.lost == 3
    live.finish()
    assert live.disk.messages() == [1, 2, 3]


def test_the_configuration_is_written_again_in_the_middle_of_a_backlog() -> None:
    """A ring that overwrites what is old always has it, however much is written at once."""
    refresh_size = 200_000
    rig = Rig(Timeline(MonotonicClock(), 100), refresh_size)
    rig.stall()
    for _ in range(100):
        rig.publisher.send(os.urandom(30_000))
    rig.finish()
    since = 0
    for chunk in rig.disk.chunks:
        _, data = unpack(packed(chunk)[RECORD_HEAD.size :])
        told = any(entry.channel.topic == "horus/scheduler" for entry in entries_of(data))
        since = 0 if told else since + len(chunk.data)
        assert since <= refresh_size + 2 * CHUNK_SIZE


def test_virtual_time_waits_for_the_disk(simulated: Rig) -> None:
    """In virtual time nothing is lost: the sender waits until there is room."""
    simulated.stall()
    sender = threading.Thread(target=simulated.send, args=[5 * ROOM])
    sender.start()
    sender.join(0.2)
    assert sender.is_alive()
    simulated.disk.flows.set()
    sender.join(PATIENCE_S)
    assert not sender.is_alive()
    simulated.finish()
    assert simulated.recorder.lost == 0
    assert simulated.disk.messages() == list(range(1, 5 * ROOM + 2))


def test_a_sender_does_not_wait_for_a_recorder_that_has_ended(simulated: Rig) -> None:
    """Whoever waits for room is released when recording ends."""
    simulated.stall()
    sender = threading.Thread(target=simulated.send, args=[5 * ROOM])
    sender.start()
    simulated.finish()
    sender.join(PATIENCE_S)
    assert not sender.is_alive()


def test_the_end_does_not_wait_for_ever(
    live: Rig, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A disk that stands still at the end of the run holds it up for a bounded time."""
    monkeypatch.setattr(module, "_FINISH_TIMEOUT_S", 0.1)
    live.stall()
    began = time.monotonic()
    live.recorder.finish()
    assert time.monotonic() - began < 2.0
    assert "the session is unfinished" in caplog.text


def test_work_for_the_writer_is_done_after_what_came_before_it(live: Rig) -> None:
    """What `do` does sees everything that was sent until then; its error is the caller's."""
    live.send(10)
    assert live.recorder.do(live.disk.messages) == list(range(1, 11))

    def fail() -> None:
        raise OSError("no space")

    with pytest.raises(OSError, match="no space"):
        live.recorder.do(fail)
    live.stall()
    with pytest.raises(TimeoutError):
        live.recorder.do(live.disk.messages, timeout_s=0.05)


@pytest.mark.parametrize(("rate", "waits"), [(None, True), (50, False)], ids=["BestEffort", "Rt"])
def test_backpressure_is_for_best_effort_nodes_only(rate, waits, tmp_path, monkeypatch) -> None:
    """With `"block"` a BestEffort node waits and loses nothing; an Rt node never waits."""
    monkeypatch.setattr(module, "MOST_UNWRITTEN", ROOM)
    write = SessionFile.write
    stalled_s = 0.3

    def write_slowly(self, chunk, index):
        if blocked.is_set():
            time.sleep(stalled_s)
        return write(self, chunk, index)

    monkeypatch.setattr(SessionFile, "write", write_slowly)
    blocked = threading.Event()
    took_s = []

    def tick(node):
        if took_s:
            return
        blocked.set()
        node.send("count", 0)
        time.sleep(0.2)  # until the writer is at it
        blocked.clear()
        began = time.monotonic()
        for count in range(1, 3 * ROOM):
            node.send("count", count)
        took_s.append(time.monotonic() - began)
        node.request_stop()

    sched = Scheduler(recording=tmp_path, recording_backpressure="block")
    sched.add(Node("it", tick, rate=rate, pubs=["count"], watchdog=5.0))
    sched.run(duration=5.0)
    (path,) = sched.stop_recording()
    with RecordingReader(path) as reader:
        counts = [recorded.message() for recorded in reader.messages(["count"])]
        losses = [fact for fact in reader.facts("horus/events") if fact["kind"] == "lost"]
        ticks = list(reader.facts("horus/ticks/it"))
    if waits:
        # What supervision logs about the long tick comes from a thread that never waits.
        assert counts == list(range(3 * ROOM))
        assert len(ticks) == sched.get_node_stats("it")["total_ticks"]
    else:
        assert counts == list(range(len(counts)))
        assert len(counts) < 3 * ROOM
        assert took_s[0] < stalled_s / 2
        assert losses


def test_large_messages_are_bounded_by_their_size(
    live: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A disk that moves, too slowly for a camera, does not cost the memory."""
    monkeypatch.setattr(module, "MOST_UNWRITTEN_BYTES", 1_000_000)
    image = bytes(100_000)
    live.publisher.send({"pixels": image})  # its size is known once it was written
    live.recorder.do(lambda: None)
    live.stall()
    live.publisher.send({"pixels": image})
    before = live.recorder.lost
    for _ in range(50):
        live.publisher.send({"pixels": image})
    assert 38 <= live.recorder.lost - before < 50
    live.disk.flows.set()
    for _ in range(2):
        live.recorder.do(lambda: None)
    lost = live.recorder.lost
    live.publisher.send({"pixels": image})
    assert live.recorder.lost == lost


@pytest.mark.parametrize("text", ["no \udc80 name", "100 % of {}"])
def test_a_log_record_of_any_text_is_recorded(
    live: Rig, text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is no Unicode reads as question marks, and the writer goes on."""
    monkeypatch.setattr(logging.getLogger("horus"), "propagate", False)  # no report could say it
    logging.getLogger("horus.node.it").warning(text)
    live.send(3)
    live.finish()
    assert live.disk.messages() == [1, 2, 3]
    assert [log["message"] for log in live.disk.facts("horus/log")] == [text.replace("\udc80", "?")]


def test_a_record_that_cannot_be_put_in_words_does_not_harm_who_logs(
    live: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The object's own error stays out of the tick, and stands in the log."""
    monkeypatch.setattr(logging.getLogger("horus"), "propagate", False)  # pytest lets it through

    class Odd:
        def __repr__(self) -> str:
            raise ZeroDivisionError

    logger = logging.getLogger("horus.node.it")
    logger.handle(logger.makeRecord(logger.name, logging.ERROR, "f", 1, Odd(), (), None))
    live.finish()
    (log,) = live.disk.facts("horus/log")
    assert "Odd whose repr raised ZeroDivisionError" in log["message"]


def test_an_item_that_cannot_be_written_costs_itself_only(
    live: Rig, caplog: pytest.LogCaptureFixture
) -> None:
    """It is counted and told of once."""
    for _ in range(2):
        live.recorder.note_fact("horus/nodes", {"name": object()})
    live.send(2)
    live.finish()
    assert live.disk.messages() == [1, 2]
    assert live.recorder.lost == 2
    assert caplog.text.count("cannot be recorded") == 1


def test_more_channels_than_a_file_can_have(
    live: Rig, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Those that were there are recorded, the others are refused with the reason."""
    monkeypatch.setattr("horus.recording.scribe._MOST_CHANNELS", 2)  # one is the scheduler's
    live.send(1)
    other = Bus()
    other.add_tap(live.recorder.note_message)
    other.topic("another").publisher("node").send(1)
    live.send(1)
    live.finish()
    assert live.disk.messages() == [1, 2]
    assert "'another' are not recorded: an MCAP file has at most 2 channels" in caplog.text


def test_the_writer_does_not_wait_for_itself(simulated: Rig) -> None:
    """In virtual time whoever sends waits for room; what the writer logs meanwhile does not."""
    logger = logging.getLogger("horus.recording")

    def work() -> None:
        goes_on.wait(PATIENCE_S)
        logger.error("something to tell")

    goes_on = threading.Event()
    simulated.recorder.do_soon(work)
    time.sleep(0.1)  # until it is at it

    def send_and_log() -> None:
        for _ in range(2 * ROOM):
            logger.info("as the nodes do")

    level = logger.level
    logger.setLevel(logging.INFO)
    try:
        sender = threading.Thread(target=send_and_log)
        sender.start()
        sender.join(0.2)
        assert sender.is_alive()
        goes_on.set()
        sender.join(PATIENCE_S)
        assert not sender.is_alive()
    finally:
        logger.setLevel(level)
    simulated.finish()
    assert simulated.recorder.lost == 0


def test_what_is_told_of_many_chunks_is_not_kept_in_memory(tmp_path: Path) -> None:
    """A robot records for weeks, ten chunks a second."""
    count = 20_000
    definitions = Definitions()
    for channel in range(20):
        definitions.define(Channel(channel, f"topic_{channel}", "", {}, 0))
    summary = Summary(definitions, tmp_path)
    entry = chunk_index(Chunk("zstd", b"", 5, 1, 0, 0), 0, 0)
    entry.message_index_offsets = dict.fromkeys(range(20), 1)
    tracemalloc.start()
    try:
        for _ in range(count):
            summary.add_chunk(entry, {0: [1, 0]})
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 3_000_000
    assert summary.message_count == count
    assert sum(map(len, summary.end(0))) > 200 * count
    assert not list(tmp_path.iterdir())
    summary.close()
