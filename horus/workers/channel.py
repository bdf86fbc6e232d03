"""Messages between a scheduler and a worker: small ones by socket, large ones by shared memory.

A message is pickled with protocol 5, its large buffers apart (PEP 574): NumPy arrays
are not copied into the pickle. Below `LARGE` bytes everything goes through the socket.
Above, pickle and buffers are written to a segment, an anonymous file in memory
(memfd_create(2)), whose descriptor goes with the message. The receiver maps it and unpickles
arrays where they lie, read-only. When the last of them is gone, so is the mapping, and the
next message to the sender says that the segment may be used again. Nothing has a name: what a
killed process leaves behind, the kernel frees.
"""

from __future__ import annotations

import array
import contextlib
import errno
import functools
import os
import pickle
import socket
import struct
import sys
import threading
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

from horus.errors import describe
from horus.workers.mapping import map_file

LARGE = 64 * 1024
"""From how many bytes on a message goes through shared memory."""

_ALIGNMENT = 64
_KEPT_FREE = 4
"""Segments that are kept for further messages although nobody uses them."""

_LAST_STEPS_S = 1.0
"""How long a sender or a receiver may take to notice that it has been hung up on [s]."""

_MOST_LENT = 16
"""Segments that are expected back; further ones are the receiver's for good."""

_ANCILLARY = socket.CMSG_SPACE(4)
_CLOSE_ON_EXEC = getattr(socket, "MSG_CMSG_CLOEXEC", 0)
_LOST = -1
"""In place of a descriptor that did not arrive: this process has too many."""

_INLINE, _GIVEN_AWAY = 0, 1
_HEADER = struct.Struct("=IIQQ")
"""Parts, segments given back, the segment's number, bytes."""
_MOST_PARTS = 512
"""More parts than this are joined: the kernel takes 1024 at a time (IOV_MAX)."""

Loads = Callable[[memoryview, list[memoryview]], Any]
Dumps = Callable[[Any, Callable[[pickle.PickleBuffer], None] | None], bytes]


class Channel:
    """One end of a conversation between two processes.

    Thread: any for `send` and `close`; one at a time for `receive`.
    """

    def __init__(self, sock: socket.socket, dumps: Dumps, loads: Loads) -> None:
        """Talk through one of a pair of connected Unix stream sockets."""
        self._socket = sock
        self._dumps = dumps
        self._loads = loads
        self._segments = _Segments()
        self._returned: deque[int] = deque()
        self._buffer = bytearray(LARGE)
        self._ahead = memoryview(self._buffer)[:0]
        self._descriptors: deque[int] = deque()
        self._sending = threading.Lock()
        self._receiving = threading.Lock()
        self._closed = False

    def fileno(self) -> int:
        """Return the socket's descriptor."""
        return self._socket.fileno()

    def send(self, message: Any) -> None:
        """Send a message.

        Raises:
            Exception: It cannot be pickled; nothing was sent.
            OSError: The other end is gone.
        """
        with self._sending:
            if self._closed:
                raise BrokenPipeError("the channel is closed")
            self._send(message)

    def _send(self, message: Any) -> None:
        buffers: list[pickle.PickleBuffer] = []
        try:
            body = self._dumps(message, buffers.append)
        except (EOFError, OSError) as exc:
            raise pickle.PicklingError(describe(exc)) from exc
        parts = [memoryview(body), *(buffer.raw() for buffer in buffers)]
        if len(parts) > _MOST_PARTS:
            parts = [memoryview(self._dumps(message, None))]
        lengths = [part.nbytes for part in parts]
        padded = _with_padding(parts)
        size = sum(part.nbytes for part in padded)
        segment = self._segments.fill(padded, size) if size >= LARGE else None
        returned = [self._returned.popleft() for _ in range(len(self._returned))]
        number = _INLINE if segment is None else segment.number
        head = _HEADER.pack(len(parts), len(returned), number, size)
        head += array.array("Q", [*lengths, *returned]).tobytes()
        if segment is None:
            self._socket.sendall(b"".join((head, *padded)))
            return
        try:
            sent = socket.send_fds(self._socket, [head], [segment.descriptor])
        finally:
            if number == _GIVEN_AWAY:
                os.close(segment.descriptor)
        self._socket.sendall(head[sent:])

    def receive(self) -> Any:
        """Wait for a message and return it.

        Raises:
            EOFError: The other end is gone.
            Exception: What the message's own classes raise.
        """
        with self._receiving:
            parts = self._receive_parts()
        try:
            return self._loads(parts[0], parts[1:])
        except (EOFError, OSError) as exc:
            raise pickle.UnpicklingError(describe(exc)) from exc

    def hang_up(self) -> None:
        """Let whoever waits at either end hear, after what was said, that the other is gone."""
        try:
            self._socket.shutdown(socket.SHUT_RDWR)
        except OSError:
            pass  # the other end was faster

    def close(self) -> None:
        """Hang up, and give back what it holds.

        Descriptors are given back once nobody uses them: their numbers may be another file's at
        once. Somebody who does not notice, stuck in an object that is pickled, keeps them.
        """
        self.hang_up()
        with contextlib.ExitStack() as stack:
            for lock in (self._sending, self._receiving):
                if not lock.acquire(timeout=_LAST_STEPS_S):
                    return
                stack.callback(lock.release)
            self._closed = True
            self._socket.close()
            self._segments.close()
            while self._descriptors:
                self._close_descriptor()

    def _receive_parts(self) -> list[memoryview]:
        if self._closed:
            raise EOFError("the channel is closed")
        count, returned, segment, size = _HEADER.unpack(self._read(_HEADER.size))
        table = array.array("Q", self._read(8 * (count + returned)))
        if returned:
            self._segments.give_back(table[count:])
        payload = self._map(segment, size) if segment else memoryview(self._read(size))
        parts, offset = [], 0
        for length in table[:count]:
            parts.append(payload[offset : offset + length].toreadonly())
            offset += length + _padding(length)
        return parts

    def _map(self, segment: int, size: int) -> memoryview:
        give_back = None
        if segment != _GIVEN_AWAY:
            give_back = functools.partial(self._returned.append, segment)
        try:
            if self._descriptors[0] == _LOST:
                raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))
            return map_file(self._descriptors[0], size, give_back)
        except OSError as exc:
            if give_back is not None:
                give_back()
            raise pickle.UnpicklingError(describe(exc)) from exc
        finally:
            self._close_descriptor()

    def _close_descriptor(self) -> None:
        descriptor = self._descriptors.popleft()
        if descriptor != _LOST:
            os.close(descriptor)

    def _read(self, size: int) -> bytearray:
        """Return the next bytes from the socket, this many."""
        data = bytearray()
        while True:
            taken = self._ahead[: size - len(data)]
            data += taken
            self._ahead = self._ahead[len(taken) :]
            if len(data) == size:
                return data
            self._read_ahead()

    def _read_ahead(self) -> None:
        """Take what has arrived, in one system call; wait if there is nothing."""
        try:
            count, ancillary, flags, _ = self._socket.recvmsg_into(
                [self._buffer], _ANCILLARY, _CLOSE_ON_EXEC
            )
        except ConnectionResetError:
            count = 0
        if not count:
            raise EOFError("the other end is gone")
        self._ahead = memoryview(self._buffer)[:count]
        # The kernel ends what it returns with the message that a descriptor came with: one at most.
        for _, _, data in ancillary:
            self._descriptors.append(int.from_bytes(data, sys.byteorder))
        if flags & socket.MSG_CTRUNC:
            self._descriptors.append(_LOST)


class _Segment(NamedTuple):
    """An anonymous file in memory."""

    number: int
    descriptor: int
    size: int


class _Segments:
    """The segments that a sender has made: lent to a message, or free for another.

    Thread: any, one at a time for `fill`.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._lent: dict[int, _Segment] = {}
        self._free: list[_Segment] = []
        self._last = _GIVEN_AWAY

    def fill(self, parts: list[memoryview], size: int) -> _Segment | None:
        """Write parts to a segment and return it; None where there are none."""
        try:
            segment = self._take(size) or self._make(size)
        except (AttributeError, OSError):  # not on this platform; or no descriptors
            return None
        try:
            offset = 0
            while offset < size:
                # A system call, which lets go of the interpreter while it copies.
                offset += os.pwritev(segment.descriptor, _after(parts, offset), offset)
        except OSError:  # no memory
            os.close(segment.descriptor)
            return None
        if segment.number != _GIVEN_AWAY:
            with self._lock:
                self._lent[segment.number] = segment
        return segment

    def give_back(self, numbers: array.array[int]) -> None:
        """Take note that nobody looks at these any more."""
        with self._lock:
            for number in numbers:
                self._free.append(self._lent.pop(number))
            while len(self._free) > _KEPT_FREE:
                os.close(self._free.pop(0).descriptor)

    def close(self) -> None:
        """Give all of them back to the kernel; what is mapped stays until it is not."""
        with self._lock:
            for segment in (*self._lent.values(), *self._free):
                os.close(segment.descriptor)
            self._lent.clear()
            self._free.clear()

    def _take(self, size: int) -> _Segment | None:
        with self._lock:
            fitting = [segment for segment in self._free if segment.size >= size]
            if not fitting:
                return None
            segment = min(fitting, key=lambda segment: segment.size)
            self._free.remove(segment)
            return segment

    def _make(self, size: int) -> _Segment:
        descriptor = os.memfd_create("horus", os.MFD_CLOEXEC)
        try:
            os.ftruncate(descriptor, size)
        except OSError:
            os.close(descriptor)
            raise
        if len(self._lent) >= _MOST_LENT:
            return _Segment(_GIVEN_AWAY, descriptor, size)
        self._last += 1
        return _Segment(self._last, descriptor, size)


def _padding(length: int) -> int:
    return -length % _ALIGNMENT


@functools.cache
def _zeros(size: int) -> memoryview:
    return memoryview(bytes(size))


def _with_padding(parts: list[memoryview]) -> list[memoryview]:
    """Return parts with what lies between them, so that arrays are aligned."""
    padded = []
    for part in parts:
        padded.append(part)
        if part.nbytes % _ALIGNMENT:
            padded.append(_zeros(_padding(part.nbytes)))
    return padded


def _after(parts: list[memoryview], offset: int) -> list[memoryview]:
    """Return what is left of parts after the first `offset` bytes."""
    left = []
    for part in parts:
        if offset < part.nbytes:
            left.append(part.cast("B")[offset:] if offset else part)
        offset = max(0, offset - part.nbytes)
    return left
