"""Sessions: their names, their order, and who may take which."""

from __future__ import annotations

import contextlib
import fcntl
import os

import pytest

from horus import RecordingError
from horus.recording import mcap_file, recovery, sessions


@pytest.fixture
def moment(monkeypatch):
    """Stop the clock that names are made from."""
    monkeypatch.setattr(sessions, "wall_ns", lambda: 1_774_000_000 * 10**9)


@contextlib.contextmanager
def session(directory):
    """Make a session, and close it at the end."""
    path, descriptor = sessions.create(directory)
    try:
        yield path
    finally:
        os.close(descriptor)


def test_sessions_of_one_second_are_numbered_and_listed_in_order(moment, tmp_path):
    """The tenth is listed after the second."""
    names = []
    for _ in range(11):
        with session(tmp_path) as path:
            names.append(path.stem)
    assert names == [names[0], *(f"{names[0]}_{number}" for number in range(2, 12))]
    assert sessions.sessions(tmp_path) == names


def test_sessions_of_all_kinds_are_listed_by_their_moments(tmp_path):
    """What the flight recorder wrote stands where it belongs; names without a moment come first."""
    names = [
        "mine",
        "session_2026_03_20_143000",
        "blackbox_2026_03_20_143001",
        "session_2026_03_20_143002",
    ]
    for name in names:
        (tmp_path / f"{name}.mcap").touch()
    assert sessions.sessions(tmp_path) == names


def test_those_who_look_at_a_session_do_not_disturb_each_other(tmp_path):
    """A session of a dead process is unfinished for two who look at the same time."""
    with session(tmp_path) as path:
        assert sessions.state_of(path) == "recording"
    with path.open() as other:
        fcntl.flock(other, fcntl.LOCK_SH | fcntl.LOCK_NB)
        assert sessions.state_of(path) == "unfinished"


@pytest.fixture
def looker(monkeypatch):
    """Have somebody look at the first session while it is made; return their descriptors."""
    create = mcap_file.create
    looking = []

    def watched(path):
        descriptor = create(path)
        if not looking:
            looking.append(os.open(path, os.O_RDONLY))
            fcntl.flock(looking[0], fcntl.LOCK_SH)
        return descriptor

    monkeypatch.setattr(mcap_file, "create", watched)
    yield looking
    for descriptor in looking:
        os.close(descriptor)


def test_a_session_looked_at_while_it_is_made_gets_its_lock(monkeypatch, moment, looker, tmp_path):
    """Whoever lists sessions at the wrong instant delays the new one a little."""
    flock = sessions._flock

    def leave_after(descriptor, **options):
        locked = flock(descriptor, **options)
        if looker:
            os.close(looker.pop())
        return locked

    monkeypatch.setattr(sessions, "_flock", leave_after)
    with session(tmp_path) as path:
        assert not path.stem.endswith("_2")
        assert sessions.state_of(path) == "recording"


def test_a_session_that_somebody_looks_at_for_ever_gets_another_name(moment, looker, tmp_path):
    """A process frozen while it looks costs a new session 50 ms and its name, not its lock."""
    with session(tmp_path) as path:
        assert path.stem.endswith("_2")
        assert sessions.sessions(tmp_path) == [path.stem]
        with pytest.raises(RecordingError, match="is being recorded"):
            recovery.recover(path)
