"""The message bus: topics, the publishers that write to them, the subscriptions that read.

A message is isolated once, when it is sent (`snapshot.freeze`), and appended to
the bounded queue of every subscription. There are no locks on the way: queues
are `collections.deque`s, each counter has one writer, and the list of
subscriptions is a tuple that is replaced, never changed.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

from horus.errors import ConfigError, TopicError, describe
from horus.foxglove import Declaration
from horus.ports import DEFAULT_CAPACITY
from horus.snapshot import Frozen, UnsendableError, freeze
from horus.validation import check_topic

_log = logging.getLogger("horus.topics")


class TopicStatistics(NamedTuple):
    """Counters of one topic since it was created."""

    topic: str
    sent: int
    dropped: int
    publishers: tuple[str, ...]
    subscribers: tuple[str, ...]


Tap = Callable[["Publisher", Frozen], None]
"""Called for every message sent, on the sender's thread: must be quick and never raise."""


class Subscription:
    """One receiver's bounded queue of one topic, oldest message first.

    When it is full the oldest message gives way and is counted in `dropped`.

    Thread: one reader at a time; any number of senders.
    """

    __slots__ = (
        "_already_sent",
        "_overflowing",
        "_sent_until",
        "away",
        "capacity",
        "owner",
        "queue",
        "received",
        "topic",
        "wake",
    )

    def __init__(self, topic: Topic, owner: str, capacity: int) -> None:
        """Start empty: what was sent earlier is not received."""
        self.topic = topic
        self.owner = owner
        self.capacity = capacity
        self.queue: deque[Frozen] = deque(maxlen=capacity)
        self.received = 0
        self.away = 0
        """How many messages wait in the reader's worker process."""
        self.wake: Callable[[], None] | None = None
        self._already_sent = topic.sent
        self._sent_until: int | None = None
        self._overflowing = False

    @property
    def dropped(self) -> int:
        """How many messages gave way to newer ones unread."""
        # Derived rather than counted: any thread may send, and an increment
        # shared between threads loses counts.
        sent = self.topic.sent if self._sent_until is None else self._sent_until
        arrived = sent - self._already_sent
        return max(0, arrived - self.received - self.away - len(self.queue))

    def take(self) -> Any:
        """Return the oldest message, or None."""
        try:
            payload, thaw = self.queue.popleft()
        except IndexError:
            self._overflowing = False
            return None
        self.received += 1
        return payload if thaw is None else thaw(payload)

    def hand_over(self) -> list[Frozen]:
        """Take all that waits, frozen as it is, for a reader in another process."""
        handed = [self.queue.popleft() for _ in range(len(self.queue))]
        self.away += len(handed)
        if not handed:
            self._overflowing = False
        return handed

    def take_all(self) -> list[Any]:
        """Return every waiting message, oldest first."""
        messages = []
        # Bounded by what waits now: a fast sender must not keep a tick here.
        for _ in range(len(self.queue)):
            message = self.take()
            if message is None:
                break
            messages.append(message)
        return messages

    def discard(self) -> None:
        """Drop the oldest message as if it had been received."""
        if self.queue:
            self.queue.popleft()
            self.received += 1

    def note_overflow(self) -> None:
        """Log the first message lost of an episode; it ends when the queue runs empty."""
        if self._overflowing or self.capacity == 1:
            return
        self._overflowing = True
        _log.warning(
            "%s does not keep up with topic %r: its queue of %d is full and the oldest "
            "messages are dropped; read it faster, or declare Sub(%r, capacity=...)",
            self.owner,
            self.topic.name,
            self.capacity,
            self.topic.name,
        )

    def close(self) -> None:
        """Stop receiving."""
        self.topic.unsubscribe(self)
        if self._sent_until is None:
            self._sent_until = self.topic.sent


class Publisher:
    """One sender's end of a topic.

    Thread: one sender at a time (a node never overlaps itself).
    """

    __slots__ = ("foxglove", "owner", "sent", "topic")

    def __init__(self, topic: Topic, owner: str, foxglove: Declaration | None = None) -> None:
        """Bind a sender to a topic; `foxglove` is how viewers are to show what it sends."""
        self.topic = topic
        self.owner = owner
        self.foxglove = foxglove
        self.sent = 0

    def send(self, message: Any) -> None:
        """Deliver an isolated copy of `message` to every subscription.

        Raises:
            TopicError: The message has another type than the topic declares, is
                None, or cannot be isolated.
        """
        self.deliver(self.isolate(message))

    def isolate(self, message: Any) -> Frozen:
        """Check a message and take the copy that will be delivered.

        Raises:
            TopicError: See `send`.

        Thread: any.
        """
        topic = self.topic
        if topic.type is not None and not topic.accepts(message):
            raise TopicError(
                f"topic {topic.name!r} carries {topic.type.__name__}; {self.owner} sent "
                f"{type(message).__name__} {describe(message)}"
            )
        if message is None:
            raise TopicError(
                f"topic {topic.name!r}: {self.owner} sent None, which is what recv() returns "
                "when there is nothing; send a value such as True or {}"
            )
        try:
            return freeze(message)
        except Exception as exc:
            # RecursionError, and whatever code of the message's own class raises.
            raise self._unsendable(message, exc) from exc

    def deliver(self, frozen: Frozen) -> None:
        """Append an isolated message to every subscription's queue."""
        topic = self.topic
        self.sent += 1
        topic.newest = frozen
        for subscription in topic.subscriptions:
            queue = subscription.queue
            if len(queue) == subscription.capacity:
                subscription.note_overflow()
            queue.append(frozen)
            if subscription.wake is not None:
                subscription.wake()
        if topic.taps:
            for tap in topic.taps:
                tap(self, frozen)

    def close(self) -> None:
        """Take the sender away from the topic; what it sent stays counted."""
        self.topic.retire(self)

    def _unsendable(self, message: Any, exc: Exception) -> TopicError:
        if isinstance(exc, UnsendableError):
            reason = f"{exc} (in {exc.path})" if exc.path else str(exc)
        elif isinstance(exc, RecursionError):
            reason = "it is nested too deeply"
        else:
            reason = f"{type(exc).__name__}: {exc}"
        return TopicError(
            f"topic {self.topic.name!r}: {self.owner} sent a {type(message).__name__} "
            f"that cannot be isolated: {reason}"
        )


class Topic:
    """A named stream of messages."""

    def __init__(self, name: str, lock: threading.Lock) -> None:
        """Create an empty topic; structural changes happen under `lock`."""
        self.name = name
        self.type: type | None = None
        self.newest: Frozen | None = None
        self.subscriptions: tuple[Subscription, ...] = ()
        self.publishers: tuple[Publisher, ...] = ()
        self.taps: tuple[Tap, ...] = ()
        self._lock = lock
        self._accepted: tuple[type, ...] = (object,)
        self._sent_by_retired = 0
        self._dropped_by_retired = 0

    @property
    def sent(self) -> int:
        """How many messages were sent."""
        return self._sent_by_retired + sum(publisher.sent for publisher in self.publishers)

    def latest(self) -> Any:
        """Return the newest message, received or not; None before the first."""
        newest = self.newest
        if newest is None:
            return None
        payload, thaw = newest
        return payload if thaw is None else thaw(payload)

    def check_type(self, kind: type | None, owner: str) -> None:
        """Refuse a declaration that contradicts an earlier one.

        Raises:
            ConfigError: Somebody else has declared another type.
        """
        if kind is not None and self.type not in (None, kind):
            raise ConfigError(
                "type",
                kind,
                f"topic {self.name!r} carries {self.type.__name__}, as was declared before "
                f"{owner}; all who declare a type must name the same",
            )

    def declare_type(self, kind: type | None) -> None:
        """Fix the type of the messages."""
        if kind is not None:
            self.type = kind
            self._accepted = (int, float) if kind is float else (kind,)

    def accepts(self, message: Any) -> bool:
        """Return whether `message` is of the declared type: an int is a fine float, a bool not."""
        if isinstance(message, bool) and self.type is float:
            return False
        return isinstance(message, self._accepted)

    def publisher(self, owner: str, foxglove: Declaration | None = None) -> Publisher:
        """Return a new sender's end."""
        with self._lock:
            publisher = self.make_publisher(owner, foxglove)
            self.publishers = (*self.publishers, publisher)
            return publisher

    def make_publisher(self, owner: str, foxglove: Declaration | None = None) -> Publisher:
        """Return a sender's end that counts for nothing yet."""
        return Publisher(self, owner, foxglove)

    def retire(self, publisher: Publisher) -> None:
        """Take a sender's end away; unknown ones are ignored."""
        with self._lock:
            rest = tuple(other for other in self.publishers if other is not publisher)
            if len(rest) < len(self.publishers):
                self._sent_by_retired += publisher.sent
                self.publishers = rest

    def subscribe(self, owner: str, capacity: int) -> Subscription:
        """Return a new, empty subscription."""
        with self._lock:
            subscription = Subscription(self, owner, capacity)
            self.subscriptions = (*self.subscriptions, subscription)
            return subscription

    def unsubscribe(self, subscription: Subscription) -> None:
        """Take a subscription away; unknown ones are ignored."""
        with self._lock:
            kept = tuple(s for s in self.subscriptions if s is not subscription)
            if len(kept) < len(self.subscriptions):
                self._dropped_by_retired += subscription.dropped
            self.subscriptions = kept

    def statistics(self) -> TopicStatistics:
        """Return the counters."""
        return TopicStatistics(
            topic=self.name,
            sent=self.sent,
            dropped=self._dropped_by_retired
            + sum(subscription.dropped for subscription in self.subscriptions),
            publishers=tuple(publisher.owner for publisher in self.publishers),
            subscribers=tuple(subscription.owner for subscription in self.subscriptions),
        )


class Bus:
    """All topics of one scheduler.

    Thread: any.
    """

    def __init__(self) -> None:
        """Create a bus without topics."""
        self._lock = threading.Lock()
        self._topics: dict[str, Topic] = {}
        self._taps: tuple[Tap, ...] = ()

    def topic(self, name: Any) -> Topic:
        """Return the topic of that name, creating it on first use.

        Raises:
            TopicError: The name is not usable.
        """
        checked = check_topic(name)
        with self._lock:
            topic = self._topics.get(checked)
            if topic is None:
                topic = self._topics[checked] = self.make_topic(checked)
                topic.taps = self._taps
            return topic

    def make_topic(self, name: str) -> Topic:
        """Return a new topic."""
        return Topic(name, self._lock)

    def subscribe(self, name: Any, owner: str, capacity: int = DEFAULT_CAPACITY) -> Subscription:
        """Return a new subscription to a topic."""
        return self.topic(name).subscribe(owner, capacity)

    def add_tap(self, tap: Tap) -> None:
        """Show `tap` every message sent from now on."""
        with self._lock:
            self._taps = (*self._taps, tap)
            for topic in self._topics.values():
                topic.taps = self._taps

    def remove_tap(self, tap: Tap) -> None:
        """Stop showing `tap` messages."""
        with self._lock:
            self._taps = tuple(other for other in self._taps if other is not tap)
            for topic in self._topics.values():
                topic.taps = self._taps

    def topics(self) -> list[Topic]:
        """Return the topics in order of creation."""
        with self._lock:
            return list(self._topics.values())
