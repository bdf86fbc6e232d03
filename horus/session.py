"""Who runs the nodes now, and how: on a run loop, step by step, or simulated."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Callable, Iterator

from horus import clock, logs
from horus.clock import MonotonicClock, SimClock, Timeline
from horus.errors import NodeError, ShutdownTimeout, StateError
from horus.executors import make_executors
from horus.live import LiveNode
from horus.loop.control import RunControl
from horus.loop.private_loop import StepLoop
from horus.loop.runtime import Runtime
from horus.loop.signals import stop_on_signals
from horus.loop.simulation import Simulation
from horus.loop.stepping import Stepper
from horus.registry import Registry
from horus.spec import SchedulerSpec
from horus.stream import MessageStream
from horus.topics import Bus
from horus.units import to_s


class Session:
    """Drives a scheduler's nodes between their `init()` and their `shutdown()`.

    A session opens with the first run or step and closes with `shutdown()` of
    every node: at the end of a run, or at `close` after steps. Three things can
    drive the nodes, and never two at a time:

    - a `Runtime`: in real time, on an event loop and the nodes' own threads;
    - a `Stepper`: one cycle at a time on the calling thread;
    - a `Simulation`, which is a stepper in virtual time: deterministic mode.

    Thread: any; those who run the nodes exclude each other.
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
        self.control = RunControl(spec.max_deadline_misses, self.registry.total_misses)
        self.status = "idle"
        self._lock = threading.Lock()
        self._open = False
        self._idle = threading.Event()
        self._idle.set()
        self._driving_thread: int | None = None
        self._runtime: Runtime | None = None
        self._stepper: Stepper | None = None
        self._streams: list[MessageStream] = []

    @property
    def running(self) -> bool:
        """Whether nodes are being run."""
        return self.status == "running"

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
        with self._driving(owns_process=not keeps_open, keeps_open=keeps_open):
            if self._spec.deterministic:
                self._simulate(duration_ns, only)
                return
            runtime = self._start_runtime()
            loop = StepLoop(_loop_factory(self._spec.loop)())
            try:
                loop.run(
                    runtime.run(
                        lambda: self.registry.in_order if only is None else only,
                        duration_ns,
                        shut_down_after=not keeps_open,
                    )
                )
            finally:
                self._runtime = None
                loop.close()

    async def arun(self, duration_ns: int | None) -> None:
        """Run on the running event loop until stopped, cancelled, or for a time [ns]."""
        with self._driving(owns_process=False):
            if self._spec.deterministic:
                await self._simulate_beside_loop(duration_ns)
                return
            runtime = self._start_runtime()
            try:
                await runtime.run(lambda: self.registry.in_order, duration_ns)
            finally:
                self._runtime = None

    def step(self, only: list[LiveNode] | None) -> None:
        """Run one cycle on the calling thread; the nodes stay initialised."""
        self._take_charge()
        try:
            stepper = self._stepper or self._open_stepper()
            stepper.cycle(self._stopping, only)
        finally:
            self._hand_back(keeps_open=True)

    def stop(self, reason: str) -> None:
        """End the run in order; without one, shut down what steps have initialised."""
        if self.running:
            self.control.request_stop(reason)
            return
        self._close()
        self.status = "stopped"

    def wait_until_idle(self) -> None:
        """Wait for the end of a run on another thread."""
        if self._driving_thread != threading.get_ident():
            self._idle.wait()

    def raise_failure(self) -> None:
        """Raise what a node with `failure_policy="fatal"` has left behind."""
        failure: NodeError | None = self.control.failure
        if failure is not None:
            raise failure

    # -- nodes that come, change and go ------------------------------------------------

    def joined(self, live: LiveNode) -> None:
        """Let a node that was added take part."""
        if self._runtime is not None:
            self._runtime.add(live)
        elif self._stepper is not None:
            self._stepper.add(live)

    def retimed(self, live: LiveNode) -> None:
        """Adopt a node's changed rate."""
        if self._runtime is not None:
            self._runtime.retime(live)
        elif self._stepper is not None:
            self._stepper.retime(live)

    def leave(self, live: LiveNode) -> None:
        """Shut down a node that was removed, and wait for it unless that would wait for ourselves.

        Raises:
            ShutdownTimeout: Its tick or its `shutdown()` did not end in time.
        """
        runtime = self._runtime
        if runtime is None:
            if self._stepper is not None:
                self._stepper.remove(live)
            return
        removed = runtime.remove(live)
        if removed.done() or runtime.is_home(live):
            return
        timeout_s = to_s(self._spec.shutdown_timeout_ns)
        try:
            removed.result(timeout_s)
        except TimeoutError:
            raise ShutdownTimeout(live.name, timeout_s) from None

    def add_stream(self, stream: MessageStream) -> None:
        """End an application's stream when the session closes."""
        with self._lock:
            self._streams.append(stream)

    # -- internals ---------------------------------------------------------------------

    @contextlib.contextmanager
    def _driving(self, *, owns_process: bool, keeps_open: bool = False) -> Iterator[None]:
        """Run the nodes in the block, from the state before to the state after."""
        self._take_charge()
        self._idle.clear()
        self._driving_thread = threading.get_ident()
        with contextlib.ExitStack() as around:
            around.callback(self._become_idle)
            around.enter_context(logs.visible(install=owns_process, verbose=self._spec.verbose))
            if owns_process:
                around.enter_context(stop_on_signals(self.control.request_stop))
            around.callback(self._hand_back, keeps_open=keeps_open)
            yield

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
            # Before the status tells anybody: a stop that comes now must count.
            self.control.begin(self._end_run)
            self.status = "running"
        if not self._open:
            self._open = True
            for live in self.registry.in_order:
                live.renew()

    def _hand_back(self, *, keeps_open: bool) -> None:
        """Let others run the nodes; unless they stay initialised, they are shut down."""
        try:
            if not keeps_open or self.control.failure is not None:
                self._close()
        finally:
            self.control.end()
            self.status = "idle" if self._open else "stopped"

    def _close(self) -> None:
        """Shut down what is still initialised; the next run begins with `init()` again."""
        if not self._open:
            return
        self._open = False
        stepper = self._stepper or Stepper(self.timeline)
        stepper.shut_down(self.registry.in_order)
        self._close_stepper(stepper)
        for live in self.registry.in_order:
            live.counters.end_span(live.period_ns)
        with self._lock:
            streams, self._streams = self._streams, []
        for stream in streams:
            stream.close()
        clock.clear_ambient(self.timeline)

    def _start_runtime(self) -> Runtime:
        """Go over from steps to a run; the nodes stay as they are."""
        self._close_stepper(self._stepper)
        self._runtime = Runtime(
            self._spec.name, self.timeline, make_executors, self._spec.shutdown_timeout_ns
        )
        if self.control.stopping:
            self._runtime.request_stop()
        return self._runtime

    def _open_stepper(self) -> Stepper:
        if self._stepper is None:
            if self._sim_clock is None:
                stepper = Stepper(self.timeline)
            else:
                stepper = Simulation(self.timeline, self._sim_clock)
            stepper.start(self.registry.in_order)
            self._stepper = stepper
        return self._stepper

    def _close_stepper(self, stepper: Stepper | None) -> None:
        self._stepper = None
        if stepper is not None:
            stepper.close()

    def _simulate(self, duration_ns: int | None, only: list[LiveNode] | None) -> None:
        """Run in virtual time on the calling thread."""
        simulation = self._open_stepper()
        assert isinstance(simulation, Simulation)
        until_ns = None if duration_ns is None else self.timeline.now_ns() + duration_ns
        simulation.advance(until_ns, self._stopping, only)

    async def _simulate_beside_loop(self, duration_ns: int | None) -> None:
        """Run in virtual time on a thread, so that the application's loop stays free."""

        def simulate() -> None:
            try:
                self._simulate(duration_ns, None)
            finally:
                self._close()

        simulation = asyncio.ensure_future(asyncio.to_thread(simulate))
        try:
            await asyncio.shield(simulation)
        except asyncio.CancelledError:
            self.control.request_stop("cancelled")
            await asyncio.wait([simulation])
            raise

    def _end_run(self) -> None:
        if self._runtime is not None:
            self._runtime.request_stop()

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
