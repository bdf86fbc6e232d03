"""`Node`: a function, or a class, with its scheduling intent."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from horus import clock
from horus.callables import Callback, is_async_callable, takes_node
from horus.errors import ConfigError, StateError, describe
from horus.ports import Ports, Pub, Sub, declared
from horus.spec import ExecutionClass, FailurePolicy, Miss, NodeSpec, make_node_spec
from horus.units import to_s

if TYPE_CHECKING:
    from horus.topics import Bus, Publisher, Subscription

ErrorCallback = Callable[["Node", BaseException], None]

_log = logging.getLogger("horus.node")
_TWO_WAYS = "is given both as an argument and as a method of the class; keep one"


class Node:
    """A unit of work that the scheduler ticks.

    Either wrap plain functions::

        Node("motor", tick=drive, rate=1000, order=20, budget=300 * us, subs=["cmd"])

    or subclass, with methods `tick`, `init`, `shutdown` and `enter_safe_state`
    (each optional but `tick`). A callback may take the node or nothing.
    """

    def __init__(
        self,
        name: str,
        tick: Callback | None = None,
        *,
        rate: float | None = None,
        order: int = 100,
        budget: float | None = None,
        deadline: float | None = None,
        on_miss: Miss | str | None = None,
        failure_policy: FailurePolicy | str | None = None,
        compute: bool | str = False,
        on: str | type | None = None,
        priority: int | None = None,
        core: int | None = None,
        watchdog: float | None = None,
        pubs: Ports = None,
        subs: Ports = None,
        init: Callback | None = None,
        shutdown: Callback | None = None,
        safe_state: Callback | None = None,
        on_error: ErrorCallback | None = None,
    ) -> None:
        """Configure a node; nothing runs until a scheduler does.

        Args:
            name: Unique in a scheduler; letters, digits, `_`, `-` and `.`.
            tick: Called at every release. `async def` makes it an AsyncIo node.
            rate: Releases per second [Hz]. Setting it makes the node an Rt node
                (unless it is Compute or async) and derives budget and deadline.
                30 Hz when not given.
            order: Lower runs earlier: 0-9 critical, 10-49 high, 50-99 normal,
                100-199 low, 200 and up background.
            budget: Longest expected execution time [s]; 80 % of the period when
                only a rate is given.
            deadline: Longest allowed time from release to finish [s]; 95 % of the
                period when only a rate is given.
            on_miss: `"warn"` (the default), `"skip"`, `"safe_mode"` or `"stop"`,
                when a tick exceeds its deadline or its budget.
            failure_policy: `"fatal"`, `"restart"`, `"skip"` or `"ignore"`, when a
                tick raises. None: log with traceback, count, keep ticking.
            compute: True runs the node on a worker thread, for CPU-heavy work.
            on: Tick once per message of this topic, instead of at a rate.
            priority: SCHED_FIFO priority, 1 to 99.
            core: CPU core to pin the node's thread to.
            watchdog: Watchdog timeout [s] of this node, instead of the scheduler's.
            pubs: Topics it sends: a name, a list of names, `Pub(...)`, message
                classes (the topic is named after the class), or `{topic: type}`.
            subs: Topics it receives: likewise, with `Sub(topic, capacity=...)`.
            init: Called once before the first tick.
            shutdown: Called once at the end, on every path.
            safe_state: Called to bring the node's hardware into a safe state.
            on_error: Called as `on_error(node, exception)` when a callback raises;
                it is told, it does not decide.

        Raises:
            ConfigError: An argument was refused; the message names it.
            TopicError: A topic name was refused.
        """
        self._tick = self._pick("tick", tick)
        if self._tick is None:
            raise ConfigError("tick", tick, "a node needs a tick function or a tick() method")
        self._init = self._pick("init", init)
        self._shutdown = self._pick("shutdown", shutdown)
        self._safe_state = self._pick("safe_state", safe_state, method="enter_safe_state")
        if on_error is not None and not callable(on_error):
            raise ConfigError("on_error", on_error, "must be callable as on_error(node, exception)")
        self.on_error = on_error
        self.is_async = is_async_callable(self._tick)
        self.spec: NodeSpec = make_node_spec(
            name=name,
            is_async=self.is_async,
            rate=rate,
            order=order,
            budget=budget,
            deadline=deadline,
            on_miss=on_miss,
            failure_policy=failure_policy,
            compute=compute,
            on=on.__name__ if isinstance(on, type) else on,
            priority=priority,
            core=core,
            watchdog=watchdog,
        )
        self._refuse_stray_async()
        self.pubs: tuple[Pub, ...] = declared("pubs", pubs, Pub)
        self.subs: tuple[Sub, ...] = declared("subs", subs, Sub)
        self.log = logging.getLogger(f"horus.node.{self.spec.name}")
        self.owner: object | None = None
        self.request_stop_hook: Callable[[str], None] | None = None
        self._bus: Bus | None = None
        self._outputs: dict[Any, Publisher] = {}
        self._inputs: dict[Any, Subscription] = {}
        self._warned_outside = False

    # -- configuration, as the contract names it -------------------------------

    @property
    def name(self) -> str:
        """The name."""
        return self.spec.name

    @property
    def rate(self) -> float:
        """The rate [Hz]; 30 when not given."""
        return self.spec.rate_hz

    @property
    def order(self) -> int:
        """The execution order; 100 when not given."""
        return self.spec.order

    @property
    def budget(self) -> float | None:
        """The budget [s], given or derived."""
        return None if self.spec.budget_ns is None else to_s(self.spec.budget_ns)

    @property
    def deadline(self) -> float | None:
        """The deadline [s], given or derived."""
        return None if self.spec.deadline_ns is None else to_s(self.spec.deadline_ns)

    @property
    def execution_class(self) -> ExecutionClass:
        """The execution class that the configuration implies."""
        return self.spec.execution_class

    # -- messages ---------------------------------------------------------------

    def send(self, topic: str | type, message: Any) -> None:
        """Publish an isolated copy of `message`.

        Raises:
            TopicError: The message or the topic was refused.
            StateError: The node was not added to a scheduler.

        Thread: the node's own callbacks.
        """
        try:
            publisher = self._outputs[topic]
        except KeyError:
            publisher = self._open_output(topic)
        publisher.send(message)

    def recv(self, topic: str | type) -> Any:
        """Return the oldest message that waits, or None.

        Thread: the node's own callbacks.
        """
        try:
            subscription = self._inputs[topic]
        except KeyError:
            subscription = self._open_input(topic)
        return subscription.take()

    def recv_all(self, topic: str | type) -> list[Any]:
        """Return every message that waits, oldest first."""
        return self._input(topic).take_all()

    def has_msg(self, topic: str | type) -> bool:
        """Return whether a message waits."""
        try:
            return bool(self._inputs[topic].queue)
        except KeyError:
            return bool(self._open_input(topic).queue)

    def latest(self, topic: str | type) -> Any:
        """Return the topic's newest message, received or not; None before the first."""
        return self._input(topic).topic.latest()

    # -- control and logging ----------------------------------------------------

    def request_stop(self, reason: str | None = None) -> None:
        """Ask the scheduler to stop in order; returns at once.

        Thread: any.
        """
        if self.request_stop_hook is None:
            raise StateError(f"node {self.name!r} was not added to a scheduler")
        self.request_stop_hook(reason or f"requested by node {self.name!r}")

    def log_debug(self, message: str, *args: object) -> None:
        """Log at debug level to `horus.node.<name>`; dropped outside callbacks."""
        self._emit(logging.DEBUG, message, args)

    def log_info(self, message: str, *args: object) -> None:
        """Log at info level; see `log_debug`."""
        self._emit(logging.INFO, message, args)

    def log_warning(self, message: str, *args: object) -> None:
        """Log at warning level; see `log_debug`."""
        self._emit(logging.WARNING, message, args)

    def log_error(self, message: str, *args: object) -> None:
        """Log at error level; see `log_debug`."""
        self._emit(logging.ERROR, message, args)

    def __repr__(self) -> str:
        """Show what the node is and how it is scheduled."""
        spec = self.spec
        when = f"on={spec.on!r}" if spec.on else f"rate={spec.rate_hz:g}"
        return f"<Node {spec.name!r} {spec.execution_class} {when} order={spec.order}>"

    # -- for the scheduler ------------------------------------------------------

    def callback(self, phase: str) -> Callable[[], Any] | None:
        """Return the callback of a phase as a call without arguments, if there is one."""
        function = {
            "tick": self._tick,
            "init": self._init,
            "shutdown": self._shutdown,
            "safe_state": self._safe_state,
        }[phase]
        if function is None or not takes_node(function):
            return function
        return functools.partial(function, self)

    def connect(self, bus: Bus) -> Subscription | None:
        """Open the declared ports on a bus; return the trigger of an event node.

        Raises:
            ConfigError: A topic was declared with another type before.
        """
        for port in (*self.pubs, *self.subs):
            bus.topic(port.topic).declare_type(port.type, self.name)
        self._bus = bus
        self._outputs = {pub.topic: bus.topic(pub.topic).publisher(self.name) for pub in self.pubs}
        self._inputs = {
            sub.topic: bus.subscribe(sub.topic, self.name, sub.capacity) for sub in self.subs
        }
        on = self.spec.on
        if on is None:
            return None
        if on not in self._inputs:
            self._inputs[on] = bus.subscribe(on, self.name)
        return self._inputs[on]

    def disconnect(self) -> None:
        """Stop receiving; what was sent stays counted."""
        for subscription in self._inputs.values():
            subscription.close()

    # -- internals --------------------------------------------------------------

    def _pick(
        self, argument: str, function: Callback | None, method: str | None = None
    ) -> Callback | None:
        own = getattr(type(self), method or argument, None)
        if own is None:
            if function is not None and not callable(function):
                raise ConfigError(argument, function, "must be callable")
            return function
        if function is not None:
            raise ConfigError(argument, function, _TWO_WAYS)
        bound: Callback = getattr(self, method or argument)
        return bound

    def _refuse_stray_async(self) -> None:
        for argument, function in (
            ("init", self._init),
            ("shutdown", self._shutdown),
            ("safe_state", self._safe_state),
        ):
            if function is not None and is_async_callable(function) and not self.is_async:
                raise ConfigError(
                    argument,
                    function,
                    "is async, but tick is not: only nodes with an async tick run on the "
                    "event loop; make both async or neither",
                )

    def _input(self, topic: str | type) -> Subscription:
        return self._inputs.get(topic) or self._open_input(topic)

    def _open_output(self, topic: str | type) -> Publisher:
        bus = self._connected_bus()
        found = bus.topic(topic)
        publisher = self._outputs.get(found.name)
        if publisher is None:
            publisher = self._outputs[found.name] = found.publisher(self.name)
            self._warn_undeclared("sends to", "pubs", found.name)
        self._outputs[topic] = publisher
        return publisher

    def _open_input(self, topic: str | type) -> Subscription:
        bus = self._connected_bus()
        found = bus.topic(topic)
        subscription = self._inputs.get(found.name)
        if subscription is None:
            subscription = self._inputs[found.name] = bus.subscribe(found.name, self.name)
            self._warn_undeclared("receives from", "subs", found.name)
        self._inputs[topic] = subscription
        return subscription

    def _connected_bus(self) -> Bus:
        if self._bus is None:
            raise StateError(f"node {self.name!r} must be added to a scheduler to use topics")
        return self._bus

    def _warn_undeclared(self, verb: str, argument: str, topic: str) -> None:
        _log.warning(
            "%s %s topic %r, which it did not declare; add %s=[%r] so that the "
            "scheduler knows the graph and nothing sent before is missed",
            self.name,
            verb,
            topic,
            argument,
            topic,
        )

    def _emit(self, level: int, message: str, args: tuple[object, ...]) -> None:
        context = clock.current.get()
        if context is None:
            if not self._warned_outside:
                self._warned_outside = True
                _log.warning(
                    "%s logs outside init, tick and shutdown; such messages are dropped "
                    "(this is said once): %s",
                    self.name,
                    describe(message),
                )
            return
        if self.log.isEnabledFor(level):
            extra = {"node": self.name, "cycle": context.cycle()}
            self.log.log(level, message, *args, extra=extra, stacklevel=3)
