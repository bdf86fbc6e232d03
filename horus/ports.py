"""The topics that a node declares, in every way they can be written."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

from horus.errors import ConfigError
from horus.foxglove import Declaration, check_declaration
from horus.validation import check_topic, is_int

DEFAULT_CAPACITY = 1024
"""Messages a subscription holds when nothing else is said."""


@dataclass(frozen=True, slots=True)
class _Port:
    """A topic that a node declares, with the type and queue it wants."""

    topic: str
    type: type | None = None
    capacity: int = DEFAULT_CAPACITY

    def __post_init__(self) -> None:
        """Refuse bad names, types and capacities.

        Raises:
            TopicError: The topic name is not usable.
            ConfigError: The type is no class or the capacity is no whole number above 0.
        """
        check_topic(self.topic)
        if self.type is not None and not isinstance(self.type, type):
            raise ConfigError("type", self.type, "must be a class, or None to accept anything")
        if not is_int(self.capacity) or self.capacity < 1:
            raise ConfigError("capacity", self.capacity, "must be a whole number of messages >= 1")


@dataclass(frozen=True, slots=True)
class Pub(_Port):
    """Declares a topic that a node publishes, e.g. `Pub("scan", LaserScan)`."""

    foxglove: Declaration | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        """Refuse bad names, types, capacities and declarations.

        Raises:
            TopicError: The topic name is not usable.
            ConfigError: The type is no class, the capacity is no whole number above 0, or
                `foxglove` is none of `horus.foxglove`'s declarations.
        """
        _Port.__post_init__(self)
        check_declaration(self.foxglove)


@dataclass(frozen=True, slots=True)
class Sub(_Port):
    """Declares a topic that a node receives; `Sub(topic, capacity=1)` keeps the latest only."""


Ports = str | type | Pub | Sub | Iterable[Any] | Mapping[Any, Any] | None
P = TypeVar("P", Pub, Sub)


def declared(argument: str, value: Ports, kind: type[P]) -> tuple[P, ...]:
    """Normalise every way to write `pubs` and `subs`."""
    if value is None:
        return ()
    if isinstance(value, str | type | Pub | Sub):
        items: list[Any] = [value]
    elif isinstance(value, Mapping):
        items = [
            item if isinstance(item, Pub | Sub) else kind(_topic_name(topic), item)
            for topic, item in value.items()
        ]
    elif isinstance(value, Iterable):
        items = list(value)
    else:
        raise ConfigError(argument, value, "must be a topic, a list of topics, or {topic: type}")
    ports: dict[str, P] = {}
    for item in items:
        port = _port(argument, item, kind)
        if port.topic in ports:
            raise ConfigError(argument, value, f"names topic {port.topic!r} twice")
        ports[port.topic] = port
    return tuple(ports.values())


def _port(argument: str, item: Any, kind: type[P]) -> P:
    if isinstance(item, kind):
        return item
    if isinstance(item, Pub | Sub):
        raise ConfigError(argument, item, f"takes {kind.__name__}(...) here")
    return kind(_topic_name(item), item if isinstance(item, type) else None)


def _topic_name(topic: Any) -> Any:
    return topic.__name__ if isinstance(topic, type) else topic
