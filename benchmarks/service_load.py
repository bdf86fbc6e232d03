"""Ask an HTTP server at 127.0.0.1 as often as it answers, on eight connections.

``python -P service_load.py PORT`` ends when the server hangs up. It does as little as it can, so
that the server is what takes the time: the request is always the same bytes, and of an answer only
the length counts, which the first one tells.
"""

from __future__ import annotations

import argparse
import asyncio
import importlib.util
from typing import TYPE_CHECKING, cast

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

HOST = "127.0.0.1"
CONNECTIONS = 8
REQUEST = b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"


def loop_factory() -> Callable[[], asyncio.AbstractEventLoop] | None:
    """Return what makes the fastest event loop that is installed; None for asyncio's own."""
    if importlib.util.find_spec("uvloop") is None:
        return None
    import uvloop

    make: Callable[[], asyncio.AbstractEventLoop] = uvloop.new_event_loop
    return make


def answer_length(start: bytes) -> int | None:
    """Return how long an answer is, head and body; None until all of its head is there [bytes].

    Raises:
        ValueError: The server did not answer with what was asked for.
    """
    head, end, _ = start.partition(b"\r\n\r\n")
    if not end:
        return None
    status, *fields = head.split(b"\r\n")
    if status != b"HTTP/1.1 200 OK":
        raise ValueError(f"the server answered {status!r}")
    headers = {name.lower(): value for name, _, value in (line.partition(b":") for line in fields)}
    return len(head) + len(end) + int(headers[b"content-length"])


class Connection(asyncio.Protocol):
    """Asks again as soon as the answer is complete."""

    def __init__(self) -> None:
        """Wait to be connected."""
        self.closed = asyncio.get_running_loop().create_future()
        self._transport: asyncio.Transport | None = None
        self._first = b""
        self._length: int | None = None
        self._missing = 0

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Ask for the first time."""
        # Not to be checked: uvloop's are none of asyncio's classes, but do the same.
        self._transport = cast("asyncio.Transport", transport)
        self._transport.write(REQUEST)

    def data_received(self, data: bytes) -> None:
        """Count what has come, and ask again if that is all."""
        if self._length is None:
            self._first += data
            self._length = answer_length(self._first)
            if self._length is None:
                return
            self._missing = self._length - len(self._first)
        else:
            self._missing -= len(data)
        assert self._transport is not None
        if self._missing == 0:
            self._missing = self._length
            self._transport.write(REQUEST)
        elif self._missing < 0:
            raise ValueError(f"an answer is {-self._missing} bytes longer than the first one was")

    def connection_lost(self, exc: Exception | None) -> None:
        """Take note that the server has hung up."""
        if not self.closed.done():
            self.closed.set_result(exc)


async def ask(port: int) -> None:
    """Keep the server at this port busy until it hangs up."""
    loop = asyncio.get_running_loop()
    opened = [await loop.create_connection(Connection, HOST, port) for _ in range(CONNECTIONS)]
    await asyncio.gather(*(connection.closed for _, connection in opened))


def main(argv: Sequence[str] | None = None) -> None:
    """Ask the server at the port given."""
    parser = argparse.ArgumentParser(description="Ask an HTTP server as often as it answers.")
    parser.add_argument("port", type=int)
    options = parser.parse_args(argv)
    with asyncio.Runner(loop_factory=loop_factory()) as runner:
        runner.run(ask(options.port))


if __name__ == "__main__":
    main()
