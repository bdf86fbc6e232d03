"""The ring of the flight recorder: whatever was appended last is in it, whole."""

from __future__ import annotations

import os

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from horus import RecordingError
from horus.recording import blackbox
from horus.recording.blackbox import Ring, recover_rings
from horus.recording.reader import RECORD_HEAD

SIZE = 1000
"""Of the rings below, without their first page [bytes]."""


def record(number, length):
    """Return a record with so many bytes of content that tell which one it is."""
    content = (number.to_bytes(4, "little") * (length // 4 + 1))[:length]
    return RECORD_HEAD.pack(6, length) + content


@pytest.fixture
def descriptor(tmp_path):
    """Open a new file."""
    opened = os.open(tmp_path / "it.ring", os.O_RDWR | os.O_CREAT)
    yield opened
    os.close(opened)


def make_ring(tmp_path_factory):
    """Return a ring and its descriptor."""
    path = tmp_path_factory.mktemp("ring") / "it.ring"
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT)
    return Ring.create(descriptor, blackbox._START + SIZE), descriptor


@given(st.lists(st.integers(0, SIZE - RECORD_HEAD.size), max_size=60))
@settings(max_examples=200, deadline=None)
def test_a_ring_keeps_the_latest_records(tmp_path_factory, lengths):
    """Records come back whole, in order, the latest of them; also to who opens the file anew."""
    ring, descriptor = make_ring(tmp_path_factory)
    appended = []
    try:
        for number, length in enumerate(lengths):
            appended.append(record(number, length))
            assert ring.append(appended[-1])
            kept = list(ring.records())
            assert kept == appended[-len(kept) :]
            assert sum(map(len, kept)) <= SIZE
            again = Ring(descriptor)
            assert list(again.records()) == kept
            again.close()
        # Not many fewer than there is room for: the gap before the start is below one record.
        if sum(map(len, appended)) > 2 * SIZE:
            largest = max(map(len, appended))
            assert sum(map(len, ring.records())) + 2 * largest >= SIZE
    finally:
        ring.close()
        os.close(descriptor)


def test_a_record_that_does_not_fit_is_refused(tmp_path_factory):
    """The others stay."""
    ring, descriptor = make_ring(tmp_path_factory)
    ring.append(record(1, 10))
    assert not ring.append(record(2, SIZE))
    assert list(ring.records()) == [record(1, 10)]
    ring.close()
    os.close(descriptor)


def test_a_ring_is_whole_at_any_moment(tmp_path_factory, monkeypatch):
    """Whenever the process dies within an append, those before it are there, or all but some."""
    ring, descriptor = make_ring(tmp_path_factory)
    snapshots = []
    set_position = Ring._set_position

    def spy(self, at, position):
        snapshots.append(os.pread(descriptor, blackbox._START + SIZE, 0))
        set_position(self, at, position)
        snapshots.append(os.pread(descriptor, blackbox._START + SIZE, 0))

    monkeypatch.setattr(Ring, "_set_position", spy)
    appended = []
    for number in range(40):
        appended.append(record(number, 37 * number % 400))
        snapshots.clear()
        ring.append(appended[-1])
        for snapshot in snapshots:
            with os.fdopen(os.memfd_create("snapshot"), "w+b") as copy:
                copy.write(snapshot)
                copy.flush()
                then = Ring(copy.fileno())
                kept = list(then.records())
                then.close()
            ends = appended[-len(kept) :], appended[-len(kept) - 1 : -1]
            assert not kept or kept in ends
    ring.close()
    os.close(descriptor)


@pytest.mark.parametrize(
    "content",
    [b"", b"HORUSBB1", b"x" * 10_000, b"HORUSBB1" + b"\xff" * 8 + b"\0" * 9000],
    ids=["empty", "magic only", "foreign", "positions that make no sense"],
)
def test_what_is_no_ring_is_left_alone(content, tmp_path, caplog):
    """It is reported, and not deleted."""
    path = tmp_path / "it.ring"
    path.write_bytes(content)
    assert recover_rings(tmp_path) == []
    assert path.read_bytes() == content
    assert str(path) in caplog.text


def test_a_ring_that_cannot_be_opened_does_not_keep_others_from_being_recovered(tmp_path, caplog):
    """Nor a new one from being made."""
    (tmp_path / "a.ring").mkdir()
    (tmp_path / "b.ring").write_bytes(b"")
    assert recover_rings(tmp_path) == []
    assert str(tmp_path / "a.ring") in caplog.text
    assert str(tmp_path / "b.ring") in caplog.text


def test_a_ring_needs_its_magic(descriptor):
    """Opening another file is refused."""
    os.write(descriptor, b"x" * 10_000)
    with pytest.raises(RecordingError, match="no flight recorder"):
        Ring(descriptor)
