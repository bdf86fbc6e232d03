"""`Node`: a function, or a class, with its scheduling intent."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from horus import clock
from horus.callables import Callback, is_async_callable, takes_node
from horus.core import NodeCore
from horus.errors import ConfigError, StateError, describe
from horus.ports import Ports, Pub, Sub, declared
from horus.spec import ExecutionClass, FailurePolicy, Miss, make_node_spec
from horus.units import to_s

if TYPE_CHECKING:
    from horus.topics import Subscription

ErrorCallback = Callable[["Node", BaseException], None]

_log = logging.getLogger("horus.node")
_TWO_WAYS = "is given both as an argument and as a method of the class; keep one"


class Node:
    """A unit of work that the scheduler ticks.

    Either wrap plain functions:

        Node("motor", tick=drive, rate=1000, order=20, budget=300 * us, subs=["cmd"])

    or subclass, with methods `tick`, `init`, `shutdown` and `enter_safe_state`
    (each optional but `tick`) and `on_error`. A callback may take the node or nothing.
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
            compute: True runs the node on a worker thread, for CPU-heavy work; "process"
                in a worker process, where `init()`, ticks and `shutdown()` all run.
            on: Tick once per message of this topic, instead of at a rate.
            priority: SCHED_FIFO priority of the node's thread, 1 to 99; with `rt=True`
                derived from the rate when not given.
            core: CPU core to pin the node's thread to.
            watchdog: Watchdog timeout [s] of this node, instead of the scheduler's
                `watchdog_ms`: for ticks that do not end.
            pubs: Topics it sends: a name, a list of names, `Pub(...)`, message
                classes (the topic is named after the class), or `{topic: type}`.
            subs: Topics it receives: likewise, with `Sub(topic, capacity=...)`.
            init: Called once before the first tick.
            shutdown: Called once at the end, on every path.
            safe_state: Called to bring the node's hardware into a safe state, within 0.1 s
                and from whatever thread; a node that has it is held in a safe state.
            on_error: Called as `on_error(node, exception)` when a callback raises;
                it is told, it does not decide.

        Raises:
            ConfigError: An argument was refused; the message names it.
            TopicError: A topic name was refused.
        """
        callbacks = {
            "tick": self._horus_pick("tick", tick),
            "init": self._horus_pick("init", init),
            "shutdown": self._horus_pick("shutdown", shutdown),
            "safe_state": self._horus_pick("safe_state", safe_state, method="enter_safe_state"),
            "on_error": self._horus_pick("on_error", on_error),
        }
        if callbacks["tick"] is None:
            raise ConfigError("tick", tick, "a node needs a tick function or a tick() method")
        _refuse_uncallable(callbacks)
        is_async = is_async_callable(callbacks["tick"])
        _refuse_stray_async(callbacks, is_async)
        spec = make_node_spec(
            name=name,
            is_async=is_async,
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
        # Names that nobody else uses: a driver class that calls its own things
        # `connect`, `log` or `_inputs` must not take the machinery apart.
        self._horus_core = NodeCore(
            self, spec, callbacks, declared("pubs", pubs, Pub), declared("subs", subs, Sub)
        )
        self._horus_outputs = self._horus_core.outputs
        self._horus_inputs = self._horus_core.inputs
        self._horus_warned = False

    # -- configuration, as the contract names it -------------------------------

    @property
    def name(self) -> str:
        """The name."""
        return self._horus_core.spec.name

    @property
    def rate(self) -> float:
        """The rate [Hz]; 30 when not given."""
        return self._horus_core.spec.rate_hz

    @property
    def order(self) -> int:
        """The execution order; 100 when not given."""
        return self._horus_core.spec.order

    @property
    def budget(self) -> float | None:
        """The budget [s], given or derived."""
        budget_ns = self._horus_core.spec.budget_ns
        return None if budget_ns is None else to_s(budget_ns)

    @property
    def deadline(self) -> float | None:
        """The deadline [s], given or derived."""
        deadline_ns = self._horus_core.spec.deadline_ns
        return None if deadline_ns is None else to_s(deadline_ns)

    @property
    def execution_class(self) -> ExecutionClass:
        """The execution class that the configuration implies."""
        return self._horus_core.spec.execution_class

    # -- messages ---------------------------------------------------------------

    def send(self, topic: str | type, message: Any) -> None:
        """Publish an isolated copy of `message`.

        Raises:
            TopicError: The message or the topic was refused.
            StateError: The node was not added to a scheduler.

        Thread: the node's own callbacks.
        """
        try:
            publisher = self._horus_outputs[topic]
        except KeyError:
            publisher = self._horus_core.open_output(topic)
        publisher.send(message)

    def recv(self, topic: str | type) -> Any:
        """Return the oldest message that waits, or None.

        Thread: the node's own callbacks.
        """
        try:
            subscription = self._horus_inputs[topic]
        except KeyError:
            subscription = self._horus_core.open_input(topic)
        return subscription.take()

    def recv_all(self, topic: str | type) -> list[Any]:
        """Return every message that waits, oldest first."""
        return self._horus_input(topic).take_all()

    def has_msg(self, topic: str | type) -> bool:
        """Return whether a message waits."""
        try:
            return bool(self._horus_inputs[topic].queue)
        except KeyError:
            return bool(self._horus_core.open_input(topic).queue)

    def latest(self, topic: str | type) -> Any:
        """Return the topic's newest message, received or not; None before the first."""
        return self._horus_input(topic).topic.latest()

    # -- control and logging ----------------------------------------------------

    def request_stop(self, reason: str | None = None) -> None:
        """Ask the scheduler to stop in order; returns at once.

        Thread: any.
        """
        request_stop = self._horus_core.request_stop
        if request_stop is None:
            raise StateError(f"node {self.name!r} was not added to a scheduler")
        request_stop(reason or f"requested by node {self.name!r}")

    def log_debug(self, message: str, *args: object) -> None:
        """Log at debug level to `horus.node.<name>`; dropped outside callbacks."""
        self._horus_emit(logging.DEBUG, message, args)

    def log_info(self, message: str, *args: object) -> None:
        """Log at info level; see `log_debug`."""
        self._horus_emit(logging.INFO, message, args)

    def log_warning(self, message: str, *args: object) -> None:
        """Log at warning level; see `log_debug`."""
        self._horus_emit(logging.WARNING, message, args)

    def log_error(self, message: str, *args: object) -> None:
        """Log at error level; see `log_debug`."""
        self._horus_emit(logging.ERROR, message, args)

    def __getstate__(self) -> object:
        """Return what goes to a worker process: all but the open ports."""
        state = object.__getstate__(self)
        if isinstance(state, dict):
            return {
                key: state[key] for key in state if key not in ("_horus_outputs", "_horus_inputs")
            }
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take over what `__getstate__` has returned."""
        self.__dict__.update(state)
        self._horus_outputs = self._horus_core.outputs
        self._horus_inputs = self._horus_core.inputs

    def __repr__(self) -> str:
        """Show what the node is and how it is scheduled."""
        spec = self._horus_core.spec
        when = f"on={spec.on!r}" if spec.on else f"rate={spec.rate_hz:g}"
        return f"<Node {spec.name!r} {spec.execution_class} {when} order={spec.order}>"

    # -- internals ----------------------------------------------------------------

    def _horus_pick(
        self, argument: str, function: Callback | None, method: str | None = None
    ) -> Callback | None:
        """Return a callback from the argument or the method of the class, not both."""
        if getattr(type(self), method or argument, None) is None:
            if function is not None and not callable(function):
                raise ConfigError(argument, function, "must be callable")
            return function
        if function is not None:
            raise ConfigError(argument, function, _TWO_WAYS)
        bound: Callback = getattr(self, method or argument)
        return bound

    def _horus_input(self, topic: str | type) -> Subscription:
        return self._horus_inputs.get(topic) or self._horus_core.open_input(topic)

    def _horus_emit(self, level: int, message: str, args: tuple[object, ...]) -> None:
        context = clock.current.get()
        log = self._horus_core.log
        if context is None:
            if not self._horus_warned:
                self._horus_warned = True
                _log.warning(
                    "%s logs outside init, tick and shutdown; such messages are dropped "
                    "(this is said once): %s",
                    self.name,
                    describe(message),
                )
        elif log.isEnabledFor(level):
            extra = {"node": self.name, "cycle": context.cycle()}
            log.log(level, message, *args, extra=extra, stacklevel=3)


def _refuse_uncallable(callbacks: Mapping[str, Callback | None]) -> None:
    for argument, function in callbacks.items():
        if function is not None and argument != "on_error" and takes_node(function) is None:
            raise ConfigError(argument, function, "must take the node, or nothing")


def _refuse_stray_async(callbacks: Mapping[str, Callback | None], is_async: bool) -> None:
    for argument, function in callbacks.items():
        if function is None or argument == "tick" or not is_async_callable(function):
            continue
        if argument == "on_error":
            raise ConfigError(argument, function, "must be a plain function; nobody awaits it")
        if not is_async:
            raise ConfigError(
                argument,
                function,
                "is async, but tick is not: only nodes with an async tick run on the "
                "event loop; make both async or neither",
            )
