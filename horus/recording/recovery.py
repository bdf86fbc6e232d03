"""Salvages recordings that have no end, because their process died or the disk was full."""

from __future__ import annotations

import contextlib
import logging
import os
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, Schema

from horus.errors import RecordingError
from horus.recording import mcap_file, reader, sessions
from horus.recording.reader import Record, RecordingReader

_log = logging.getLogger("horus.recording")

_IGNORED_OPCODE = 0x80
"""Of private records, which every reader of MCAP skips."""
_CHANNEL = struct.Struct("<H")


@dataclass(frozen=True, slots=True)
class Recovery:
    """What was salvaged."""

    path: Path
    """The recording, which is finished now."""
    messages: int
    """How many messages of all channels it has, ticks and log records included."""
    bytes_dropped: int
    """How many bytes at the end, and in damaged chunks, could not be used."""

    def __str__(self) -> str:
        """Return it in words."""
        dropped = f"; {self.bytes_dropped} bytes were not usable" if self.bytes_dropped else ""
        return f"{self.path}: {self.messages} messages{dropped}"


def recover(path: str | os.PathLike[str]) -> Recovery:
    """Give a recording the end that it lacks; one that has an end is left as it is.

    In place: what is incomplete at the end is cut off, chunks that are damaged are marked so
    that readers skip them, and the index is written. Should that be interrupted, it can be
    done again.

    Raises:
        RecordingError: It is no recording, there is nothing to salvage, it is being recorded,
            or it cannot be written.
    """
    where = Path(path)
    try:
        descriptor = os.open(where, os.O_RDWR | os.O_CLOEXEC)
    except OSError as exc:
        raise RecordingError(f"{where} cannot be recovered: {exc}") from exc
    try:
        if not sessions.lock(descriptor, wait=True):
            raise RecordingError(f"{where} is being recorded; stop that first")
        return _recover(where, descriptor)
    except OSError as exc:
        raise RecordingError(f"{where} cannot be recovered: {exc}") from exc
    finally:
        os.close(descriptor)


def open_recording(path: str | os.PathLike[str]) -> RecordingReader:
    """Open a recording to read it; recover it first if its process has died.

    Raises:
        RecordingError: It is no recording, it is being recorded, or it cannot be recovered.
    """
    if Path(path).exists() and sessions.state_of(Path(path)) == "unfinished":
        _log.warning("recovered %s", recover(path))
    return RecordingReader(path)


def _recover(path: Path, descriptor: int) -> Recovery:
    summary = mcap_file.Summary(mcap_file.Definitions(), path.parent)
    with contextlib.closing(summary):
        with reader.open_file(path) as file:
            size = os.fstat(descriptor).st_size
            found = _survey(file, summary)
        finished = sessions.state_of(path) == "finished"
        dropped = 0
        if found.damaged or not finished:
            dropped = _end(descriptor, found, summary)
            if not finished:
                dropped += size - found.end
        return Recovery(path, summary.message_count, dropped)


def _end(descriptor: int, found: _Survey, summary: mcap_file.Summary) -> int:
    """Give a file the end that it lacks; return how many bytes of it are damaged."""
    for record in found.damaged:
        os.pwrite(descriptor, bytes([_IGNORED_OPCODE]), record.offset)
    os.ftruncate(descriptor, found.end)
    output = mcap_file.AppendedFile(descriptor)
    if found.unindexed is not None:
        mcap_file.append_index(output, summary, *found.unindexed)
    output.append_all(summary.end(output.size))
    output.sync()
    return sum(record.end - record.offset for record in found.damaged)


@dataclass(slots=True)
class _Survey:
    """How far a file is good, whether it has an end or not."""

    end: int = 0
    """Where what can be used ends."""
    damaged: list[Record] = field(default_factory=list)
    """Chunks that cannot be read."""
    unindexed: tuple[ChunkIndex, mcap_file.Index] | None = None
    """The last chunk, if its index is cut short."""


def _survey(file: BinaryIO, summary: mcap_file.Summary) -> _Survey:
    found = _Survey()
    chunk: tuple[ChunkIndex, mcap_file.Index] | None = None
    for record in reader.records(file):
        if record.opcode == Opcode.CHUNK:
            if chunk is not None:
                summary.add_chunk(*chunk)
            try:
                head, definitions, index = survey_chunk(record.content)
            except ValueError:
                found.damaged.append(record)
                chunk = None
            else:
                for definition in definitions:
                    summary.definitions.define(definition)
                length = record.end - record.offset
                chunk = mcap_file.chunk_index(head, record.offset, length), index
        elif record.opcode == Opcode.MESSAGE_INDEX and chunk is not None:
            entry, _ = chunk
            (channel,) = _CHANNEL.unpack_from(record.content)
            entry.message_index_offsets[channel] = record.offset
            entry.message_index_length += record.end - record.offset
        elif record.opcode not in (Opcode.HEADER, Opcode.MESSAGE_INDEX, _IGNORED_OPCODE):
            break  # the end begins
        found.end = record.end
    if chunk is not None:
        entry, index = chunk
        if entry.message_index_offsets.keys() == index.keys():
            summary.add_chunk(entry, index)
        else:
            found.unindexed = chunk
            found.end = entry.chunk_start_offset + entry.chunk_length
    return found


def survey_chunk(content: bytes) -> tuple[Chunk, list[Schema | Channel], mcap_file.Index]:
    """Return a chunk, what it defines, and its index.

    Raises:
        ValueError: It is damaged.
    """
    index: mcap_file.Index = {}
    definitions: list[Schema | Channel] = []
    chunk, data = reader.unpack(content)
    view = memoryview(data)
    for opcode, start, end in reader.walk(data):
        if opcode == Opcode.MESSAGE:
            _, _, channel, _, log_ns, _ = reader.head_of_message(data, start)
            index.setdefault(channel, []).extend((log_ns, start))
        elif opcode == Opcode.SCHEMA:
            definitions.append(reader.definition(Schema, view[start:end]))
        elif opcode == Opcode.CHANNEL:
            definitions.append(reader.definition(Channel, view[start:end]))
    if index.keys() != {it.id for it in definitions if isinstance(it, Channel)}:
        raise ValueError("a chunk does not define its channels")
    return chunk, definitions, index
