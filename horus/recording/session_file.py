"""The file of a session; that it cannot be written is told once, and the robot runs on."""

from __future__ import annotations

import contextlib
import logging
import os
from pathlib import Path

from mcap.records import Chunk

from horus.recording import mcap_file, sessions
from horus.recording.mcap_file import Definitions, Index, Summary

_log = logging.getLogger("horus.recording")


class SessionFile:
    """Takes chunks, from the beginning of a file to its end.

    Thread: one at a time.
    """

    def __init__(self, directory: Path, definitions: Definitions) -> None:
        """Begin a session.

        Args:
            directory: Where its file goes.
            definitions: The schemas and channels that the chunks refer to.

        Raises:
            OSError: The file cannot be made or written.
        """
        self.lost = 0
        """How many items were in chunks that could not be written."""
        self.path, self._descriptor = sessions.create(directory)
        self._summary = Summary(definitions, directory)
        self._failing = False
        self._file = mcap_file.AppendedFile(self._descriptor)
        try:
            mcap_file.begin(self._file)
        except BaseException:
            self.close()
            raise

    def write(self, chunk: Chunk, index: Index) -> int:
        """Write a chunk; return its size [bytes]. If that fails, the next may fare better."""
        try:
            mcap_file.append_chunk(self._file, self._summary, chunk, index)
        except OSError as exc:
            self.lost += sum(len(entries) // 2 for entries in index.values())
            if not self._failing:
                self._failing = True
                _log.error("%s cannot be written, and the robot runs on: %s", self.path, exc)
        else:
            if self._failing:
                self._failing = False
                _log.warning("%s can be written again; %d items were lost", self.path, self.lost)
        return len(chunk.data)

    def sync(self) -> None:
        """Have what was written survive a power cut."""
        with contextlib.suppress(OSError):  # told when writing fails
            self._file.sync()

    def finish(self) -> None:
        """Write the end."""
        try:
            self._file.append_all(self._summary.end(self._file.size))
            self._file.sync()
        except OSError as exc:
            if not self._failing:
                _log.error("%s is unfinished: %s", self.path, exc)

    def close(self) -> None:
        """Close it, which gives its lock back."""
        self._summary.close()
        os.close(self._descriptor)
