"""Files: writing them as fast as possible, replaying one, salvaging one that was cut off."""

from __future__ import annotations

import itertools
import math
import os
import random
import struct
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from session import home
from traffic import (
    MESSAGE_RATE_HZ,
    SOURCE_RATE_HZ,
    TOPIC_RATE_HZ,
    TOPICS,
    Counter,
    make_listener,
    make_message,
    make_nodes,
    make_sources,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from sizes import Series, Size

now_ns = time.perf_counter_ns

SPACING_NS = round(1e9 / MESSAGE_RATE_HZ)
"""Time between two messages of a file that is written as fast as possible [ns]."""
CHUNK_SIZE = 64 * 1024
"""What the bare writer gathers before it compresses, as this package does [bytes]."""

# -- writing ---------------------------------------------------------------------------------


def write(_horus: Any, size: Size, _seconds: float) -> Series:
    """Have this package's recorder write what waits in its queue, to the end of the file."""
    return write_again_and_again(size, write_once)


def write_once(directory: Path, count: int) -> tuple[int, Path]:
    """Return how long it took to write so many messages [ns], and the file.

    All of them wait when the clock starts; making and queueing them is the sender's part. The
    clock stops when the file has its end and would survive a power cut.
    """
    from horus.clock import MonotonicClock, Timeline
    from horus.recording.recorder import Recorder
    from horus.recording.session_file import SessionFile
    from horus.snapshot import freeze
    from horus.topics import Bus

    recorder = Recorder(Timeline(MonotonicClock(), 1000.0, seed=None), {"name": "bench"}, 10**9)
    bus = Bus()
    publishers = [bus.topic(topic).publisher("source") for topic in TOPICS]
    for number in range(count):
        publisher = publishers[number % len(TOPICS)]
        publisher.sent += 1
        recorder.note_message(publisher, freeze(make_message(number)))
    file = SessionFile(directory, recorder.definitions)
    started_ns = now_ns()
    recorder.start([file])
    recorder.finish()
    took_ns = now_ns() - started_ns
    if recorder.lost:
        raise RuntimeError(f"{recorder.lost} of {count} messages were dropped")
    return took_ns, file.path


def write_mcap(_mcap: Any, size: Size, _seconds: float) -> Series:
    """Have the bare writer of the mcap library write the same, encoded by msgspec."""
    return write_again_and_again(size, write_mcap_once)


def write_mcap_once(directory: Path, count: int) -> tuple[int, Path]:
    """Return how long it took to encode and write so many messages [ns], and the file."""
    import msgspec
    from mcap.writer import CompressionType, Writer

    encode = msgspec.msgpack.Encoder().encode
    messages = [make_message(number) for number in range(count)]
    path = directory / "bare.mcap"
    with path.open("wb") as stream:
        started_ns = now_ns()
        writer = Writer(stream, chunk_size=CHUNK_SIZE, compression=CompressionType.ZSTD)
        writer.start()
        channels = [writer.register_channel(topic, "msgpack", 0) for topic in TOPICS]
        sequences = itertools.count()
        for message in messages:
            number = next(sequences)
            at_ns = number * SPACING_NS
            writer.add_message(
                channel_id=channels[number % len(TOPICS)],
                log_time=at_ns,
                data=encode(message),
                publish_time=at_ns,
                sequence=number // len(TOPICS) + 1,
            )
        writer.finish()
        stream.flush()
        os.fdatasync(stream.fileno())
        took_ns = now_ns() - started_ns
    return took_ns, path


def write_again_and_again(size: Size, once: Callable[[Path, int], tuple[int, Path]]) -> Series:
    """Write files; return the time per message [µs] and the bytes per message of each."""
    from mcap.reader import make_reader

    count = size.write_messages
    series: Series = {"write_us": [], "message_bytes": []}
    for _ in range(size.writes):
        with tempfile.TemporaryDirectory(prefix="horus-bench-") as directory:
            took_ns, path = once(Path(directory), count)
            with path.open("rb") as stream:
                poses = sum(1 for _, channel, _ in make_reader(stream).iter_messages(topics=TOPICS))
            if poses != count:
                raise RuntimeError(f"{path.name} has {poses} of {count} messages")
            series["write_us"].append(took_ns / count / 1e3)
            series["message_bytes"].append(path.stat().st_size / count)
    return series


# -- replay ----------------------------------------------------------------------------------


def record_virtual(horus: Any, messages: int, rate_hz: float = SOURCE_RATE_HZ) -> Path:
    """Record a session in virtual time, below ``HOME``; return its file.

    Args:
        horus: The package.
        messages: How many messages.
        rate_hz: The rate of those who send them.
    """
    seconds = messages / MESSAGE_RATE_HZ
    sources = make_sources(seconds, rate_hz=rate_hz, clock_ns=lambda: round(1e9 * horus.elapsed()))
    scheduler = horus.Scheduler(tick_rate=1000.0, deterministic=True, recording=True)
    for node in make_nodes(horus, sources):
        scheduler.add(node)
    scheduler.run(duration=seconds + 1.0 / SOURCE_RATE_HZ)
    if any(source.sent != source.quota for source in sources):
        raise RuntimeError("the session ended before everything was sent")
    (path,) = scheduler.stop_recording()
    return Path(path)


REPLAYED_HZ: Mapping[str, float] = {"ten": SOURCE_RATE_HZ, "one": TOPIC_RATE_HZ}
"""How many messages a tick sends, in words, to the rate of those who send."""


def replay(horus: Any, size: Size, _seconds: float) -> Series:
    """Replay sessions as fast as possible to a node that counts."""
    series: Series = {}
    for per_tick, rate_hz in REPLAYED_HZ.items():
        run_hz, whole_hz = replay_once(horus, size.replay_messages, rate_hz)
        series |= {f"run_{per_tick}_hz": [run_hz], f"whole_{per_tick}_hz": [whole_hz]}
    return series


def replay_once(horus: Any, messages: int, rate_hz: float) -> tuple[float, float]:
    """Return messages per second of the run, and of all from opening the file on [Hz]."""
    with home():
        path = record_virtual(horus, messages, rate_hz)
        counter = Counter()
        opened_ns = now_ns()
        # The sources only: the one that listened has sent nothing.
        scheduler = horus.Scheduler.replay_from(path)
        scheduler.set_replay_speed(math.inf)
        scheduler.add(make_listener(horus, counter))
        started_ns = now_ns()
        scheduler.run()
        ended_ns = now_ns()
    if counter.received != messages:
        raise RuntimeError(f"{counter.received} of {messages} messages were replayed")
    return (
        1e9 * messages / (ended_ns - started_ns),
        1e9 * messages / (ended_ns - opened_ns),
    )


# -- recovery --------------------------------------------------------------------------------

MAGIC_SIZE = 8
RECORD_HEAD = struct.Struct("<BQ")
"""Opcode and length of every record of an MCAP file."""
CHUNK, MESSAGE_INDEX, DATA_END = 0x06, 0x07, 0x0F
INDEX_HEAD_SIZE, INDEX_ENTRY_SIZE = 6, 16
SEED_MESSAGES = 100_000
"""Length of the session that the large recording repeats."""


class Record(NamedTuple):
    """A record of an MCAP file: where it begins and ends, and what it is."""

    opcode: int
    start: int
    end: int


def records_of(data: bytes) -> Iterator[Record]:
    """Yield the records of a whole file up to the end of its data, which included."""
    position = MAGIC_SIZE
    while True:
        opcode, length = RECORD_HEAD.unpack_from(data, position)
        end = position + RECORD_HEAD.size + length
        yield Record(opcode, position, end)
        if opcode == DATA_END:
            return
        position = end


def messages_of(record: Record) -> int:
    """Return how many messages an index lists."""
    return (record.end - record.start - RECORD_HEAD.size - INDEX_HEAD_SIZE) // INDEX_ENTRY_SIZE


class Repeated(NamedTuple):
    """A recording that is as long as one likes: the chunks of a session, again and again."""

    head: bytes
    body: bytes
    times: int
    chunks: list[tuple[int, int]]
    """Where each chunk ends in the body, and how many messages it has."""

    @property
    def data_end(self) -> int:
        """Where the data ends [bytes]."""
        return len(self.head) + self.times * len(self.body)

    def complete_before(self, cut: int) -> int:
        """Return how many messages are in chunks that end before a byte."""
        whole, rest = divmod(cut - len(self.head), len(self.body))
        of_body = sum(count for _, count in self.chunks)
        return whole * of_body + sum(count for end, count in self.chunks if end <= rest)


def repeat(data: bytes, size: float) -> Repeated:
    """Return a recording of at least so many bytes, made of the chunks of another one."""
    records = list(records_of(data))
    start = next(record.start for record in records if record.opcode == CHUNK)
    end = records[-1].start
    ends = [record.end - start for record in records if record.opcode == CHUNK]
    counts = [0] * len(ends)
    chunk = -1
    for record in records:
        if record.opcode == CHUNK:
            chunk += 1
        elif record.opcode == MESSAGE_INDEX:
            counts[chunk] += messages_of(record)
    times = math.ceil(size / (end - start))
    return Repeated(data[:start], data[start:end], times, list(zip(ends, counts, strict=True)))


def recover(horus: Any, size: Size, _seconds: float) -> Series:
    """Cut off a large recording somewhere near its end, and time how long its recovery takes.

    The file is not in memory when the clock starts, as after a power cut.
    """
    with home() as directory:
        seed = record_virtual(horus, min(SEED_MESSAGES, size.replay_messages))
        large = repeat(seed.read_bytes(), 1e6 * size.recover_mb)
        path = directory / "large.mcap"
        with path.open("wb") as file:
            file.write(large.head)
            for _ in range(large.times):
                file.write(large.body)
        # Makes it a whole recording, with an end.
        horus.recover(path)
        whole = read_all(horus, path)
        if whole != large.complete_before(large.data_end):
            raise RuntimeError(f"the recording to be cut off has {whole} messages")
        size_mb = path.stat().st_size / 1e6
        cut = random.Random(0).randrange(round(0.99 * large.data_end), large.data_end)
        os.truncate(path, cut)
        forget(path)
        started_ns = now_ns()
        recovery = horus.recover(path)
        took_s = (now_ns() - started_ns) / 1e9
        complete, salvaged = large.complete_before(cut), read_all(horus, path)
    if recovery.messages != salvaged:
        raise RuntimeError(f"recover() tells {recovery.messages} messages; there are {salvaged}")
    return {
        "recover_s": [took_s],
        "size_mb": [size_mb],
        "complete": [complete],
        "salvaged": [salvaged],
    }


def read_all(horus: Any, path: Path) -> int:
    """Return how many messages of all channels a recording has, by reading them."""
    with horus.RecordingReader(path) as reader:
        return sum(1 for _ in reader.entries())


def forget(path: Path) -> None:
    """Have the kernel write a file to disk and drop it from memory, where it can."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
        if hasattr(os, "posix_fadvise"):
            os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
    finally:
        os.close(descriptor)
