"""An MCAP file that is written chunk by chunk and is readable after any of them.

The `mcap` library knows the records; what is ours is when they are written. A chunk goes to
the file in one call, with its index, as soon as it is full or somebody asks: what a crash
leaves behind is a file that ends between two chunks, or within one, and `recovery` adds the
end that is missing. Each chunk defines all that it refers to, so that it can be read without
the others. Messages, of which there are many, are packed here.

Format: https://mcap.dev/spec
"""

from __future__ import annotations

import os
import struct
import tempfile
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator
from importlib import metadata
from pathlib import Path
from typing import Any, Protocol

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

from horus.timing import FOREVER_NS

PROFILE = "horus"
CHUNK_SIZE = 64 * 1024
"""Size of a chunk before compression from which it is written [bytes]."""

COMPRESSION = "zstd"
MESSAGE_HEAD = struct.Struct("<BQHIQQ")
"""Opcode, length, channel, sequence, log time, publish time."""

_RECORD_HEAD_SIZE = 9
_MESSAGE_FIELDS_SIZE = MESSAGE_HEAD.size - _RECORD_HEAD_SIZE
_LAST_SEQUENCE = 2**32 - 1
_MOST_IN_MEMORY = 1 << 20
"""How much is kept in memory of what is told of the chunks [bytes]."""

Index = dict[int, list[int]]
"""By channel, log time [ns] and place in the chunk of each message, one after the other."""


class Definitions:
    """The schemas and channels of a file, by number."""

    def __init__(self) -> None:
        """Begin with none."""
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}

    def define(self, record: Schema | Channel) -> None:
        """Take note of a schema or a channel."""
        kept: dict[int, Any] = self.schemas if isinstance(record, Schema) else self.channels
        kept[record.id] = record


class Summary:
    """What the end of a file tells about the rest of it.

    There are ten chunks or more in a second, and a robot may record for weeks: what is told of
    each is kept on the disk, once it is more than a little.

    Thread: one at a time.
    """

    def __init__(self, definitions: Definitions, directory: Path) -> None:
        """Begin with an empty file.

        Args:
            definitions: The schemas and channels that its chunks refer to.
            directory: Where a file without a name may be kept.
        """
        self.definitions = definitions
        self._counts: Counter[int] = Counter()
        self._first_ns, self._last_ns, self._chunks = FOREVER_NS, 0, 0
        self._entries = tempfile.SpooledTemporaryFile(  # noqa: SIM115 - until close
            _MOST_IN_MEMORY, dir=str(directory)
        )
        self._error: OSError | None = None

    @property
    def message_count(self) -> int:
        """How many messages of all channels there are."""
        return self._counts.total()

    def add_chunk(self, entry: ChunkIndex, index: Index) -> None:
        """Take note of a chunk that was written."""
        for channel, entries in index.items():
            self._counts[channel] += len(entries) // 2
        self._chunks += 1
        self._first_ns = min(self._first_ns, entry.message_start_time)
        self._last_ns = max(self._last_ns, entry.message_end_time)
        try:
            self._entries.write(packed(entry))
        except OSError as exc:  # the chunk is there all the same
            self._error = exc

    def end(self, start: int) -> Iterator[bytes]:
        """Yield the end of a file whose data ends at `start`, which this end begins at.

        Raises:
            OSError: What there is to tell could not be kept.
        """
        if self._error is not None:
            raise self._error
        head = packed(DataEnd(0))
        yield head
        begin = start = start + len(head)
        crc = 0
        offsets: list[SummaryOffset] = []
        for opcode, group in self._groups():
            size = 0
            for part in group:
                crc = zlib.crc32(part, crc)
                size += len(part)
                yield part
            if size:
                offsets.append(SummaryOffset(opcode, start, size))
            start += size
        # The checksum covers the footer, too, up to itself.
        last = packed(*offsets, Footer(begin, start, 0))[:-4]
        yield b"".join((last, struct.pack("<I", zlib.crc32(last, crc)), MCAP0_MAGIC))

    def close(self) -> None:
        """Give back what it holds."""
        self._entries.close()

    def _groups(self) -> Iterator[tuple[Opcode, Iterable[bytes]]]:
        yield Opcode.SCHEMA, map(packed, self.definitions.schemas.values())
        yield Opcode.CHANNEL, map(packed, self.definitions.channels.values())
        yield Opcode.STATISTICS, [packed(self._statistics())]
        self._entries.seek(0)
        yield Opcode.CHUNK_INDEX, iter(lambda: self._entries.read(_MOST_IN_MEMORY), b"")

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=0,
            channel_count=len(self.definitions.channels),
            channel_message_counts=dict(self._counts),
            chunk_count=self._chunks,
            message_count=self.message_count,
            metadata_count=0,
            message_start_time=self._first_ns if self._chunks else 0,
            message_end_time=self._last_ns,
            schema_count=len(self.definitions.schemas),
        )


class ChunkBuilder:
    """Gathers messages for the next chunk.

    Thread: one at a time.
    """

    def __init__(self, definitions: Definitions) -> None:
        """Begin empty; `definitions` has the channels."""
        self._definitions = definitions
        self._records = bytearray()
        self._index: Index = {}
        self._schemas: set[int] = set()
        self._first_ns, self._last_ns = FOREVER_NS, 0

    @property
    def size(self) -> int:
        """The size so far [bytes]."""
        return len(self._records)

    def add_message(
        self, channel: int, sequence: int, log_ns: int, publish_ns: int, data: bytes
    ) -> None:
        """Add a message; the times are wall times [ns]."""
        index = self._index.get(channel)
        if index is None:
            self._define(channel)
            index = self._index[channel] = []
        if log_ns < self._first_ns:
            self._first_ns = log_ns
        if log_ns > self._last_ns:
            self._last_ns = log_ns
        index += (log_ns, len(self._records))
        self._records += MESSAGE_HEAD.pack(
            Opcode.MESSAGE,
            _MESSAGE_FIELDS_SIZE + len(data),
            channel,
            sequence & _LAST_SEQUENCE,
            log_ns,
            publish_ns,
        )
        self._records += data

    def _define(self, channel: int) -> None:
        definition = self._definitions.channels[channel]
        schema = definition.schema_id
        if schema and schema not in self._schemas:
            self._schemas.add(schema)
            self._records += packed(self._definitions.schemas[schema])
        self._records += packed(definition)

    def take(self, compressor: zstandard.ZstdCompressor) -> tuple[Chunk, Index]:
        """Return what was gathered, with its index."""
        records, index = bytes(self._records), self._index
        chunk = Chunk(
            compression=COMPRESSION,
            data=compressor.compress(records),
            message_start_time=self._first_ns if index else 0,
            message_end_time=self._last_ns,
            uncompressed_crc=zlib.crc32(records),
            uncompressed_size=len(records),
        )
        self._records, self._index, self._schemas = bytearray(), {}, set()
        self._first_ns, self._last_ns = FOREVER_NS, 0
        return chunk, index


class Output(Protocol):
    """Where the bytes of a file go."""

    def append(self, data: bytes) -> int:
        """Write all of it, or nothing; return where it begins [bytes].

        Raises:
            OSError: It could not be written.
        """


class AppendedFile:
    """A file that only ever grows by whole appends.

    Thread: one at a time.
    """

    def __init__(self, descriptor: int) -> None:
        """Append to an open file, whose end is where its good data ends."""
        self._descriptor = descriptor
        self.size = os.fstat(descriptor).st_size

    def append(self, data: bytes) -> int:
        """Write all of it, or nothing; return where it begins [bytes].

        Raises:
            OSError: It could not be written: the disk is full, or the file was deleted.
        """
        return self.append_all([data])

    def append_all(self, parts: Iterable[bytes]) -> int:
        """Write all parts, or nothing; return where they begin [bytes].

        Raises:
            OSError: They could not be written: the disk is full, or the file was deleted.
        """
        if not os.fstat(self._descriptor).st_nlink:
            raise FileNotFoundError("it was deleted")
        start = end = self.size
        try:
            for part in parts:
                rest = memoryview(part)
                while rest:
                    written = os.pwrite(self._descriptor, rest, end)
                    rest, end = rest[written:], end + written
        except BaseException:
            # Half a chunk is of no use, and in the way of the next.
            os.ftruncate(self._descriptor, start)
            raise
        self.size = end
        return start

    def sync(self) -> None:
        """Have what was written survive a power cut."""
        os.fdatasync(self._descriptor)


def begin(file: AppendedFile) -> None:
    """Write the head of a new file.

    Raises:
        OSError: It could not be written.
    """
    file.append(
        MCAP0_MAGIC + packed(Header(PROFILE, f"horus {metadata.version('horus-scheduler')}"))
    )


def append_chunk(file: Output, summary: Summary, chunk: Chunk, index: Index) -> None:
    """Write a chunk with its index.

    Raises:
        OSError: It could not be written.
    """
    head = packed(chunk)
    records, offsets = _packed_index(index)
    start = file.append(head + records)
    entry = chunk_index(chunk, start, len(head))
    _set_index(entry, start + len(head), records, offsets)
    summary.add_chunk(entry, index)


def append_index(file: Output, summary: Summary, entry: ChunkIndex, index: Index) -> None:
    """Write the index of a chunk that is the last in the file and lacks it.

    Raises:
        OSError: It could not be written.
    """
    records, offsets = _packed_index(index)
    _set_index(entry, file.append(records), records, offsets)
    summary.add_chunk(entry, index)


def chunk_index(chunk: Chunk, start: int, length: int) -> ChunkIndex:
    """Return what the summary says of a chunk, apart from the chunk's index.

    Args:
        chunk: The chunk.
        start: Where its record is in the file.
        length: How long that is [bytes].
    """
    return ChunkIndex(
        chunk_length=length,
        chunk_start_offset=start,
        compression=chunk.compression,
        compressed_size=len(chunk.data),
        message_end_time=chunk.message_end_time,
        message_index_length=0,
        message_index_offsets={},
        message_start_time=chunk.message_start_time,
        uncompressed_size=chunk.uncompressed_size,
    )


def _packed_index(index: Index) -> tuple[bytes, dict[int, int]]:
    """Return the records of an index, and where among them is that of each channel."""
    parts, offsets, size = [], {}, 0
    for channel, entries in index.items():
        offsets[channel] = size
        body = struct.pack(f"<HI{len(entries)}Q", channel, 8 * len(entries), *entries)
        parts.append(struct.pack("<BQ", Opcode.MESSAGE_INDEX, len(body)) + body)
        size += len(parts[-1])
    return b"".join(parts), offsets


def _set_index(entry: ChunkIndex, start: int, records: bytes, offsets: dict[int, int]) -> None:
    entry.message_index_length = len(records)
    entry.message_index_offsets = {channel: start + at for channel, at in offsets.items()}


def create(path: Path) -> int:
    """Return the descriptor of a new file.

    Raises:
        OSError: There is one already, or it cannot be made.
    """
    flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
    return os.open(path, flags, 0o644)


def packed(*records: McapRecord) -> bytes:
    """Return records as bytes."""
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    data: bytes = builder.end()  # type: ignore[no-untyped-call]
    return data
