"""Reads recordings: every message, tick, log record and event of a session.

Whatever bytes a file has, they are read or refused with a `RecordingError` that says what is
wrong and where.
"""

from __future__ import annotations

import io
import os
import struct
import zlib
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, TypeVar

import msgspec
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Header, Schema
from mcap.writer import MCAP0_MAGIC

from horus.errors import ConfigError, RecordingError
from horus.recording import encoding, sessions
from horus.recording.mcap_file import COMPRESSION, MESSAGE_HEAD, PROFILE
from horus.recording.scribe import ENVELOPE, EXACT, FORMAT, OUTSIDE

RECORD_HEAD = struct.Struct("<BQ")
_LARGEST_CHUNK = 1 << 31


class RecordedMessage(NamedTuple):
    """A message of a recording."""

    topic: str
    publisher: str
    """The node that sent it, or `"application"`."""
    sequence: int
    """Counts the messages of this publisher on this topic, from 1."""
    cycle: int
    """The scheduler's cycle in which it was sent."""
    sent_ns: int
    """When it was sent, in wall time [ns]; in deterministic mode simulated time."""
    release_ns: int | None
    """The release of the tick that sent it [ns]; None if no tick did."""
    data: bytes
    """The message, encoded."""

    def message(self, classes: encoding.Classes | None = None) -> Any:
        """Return the message itself.

        Args:
            classes: Further classes that it may be made of; see `encoding.decode`.

        Raises:
            RecordingError: It is damaged, or of a class that is not there.
        """
        try:
            return encoding.decode(self.data, classes)
        except ValueError as exc:
            raise RecordingError(
                f"message {self.sequence} of {self.publisher!r} on topic {self.topic!r} in cycle "
                f"{self.cycle} cannot be read: {exc}"
            ) from exc


class Record(NamedTuple):
    """A record of an MCAP file."""

    offset: int
    opcode: int
    content: bytes

    @property
    def end(self) -> int:
        """The offset after it."""
        return self.offset + RECORD_HEAD.size + len(self.content)


class Entry(NamedTuple):
    """A message as MCAP knows it."""

    channel: Channel
    sequence: int
    log_ns: int
    data: memoryview


class RecordingReader:
    """A finished recording, open for reading.

    Thread: one at a time.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        """Open a file.

        Raises:
            RecordingError: It cannot be opened, or is no finished recording.
        """
        self.path = Path(path)
        state = sessions.state_of(self.path)
        if state == "recording":
            raise RecordingError(f"{self.path} is being recorded; stop that first")
        if state != "finished":
            if not self.path.exists():
                raise RecordingError(f"there is no file {self.path}")
            raise RecordingError(
                f"{self.path} is unfinished or truncated: horus.recover(path) salvages it"
            )
        self._file = open_file(self.path)
        try:
            self.about = self._find_about()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> RecordingReader:
        """Return the reader; leaving the block closes it."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Close the file."""
        self.close()

    def close(self) -> None:
        """Close the file; what was read from it stays."""
        self._file.close()

    def messages(self, topics: Collection[str] | None = None) -> Iterator[RecordedMessage]:
        """Yield the messages of some topics, or of all, in the order in which they were sent.

        Raises:
            ConfigError: `topics` is no collection of names.
            RecordingError: The file is damaged.
        """
        return self._messages(set_of_names("topics", topics))

    def _messages(self, topics: Collection[str] | None) -> Iterator[RecordedMessage]:
        for entry in self.entries():
            channel = entry.channel
            wanted = topics is None or channel.topic in topics
            if wanted and channel.message_encoding == EXACT:
                yield self.message_of(entry)

    def message_of(self, entry: Entry) -> RecordedMessage:
        """Return what an entry of a topic's channel says.

        Raises:
            RecordingError: The file is damaged.
        """
        channel, sequence, log_ns, data = entry
        try:
            _, _, cycle, _, release_ns = ENVELOPE.unpack_from(data)
        except struct.error:
            raise RecordingError(
                f"{self.path}: message {sequence} on topic {channel.topic!r} is cut short"
            ) from None
        return RecordedMessage(
            channel.topic,
            channel.metadata.get("publisher", ""),
            sequence,
            cycle,
            log_ns,
            None if release_ns == OUTSIDE else release_ns,
            bytes(data[ENVELOPE.size :]),
        )

    def facts(self, channel: str) -> Iterator[dict[str, Any]]:
        """Yield what is in a JSON channel, such as `horus/events`; `log_ns` is the time of each.

        Raises:
            RecordingError: The file is damaged.
        """
        for found, _, log_ns, data in self.entries():
            if found.topic == channel and found.message_encoding == "json":
                yield {"log_ns": log_ns, **self.json_of(data, channel)}

    def entries(self) -> Iterator[Entry]:
        """Yield every message of every channel.

        Raises:
            RecordingError: The file is damaged.
        """
        for record in records(self._file):
            if record.opcode != Opcode.CHUNK:
                continue
            try:
                _, data = unpack(record.content)
                yield from entries_of(data)
            except ValueError as exc:
                raise RecordingError(
                    f"{self.path} is damaged at byte {record.offset}: {exc}; "
                    "horus.recover(path) salvages the rest"
                ) from exc

    def _find_about(self) -> dict[str, Any]:
        for about in self.facts("horus/scheduler"):
            if about.get("format") != FORMAT:
                raise RecordingError(
                    f"{self.path} has format {about.get('format')!r}, and this version of horus "
                    f"reads format {FORMAT!r}"
                )
            return about
        raise RecordingError(f"{self.path} does not say which scheduler was recorded")

    def json_of(self, data: memoryview, channel: str) -> dict[str, Any]:
        """Return what an entry of a JSON channel says.

        Raises:
            RecordingError: The file is damaged.
        """
        try:
            return msgspec.json.decode(data, type=dict[str, Any])
        except ValueError as exc:
            raise RecordingError(f"{self.path}: what {channel} says is damaged: {exc}") from exc


def set_of_names(argument: str, names: Iterable[str] | None) -> frozenset[str] | None:
    """Return names as a set; None stays None, which is for all.

    Raises:
        ConfigError: It is a single name, or nothing that has names.
    """
    if names is None:
        return None
    if isinstance(names, str) or not isinstance(names, Iterable):
        raise ConfigError(argument, names, f"must be a list of names, e.g. [{names!r}]")
    return frozenset(names)


def open_file(path: Path) -> BinaryIO:
    """Return an open file that begins as a recording does.

    Raises:
        RecordingError: It cannot be opened, is empty, no MCAP, or an MCAP of another program.
    """
    try:
        file = path.open("rb")
    except (OSError, ValueError) as exc:
        raise RecordingError(f"{path} cannot be opened: {exc}") from exc
    try:
        _check_head(file, path)
    except BaseException:
        file.close()
        raise
    return file


def _check_head(file: BinaryIO, path: Path) -> None:
    try:
        magic = file.read(len(MCAP0_MAGIC))
        if not magic:
            raise RecordingError(f"{path} is empty: its process died before anything was written")
        if magic != MCAP0_MAGIC:
            raise RecordingError(f"{path} is not an MCAP file: it begins with {magic!r}")
        head = next(records(file), None)
        if head is None or head.opcode != Opcode.HEADER:
            raise RecordingError(f"{path} ends within its header: there is nothing to salvage")
        profile = Header.read(_stream(head.content)).profile
    except RecordingError:
        raise
    except Exception as exc:  # the library raises errors of many kinds
        raise RecordingError(f"{path} has a damaged header: {exc!r}") from exc
    if profile != PROFILE:
        raise RecordingError(
            f"{path} is an MCAP file of another program (profile {profile!r}), "
            "not a recording of horus"
        )


def records(file: BinaryIO) -> Iterator[Record]:
    """Yield the records of a file up to its footer, or as far as they are complete.

    Raises:
        OSError: It cannot be read.
    """
    size = os.fstat(file.fileno()).st_size
    offset = len(MCAP0_MAGIC)
    while offset + RECORD_HEAD.size <= size:
        # Each time: others may read elsewhere in between.
        file.seek(offset)
        opcode, length = RECORD_HEAD.unpack(file.read(RECORD_HEAD.size))
        if offset + RECORD_HEAD.size + length > size:
            return
        record = Record(offset, opcode, file.read(length))
        yield record
        if opcode == Opcode.FOOTER:
            return
        offset = record.end


def unpack(content: bytes) -> tuple[Chunk, bytes]:
    """Return a chunk, and what is in it.

    Raises:
        ValueError: It is damaged.
    """
    try:
        chunk = Chunk.read(_stream(content))
        if chunk.compression != COMPRESSION:
            raise ValueError(f"a chunk is compressed with {chunk.compression!r}")
        if chunk.uncompressed_size > _LARGEST_CHUNK:
            raise ValueError(f"a chunk of {chunk.uncompressed_size} bytes")
        # The size it says itself: a decompressor would believe what the data says.
        if zstandard.frame_content_size(chunk.data) != chunk.uncompressed_size:
            raise ValueError("a chunk says two sizes")
        data = zstandard.decompress(chunk.data) if chunk.uncompressed_size else b""
    except ValueError:
        raise
    except Exception as exc:  # the libraries raise errors of their own
        raise ValueError(f"a chunk cannot be read: {exc}") from exc
    if zlib.crc32(data) != chunk.uncompressed_crc:
        raise ValueError("a chunk has another checksum than it had")
    return chunk, data


def entries_of(data: bytes) -> Iterator[Entry]:
    """Yield the messages of a chunk.

    Raises:
        ValueError: It is damaged.
    """
    channels: dict[int, Channel] = {}
    view = memoryview(data)
    for opcode, start, end in walk(data):
        if opcode == Opcode.MESSAGE:
            _, _, number, sequence, log_ns, _ = head_of_message(data, start)
            channel = channels.get(number)
            if channel is None:
                raise ValueError(f"a message of channel {number}, which is not defined")
            yield Entry(channel, sequence, log_ns, view[start + MESSAGE_HEAD.size : end])
        elif opcode == Opcode.CHANNEL:
            channel = definition(Channel, view[start:end])
            channels[channel.id] = channel


def walk(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, beginning and end of the records in a chunk.

    Raises:
        ValueError: It is damaged.
    """
    offset, size, head_size, unpack_head = 0, len(data), RECORD_HEAD.size, RECORD_HEAD.unpack_from
    while offset < size:
        if offset + head_size > size:
            raise ValueError("a record is cut short")
        opcode, length = unpack_head(data, offset)
        end = offset + head_size + length
        if end > size:
            raise ValueError("a record is longer than its chunk")
        yield opcode, offset, end
        offset = end


def head_of_message(data: bytes, start: int) -> tuple[int, ...]:
    """Return what a message record begins with; see `MESSAGE_HEAD`.

    Raises:
        ValueError: It is damaged.
    """
    try:
        return MESSAGE_HEAD.unpack_from(data, start)
    except struct.error as exc:
        raise ValueError(f"a message is cut short: {exc}") from exc


Definition = TypeVar("Definition", Schema, Channel)


def definition(kind: type[Definition], record: memoryview) -> Definition:
    """Return a schema or a channel.

    Raises:
        ValueError: It is damaged.
    """
    try:
        found: Definition = kind.read(_stream(record[RECORD_HEAD.size :]))
    except Exception as exc:  # the library raises errors of many kinds
        raise ValueError(f"a {kind.__name__.lower()} cannot be read: {exc!r}") from exc
    return found


def _stream(content: bytes | memoryview) -> ReadDataStream:
    return ReadDataStream(io.BytesIO(content))
