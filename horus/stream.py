"""How an application listens to a topic: an async iterator over its messages."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from types import TracebackType
from typing import Any

from horus.errors import StateError
from horus.topics import Subscription


class MessageStream:
    """The messages of a topic, oldest first, for code that is not a node.

    Use it as `async for message in stream`, or ask with `recv()`, `recv_all()`
    and `latest()`. The iteration ends when the scheduler's run ends or `close()`
    is called, after the messages that still wait.

    Thread: any one thread, and any event loop; messages may come from all threads.
    """

    def __init__(
        self, subscription: Subscription, on_close: Callable[[MessageStream], None]
    ) -> None:
        """Listen on `subscription`, which becomes this stream's own."""
        self._on_close = on_close
        self._subscription = subscription
        self._lock = threading.Lock()
        self._waiter: asyncio.Future[None] | None = None
        self._ended = False
        subscription.wake = self._wake

    @property
    def topic(self) -> str:
        """The topic's name."""
        return self._subscription.topic.name

    @property
    def dropped(self) -> int:
        """How many messages were lost because nobody read them in time."""
        return self._subscription.dropped

    def recv(self) -> Any:
        """Return the oldest message that waits, or None."""
        return self._subscription.take()

    def recv_all(self) -> list[Any]:
        """Return all messages that wait, oldest first."""
        return self._subscription.take_all()

    def latest(self) -> Any:
        """Return the topic's newest message, received or not; None before the first."""
        return self._subscription.topic.latest()

    def close(self) -> None:
        """Receive nothing more; an iteration ends after what still waits."""
        if not self._ended:
            self._subscription.close()
            self._ended = True
            self._on_close(self)
        self._wake()

    def __aiter__(self) -> MessageStream:
        """Iterate over this stream."""
        return self

    async def __anext__(self) -> Any:
        """Wait for the next message."""
        while True:
            message = self._subscription.take()
            if message is not None:
                return message
            if self._ended:
                raise StopAsyncIteration
            waiter = asyncio.get_running_loop().create_future()
            with self._lock:
                if self._waiter is not None and not self._waiter.done():
                    raise StateError("two tasks iterate over one stream; subscribe once for each")
                self._waiter = waiter
            # Looked at again now that senders can see the waiter.
            if not self._subscription.queue and not self._ended:
                await waiter

    def __enter__(self) -> MessageStream:
        """Close the stream at the end of the block."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Close the stream."""
        self.close()

    def _wake(self) -> None:
        """Let the iteration look again. Thread: any."""
        if self._waiter is None:
            return
        with self._lock:
            waiter, self._waiter = self._waiter, None
        if waiter is not None:
            loop = waiter.get_loop()
            if not loop.is_closed():
                loop.call_soon_threadsafe(_resolve, waiter)


def _resolve(waiter: asyncio.Future[None]) -> None:
    if not waiter.done():
        waiter.set_result(None)
