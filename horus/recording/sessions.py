"""Where recordings are, what they are called, and how they stand."""

from __future__ import annotations

import contextlib
import datetime as dt
import os
import re
import threading
from pathlib import Path

import platformdirs
from mcap.writer import MCAP0_MAGIC

from horus.clock import wall_ns
from horus.errors import RecordingError, describe
from horus.recording import mcap_file
from horus.units import NS_PER_S

try:
    import fcntl
except ImportError:  # Windows: nobody can tell a session that is recorded from an unfinished one
    fcntl = None  # type: ignore[assignment]

SUFFIX = ".mcap"
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,199}")


class RecordedSession(str):
    """The name of a session, such as `session_2026_03_20_143000`, and what is known of it."""

    path: Path
    """The file."""
    state: str
    """`"finished"`, `"recording"` by a process that lives, or `"unfinished"`, as that has died."""

    def __new__(cls, path: Path) -> RecordedSession:
        """Look at a file."""
        session = super().__new__(cls, path.name.removesuffix(SUFFIX))
        session.path = path
        session.state = state_of(path)
        return session

    @property
    def finished(self) -> bool:
        """Whether the file is complete."""
        return self.state == "finished"


def default_directory() -> Path:
    """Return where recordings go: under `HORUS_HOME`, else the user's data directory."""
    home = os.environ.get("HORUS_HOME")
    return (Path(home) if home else platformdirs.user_data_path("horus", False)) / "recordings"


def create(directory: Path, kind: str = "session", suffix: str = SUFFIX) -> tuple[Path, int]:
    """Return the path of a new session's file, and its descriptor, which holds a lock.

    Raises:
        OSError: It cannot be made.
    """
    directory.mkdir(parents=True, exist_ok=True)
    moment = dt.datetime.fromtimestamp(wall_ns() / NS_PER_S)
    stem = f"{kind}_{moment:%Y_%m_%d_%H%M%S}"
    for number in range(1, 1000):
        name = stem if number == 1 else f"{stem}_{number}"
        path = directory / f"{name}{suffix}"
        with contextlib.suppress(FileExistsError):
            descriptor = mcap_file.create(path)
            if lock(descriptor, wait=True):
                return path, descriptor
            os.close(descriptor)
            path.unlink()
    raise FileExistsError(f"there are 1000 sessions called {stem} in {directory}")


def lock(descriptor: int, *, wait: bool = False) -> bool:
    """Lock an open file for as long as it is open; return whether nobody else has.

    Args:
        descriptor: The file.
        wait: Whether to wait, at most 50 ms, for those who only look at how a session stands:
            each of them holds a lock for an instant.
    """
    for _ in range(50 if wait else 1):
        if _flock(descriptor):
            return True
        if wait:
            threading.Event().wait(0.001)
    return False


def _flock(descriptor: int, *, shared: bool = False) -> bool:
    if fcntl is not None:
        try:
            fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
        except OSError:
            return False
    return True


def state_of(path: Path) -> str:
    """Return how a session's file stands; see `RecordedSession`."""
    try:
        with path.open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(0, size - len(MCAP0_MAGIC)))
            if size > 2 * len(MCAP0_MAGIC) and file.read() == MCAP0_MAGIC:
                return "finished"
            return "unfinished" if _flock(file.fileno(), shared=True) else "recording"
    except OSError:
        return "unfinished"


def sessions(directory: Path) -> list[RecordedSession]:
    """Return all sessions of a directory, the oldest first."""
    try:
        paths = sorted(directory.glob(f"*{SUFFIX}"), key=_age)
    except OSError:
        return []
    return [RecordedSession(path) for path in paths if path.is_file()]


def _age(path: Path) -> tuple[list[int], str]:
    """Return what sorts sessions by the moment in their names: `…_10` is younger than `…_2`."""
    return [int(digits) for digits in re.findall(r"\d+", path.stem)], path.stem


def find(name: object, directory: Path) -> RecordedSession:
    """Return the session of that name.

    Raises:
        RecordingError: It is no name, or there is no such session.
    """
    if not isinstance(name, str) or not _NAME.fullmatch(name.removesuffix(SUFFIX)):
        raise RecordingError(
            f"{describe(name)} is no name of a session: letters, digits, '_', '-' and '.' only; "
            "list_recordings() returns the names there are"
        )
    path = directory / f"{name.removesuffix(SUFFIX)}{SUFFIX}"
    if not path.is_file():
        known = ", ".join(sessions(directory)) or "none"
        raise RecordingError(f"there is no session {name!r} in {directory}; there are: {known}")
    return RecordedSession(path)


def delete(name: object, directory: Path) -> None:
    """Delete a session.

    Raises:
        RecordingError: There is none of that name, it is being recorded, or it cannot be deleted.
    """
    session = find(name, directory)
    if session.state == "recording":
        raise RecordingError(f"session {session!r} is being recorded; stop that first")
    try:
        session.path.unlink()
    except OSError as exc:
        raise RecordingError(f"session {session!r} cannot be deleted: {exc}") from exc
