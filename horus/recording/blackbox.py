"""The flight recorder: a ring of the latest chunks in a memory-mapped file.

The kernel keeps what was written to the mapping, whatever becomes of the process. The chunks
are those of a recording; `dump` makes one of them. Layout of the file (little-endian):

| at | what |
| --- | --- |
| 0 | 8 bytes `HORUSBB1` |
| 8 | tail: where the oldest chunk begins |
| 16 | head: where the next chunk begins |
| 4096 | the ring: chunk records of MCAP, one after another |

Tail and head only grow; their place in the ring is the remainder. A chunk that does not fit
before the end of the ring begins at its start, and a zero byte takes its place. The tail moves
on before anything is overwritten and the head after, so that the ring is whole at any moment.
"""

from __future__ import annotations

import contextlib
import logging
import mmap
import os
import struct
from collections.abc import Iterator
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Chunk

from horus.errors import RecordingError
from horus.recording import mcap_file, recovery, sessions
from horus.recording.mcap_file import Index
from horus.recording.reader import RECORD_HEAD

_log = logging.getLogger("horus.recording")

SUFFIX = ".ring"
MAGIC = b"HORUSBB1"
MB = 1_000_000
_START = mmap.PAGESIZE
_POSITION = struct.Struct("<Q")
_TAIL_AT, _HEAD_AT = 8, 16


class Ring:
    """A file of fixed size that keeps the latest records.

    Thread: one at a time.
    """

    def __init__(self, descriptor: int) -> None:
        """Open the ring that a file contains.

        Raises:
            RecordingError: It contains none.
            OSError: It cannot be mapped.
        """
        size = os.fstat(descriptor).st_size
        if size <= _START or os.pread(descriptor, len(MAGIC), 0) != MAGIC:
            raise RecordingError("is no flight recorder's file")
        self._map = mmap.mmap(descriptor, size)
        self._size = size - _START
        self._tail, self._head = self._position(_TAIL_AT), self._position(_HEAD_AT)
        if not self._tail <= self._head <= self._tail + self._size:
            self._map.close()
            raise RecordingError("is damaged: its positions make no sense")

    @classmethod
    def create(cls, descriptor: int, size: int) -> Ring:
        """Make a file a ring of so many bytes in all.

        Raises:
            OSError: There is no room for it.
        """
        # All of it now: writing to a mapping whose page finds no room kills the process.
        os.posix_fallocate(descriptor, 0, size)
        os.pwrite(descriptor, MAGIC, 0)
        return cls(descriptor)

    def append(self, record: bytes) -> bool:
        """Keep a record in place of the oldest; return whether it fits at all."""
        if len(record) > self._size:
            return False
        place = self._head % self._size
        rest = self._size - place
        start = self._head if len(record) <= rest else self._head + rest
        end = start + len(record)
        while self._tail < self._head and end - self._tail > self._size:
            self._tail = self._after(self._tail)
        self._set_position(_TAIL_AT, self._tail)
        if start != self._head:
            self._map[_START + place] = 0
        if self._tail == self._head:
            # All of them make way: the ring is empty, and begins where this one does.
            self._set_position(_HEAD_AT, start)
            self._set_position(_TAIL_AT, start)
            self._tail = start
        at = _START + start % self._size
        self._map[at : at + len(record)] = record
        self._head = end
        self._set_position(_HEAD_AT, end)
        return True

    def records(self) -> Iterator[bytes]:
        """Yield the records, the oldest first."""
        position = self._tail
        while position < self._head:
            length = self._length_at(position)
            if length:
                at = _START + position % self._size
                yield self._map[at : at + length]
            position = self._after(position)

    def close(self) -> None:
        """Give the mapping back; the file stays."""
        self._map.close()

    def _after(self, position: int) -> int:
        return position + (self._length_at(position) or self._size - position % self._size)

    def _length_at(self, position: int) -> int:
        """Return the length of the record there; 0 if the ring begins anew."""
        place = position % self._size
        if self._size - place < RECORD_HEAD.size or self._map[_START + place] == 0:
            return 0
        _, length = RECORD_HEAD.unpack_from(self._map, _START + place)
        return min(RECORD_HEAD.size + int(length), self._size - place)

    def _position(self, at: int) -> int:
        return int(_POSITION.unpack_from(self._map, at)[0])

    def _set_position(self, at: int, position: int) -> None:
        # In one store, as eight bytes that are aligned.
        _POSITION.pack_into(self._map, at, position)


class Blackbox:
    """Keeps the latest chunks of a run, and writes them to a session when asked.

    Thread: one at a time.
    """

    def __init__(self, directory: Path, size_mb: int) -> None:
        """Begin with an empty ring in a new file.

        Raises:
            OSError: The file cannot be made; there is no room for it, say.
        """
        self.lost = 0
        self._directory = directory
        self.path, self._descriptor = sessions.create(directory, "blackbox", SUFFIX)
        try:
            self._ring = Ring.create(self._descriptor, size_mb * MB)
        except BaseException:
            os.close(self._descriptor)
            self.path.unlink(missing_ok=True)
            raise
        self.refresh_size = size_mb * MB // 4
        """After so many bytes the configuration is due again, or it would be overwritten."""

    def write(self, chunk: Chunk, index: Index) -> int:
        """Keep a chunk; return its size [bytes]."""
        record = mcap_file.packed(chunk)
        if not self._ring.append(record):
            self.lost += sum(len(entries) // 2 for entries in index.values())
        return len(record)

    def sync(self) -> None:
        """Do nothing: the kernel writes the mapping out as it likes."""

    def dump(self) -> Path:
        """Write what is kept to a session of its own; return its file.

        Raises:
            OSError: It cannot be written.
        """
        return _dump(self._ring, self._directory)

    def finish(self) -> None:
        """Do away with the file: the run has come to its end."""
        self.path.unlink(missing_ok=True)

    def close(self) -> None:
        """Close the file, which gives its lock back."""
        self._ring.close()
        os.close(self._descriptor)


def recover_rings(directory: Path) -> list[Path]:
    """Write sessions of what dead processes have left in their rings; return the files."""
    recovered = []
    for path in sorted(directory.glob(f"*{SUFFIX}")):
        try:
            dumped = _recover_ring(path)
        except FileNotFoundError:  # somebody else was faster
            continue
        except OSError as exc:
            _log.error("%s cannot be recovered: %s; it is left alone", path, exc)
            continue
        if dumped is not None:
            recovered.append(dumped)
    return recovered


def _recover_ring(path: Path) -> Path | None:
    descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC)
    try:
        if not sessions.lock(descriptor):
            return None  # of a process that lives
        try:
            ring = Ring(descriptor)
        except RecordingError as exc:
            _log.error("%s %s; it is left alone", path, exc)
            return None
        try:
            dumped = _dump(ring, path.parent) if any(ring.records()) else None
        finally:
            ring.close()
        path.unlink()
        return dumped
    finally:
        os.close(descriptor)


def _dump(ring: Ring, directory: Path) -> Path:
    path, descriptor = sessions.create(directory, "blackbox")
    try:
        file = mcap_file.AppendedFile(descriptor)
        mcap_file.begin(file)
        summary = mcap_file.Summary(mcap_file.Definitions(), directory)
        with contextlib.closing(summary):
            for record in ring.records():
                # What is damaged after a power cut costs itself only.
                with contextlib.suppress(ValueError):
                    if record[0] != Opcode.CHUNK:
                        continue
                    content = record[RECORD_HEAD.size :]
                    chunk, definitions, index = recovery.survey_chunk(content)
                    for definition in definitions:
                        summary.definitions.define(definition)
                    mcap_file.append_chunk(file, summary, chunk, index)
            file.append_all(summary.end(file.size))
        file.sync()
    except BaseException:
        path.unlink(missing_ok=True)
        raise
    finally:
        os.close(descriptor)
    return path
