"""The composition root: `Scheduler`, and `run` for programs that need no more."""

from __future__ import annotations

import asyncio
import os
import threading
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from horus import embedding
from horus.core import NodeCore, core_of
from horus.errors import ConfigError, StateError
from horus.loop.realtime import capabilities
from horus.node import Node
from horus.ports import DEFAULT_CAPACITY
from horus.registry import node_stats
from horus.session import Session
from horus.spec import make_scheduler_spec
from horus.stats import TimingReport
from horus.stream import MessageStream
from horus.topics import Publisher
from horus.units import to_s
from horus.validation import (
    check_count,
    check_duration,
    check_speed,
    check_topic,
    optional_duration,
)

if TYPE_CHECKING:
    from horus.live import LiveNode
    from horus.recording.sessions import RecordedSession

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
        recording: bool | str | os.PathLike[str] = False,
        recording_backpressure: str = "drop",
        name: str | None = None,
        cores: Iterable[int] | None = None,
        max_deadline_misses: int | None = None,
        verbose: bool = False,
        telemetry: str | None = None,
        loop: str = "uvloop",
        shutdown_timeout: float = 3.0,
        spin_us: float | None = None,
        seed: int = 0,
    ) -> None:
        """Configure a scheduler; nothing runs yet.

        Args:
            tick_rate: Cycles per second [Hz]: what `horus.tick()` counts and
                `tick_once()` advances by. Match it to the fastest node.
            rt: Ask for SCHED_FIFO, locked memory and no garbage collection in ticks;
                `degradations()` tells what was refused.
            deterministic: Run in virtual time on one thread, reproducibly.
            blackbox_mb: Size of the flight recorder [MB]; 0 for none. It keeps the latest of
                what `recording` records in a file of that size, and writes it to a session
                on a fatal stop, when a critical node freezes, on SIGUSR2 during `run()`, by
                `dump_blackbox()`, and at the next start if the process dies.
            watchdog_ms: Timeout after which a tick counts as frozen [ms]; 0 for never.
                See `add_critical_node` and `Node(watchdog=)`.
            recording: Record every session: True, or the directory where its files go.
                Without one, `HORUS_HOME`/recordings or the user's data directory.
            recording_backpressure: What happens to what is recorded faster than it can be
                written: `"drop"` loses and counts it, with `"block"` BestEffort nodes wait.
            name: For logs and reports; `"horus"` when not given.
            cores: CPU cores to run on.
            max_deadline_misses: Stop after this many misses in all; None for no limit.
            verbose: Log at debug level and print the timing report after `run()`.
            telemetry: Endpoint URL for metrics, every second: `http(s)://host/path` is sent
                JSON, `otlp+http(s)://host:4318` OTLP/JSON; `file:///path.jsonl` grows by a
                line; `prometheus://host:port` serves `/metrics`, on loopback if there is
                no host.
            loop: The event loop of `run()`: `"uvloop"` or `"asyncio"`.
            shutdown_timeout: How long each node's shutdown may take [s].
            spin_us: How much early an Rt thread may wake up, to have the interpreter at
                its release [us]. It wakes early by the delay of its latest wake-ups,
                at most this much and a quarter of its period. 0 for never; None for
                200 with `rt=True`, else 0.
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
            recording_backpressure=recording_backpressure,
            name=name,
            cores=cores,
            max_deadline_misses=max_deadline_misses,
            verbose=verbose,
            telemetry=telemetry,
            loop=loop,
            shutdown_timeout=shutdown_timeout,
            spin_us=spin_us,
            seed=seed,
        )
        self._session = Session(self._spec)
        self._registry = self._session.registry
        self._bus = self._session.bus
        self._publish_lock = threading.Lock()
        self._publishers: dict[Any, Publisher] = {}
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
        core = core_of(node)
        self._take_over(core)
        self._put_in(node, self._make_way(core.spec.name))
        return self

    def remove_node(self, name: str) -> bool:
        """Shut a node down and remove it; return whether it existed.

        `shutdown()` has run when this returns, except for a node that removes
        itself and for an async node removed by a callback on the event loop: they
        are shut down as soon as their tick has ended. While the whole run shuts
        down, the node has its turn there.

        Raises:
            ShutdownTimeout: The node's tick or `shutdown()` did not end in time.
        """
        live = self._registry.remove(name)
        if live is None:
            return False
        live.core.owner = None
        self._session.leave(live)
        return True

    def set_node_rate(self, name: str, rate: float) -> None:
        """Change a node's rate [Hz]; automatic budget and deadline follow.

        Raises:
            UnknownNodeError: There is no such node.
            ConfigError: The rate is refused, or the node is an event node.
        """
        live = self._registry.get(name)
        if live.trigger is not None:
            raise ConfigError("rate", rate, f"{name!r} is released by messages, not by a rate")
        if live.core.releases_ns is not None:
            raise ConfigError("rate", rate, f"{name!r} is replayed as it was recorded")
        live.apply(live.spec.with_rate(rate))
        self._session.retimed(live)

    def set_tick_budget(self, name: str, budget_us: float) -> None:
        """Change a node's budget; the argument is in microseconds [us].

        Raises:
            UnknownNodeError: There is no such node.
            ConfigError: The budget is refused.
        """
        live = self._registry.get(name)
        live.apply(live.spec.with_budget_ns(check_duration("budget_us", budget_us, "microseconds")))

    def add_critical_node(self, name: str, timeout_ms: float) -> None:
        """Mark a node as safety-critical, with a watchdog timeout of its own [ms].

        A tick of it that is due or running for longer puts the whole system in its safe
        state: the safe-state hook of every node is called, in shutdown order, and nodes
        that have one do not tick until `clear_safe_state()`.

        Raises:
            UnknownNodeError: There is no such node.
            ConfigError: The timeout is refused.
        """
        live = self._registry.get(name)
        live.make_critical(check_duration("timeout_ms", timeout_ms, "milliseconds"))
        self._session.oversight.watch(live)

    def clear_safe_state(self) -> list[str]:
        """Let the nodes tick again that the safe state or their isolation has taken out.

        Returns:
            The names of nodes that cannot yet: an isolated one whose tick still does
            not end, or one whose safe-state hook has not returned. Call it again later.

        Raises:
            StateError: A critical node is still frozen; nothing has changed.

        Thread: any, but not a signal handler: it takes locks, and waits up to 0.1 s for
        each hook that is just being called.
        """
        return self._session.oversight.clear_safe_state()

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
        self._session.run(duration_ns)
        try:
            if self._spec.verbose:
                print(self.timing_report())
        finally:  # stdout may be closed
            self._session.raise_failure()

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
        await self._session.arun(duration_ns)
        self._session.raise_failure()

    def stop(self, reason: str | None = None) -> None:
        """End the run in order; returns at once, from any thread, callback or signal handler.

        When nothing runs, nodes that `tick_once` or `tick_for` have initialised
        are shut down here and now.
        """
        self._session.stop(reason or "stop() was called")

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
        self._session.step(self._registry.choose(names))
        self._session.raise_failure()

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
        chosen = self._registry.choose(names)
        if not self._spec.deterministic:
            _refuse_in_event_loop("tick_for", "await sched.arun(duration)")
        self._session.run(duration_ns, only=chosen, keeps_open=True)
        self._session.raise_failure()

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
        self._session.wait_until_idle()

    async def __aenter__(self) -> Self:
        """Start running in the background of the event loop."""
        self._background = asyncio.ensure_future(self.arun())
        try:
            await asyncio.sleep(0)
        except BaseException:
            await self.__aexit__(None, None, None)
            raise
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

    async def started(self) -> None:
        """Wait until every node of the run, or of the next one, is initialised and may tick.

        Raises:
            StateError: The run ended before; its reason is in the message.

        Thread: that of an asyncio event loop, whichever runs the nodes.
        """
        await embedding.started(self._session)

    async def wait_node(self, name: str, ticks: int = 1) -> None:
        """Wait until a node has completed `ticks` ticks in all, as in its `total_ticks`.

        Raises:
            UnknownNodeError: There is no such node, or it was removed.
            ConfigError: `ticks` is no whole number above 0.
            StateError: The run ended before, or the node's `init()` failed.

        Thread: that of an asyncio event loop, whichever runs the nodes.
        """
        await embedding.ticked(self._session, name, check_count("ticks", ticks, least=1))

    # -- topics, for the application -------------------------------------------------

    def publish(self, topic: str | type, message: Any) -> None:
        """Send a message to the nodes, as they do among themselves.

        Raises:
            TopicError: The topic or the message was refused.
        """
        if not isinstance(topic, str | type):
            check_topic(topic)
        with self._publish_lock:
            publisher = self._publishers.get(topic)
            if publisher is None:
                publisher = self._bus.topic(topic).publisher(_APPLICATION)
                self._publishers[topic] = publisher
        # Copied outside the lock: a large message must not hold up a small one.
        frozen = publisher.isolate(message)
        with self._publish_lock:
            publisher.deliver(frozen)

    def subscribe(self, topic: str | type, capacity: int = DEFAULT_CAPACITY) -> MessageStream:
        """Return the messages of a topic from now on: `async for message in stream`.

        Raises:
            TopicError: The topic name was refused.
        """
        subscription = self._bus.subscribe(topic, _APPLICATION, capacity)
        return self._session.open_stream(subscription)

    async def request(
        self, topic: str | type, message: Any, *, reply: str | type, timeout: float | None = None
    ) -> Any:
        """Send a message and return the first one that is then sent on the topic `reply`.

        There is nothing in it that ties the two together: with several who ask at once,
        put a number into the message that the answer repeats, and use `subscribe`.

        Args:
            topic: Where to send it.
            message: What to send.
            reply: Where the answer comes.
            timeout: How long to wait [s]; None for as long as the run goes on.

        Raises:
            TimeoutError: There was no answer in time.
            TopicError: A topic or the message was refused.
            StateError: The run ended before.

        Thread: that of an asyncio event loop, whichever runs the nodes.
        """
        timeout_ns = optional_duration("timeout", timeout)
        with self.subscribe(reply) as replies:
            self.publish(topic, message)
            return await embedding.answer(replies, None if timeout_ns is None else to_s(timeout_ns))

    # -- introspection ----------------------------------------------------------------

    def status(self) -> str:
        """Return `"idle"`, `"running"` or `"stopped"`."""
        return self._session.status

    def is_running(self) -> bool:
        """Return whether nodes are being run."""
        return self._session.running

    def current_tick(self) -> int:
        """Return the current cycle number."""
        return self._session.timeline.current_cycle()

    def scheduler_name(self) -> str:
        """Return the name."""
        return self._spec.name

    @property
    def stop_reason(self) -> str | None:
        """Why the last run ended; None if its time was simply over."""
        return self._session.control.stop_reason

    def get_node_count(self) -> int:
        """Return how many nodes there are."""
        return len(self._registry.in_order)

    def get_node_names(self) -> list[str]:
        """Return the nodes' names in execution order."""
        return self._registry.names()

    def has_node(self, name: str) -> bool:
        """Return whether there is a node of that name."""
        return name in self._registry

    def get_node_info(self, name: str) -> int:
        """Return a node's execution order.

        Raises:
            UnknownNodeError: There is no such node.
        """
        return self._registry.get(name).order

    def get_node_stats(self, name: str) -> dict[str, Any]:
        """Return a node's configuration, state and counters; durations in seconds.

        Raises:
            UnknownNodeError: There is no such node.
        """
        return node_stats(self._registry.get(name), self._session.reporting_ns())

    def get_all_nodes(self) -> list[dict[str, Any]]:
        """Return every node's stats, in execution order."""
        now_ns = self._session.reporting_ns()
        return [node_stats(live, now_ns) for live in self._registry.in_order]

    def timing_report(self) -> TimingReport:
        """Return how well each node has kept its schedule; `str()` of it is a table."""
        return self._registry.timing_report(self._session.reporting_ns())

    def safety_stats(self) -> dict[str, Any]:
        """Return the sums of what went wrong, each node's health, and the safe state's reason."""
        stats = self._registry.safety_stats()
        stats["safe_state"] = self._session.oversight.safety.active
        stats["safe_state_reason"] = self._session.oversight.safety.reason
        return stats

    @property
    def fault_log(self) -> Path | None:
        """The file for the stacks of all threads, should Python itself stand still.

        With a watchdog, `faulthandler` writes them there, from C, when supervision has
        not run for two of the shortest timeouts, and for 1 s at least: an extension
        computes without releasing the interpreter. None while there is no such file;
        it goes away after the run if nothing was written to it.
        """
        return self._session.oversight.fault_log.path

    def capabilities(self) -> dict[str, Any]:
        """Return what real-time features this process may have, and facts about the machine.

        `rt_scheduling`: SCHED_FIFO is permitted. `memory_locking`: mlockall is.
        `cpu_isolation`: the kernel keeps cores free, listed in `isolated_cores`.
        Further `cores`, `preempt_rt` and `kernel`.
        """
        return capabilities()

    def has_full_rt(self) -> bool:
        """Return whether nothing that was requested was refused."""
        return not self.degradations()

    def degradations(self) -> list[str]:
        """Return what was requested and refused, in readable sentences."""
        return self._session.oversight.real_time.degradations()

    def metrics_text(self) -> str:
        """Return all counters in Prometheus' text format, for an endpoint of your own.

        Thread: any.
        """
        from horus.observe.metrics import prometheus_text

        return prometheus_text([self._session.metrics().snapshot()])

    # -- recording -------------------------------------------------------------------

    def is_recording(self) -> bool:
        """Return whether what happens is being recorded."""
        return self._session.recording

    def stop_recording(self) -> list[Path]:
        """Record no more of this run; return its files.

        After a run, the files of that run; without `recording=`, none.
        """
        return self._session.stop_recording()

    def list_recordings(self) -> list[RecordedSession]:
        """Return the names of all recorded sessions, the oldest first.

        Also those of other programs, and those that have no end because their process
        died: each is a `str` with `path`, and a `state` of `"finished"`, `"recording"`
        or `"unfinished"`.
        """
        from horus.recording import sessions

        return sessions.sessions(self._recordings_directory())

    def delete_recording(self, name: str) -> None:
        """Delete a recorded session.

        Raises:
            RecordingError: It is no name of a session, there is no such session, or it is
                being recorded.
        """
        from horus.recording import sessions

        sessions.delete(name, self._recordings_directory())

    def dump_blackbox(self, reason: str | None = None) -> Path:
        """Write what the flight recorder has to a session of its own; return its file.

        Raises:
            StateError: There is none, or nothing runs: without `blackbox_mb=`, say.
            RecordingError: It cannot be written: the disk is full, say.

        Thread: any, but a callback waits for the disk.
        """
        return self._session.dump_blackbox(reason or "dump_blackbox() was called")

    # -- replay ------------------------------------------------------------------------

    @classmethod
    def replay_from(
        cls,
        path: str | os.PathLike[str],
        nodes: Iterable[str] | None = None,
        *,
        topics: Iterable[str] | None = None,
        classes: Iterable[type] = (),
        **options: Any,
    ) -> Self:
        """Return a scheduler that re-runs a recorded session, in virtual time.

        It has the cycles, the clock and the seed of the recording, and `run()` ends
        where that ends. Time passes as it did, unless `set_replay_speed` says otherwise.
        A node that is added takes the place of the recorded one of its name.

        Args:
            path: The recording; one whose process has died is recovered first.
            nodes: Only what these have sent; None for all.
            topics: Only what was sent on these; None for all.
            classes: Classes that messages are made of, if they are neither dataclasses
                nor Structs, named tuples or enumerations that are imported.
            options: Keyword arguments of `Scheduler`.

        Raises:
            ConfigError: An argument was refused.
            RecordingError: The file is no recording, is damaged, or lacks a node or a topic;
                or its messages are of classes that may not come back.
        """
        from horus.recording.recovery import open_recording

        with open_recording(path) as reader:
            about = reader.about
        recorded = {
            "tick_rate": about["tick_rate_hz"],
            "seed": about["seed"],
            "name": about["name"],
            "deterministic": True,
        }
        scheduler = cls(**{**recorded, **options})
        scheduler._session.replays.rules_time = True
        scheduler.set_replay_speed(1.0)
        return scheduler.add_replay(path, nodes, topics=topics, classes=classes)

    def add_replay(
        self,
        path: str | os.PathLike[str],
        nodes: Iterable[str] | None = None,
        *,
        topics: Iterable[str] | None = None,
        classes: Iterable[type] = (),
    ) -> Self:
        """Add stand-ins for nodes of a recording, which send again what those have sent.

        The recording begins where the run does, or now while one is in progress. What is
        replayed is kept in memory. Arguments and errors as for `replay_from`.

        Raises:
            ConfigError: Also: a node of the same name is here already.
        """
        stand_ins = self._session.replays.load(path, nodes, topics, classes)
        for stand_in in stand_ins:
            if stand_in.node.name in self._registry:
                raise ConfigError(
                    "nodes",
                    stand_in.node.name,
                    "is here already; remove it, or replay other nodes or topics",
                )
        for stand_in in stand_ins:
            self._session.replays.adopt(stand_in, now=self._session.open)
            self._put_in(stand_in.node)
        return self

    def start_at_tick(self, cycle: int) -> None:
        """Begin the replay with this cycle of the recording; call it before the run.

        With `replay_from`, `horus.tick()` and the clock begin there, too.

        Raises:
            RecordingError: The recording ends before.
            StateError: Nothing is replayed, or it runs already.
        """
        self._refuse_while_running("start_at_tick")
        self._session.replays.select(start=check_count("cycle", cycle))

    def stop_at_tick(self, cycle: int) -> None:
        """End the replay before this cycle of the recording; call it before the run.

        Raises:
            RecordingError: The recording ends before.
            StateError: Nothing is replayed, or it runs already.
        """
        self._refuse_while_running("stop_at_tick")
        self._session.replays.select(stop=check_count("cycle", cycle))

    def set_replay_speed(self, speed: float) -> None:
        """Replay slower or faster than recorded: 0.01 to 100 times, or `math.inf`.

        In deterministic mode virtual time passes at this speed, `math.inf` (as fast as
        possible) unless this is called; it may change while running. In real time
        it is set before the run, to a finite speed.

        Raises:
            ConfigError: The speed is refused.
            StateError: In real time, while running.
        """
        self._session.replays.set_speed(check_speed(speed), running=self._session.running)

    def set_replay_override(self, topic: str, override: Any) -> None:
        """Replay something else on a topic: a value, or what a function makes of each message.

        The function gets the recorded message and returns another; None sends nothing.
        """
        self._session.replays.override(check_topic(topic), override)

    def is_replaying(self) -> bool:
        """Return whether something is left to replay."""
        return self._session.replaying

    def _recordings_directory(self) -> Path:
        from horus.recording import sessions

        return self._spec.recording_directory or sessions.default_directory()

    # -- internals -------------------------------------------------------------------

    def _put_in(self, node: Node, sequence: int | None = None) -> LiveNode:
        live = self._registry.add(node, self._session.control, sequence)
        live.core.owner = self
        live.core.request_stop = self._session.control.request_stop
        self._session.joined(live)
        return live

    def _make_way(self, name: str) -> int | None:
        """Remove what stands in for a node; return its place in execution order."""
        if name not in self._registry or not self._session.discard_stand_in(name):
            return None
        sequence = self._registry.get(name).sequence
        self.remove_node(name)
        return sequence

    def _refuse_while_running(self, method: str) -> None:
        if self._session.running:
            raise StateError(f"{method}() must be called before the run")

    def _take_over(self, core: NodeCore) -> None:
        """Take a node from the scheduler it was in before."""
        owner = core.owner
        if isinstance(owner, Scheduler) and owner is not self:
            if owner.is_running():
                raise StateError(
                    f"node {core.spec.name!r} is in use by scheduler {owner.scheduler_name()!r}, "
                    "which is running; remove it there first"
                )
            owner.remove_node(core.spec.name)


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


def _refuse_in_event_loop(method: str, instead: str) -> None:
    if asyncio._get_running_loop() is not None:
        raise StateError(f"{method}() would block the event loop it is called in; use {instead}")
