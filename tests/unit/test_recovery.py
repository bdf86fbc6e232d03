"""Recordings that were cut off or damaged, and files that are none."""

from __future__ import annotations

import contextlib
import random
import re
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer

from horus import Node, RecordingError, RecordingReader, Scheduler, open_recording, recover
from horus.recording import mcap_file, reader

OFFSETS = 400
"""At how many places the recording is cut off, and at how many a bit is flipped."""


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Record several chunks, with nodes that come in late: the definitions are in many places."""
    directory = tmp_path_factory.mktemp("recordings")
    sched = Scheduler(tick_rate=100, deterministic=True, recording=directory)
    noise = random.Random(0)

    def tick(node):
        node.send(
            f"topic.{node.name}", {"count": sched.current_tick(), "data": noise.randbytes(300)}
        )

    for number in range(4):
        name = f"node{number}"
        sched.add(Node(name, tick, rate=100, pubs=[f"topic.{name}"]))
        sched.tick_for(2.5)
    (path,) = sched.stop_recording()
    sched.stop()
    return path


@pytest.fixture(scope="module")
def sent(recording):
    """All messages of the recording."""
    return messages_of(recording)


def messages_of(path):
    """Return all messages of a recording."""
    with RecordingReader(path) as open_reader:
        return list(open_reader.messages())


def count_with_library(path, **options):
    """Return how many messages the mcap library finds, checking every sum."""
    with path.open("rb") as file:
        return sum(1 for _ in make_reader(file, validate_crcs=True).iter_messages(**options))


def chunks_of(path):
    """Return where the chunks end, and how many messages of topics are in the file by then."""
    ends, total = [], 0
    with path.open("rb") as file:
        for record in reader.records(file):
            if record.opcode == 6:
                _, data = reader.unpack(record.content)
                entries = reader.entries_of(data)
                total += sum(entry.channel.message_encoding != "json" for entry in entries)
                ends.append((record.end, total))
    return ends


def test_the_recording_has_many_chunks(recording):
    """Otherwise the tests below would test little."""
    assert len(chunks_of(recording)) > 4


def test_a_recording_cut_off_anywhere_keeps_every_whole_chunk(recording, sent, tmp_path):
    """At several hundred offsets: all messages of the chunks before the cut are salvaged."""
    data, chunks = recording.read_bytes(), chunks_of(recording)
    path = tmp_path / "cut.mcap"
    some = random.Random(1).sample(range(1, len(data)), OFFSETS)
    some += [end + by for end, _ in chunks for by in (-1, 0, 1)]
    first = min(end for end, _ in chunks)
    for number, offset in enumerate(some):
        path.write_bytes(data[:offset])
        kept = max((total for end, total in chunks if end <= offset), default=0)
        if offset < first:
            with pytest.raises(RecordingError, match=r"salvage|scheduler|not an MCAP"):
                list(open_recording(path).messages())
            continue
        salvaged = recover(path)
        assert messages_of(path) == sent[:kept], offset
        assert salvaged.bytes_dropped <= offset
        if number % 8 == 0:  # the library takes its time
            assert count_with_library(path) == salvaged.messages
            assert count_with_library(path, topics=["topic.node0"]) > 0  # by the index


def test_recovering_twice_changes_nothing(recording, tmp_path):
    """What is finished is left alone, to the byte."""
    path = tmp_path / "cut.mcap"
    path.write_bytes(recording.read_bytes()[:-1000])
    recover(path)
    once = path.read_bytes()
    assert recover(path).bytes_dropped == 0
    assert path.read_bytes() == once
    whole = tmp_path / "whole.mcap"
    whole.write_bytes(recording.read_bytes())
    recover(whole)
    assert whole.read_bytes() == recording.read_bytes()


def test_an_index_that_is_cut_off_is_written_again(recording, tmp_path):
    """A file that ends within the index of its last chunk gets the same index as before."""
    data = recording.read_bytes()
    *_, (end, _) = chunks_of(recording)
    path = tmp_path / "cut.mcap"
    for extra in (0, 5, 40):
        path.write_bytes(data[: end + extra])
        recover(path)
        assert path.read_bytes() == data


def test_a_damaged_chunk_costs_its_own_messages_only(recording, sent, tmp_path):
    """Bits flipped within a chunk: reading says where, recovering keeps all the others."""
    data = bytearray(recording.read_bytes())
    chunks = chunks_of(recording)
    (_, before), (end, after) = chunks[1:3]
    data[end - 100] ^= 0x10
    path = tmp_path / "flipped.mcap"
    path.write_bytes(data)
    with pytest.raises(RecordingError, match=r"damaged at byte \d+.*horus\.recover"):
        messages_of(path)
    salvaged = recover(path)
    assert salvaged.bytes_dropped > 0
    assert messages_of(path) == sent[:before] + sent[after:]
    assert count_with_library(path) == salvaged.messages


def test_a_flipped_bit_anywhere_is_read_or_refused(recording, tmp_path):
    """Neither reading nor recovering ever raises anything but RecordingError."""
    data = recording.read_bytes()
    path = tmp_path / "flipped.mcap"
    chance = random.Random(2)
    refused = []
    for _ in range(OFFSETS):
        flipped = bytearray(data)
        flipped[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
        path.write_bytes(flipped)
        try:
            for message in messages_of(path):
                message.message()
        except RecordingError as exc:
            refused.append(exc)
        with contextlib.suppress(RecordingError):
            recover(path)
    assert len(refused) > OFFSETS / 2
    assert all(str(path) in str(exc) or "message" in str(exc) for exc in refused)


@given(st.binary(max_size=300), st.sampled_from(["", "magic", "head"]))
@settings(max_examples=300, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_bytes_are_read_or_refused(tmp_path, data, start):
    """Whatever a file contains, it is a recording or a RecordingError."""
    path = tmp_path / "any.mcap"
    head = tmp_path / "head"
    with head.open("w+b") as file:
        mcap_file.begin(mcap_file.AppendedFile(file.fileno()))
    begin = {"": b"", "magic": head.read_bytes()[:8], "head": head.read_bytes()}[start]
    for end in (b"", begin[:8]):
        path.write_bytes(begin + data + end)
        for read in (messages_of, recover, lambda it: list(open_recording(it).messages())):
            with contextlib.suppress(RecordingError):
                read(path)


def _foreign(path):
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        writer.finish()


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda path: path.write_bytes(b""), "is empty"),
        (lambda path: path.write_bytes(b"hello, world, this is no recording"), "not an MCAP"),
        (lambda path: path.write_bytes(b"PK\3\4" * 100), "not an MCAP"),
        (_foreign, "another program.*'ros2'"),
        (lambda path: None, "(no file|cannot be)"),
        (lambda path: path.mkdir(), "cannot be"),
    ],
    ids=["zero bytes", "text", "zip", "foreign", "missing", "directory"],
)
def test_what_is_no_recording_says_so(make, says, tmp_path):
    """Opening and recovering name the file and what is wrong with it."""
    path = tmp_path / "it.mcap"
    make(path)
    for use in (open_recording, recover):
        with pytest.raises(RecordingError, match=f"(?s){says}"):
            use(path)


def test_a_future_format_is_refused(recording, tmp_path, monkeypatch):
    """A recording of a format that this version does not know is not guessed at."""
    monkeypatch.setattr(reader, "FORMAT", "0")
    with pytest.raises(RecordingError, match=r"format '1', and this version of horus reads .*'0'"):
        RecordingReader(recording)


def test_a_session_that_is_being_recorded_is_not_recovered(tmp_path):
    """It is not broken; recovering it would break it."""
    sched = Scheduler(recording=tmp_path, deterministic=True)
    sched.add(Node("node", lambda node: None))
    sched.tick_once()
    (session,) = sched.list_recordings()
    with pytest.raises(RecordingError, match="being recorded"):
        recover(session.path)
    sched.stop_recording()
    sched.stop()


def test_nothing_is_ever_unpickled(tmp_path):
    """A message of unknown origin cannot make code run: no import, no pickle, no constructor."""
    source = "".join(path.read_text() for path in Path(reader.__file__).parent.glob("*.py"))
    assert not re.search(r"\bimport (cloud)?pickle|importlib\.import|__import__|\beval\(", source)
