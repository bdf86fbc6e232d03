"""What there is to record: 20,000 messages a second, dicts of three floats on 20 topics.

Whoever has nodes runs these functions. They take any node with ``send`` and ``recv``.
"""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

now_ns = time.monotonic_ns

MESSAGE_RATE_HZ = 20_000.0
"""Messages of all topics."""
TOPICS = tuple(f"pose{index}" for index in range(20))
TOPIC_RATE_HZ = MESSAGE_RATE_HZ / len(TOPICS)
SOURCE_RATE_HZ = 100.0
"""Of a node for each topic: it sends ten messages in a tick."""
TOGETHER_RATE_HZ = TOPIC_RATE_HZ
"""Of one node for all topics: it sends a message on each of them in a tick."""


def make_message(number: int) -> dict[str, float]:
    """Return a pose; no two numbers make the same one.

    The robot drives in circles: two of the floats are as hard to compress as measured ones.
    """
    angle = 1e-3 * number
    return {"x": float(number), "y": math.sin(angle), "theta": math.cos(angle)}


def number_of(message: Mapping[str, float]) -> int:
    """Return the number that a message was made with."""
    return int(message["x"])


class Source:
    """Sends on one topic, in each tick what is due by the end of its period.

    A source that was held up sends more in its next tick: the rate is what was asked for, unless
    the program as a whole does not get that far.
    """

    def __init__(
        self, index: int, quota: int, *, rate_hz: float, clock_ns: Callable[[], int]
    ) -> None:
        """Prepare to send.

        Args:
            index: Which topic it sends on.
            quota: How many messages in all.
            rate_hz: The rate of its ticks.
            clock_ns: Tells the time, which need not be real.
        """
        self.index = index
        self.topic = TOPICS[index]
        self.quota = quota
        self.rate_hz = rate_hz
        self.sent = 0
        self.first_ns = self.last_ns = 0
        """When the first tick began, and when the last message was sent."""
        self._clock_ns = clock_ns

    def tick(self, node: Any) -> None:
        """Send what is due."""
        started_ns = self._clock_ns()
        if not self.sent:
            self.first_ns = started_ns
        passed_s = (started_ns - self.first_ns) / 1e9
        due = min(self.quota, round((passed_s + 1.0 / self.rate_hz) * TOPIC_RATE_HZ))
        if self.sent >= due:
            return
        send, topic, index, stride = node.send, self.topic, self.index, len(TOPICS)
        for count in range(self.sent, due):
            send(topic, make_message(count * stride + index))
        self.sent = due
        self.last_ns = self._clock_ns()

    def numbers(self) -> list[int]:
        """Return the numbers of what was sent, in that order."""
        return [count * len(TOPICS) + self.index for count in range(self.sent)]


def make_sources(
    seconds: float, *, rate_hz: float = SOURCE_RATE_HZ, clock_ns: Callable[[], int] = now_ns
) -> list[Source]:
    """Return a source for every topic, which send for so long [s]."""
    quota = round(seconds * TOPIC_RATE_HZ)
    indices = range(len(TOPICS))
    return [Source(index, quota, rate_hz=rate_hz, clock_ns=clock_ns) for index in indices]


def make_nodes(horus: Any, sources: Sequence[Source]) -> list[Any]:
    """Return a node for each source, and one that receives everything."""
    nodes = [
        horus.Node(
            name=f"source{source.index}",
            tick=source.tick,
            rate=source.rate_hz,
            order=10 + source.index,
            pubs=[source.topic],
        )
        for source in sources
    ]
    return [*nodes, make_listener(horus, Counter())]


def make_node_for_all(horus: Any, sources: Sequence[Source]) -> list[Any]:
    """Return one node for all sources, and one that receives everything."""

    def tick(node: Any) -> None:
        for source in sources:
            source.tick(node)

    node = horus.Node(
        name="source", tick=tick, rate=sources[0].rate_hz, order=10, pubs=list(TOPICS)
    )
    return [node, make_listener(horus, Counter())]


def make_listener(horus: Any, counter: Counter) -> Any:
    """Return the node that receives what all others have sent."""
    return horus.Node(
        name="listener", tick=counter.tick, rate=SOURCE_RATE_HZ, order=90, subs=list(TOPICS)
    )


class Counter:
    """Receives all there is on all topics, and counts."""

    def __init__(self) -> None:
        """Begin with nothing."""
        self.received = 0

    def tick(self, node: Any) -> None:
        """Receive what waits."""
        recv = node.recv
        for topic in TOPICS:
            while recv(topic) is not None:
                self.received += 1
