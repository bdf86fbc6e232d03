"""What the scheduler knows of a node: configuration, callbacks, open ports."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from horus.callables import Callback, is_async_callable, takes_node
from horus.errors import ConfigError, StateError
from horus.ports import Pub, Sub
from horus.spec import NodeSpec

if TYPE_CHECKING:
    # The bus brings in a message library, which programs that only describe
    # nodes do without.
    from horus.topics import Bus, Publisher, Subscription

_log = logging.getLogger("horus.node")


class NodeCore:
    """What the scheduler knows of a node: configuration, callbacks, open ports."""

    def __init__(
        self,
        node: object,
        spec: NodeSpec,
        functions: Mapping[str, Callback | None],
        pubs: tuple[Pub, ...],
        subs: tuple[Sub, ...],
    ) -> None:
        """Describe a node that belongs to no scheduler yet."""
        self.node = node
        self.spec = spec
        self.pubs = pubs
        self.subs = subs
        self.publishes = frozenset(pub.topic for pub in pubs)
        self.subscribes = frozenset(sub.topic for sub in subs)
        self.is_async = is_async_callable(functions["tick"])
        self.functions = functions
        self.on_error: Callable[[Any, BaseException], None] | None = functions["on_error"]
        self.callbacks = {
            phase: _without_arguments(functions[phase], node)
            for phase in ("init", "tick", "shutdown", "safe_state")
        }
        self.releases_ns: Sequence[int] | None = None
        """Release instants after the epoch [ns] in place of a rate: what is recorded has them."""
        self.log = logging.getLogger(f"horus.node.{spec.name}")
        self.owner: object | None = None
        self.request_stop: Callable[[str], None] | None = None
        self.outputs: dict[Any, Publisher] = {}
        self.inputs: dict[Any, Subscription] = {}
        self._bus: Bus | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Return what goes to a worker process: no scheduler, no open ports, nobody to tell."""
        state = self.__dict__.copy()
        state.update(owner=None, request_stop=None, outputs={}, inputs={}, _bus=None)
        state.update(on_error=None, functions={})
        return state

    @property
    def dropped(self) -> int:
        """How many messages its queues have lost."""
        return sum(subscription.dropped for subscription in set(self.inputs.values()))

    def connect(self, bus: Bus) -> Subscription | None:
        """Open the declared ports on a bus; return the trigger of an event node.

        Raises:
            ConfigError: A topic was declared with another type before.
        """
        ports = [(bus.topic(port.topic), port.type) for port in (*self.pubs, *self.subs)]
        for topic, kind in ports:
            topic.check_type(kind, self.spec.name)
        for topic, kind in ports:
            topic.declare_type(kind)
        self.disconnect()
        self._bus = bus
        for pub in self.pubs:
            self.outputs[pub.topic] = bus.topic(pub.topic).publisher(self.spec.name, pub.foxglove)
        for sub in self.subs:
            self.inputs[sub.topic] = bus.subscribe(sub.topic, self.spec.name, sub.capacity)
        on = self.spec.on
        if on is None:
            return None
        if on not in self.inputs:
            self.inputs[on] = bus.subscribe(on, self.spec.name)
        return self.inputs[on]

    def disconnect(self) -> None:
        """Close the ports; what was sent stays counted."""
        for subscription in self.inputs.values():
            subscription.close()
        for publisher in self.outputs.values():
            publisher.close()
        self.inputs.clear()
        self.outputs.clear()

    def open_output(self, topic: str | type, *, warn: bool = True) -> Publisher:
        """Open a topic for sending that was not declared, or under another key."""
        found = self._connected_bus().topic(topic)
        publisher = self.outputs.get(found.name)
        if publisher is None:
            publisher = self.outputs[found.name] = found.publisher(self.spec.name)
            if warn:
                self._warn_undeclared("sends to", "pubs", found.name)
        self.outputs[topic] = publisher
        return publisher

    def open_input(self, topic: str | type, *, warn: bool = True) -> Subscription:
        """Open a topic for receiving that was not declared, or under another key."""
        bus = self._connected_bus()
        found = bus.topic(topic)
        subscription = self.inputs.get(found.name)
        if subscription is None:
            subscription = self.inputs[found.name] = bus.subscribe(found.name, self.spec.name)
            if warn:
                self._warn_undeclared("receives from", "subs", found.name)
        self.inputs[topic] = subscription
        return subscription

    def _connected_bus(self) -> Bus:
        if self._bus is None:
            raise StateError(f"node {self.spec.name!r} must be added to a scheduler to use topics")
        return self._bus

    def _warn_undeclared(self, verb: str, argument: str, topic: str) -> None:
        _log.warning(
            "%s %s topic %r, which it did not declare; add %s=[%r] so that the "
            "scheduler knows the graph and nothing sent before is missed",
            self.spec.name,
            verb,
            topic,
            argument,
            topic,
        )


def core_of(node: object) -> NodeCore:
    """Return what the scheduler knows of a node.

    Raises:
        ConfigError: Not a node, or a subclass that did not call `super().__init__()`.
    """
    core = getattr(node, "_horus_core", None)
    if not isinstance(core, NodeCore):
        raise ConfigError(
            "node", node, "must be a Node; a subclass must call super().__init__(name, ...)"
        )
    return core


def _without_arguments(function: Callback | None, node: object) -> Callable[[], Any] | None:
    if function is None or not takes_node(function):
        return function
    return functools.partial(function, node)
