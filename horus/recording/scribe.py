"""What happened, as records of an MCAP file: which channel, which encoding, which schema.

| channel | encoding | what |
| --- | --- | --- |
| the topic's name, one channel for each publisher | `horus.msgpack` | every message, exactly |
| `foxglove/TOPIC`, likewise, if its `Pub` declares it | JSON, `foxglove.*` | the same for viewers |
| `horus/ticks/NODE` | JSON | every tick |
| `horus/log` | JSON, `foxglove.Log` | every log record |
| `horus/events` | JSON | what changes: health, states, runs, losses |
| `horus/nodes` | JSON | the configuration of each node |
| `horus/scheduler` | JSON | the configuration of the scheduler |

`docs/reference/recording-format.md` describes each field.
"""

from __future__ import annotations

import json
import logging
import struct
from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

import msgspec
from mcap.records import Channel, Schema

from horus.clock import NEVER
from horus.errors import describe
from horus.foxglove import DECLARATIONS, LOG_SCHEMA, Declaration, object_schema, timestamp
from horus.recording.encoding import UnrecordableError, encode, name_of
from horus.snapshot import Frozen
from horus.topics import Publisher

FORMAT = "1"
"""Version of the format; a reader refuses those that it does not know."""

EXACT = "horus.msgpack"
ENVELOPE = struct.Struct(">BBqBq")
"""The beginning of a message: a MessagePack array of cycle, release [ns] and what follows."""

_ARRAY_OF_3, _INT64 = 0x93, 0xD3
OUTSIDE = -1
"""The release of a message that no tick has sent."""

_MOST_CHANNELS = 2**16 - 1

_json = msgspec.json.Encoder().encode


def _text(content: Mapping[str, Any]) -> bytes:
    """Return JSON; characters that Unicode has no place for become question marks."""
    try:
        return _json(content)
    except UnicodeEncodeError:  # from a file name that is no UTF-8, say
        return json.dumps(content, ensure_ascii=False).encode("utf-8", "replace")


class Message(NamedTuple):
    """A message that was sent."""

    sent_ns: int
    release_ns: int
    cycle: int
    publisher: Publisher
    sequence: int
    frozen: Frozen
    size: int
    """How large it was thought to be when it was sent [bytes]; 0 if not worth mentioning."""


class Tick(NamedTuple):
    """A tick that has ended; durations in excess of a limit are 0 if it was met [ns]."""

    node: str
    cycle: int
    release_ns: int
    start_ns: int
    finish_ns: int
    over_budget_ns: int
    past_deadline_ns: int
    failed: bool


class Log(NamedTuple):
    """A log record."""

    at_ns: int
    record: logging.LogRecord
    text: str


class Fact(NamedTuple):
    """Something else, for one of the channels that have a schema of their own."""

    channel: str
    at_ns: int
    content: Mapping[str, Any]


Item = Message | Tick | Log | Fact


class Writer(Protocol):
    """Where records go."""

    def define(self, record: Schema | Channel) -> None:
        """Take a schema or a channel, once, before the first record that refers to it."""

    def add_message(
        self, channel: int, sequence: int, log_ns: int, publish_ns: int, data: bytes
    ) -> None:
        """Take a message; the times are wall times [ns]."""


SCHEMAS: Mapping[str, Mapping[str, Any]] = {
    "horus.Tick": object_schema(
        cycle="integer",
        release_ns="integer",
        start_latency_us="number",
        execution_time_us="number",
        over_budget_us="number",
        past_deadline_us="number",
        failed="boolean",
    ),
    "horus.Event": object_schema(kind="string", node="string", text="string"),
    "horus.Node": {"type": "object", "properties": {"name": {"type": "string"}}},
    "horus.Scheduler": {"type": "object", "properties": {"format": {"type": "string"}}},
    "foxglove.Log": LOG_SCHEMA,
    **{kind.schema_name: kind.schema for kind in DECLARATIONS},
}
_SCHEMA_OF_CHANNEL = {
    "horus/events": "horus.Event",
    "horus/nodes": "horus.Node",
    "horus/scheduler": "horus.Scheduler",
}
_FOXGLOVE_LEVELS = ((50, 5), (40, 4), (30, 3), (20, 2), (10, 1))


class Scribe:
    """Writes items to a file, defining channels as they come.

    Thread: one at a time.
    """

    def __init__(self, writer: Writer, wall_offset_ns: int) -> None:
        """Write to `writer`; add `wall_offset_ns` to an instant to get wall time [ns]."""
        self._writer = writer
        self._offset_ns = wall_offset_ns
        self._channels: dict[tuple[str, str], int] = {}
        self._schemas: dict[str, int] = {}
        self._of_publisher: dict[Publisher, int] = {}
        self._of_node: dict[str, int] = {}
        self.refused: dict[str, str] = {}
        """What is not written as it should be, and why, by topic."""

    def write(self, item: Item) -> int:
        """Write one item; return the size of a message [bytes].

        Raises:
            UnrecordableError: There are more channels than a file can have.
        """
        # By type, the most frequent first: there are thousands in a second.
        kind = type(item)
        if kind is Message:
            return self._write_message(*item)
        elif kind is Tick:
            self._write_tick(*item)
        elif kind is Log:
            self._write_log(*item)
        else:
            self._write_fact(*item)
        return 0

    def _write_message(
        self,
        sent_ns: int,
        release_ns: int,
        cycle: int,
        publisher: Publisher,
        sequence: int,
        frozen: Frozen,
        size: int,
    ) -> int:
        payload, thaw = frozen
        try:
            channel = self._of_publisher.get(publisher)
            if channel is None:
                channel = self._of_publisher[publisher] = self._open_topic(publisher)
            message = payload if thaw is None else thaw(payload)
            data = encode(message)
        except Exception as exc:  # also of the code of a message's own class
            reason = str(exc) if isinstance(exc, UnrecordableError) else f"{exc!r}"
            self.refused.setdefault(publisher.topic.name, f"are not recorded: {reason}")
            return 0
        offset_ns = self._offset_ns
        release_ns = OUTSIDE if release_ns == NEVER else release_ns + offset_ns
        envelope = ENVELOPE.pack(_ARRAY_OF_3, _INT64, cycle, _INT64, release_ns)
        sent_ns += offset_ns
        self._writer.add_message(channel, sequence, sent_ns, sent_ns, envelope + data)
        if publisher.foxglove is not None:
            self._write_for_viewers(publisher, publisher.foxglove, sequence, sent_ns, message)
        return len(data)

    def _write_for_viewers(
        self,
        publisher: Publisher,
        declaration: Declaration,
        sequence: int,
        wall_ns: int,
        message: Any,
    ) -> None:
        topic, schema = publisher.topic.name, declaration.schema_name
        try:
            data = _json(declaration.converted(message, wall_ns))
            channel = self._open(f"foxglove/{topic}", schema, publisher.owner)
        except Exception as exc:  # also of the application's own callables
            self.refused.setdefault(topic, f"are not shown as {schema}: {describe(exc, 500)}")
            return
        self._writer.add_message(channel, sequence, wall_ns, wall_ns, data)

    def _write_tick(
        self,
        node: str,
        cycle: int,
        release_ns: int,
        start_ns: int,
        finish_ns: int,
        over_budget_ns: int,
        past_deadline_ns: int,
        failed: bool,
    ) -> None:
        channel = self._of_node.get(node)
        if channel is None:
            channel = self._of_node[node] = self._open(f"horus/ticks/{node}", "horus.Tick")
        data = _json(
            {
                "cycle": cycle,
                "release_ns": release_ns + self._offset_ns,
                "start_latency_us": (start_ns - release_ns) / 1e3,
                "execution_time_us": (finish_ns - start_ns) / 1e3,
                "over_budget_us": over_budget_ns / 1e3,
                "past_deadline_us": past_deadline_ns / 1e3,
                "failed": failed,
            }
        )
        start_ns += self._offset_ns
        self._writer.add_message(channel, 0, start_ns, start_ns, data)

    def _write_log(self, at_ns: int, record: logging.LogRecord, text: str) -> None:
        at_ns += self._offset_ns
        data = _text(
            {
                "timestamp": timestamp(at_ns),
                "level": next((to for least, to in _FOXGLOVE_LEVELS if record.levelno >= least), 0),
                "message": text,
                "name": record.name,
                "file": record.pathname,
                "line": record.lineno,
            }
        )
        self._writer.add_message(self._open("horus/log", "foxglove.Log"), 0, at_ns, at_ns, data)

    def _write_fact(self, channel: str, at_ns: int, content: Mapping[str, Any]) -> None:
        at_ns += self._offset_ns
        number = self._open(channel, _SCHEMA_OF_CHANNEL[channel])
        self._writer.add_message(number, 0, at_ns, at_ns, _text(content))

    def _open_topic(self, publisher: Publisher) -> int:
        topic = publisher.topic
        metadata = {"publisher": publisher.owner}
        if topic.type is not None:
            metadata["type"] = name_of(topic.type)
        return self._define(topic.name, publisher.owner, EXACT, 0, metadata)

    def _open(self, name: str, schema: str, publisher: str = "") -> int:
        number = self._channels.get((name, publisher))
        if number is not None:
            return number
        if schema not in self._schemas:
            self._schemas[schema] = len(self._schemas) + 1
            data = _json(SCHEMAS[schema])
            self._writer.define(Schema(self._schemas[schema], data, "jsonschema", schema))
        metadata = {"publisher": publisher} if publisher else {}
        return self._define(name, publisher, "json", self._schemas[schema], metadata)

    def _define(
        self, name: str, publisher: str, encoding: str, schema: int, metadata: dict[str, str]
    ) -> int:
        key = (name, publisher)
        if key not in self._channels:
            if len(self._channels) == _MOST_CHANNELS:
                raise UnrecordableError(
                    f"an MCAP file has at most {_MOST_CHANNELS} channels, "
                    "and there is one for each topic and publisher"
                )
            self._channels[key] = len(self._channels) + 1
            self._writer.define(Channel(self._channels[key], name, encoding, metadata, schema))
        return self._channels[key]
