"""Who runs the nodes now, and how: on a run loop, step by step, or simulated."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from horus import clock, logs
from horus.clock import MonotonicClock, SimClock, Timeline
from horus.drivers import Drivers
from horus.errors import NodeError, ShutdownTimeout, StateError
from horus.executors import make_executors
from horus.live import LiveNode
from horus.loop.control import RunControl
from horus.loop.pacer import Pacer
from horus.loop.private_loop import StepLoop
from horus.loop.runtime import Runtime, uninterrupted
from horus.loop.simulation import Simulation
from horus.loop.stepping import Stepper
from horus.oversight import Oversight
from horus.registry import Registry
from horus.spec import SchedulerSpec
from horus.stream import MessageStream
from horus.topics import Bus, Subscription
from horus.units import to_s

if TYPE_CHECKING:
    from horus.observe.metrics import Metrics
    from horus.observe.telemetry import Telemetry
    from horus.recording.recordings import Recordings
    from horus.recording.replay import Replays


class Session:
    """Drives a scheduler's nodes between their `init()` and their `shutdown()`.

    A session opens with the first run or step and closes with `shutdown()` of
    every node: at the end of a run, or at `stop` after steps. Three things can
    drive the nodes, and never two at a time:

    - a `Runtime`: in real time, on an event loop and the nodes' own threads;
    - a `Stepper`: one cycle at a time on the calling thread;
    - a `Simulation`, which is a stepper in virtual time: deterministic mode.

    Event loop and threads stay for as long as the session does, so that what
    `init()` opened works in every `tick_for`.

    Thread: any; those who drive the nodes exclude each other.
    """

    def __init__(self, spec: SchedulerSpec) -> None:
        """Begin idle, without nodes."""
        self._spec = spec
        self.bus = Bus()
        self._sim_clock = SimClock() if spec.deterministic else None
        self.timeline = Timeline(
            self._sim_clock or MonotonicClock(),
            spec.tick_rate_hz,
            seed=spec.seed if spec.deterministic else None,
        )
        self.registry = Registry(self.bus, self.timeline)
        self._drivers = Drivers()
        self.oversight = Oversight(
            spec, self.timeline, self.registry, self._drivers, self._safe_state_entered
        )
        self.control = RunControl(spec.max_deadline_misses, self.oversight.critical_late)
        self.status = "idle"
        self.started = False
        """Whether all nodes of the present run are initialised and may tick."""
        self.runs_started = 0
        """How many runs, this one included, came so far that all nodes could tick."""
        self.runs_ended = 0
        """How many runs have ended."""
        self._lock = threading.Lock()
        self._open = False
        self._closing = False
        self._idle = threading.Event()
        self._idle.set()
        self._driving_thread: int | None = None
        self._loop: StepLoop | None = None
        self._streams: set[MessageStream] = set()
        self._recordings = self._make_recordings()
        self.pacer = Pacer()
        """Holds virtual time to real time, if asked to."""
        self._replays: Replays | None = None
        self._telemetry: Telemetry | None = None

    @property
    def open(self) -> bool:
        """Whether nodes are initialised, or are about to be."""
        return self._open

    @property
    def running(self) -> bool:
        """Whether nodes are being run."""
        return self.status == "running"

    @property
    def private_loop(self) -> asyncio.AbstractEventLoop | None:
        """The event loop of runs on a thread of the scheduler's user; None while there is none."""
        return None if self._loop is None else self._loop.loop

    def reporting_ns(self) -> int:
        """Return the instant up to which rates are reported [ns]; 0 when nothing runs."""
        return self.timeline.now_ns() if self.running else 0

    # -- running ---------------------------------------------------------------------

    def run(
        self,
        duration_ns: int | None,
        *,
        only: list[LiveNode] | None = None,
        keeps_open: bool = False,
    ) -> None:
        """Run on the calling thread until stopped or for a time.

        Args:
            duration_ns: How long [ns]; None until stopped.
            only: The nodes to run; None for all.
            keeps_open: Whether this is a step of a program that goes on: the nodes
                stay initialised, and signals and logs are left to the program.
        """
        if keeps_open:
            self._refuse_to_step_replay()
        duration_ns = self._natural_end(duration_ns)
        with self._driving(owns_process=not keeps_open, keeps_open=keeps_open):
            if self._spec.deterministic:
                self._simulate(duration_ns, only)
            else:
                runtime = self._start_runtime()
                members = self._all if only is None else lambda: only
                play = runtime.play(
                    members, duration_ns, final=not keeps_open, on_ready=self._ready
                )
                self._private_loop().run(play)

    async def arun(self, duration_ns: int | None) -> None:
        """Run on the running event loop until stopped, cancelled, or for a time [ns].

        Nodes that steps have initialised elsewhere are shut down first.
        """
        self.close_if_idle()
        duration_ns = self._natural_end(duration_ns)
        with self._driving(owns_process=False):
            if self._spec.deterministic:
                await self._simulate_beside_loop(duration_ns)
                return
            runtime = self._start_runtime()
            try:
                await runtime.play(self._all, duration_ns, final=True, on_ready=self._ready)
            except asyncio.CancelledError:
                self.control.request_stop("cancelled")
                raise
            finally:
                self.control.end()
                await runtime.close()
                self._drivers.runtime = None

    def step(self, only: list[LiveNode] | None) -> None:
        """Run one cycle on the calling thread; the nodes stay initialised."""
        self._refuse_to_step_replay()
        self._take_charge()
        self._drivers.stepping = True
        self.oversight.begin_steps()
        try:
            self._open_stepper().cycle(only)
        finally:
            self._drivers.stepping = False
            self._hand_back(keeps_open=True)

    def stop(self, reason: str) -> None:
        """End the run in order; without one, shut down what steps have initialised."""
        if self.running:
            self.control.request_stop(reason)
        else:
            self.close_if_idle()
            self.status = "stopped"

    def close_if_idle(self) -> None:
        """Shut the nodes down, unless they are being run or shut down already."""
        with self._lock:
            if self.running or self._closing:
                return
            self._closing = True
        try:
            self._close()
        finally:
            self._closing = False

    def wait_until_idle(self) -> None:
        """Wait for the end of a run on another thread."""
        if self._driving_thread != threading.get_ident():
            self._idle.wait()

    def raise_failure(self) -> None:
        """Raise what a node with `failure_policy="fatal"` has left behind."""
        failure: NodeError | None = self.control.failure
        if failure is not None:
            raise failure

    # -- recording -----------------------------------------------------------------------

    @property
    def recording(self) -> bool:
        """Whether what happens is being recorded."""
        return self._recordings is not None and self._recordings.active

    def stop_recording(self) -> list[Path]:
        """Record no more of this session; return its files, or those of the last one."""
        return [] if self._recordings is None else self._recordings.stop()

    @property
    def replays(self) -> Replays:
        """The recordings that are replayed."""
        if self._replays is None:
            from horus.recording.replay import Replays  # it loads several libraries

            self._replays = Replays(self.timeline, self.pacer)
        return self._replays

    @property
    def replaying(self) -> bool:
        """Whether something is left to replay."""
        return self._replays is not None and self._replays.active

    def discard_stand_in(self, name: str) -> bool:
        """Replay a node no more; return whether it was replayed."""
        return self._replays is not None and self._replays.discard(name)

    def _refuse_to_step_replay(self) -> None:
        if self.replaying and not self._spec.deterministic:
            raise StateError("a replay is run step by step in deterministic mode only")

    def _replay_begins(self) -> None:
        if self._replays is not None:
            begins_ns = self._replays.begin()
            if self._sim_clock is not None:
                self._sim_clock.advance_to(begins_ns)

    def _natural_end(self, duration_ns: int | None) -> int | None:
        """Return how long to run [ns]: as long as the recording whose time this is."""
        if duration_ns is None and self._replays is not None and self._replays.rules_time:
            return self._replays.length_ns()
        return duration_ns

    def dump_blackbox(self, reason: str) -> Path:
        """Write what the flight recorder has; return its file.

        Raises:
            StateError: There is none, or nothing runs.
            RecordingError: It cannot be written.
        """
        if self._recordings is None:
            raise StateError("there is no flight recorder: it needs blackbox_mb=")
        return self._recordings.dump(reason)

    def _dump_blackbox_soon(self, reason: str) -> None:
        if self._recordings is not None:
            self._recordings.dump_soon(reason)

    def _safe_state_entered(self, reason: str) -> None:
        if self._recordings is not None:
            self._recordings.safe_state_entered(reason)

    def _make_recordings(self) -> Recordings | None:
        if not (self._spec.recording or self._spec.blackbox_mb):
            return None
        from horus.recording.recordings import Recordings  # it loads several libraries

        return Recordings(self._spec, self.timeline, self.bus)

    # -- metrics -------------------------------------------------------------------------

    def metrics(self) -> Metrics:
        """Return what takes snapshots of the counters."""
        from horus.observe.metrics import Metrics

        safety = self.oversight.safety
        return Metrics(
            self._spec,
            self.timeline,
            self.registry,
            self.bus,
            lambda: safety.reason,
            self.reporting_ns,
        )

    def _start_telemetry(self) -> None:
        if self._spec.telemetry is not None:
            from horus.observe.telemetry import Telemetry  # it loads an HTTP library

            self._telemetry = Telemetry(self._spec.telemetry, self.metrics())
            self._telemetry.start()

    # -- nodes that come, change and go ------------------------------------------------

    def joined(self, live: LiveNode) -> None:
        """Let a node that was added take part: now, or from the next run or step on."""
        self.oversight.watch(live)
        if self._recordings is not None:
            self._recordings.join(live)
        runtime, stepper = self._drivers.runtime, self._drivers.stepper
        if self.running and runtime is not None:
            runtime.add(live)
        elif self.running and stepper is not None:
            stepper.add(live)

    def retimed(self, live: LiveNode) -> None:
        """Adopt a node's changed rate."""
        if self._recordings is not None:
            self._recordings.describe(live)
        for driver in (self._drivers.runtime, self._drivers.stepper):
            if driver is not None:
                driver.retime(live)

    def leave(self, live: LiveNode) -> None:
        """Shut down a node that was removed, and wait for it unless that would wait for ourselves.

        Raises:
            ShutdownTimeout: Its tick or its `shutdown()` did not end in time.
        """
        live.removed = True
        runtime, stepper = self._drivers.runtime, self._drivers.stepper
        # While a step is taken, a runtime stands still, and the stepper sees to it.
        if runtime is not None and not (self.running and self._drivers.stepping):
            self._wait_for(live, runtime)
        if stepper is not None:
            stepper.remove(live)
        if not live.initialized and not live.ticking:
            live.core.disconnect()

    def open_stream(self, subscription: Subscription) -> MessageStream:
        """Return a stream that ends with the session."""
        stream = MessageStream(subscription, self._streams.discard)
        self._streams.add(stream)
        return stream

    # -- internals ---------------------------------------------------------------------

    @contextlib.contextmanager
    def _driving(self, *, owns_process: bool, keeps_open: bool = False) -> Iterator[None]:
        """Run the nodes in the block, from the state before to the state after."""
        with contextlib.ExitStack() as around:
            # Before anything is recorded: that adds a handler, which shows nobody anything.
            around.enter_context(logs.visible(install=owns_process, verbose=self._spec.verbose))
            self._take_charge()
            self._idle.clear()
            self._driving_thread = threading.get_ident()
            around.callback(self._become_idle)
            if owns_process:
                around.enter_context(
                    self.oversight.owning_process(
                        self.control.request_stop, self._dump_blackbox_soon
                    )
                )
            around.callback(self._hand_back, keeps_open=keeps_open)
            try:
                yield
            except KeyboardInterrupt:
                self.control.request_stop("KeyboardInterrupt")
                raise

    def _become_idle(self) -> None:
        self._driving_thread = None
        self._idle.set()

    def _take_charge(self) -> None:
        """Become the one who runs the nodes.

        Raises:
            StateError: Somebody else does.
        """
        with self._lock:
            if self.status == "running":
                raise StateError(
                    f"scheduler {self._spec.name!r} is already running; "
                    "stop it first, or use a second scheduler"
                )
            if self._drivers.runtime is not None:
                self._drivers.runtime.rearm()
            # Before the status tells anybody: a stop that comes now must count.
            self.control.begin(self._end_run)
            self.status = "running"
        if not self._open:
            self._open = True
            self.oversight.safety.reset()
            self.registry.renew()
            self._replay_begins()
            if self._recordings is not None:
                self._recordings.begin(self.registry.in_order)
            self._start_telemetry()

    def _hand_back(self, *, keeps_open: bool) -> None:
        """Let others run the nodes; unless they stay initialised, they are shut down."""
        self.control.end()
        self.oversight.tell_manager("STOPPING=1")
        try:
            if not keeps_open or self.control.failure is not None:
                self._close()
        finally:
            self.status = "idle" if self._open else "stopped"
            self.started = False
            self.runs_ended += 1

    def _close(self) -> None:
        """Shut down what is still initialised; the next run begins with `init()` again."""
        if not self._open:
            return
        self._open = False
        try:
            if self._drivers.runtime is not None:
                self._private_loop().run(self._drivers.runtime.close())
        finally:
            self._drivers.runtime = None
            stepper = self._drivers.stepper or self._make_stepper()
            self._drivers.stepper = None
            stepper.shut_down(self.registry.in_order)
            stepper.close()
            self.oversight.close()
            if self._loop is not None:
                self._loop.close()
                self._loop = None
            for live in self.registry.in_order:
                live.counters.end_span(live.period_ns)
            for stream in tuple(self._streams):
                stream.close()
            if self._telemetry is not None:
                self._telemetry.stop()
                self._telemetry = None
            if self._recordings is not None:
                self._recordings.close(self.control.fault)
            clock.clear_ambient(self.timeline)

    def _all(self) -> tuple[LiveNode, ...]:
        return self.registry.in_order

    def _private_loop(self) -> StepLoop:
        if self._loop is None:
            self._loop = StepLoop(_loop_factory(self._spec.loop)())
        return self._loop

    def _start_runtime(self) -> Runtime:
        runtime = self._drivers.runtime
        if runtime is None:
            runtime = self._drivers.runtime = Runtime(
                self.timeline,
                self.oversight.real_time,
                self.oversight.supervisor(),
                self.oversight.safety,
                make_executors,
                self._spec.shutdown_timeout_ns,
            )
        self.oversight.keep_manager_informed()
        runtime.way_out = self.oversight.way_out
        if self.control.stopping:
            runtime.request_stop()
        return runtime

    def _open_stepper(self) -> Stepper:
        stepper = self._drivers.stepper
        if stepper is None:
            stepper = self._drivers.stepper = self._make_stepper()
        if stepper.take_on(self.registry.in_order):
            self.oversight.look_again()
            if self._recordings is not None:
                self._recordings.run_begins()
        return stepper

    def _make_stepper(self) -> Stepper:
        safety = self.oversight.safety
        if self._sim_clock is None:
            return Stepper(self.timeline, self._private_loop, self._stopping, safety)
        inspector = self.oversight.inspector()
        return Simulation(
            self.timeline, self._sim_clock, self._stopping, safety, inspector, self.pacer
        )

    def _ready(self) -> None:
        if self._recordings is not None:
            self._recordings.run_begins()
        if not self.control.stopping:
            self.started = True
            self.runs_started += 1
        self.oversight.tell_manager("READY=1")

    def _simulate(self, duration_ns: int | None, only: list[LiveNode] | None) -> None:
        """Run in virtual time on the calling thread."""
        simulation = self._open_stepper()
        assert isinstance(simulation, Simulation)
        self._ready()
        until_ns = None if duration_ns is None else self.timeline.now_ns() + duration_ns
        simulation.advance(until_ns, only)

    async def _simulate_beside_loop(self, duration_ns: int | None) -> None:
        """Run in virtual time on a thread, so that the application's loop stays free."""

        def simulate() -> None:
            try:
                self._simulate(duration_ns, None)
            finally:
                self.control.end()
                self._close()

        simulation = asyncio.get_running_loop().run_in_executor(None, simulate)

        async def watch() -> None:
            await asyncio.wait([simulation])

        try:
            await asyncio.shield(simulation)
        except asyncio.CancelledError:
            self.control.request_stop("cancelled")
            await uninterrupted(watch)
            raise

    def _wait_for(self, live: LiveNode, runtime: Runtime) -> None:
        """Wait until a node has left the runtime."""
        removed = runtime.remove(live)
        if not self.running and not removed.done():
            # Between two runs the loop stands still unless we run it.
            self._private_loop().run(runtime.depart(removed))
        if removed.done() or runtime.is_home(live):
            return
        timeout_s = 3 * to_s(self._spec.shutdown_timeout_ns)
        try:
            removed.result(timeout_s)
        except TimeoutError:
            raise ShutdownTimeout(live.name, timeout_s) from None

    def _end_run(self) -> None:
        self.oversight.tell_manager("STOPPING=1")
        runtime = self._drivers.runtime
        if runtime is not None:
            runtime.request_stop()

    def _stopping(self) -> bool:
        return self.control.stopping


def _loop_factory(kind: str) -> Callable[[], asyncio.AbstractEventLoop]:
    if kind == "asyncio":
        return asyncio.new_event_loop
    try:
        import uvloop
    except ImportError:  # not made for Windows
        return asyncio.new_event_loop
    return uvloop.new_event_loop
