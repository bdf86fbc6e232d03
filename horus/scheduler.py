"""The composition root: `Scheduler`, and `run` for programs that need no more."""

from __future__ import annotations

import asyncio
import contextlib
import threading
import warnings
from collections.abc import Iterable, Iterator
from types import TracebackType
from typing import Any, Self

from horus import clock, logs
from horus.clock import MonotonicClock, SimClock, Timeline
from horus.errors import (
    ConfigError,
    ShutdownTimeout,
    StateError,
    UnavailableWarning,
    UnknownNodeError,
)
from horus.executors.async_io import AsyncIoExecutor
from horus.executors.best_effort import BestEffortExecutor
from horus.executors.compute import ComputeExecutor
from horus.executors.event import EventExecutor
from horus.executors.rt import RtExecutor
from horus.live import LiveNode
from horus.loop.bridge import Bridge
from horus.loop.control import RunControl
from horus.loop.cycle import Cycle
from horus.loop.executor import Executor
from horus.loop.runtime import Runtime
from horus.loop.signals import stop_on_signals
from horus.loop.simulation import Simulation
from horus.loop.stepping import Stepper
from horus.node import Node
from horus.spec import (
    DEFAULT_CAPACITY,
    ExecutionClass,
    NodeSpec,
    SchedulerSpec,
    check_duration,
    make_scheduler_spec,
    optional_duration,
)
from horus.stats import TimingReport
from horus.stream import MessageStream
from horus.topics import Bus, Publisher
from horus.units import to_s

_APPLICATION = "application"


class Scheduler:
    """Owns a set of nodes and when they run.

    Threads: methods may be called from any thread unless they say otherwise;
    `run`, `tick_once` and `tick_for` run the nodes and exclude each other.
    """

    def __init__(
        self,
        *,
        tick_rate: float = 1000.0,
        rt: bool = False,
        deterministic: bool = False,
        blackbox_mb: int = 0,
        watchdog_ms: int = 0,
        recording: bool = False,
        name: str | None = None,
        cores: Iterable[int] | None = None,
        max_deadline_misses: int | None = None,
        verbose: bool = False,
        telemetry: str | None = None,
        loop: str = "uvloop",
        shutdown_timeout: float = 3.0,
        seed: int = 0,
    ) -> None:
        """Configure a scheduler; nothing runs yet.

        Args:
            tick_rate: Cycles per second [Hz]: what `horus.tick()` counts and
                `tick_once()` advances by. Match it to the fastest node.
            rt: Ask for SCHED_FIFO and locked memory.
            deterministic: Run in virtual time on one thread, reproducibly.
            blackbox_mb: Size of the flight recorder [MB]; 0 for none.
            watchdog_ms: Timeout after which a tick counts as frozen [ms]; 0 for never.
            recording: Record the session.
            name: For logs and reports; `"horus"` when not given.
            cores: CPU cores to run on.
            max_deadline_misses: Stop after this many misses in all; None for no limit.
            verbose: Log at debug level and print the timing report after `run()`.
            telemetry: Endpoint URL for metrics.
            loop: The event loop of `run()`: `"uvloop"` or `"asyncio"`.
            shutdown_timeout: How long each node's shutdown may take [s].
            seed: Seed of `horus.rng_float()` in deterministic mode.

        Raises:
            ConfigError: An argument was refused; the message names it.
        """
        self._spec = make_scheduler_spec(
            tick_rate=tick_rate,
            rt=rt,
            deterministic=deterministic,
            blackbox_mb=blackbox_mb,
            watchdog_ms=watchdog_ms,
            recording=recording,
            name=name,
            cores=cores,
            max_deadline_misses=max_deadline_misses,
            verbose=verbose,
            telemetry=telemetry,
            loop=loop,
            shutdown_timeout=shutdown_timeout,
            seed=seed,
        )
        _warn_of_unavailable(self._spec)
        self._lock = threading.RLock()
        self._lives: dict[str, LiveNode] = {}
        self._added = 0
        self._bus = Bus()
        self._application_outputs: dict[str, Publisher] = {}
        self._streams: list[MessageStream] = []
        self._sim_clock = SimClock() if deterministic else None
        self._timeline = Timeline(
            self._sim_clock or MonotonicClock(),
            self._spec.tick_rate_hz,
            seed=self._spec.seed if deterministic else None,
        )
        self._control = RunControl(self._spec.max_deadline_misses, self._total_misses)
        self._status = "idle"
        self._idle = threading.Event()
        self._idle.set()
        self._running_thread: int | None = None
        self._session_open = False
        self._runtime: Runtime | None = None
        self._stepper: Stepper | None = None
        self._background: asyncio.Task[None] | None = None

    # -- nodes ---------------------------------------------------------------------

    def add(self, node: Node) -> Self:
        """Add a node; while running, it is initialised and ticks as soon as possible.

        Returns:
            The scheduler, so that calls can be chained.

        Raises:
            ConfigError: Not a node, or the name is taken.
            StateError: The node is in use by another scheduler that runs.
        """
        if not isinstance(node, Node) or not hasattr(node, "spec"):
            raise ConfigError(
                "node", node, "must be a Node; a subclass must call super().__init__(name, ...)"
            )
        with self._lock:
            if node.name in self._lives:
                raise ConfigError(
                    "name", node.name, "is taken by another node; names must be unique"
                )
            self._take_over(node)
            live = LiveNode(node, self._timeline, self._control, self._added)
            live.trigger = node.connect(self._bus)
            self._added += 1
            self._lives[node.name] = live
        _warn_of_unavailable_in(node.spec)
        if self._runtime is not None:
            self._runtime.add(live)
        elif self._stepper is not None:
            self._stepper.add(live)
        return self

    def remove_node(self, name: str) -> bool:
        """Shut a node down and remove it; return whether it existed.

        `shutdown()` has run when this returns. Two cases must end first to begin
        it: a node that removes itself, and an async node removed from a callback
        on the event loop. They are shut down as soon as their tick has ended.

        Raises:
            ShutdownTimeout: The node's tick or `shutdown()` did not end in time.
        """
        with self._lock:
            live = self._lives.pop(_node_name(name), None)
        if live is None:
            return False
        if self._runtime is not None:
            removed = self._runtime.remove(live)
            timeout_s = to_s(self._spec.shutdown_timeout_ns)
            if not removed.done() and not self._runtime.is_home(live):
                try:
                    removed.result(timeout_s)
                except TimeoutError:
                    raise ShutdownTimeout(name, timeout_s) from None
        elif self._stepper is not None:
            self._stepper.remove(live)
        live.node.disconnect()
        live.node.owner = None
        return True

    def set_node_rate(self, name: str, rate: float) -> None:
        """Change a node's rate [Hz]; automatic budget and deadline follow.

        Raises:
            UnknownNodeError: There is no such node.
            ConfigError: The rate is refused, or the node is an event node.
        """
        live = self._live(name)
        if live.trigger is not None:
            raise ConfigError("rate", rate, f"{name!r} is released by messages, not by a rate")
        live.apply(live.spec.with_rate(rate))
        if self._runtime is not None:
            self._runtime.retime(live)
        elif self._stepper is not None:
            self._stepper.retime(live)

    def set_tick_budget(self, name: str, budget_us: float) -> None:
        """Change a node's budget; the argument is in microseconds [us].

        Raises:
            UnknownNodeError: There is no such node.
            ConfigError: The budget is refused.
        """
        live = self._live(name)
        live.apply(live.spec.with_budget_ns(check_duration("budget_us", budget_us, "microseconds")))

    def add_critical_node(self, name: str, timeout_ms: float) -> None:
        """Mark a node as safety-critical, with a watchdog timeout of its own [ms].

        Raises:
            UnknownNodeError: There is no such node.
            ConfigError: The timeout is refused.
        """
        self._live(name)
        check_duration("timeout_ms", timeout_ms, "milliseconds")
        _warn_unavailable(f"add_critical_node({name!r})", "no watchdog supervises the node")

    # -- running -------------------------------------------------------------------

    def run(self, duration: float | None = None) -> None:
        """Run the nodes until stopped, or for `duration` seconds [s].

        Owns SIGINT and SIGTERM meanwhile, if called in the main thread: the
        first ends the run in order, a second one forces exit. Every node's
        `shutdown()` has run when this returns, whatever ended the run.

        Raises:
            NodeError: A node with `failure_policy="fatal"` failed.
            StateError: Already running, or called inside an event loop.

        Thread: any; nodes of the event loop's classes run on the calling one.
        """
        duration_ns = optional_duration("duration", duration)
        _refuse_in_event_loop("run", "await sched.arun()")
        with self._running(show_logs=True), stop_on_signals(self._control.request_stop):
            if self._spec.deterministic:
                self._simulate(duration_ns, shut_down_after=True)
            else:
                self._run_loop(duration_ns, list(self._lives.values()), shut_down_after=True)
        if self._spec.verbose:
            print(self.timing_report())
        self._raise_failure()

    async def arun(self, duration: float | None = None) -> None:
        """Run the nodes on the running event loop, beside the application's own tasks.

        Cancelling it is a stop: the nodes are shut down in order, then the
        cancellation goes on. Signals are left to the application.

        Raises:
            NodeError: A node with `failure_policy="fatal"` failed.
            StateError: Already running, or not under asyncio or uvloop.

        Thread: that of the running event loop.
        """
        duration_ns = optional_duration("duration", duration)
        try:
            asyncio.get_running_loop()
        except RuntimeError:
            raise StateError(
                "arun() needs a running asyncio or uvloop event loop; trio's will not do"
            ) from None
        with self._running(show_logs=False):
            if self._spec.deterministic:
                await self._simulate_beside_loop(duration_ns)
            else:
                self._close_stepper()
                self._runtime = runtime = self._new_runtime()
                try:
                    await runtime.run(list(self._lives.values()), _seconds(duration_ns))
                finally:
                    self._runtime = None
        self._raise_failure()

    def stop(self, reason: str | None = None) -> None:
        """End the run in order; returns at once, from any thread, callback or signal handler.

        When nothing runs, nodes that `tick_once` or `tick_for` have initialised
        are shut down here and now.
        """
        if self.is_running():
            self._control.request_stop(reason or "stop() was called")
        else:
            self._end_session()
            self._status = "stopped"

    def tick_once(self, names: Iterable[str] | None = None) -> None:
        """Run exactly one cycle on the calling thread, then return.

        All nodes tick once in order, without rate control, whatever their class;
        with `names`, only those. The first call initialises the nodes. In
        deterministic mode virtual time advances by one cycle, and only nodes
        that are due in it tick (named ones always do, once).

        Raises:
            UnknownNodeError: A name is not known.
            StateError: Called while running.
            NodeError: A node with `failure_policy="fatal"` failed; all nodes are
                shut down.
        """
        chosen = self._chosen(names)
        self._take_charge()
        try:
            stepper = self._stepper or self._open_stepper()
            stepper.cycle(self._stopping, chosen)
        finally:
            self._hand_back(keeps_session=True)
        self._raise_failure()

    def tick_for(self, seconds: float, names: Iterable[str] | None = None) -> None:
        """Run for a time [s], then return with the nodes still initialised.

        Paced in real time on the nodes' usual threads; in deterministic mode
        virtual seconds at full speed. With `names`, only those nodes tick.

        Raises:
            UnknownNodeError: A name is not known.
            StateError: Called while running, or inside an event loop.
            NodeError: A node with `failure_policy="fatal"` failed; all nodes are
                shut down.
        """
        duration_ns = check_duration("seconds", seconds)
        chosen = self._chosen(names)
        if not self._spec.deterministic:
            _refuse_in_event_loop("tick_for", "await sched.arun(duration)")
        with self._running(show_logs=False, keeps_session=True):
            if self._spec.deterministic:
                self._simulate(duration_ns, shut_down_after=False, only=chosen)
            else:
                lives = list(self._lives.values()) if chosen is None else chosen
                self._run_loop(duration_ns, lives, shut_down_after=False)
        self._raise_failure()

    def __enter__(self) -> Self:
        """Return the scheduler; leaving the block stops it."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Stop, and wait for the end of a run on another thread."""
        self.stop()
        if self._running_thread != threading.get_ident():
            self._idle.wait()

    async def __aenter__(self) -> Self:
        """Start running in the background of the event loop."""
        self._background = asyncio.ensure_future(self.arun())
        await asyncio.sleep(0)
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Stop, and wait until every node is shut down."""
        background, self._background = self._background, None
        if background is not None:
            self.stop()
            await background

    # -- topics, for the application -------------------------------------------------

    def publish(self, topic: str | type, message: Any) -> None:
        """Send a message to the nodes, as they do among themselves.

        Raises:
            TopicError: The topic or the message was refused.
        """
        with self._lock:
            found = self._bus.topic(topic)
            publisher = self._application_outputs.get(found.name)
            if publisher is None:
                publisher = self._application_outputs[found.name] = found.publisher(_APPLICATION)
            publisher.send(message)

    def subscribe(self, topic: str | type, capacity: int = DEFAULT_CAPACITY) -> MessageStream:
        """Return the messages of a topic from now on: `async for message in stream`.

        Raises:
            TopicError: The topic name was refused.
        """
        stream = MessageStream(self._bus.subscribe(topic, _APPLICATION, capacity))
        with self._lock:
            self._streams.append(stream)
        return stream

    # -- introspection ----------------------------------------------------------------

    def status(self) -> str:
        """Return `"idle"`, `"running"` or `"stopped"`."""
        return self._status

    def is_running(self) -> bool:
        """Return whether nodes are being run."""
        return self._status == "running"

    def current_tick(self) -> int:
        """Return the current cycle number."""
        return self._timeline.current_cycle()

    def scheduler_name(self) -> str:
        """Return the name."""
        return self._spec.name

    @property
    def stop_reason(self) -> str | None:
        """Why the last run ended; None if its time was simply over."""
        return self._control.stop_reason

    def get_node_count(self) -> int:
        """Return how many nodes there are."""
        return len(self._lives)

    def get_node_names(self) -> list[str]:
        """Return the nodes' names in execution order."""
        return [live.name for live in self._in_order()]

    def has_node(self, name: str) -> bool:
        """Return whether there is a node of that name."""
        return _node_name(name) in self._lives

    def get_node_info(self, name: str) -> int:
        """Return a node's execution order.

        Raises:
            UnknownNodeError: There is no such node.
        """
        return self._live(name).order

    def get_node_stats(self, name: str) -> dict[str, Any]:
        """Return a node's configuration, state and counters; durations in seconds.

        Raises:
            UnknownNodeError: There is no such node.
        """
        return _node_stats(self._live(name), self._reporting_ns())

    def get_all_nodes(self) -> list[dict[str, Any]]:
        """Return every node's stats, in execution order."""
        return [_node_stats(live, self._reporting_ns()) for live in self._in_order()]

    def timing_report(self) -> TimingReport:
        """Return how well each node has kept its schedule; `str()` of it is a table."""
        now_ns = self._reporting_ns()
        return TimingReport(tuple(live.timing(now_ns) for live in self._in_order()))

    def safety_stats(self) -> dict[str, Any]:
        """Return the sums of what went wrong, and each node's health."""
        lives = self._in_order()
        return {
            "budget_overruns": sum(live.counters.budget_overruns for live in lives),
            "deadline_misses": self._total_misses(),
            "watchdog_expirations": sum(live.counters.watchdog_expirations for live in lives),
            "skipped": sum(live.counters.skipped for live in lives),
            "health_states": {live.name: live.health.value for live in lives},
        }

    def capabilities(self) -> dict[str, bool]:
        """Return which real-time features are in force."""
        return {"rt_scheduling": False, "memory_locking": False, "cpu_isolation": False}

    def has_full_rt(self) -> bool:
        """Return whether nothing that was requested is missing."""
        return not self.degradations()

    def degradations(self) -> list[str]:
        """Return what was requested and could not be had, in readable sentences."""
        missing = []
        if self._spec.rt:
            missing.append("SCHED_FIFO is not part of this version - using SCHED_OTHER")
            missing.append("mlockall is not part of this version - memory pages may be swapped")
        if self._spec.cores is not None:
            missing.append("cores= is not part of this version - threads may run on any core")
        for live in self._in_order():
            if live.spec.core is not None:
                missing.append(f"node {live.name!r} is not pinned to core {live.spec.core}")
            if live.spec.priority is not None:
                missing.append(f"node {live.name!r} has no priority {live.spec.priority}")
        return missing

    # -- recording: the contract's names, refused until there is something behind them --

    def is_recording(self) -> bool:
        """Return whether the session is being recorded."""
        return False

    def stop_recording(self) -> list[str]:
        """Raise: this version does not record.

        Raises:
            StateError: Always.
        """
        raise StateError("recording is not part of this version; there is nothing to stop")

    def list_recordings(self) -> list[str]:
        """Raise: this version does not record.

        Raises:
            StateError: Always.
        """
        raise StateError("recording is not part of this version; there are no sessions to list")

    def delete_recording(self, name: str) -> None:
        """Raise: this version does not record.

        Raises:
            StateError: Always.
        """
        raise StateError(f"recording is not part of this version; there is no session {name!r}")

    # -- internals: modes ------------------------------------------------------------

    @contextlib.contextmanager
    def _running(self, *, show_logs: bool, keeps_session: bool = False) -> Iterator[None]:
        """Run the nodes in the block, from the state before to the state after."""
        self._take_charge()
        self._idle.clear()
        self._running_thread = threading.get_ident()
        try:
            with logs.visible(install=show_logs, verbose=self._spec.verbose):
                try:
                    yield
                finally:
                    self._hand_back(keeps_session=keeps_session)
        finally:
            self._running_thread = None
            self._idle.set()

    def _take_charge(self) -> None:
        """Become the one who runs the nodes."""
        with self._lock:
            if self._status == "running":
                raise StateError(
                    f"scheduler {self._spec.name!r} is already running; "
                    "stop it first, or use a second scheduler"
                )
            self._status = "running"
        self._control.begin(self._end_run)
        if not self._session_open:
            self._session_open = True
            for live in self._lives.values():
                live.renew()

    def _hand_back(self, *, keeps_session: bool) -> None:
        """Let others run the nodes again; without a session kept, they are shut down."""
        try:
            if not keeps_session or self._control.failure is not None:
                self._end_session()
        finally:
            self._control.end()
            self._status = "idle" if self._session_open else "stopped"

    def _run_loop(
        self, duration_ns: int | None, lives: list[LiveNode], *, shut_down_after: bool
    ) -> None:
        """Run on an event loop of our own."""
        self._close_stepper()
        self._runtime = runtime = self._new_runtime()
        work = runtime.run(lives, _seconds(duration_ns), shut_down_after=shut_down_after)
        try:
            with asyncio.Runner(loop_factory=_loop_factory(self._spec.loop)) as runner:
                runner.run(work)
        finally:
            self._runtime = None

    def _simulate(
        self,
        duration_ns: int | None,
        *,
        shut_down_after: bool,
        only: list[LiveNode] | None = None,
    ) -> None:
        """Run in virtual time on the calling thread."""
        simulation = self._open_stepper()
        assert isinstance(simulation, Simulation)
        until_ns = None if duration_ns is None else self._timeline.now_ns() + duration_ns
        try:
            simulation.advance(until_ns, self._stopping, only)
        finally:
            if shut_down_after:
                self._end_session()

    async def _simulate_beside_loop(self, duration_ns: int | None) -> None:
        """Run in virtual time on a thread, so that the application's loop stays free."""
        simulation = asyncio.ensure_future(
            asyncio.to_thread(self._simulate, duration_ns, shut_down_after=True)
        )
        try:
            await asyncio.shield(simulation)
        except asyncio.CancelledError:
            self._control.request_stop("cancelled")
            await asyncio.wait([simulation])
            raise

    def _new_runtime(self) -> Runtime:
        return Runtime(
            self._spec.name, self._timeline, _make_executors, self._spec.shutdown_timeout_ns
        )

    def _open_stepper(self) -> Stepper:
        if self._stepper is None:
            if self._sim_clock is None:
                self._stepper = Stepper(self._timeline)
            else:
                self._stepper = Simulation(self._timeline, self._sim_clock)
            self._stepper.start(self._in_order())
        return self._stepper

    def _close_stepper(self) -> None:
        """Go over from stepping to running; the nodes stay initialised."""
        if self._stepper is not None:
            self._stepper.close()
            self._stepper = None

    def _end_session(self) -> None:
        """Shut down what is still initialised; the next run begins with `init()` again."""
        if not self._session_open:
            return
        self._session_open = False
        stepper = self._stepper or Stepper(self._timeline)
        stepper.shut_down(self._lives.values())
        stepper.close()
        self._stepper = None
        for live in self._lives.values():
            live.counters.end_span(live.period_ns)
        with self._lock:
            streams, self._streams = self._streams, []
        for stream in streams:
            stream.close()
        clock.clear_ambient(self._timeline)

    def _end_run(self) -> None:
        if self._runtime is not None:
            self._runtime.request_stop()

    def _stopping(self) -> bool:
        return self._control.stopping

    def _raise_failure(self) -> None:
        if self._control.failure is not None:
            raise self._control.failure

    # -- internals: nodes --------------------------------------------------------------

    def _take_over(self, node: Node) -> None:
        """Take a node from the scheduler it was in before."""
        owner = node.owner
        if isinstance(owner, Scheduler) and owner is not self:
            if owner.is_running():
                raise StateError(
                    f"node {node.name!r} is in use by scheduler {owner.scheduler_name()!r}, "
                    "which is running; remove it there first"
                )
            owner.remove_node(node.name)
        node.owner = self
        node.request_stop_hook = self._control.request_stop

    def _live(self, name: str) -> LiveNode:
        try:
            return self._lives[_node_name(name)]
        except KeyError:
            raise UnknownNodeError(name, self.get_node_names()) from None

    def _chosen(self, names: Iterable[str] | None) -> list[LiveNode] | None:
        if names is None:
            return None
        if isinstance(names, str) or not isinstance(names, Iterable):
            raise ConfigError("names", names, "must be a list of node names, e.g. ['motor']")
        return [self._live(name) for name in names]

    def _in_order(self) -> list[LiveNode]:
        with self._lock:
            return sorted(self._lives.values(), key=lambda live: live.rank)

    def _total_misses(self) -> int:
        with self._lock:
            return sum(live.counters.deadline_misses for live in self._lives.values())

    def _reporting_ns(self) -> int:
        return self._timeline.now_ns() if self.is_running() else 0


def run(*nodes: Node, duration: float | None = None, **options: Any) -> None:
    """Run nodes until stopped, or for `duration` seconds [s]: the one-liner.

    Takes every keyword argument of `Scheduler`.

    Raises:
        ConfigError: An argument was refused.
        NodeError: A node with `failure_policy="fatal"` failed.
    """
    with Scheduler(**options) as scheduler:
        for node in nodes:
            scheduler.add(node)
        scheduler.run(duration)


def _node_name(name: object) -> str:
    if not isinstance(name, str):
        raise ConfigError("name", name, "must be a node's name")
    return name


def _make_executors(bridge: Bridge, cycle: Cycle) -> dict[ExecutionClass, Executor]:
    return {
        ExecutionClass.BEST_EFFORT: BestEffortExecutor(bridge, cycle),
        ExecutionClass.EVENT: EventExecutor(bridge, cycle),
        ExecutionClass.ASYNC_IO: AsyncIoExecutor(bridge, cycle),
        ExecutionClass.RT: RtExecutor(),
        ExecutionClass.COMPUTE: ComputeExecutor(cycle),
    }


def _loop_factory(kind: str) -> Any:
    if kind == "asyncio":
        return asyncio.new_event_loop
    try:
        import uvloop
    except ImportError:  # not made for Windows
        return asyncio.new_event_loop
    return uvloop.new_event_loop


def _seconds(duration_ns: int | None) -> float | None:
    return None if duration_ns is None else to_s(duration_ns)


def _refuse_in_event_loop(method: str, instead: str) -> None:
    if asyncio._get_running_loop() is not None:
        raise StateError(f"{method}() would block the event loop it is called in; use {instead}")


def _node_stats(live: LiveNode, now_ns: int) -> dict[str, Any]:
    spec, counters, timing = live.spec, live.counters, live.timing(now_ns)
    return {
        "name": live.name,
        "order": live.order,
        "execution_class": spec.execution_class.value,
        "rate": timing.rate_hz,
        "achieved_rate": timing.achieved_hz,
        "priority": spec.priority,
        "state": live.state.value,
        "health": live.health.value,
        "total_ticks": counters.ticks,
        "errors_count": counters.errors,
        "restarts": counters.restarts,
        "budget_overruns": counters.budget_overruns,
        "deadline_misses": counters.deadline_misses,
        "skipped": counters.skipped,
        "watchdog_expirations": counters.watchdog_expirations,
        "avg_tick_duration": timing.execution_avg_s,
        "p99_tick_duration": timing.execution_p99_s,
        "max_tick_duration": timing.execution_max_s,
        "p99_start_latency": timing.start_latency_p99_s,
        "max_start_latency": timing.start_latency_max_s,
    }


def _warn_of_unavailable(spec: SchedulerSpec) -> None:
    for asked, argument, consequence in (
        (spec.rt, "rt=True", "nodes run with ordinary priority; see degradations()"),
        (spec.cores, f"cores={spec.cores}", "threads may run on any core"),
        (spec.watchdog_ns, "watchdog_ms", "frozen nodes are not detected"),
        (spec.blackbox_mb, "blackbox_mb", "there is no flight recorder"),
        (spec.recording, "recording=True", "nothing is recorded"),
        (spec.telemetry, "telemetry", "no metrics are sent"),
    ):
        if asked:
            _warn_unavailable(argument, consequence)


def _warn_of_unavailable_in(spec: NodeSpec) -> None:
    where = f"of node {spec.name!r}"
    for asked, argument, consequence in (
        (spec.watchdog_ns, "watchdog", "a frozen tick is not detected"),
        (spec.priority, "priority", "its thread has ordinary priority"),
        (spec.core is not None, "core", "its thread may run on any core"),
    ):
        if asked:
            _warn_unavailable(f"{argument}= {where}", consequence)


def _warn_unavailable(argument: str, consequence: str) -> None:
    warnings.warn(
        f"{argument} is not part of this version: {consequence}", UnavailableWarning, stacklevel=4
    )
