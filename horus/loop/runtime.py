"""One run of a scheduler, from the first `init()` to the last `shutdown()`."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Callable, Coroutine, Iterable, Mapping
from concurrent.futures import Future
from typing import Any

import anyio

from horus import clock
from horus.clock import Timeline
from horus.errors import StateError
from horus.live import LiveNode
from horus.loop.bridge import Bridge
from horus.loop.cycle import Cycle
from horus.loop.executor import Executor
from horus.loop.shutdown import begin_shutdown, quiesce, shut_down
from horus.loop.supervisor import Supervisor, report_blocked_loop
from horus.spec import ExecutionClass, NodeState
from horus.units import NS_PER_MS, to_s

_HEAD_START_NS = 2 * NS_PER_MS
"""From the last `init()` to release 0 [ns]: time for every thread to be ready for it."""

MakeExecutors = Callable[[Bridge, Cycle], Mapping[ExecutionClass, Executor]]


class Runtime:
    """Owns what exists only while a scheduler runs: loop hooks, homes, supervisor.

    Thread: loop, except the methods that say otherwise.
    """

    def __init__(
        self,
        name: str,
        timeline: Timeline,
        make_executors: MakeExecutors,
        shutdown_timeout_ns: int,
    ) -> None:
        """Describe a run; nothing happens before `run`."""
        self._name = name
        self._timeline = timeline
        self._make_executors = make_executors
        self._shutdown_timeout_ns = shutdown_timeout_ns
        self._homes: dict[LiveNode, Executor] = {}
        self._stop_requested = threading.Event()
        self._stopping = threading.Event()
        self._stop_event = asyncio.Event()
        self._tasks: set[asyncio.Task[None]] = set()
        self._bridge: Bridge | None = None

    async def run(
        self, lives: Iterable[LiveNode], duration_s: float | None, *, shut_down_after: bool = True
    ) -> None:
        """Initialise the nodes, tick them until stopped, and bring them to rest.

        Args:
            lives: The nodes to begin with.
            duration_s: How long to tick [s]; None until stopped.
            shut_down_after: Whether `shutdown()` is called at the end. A timed step
                of a simulation leaves its nodes initialised for the next one.
        """
        with contextlib.ExitStack() as resources:
            self._open(resources)
            try:
                await self._initialize(sorted(lives, key=lambda live: live.rank))
                self._engage()
                await self._until_stopped(duration_s)
            finally:
                self._stopping.set()
                self._timeline.pause()
                await uninterrupted(self._finish(shut_down_after))

    # -- from anywhere ------------------------------------------------------------

    def request_stop(self) -> None:
        """End the run in order; returns at once.

        Thread: any, also a signal handler.
        """
        if self._stop_requested.is_set():
            return
        self._stop_requested.set()
        for live in tuple(self._homes):
            # At once, not when the loop gets to it: a tick that asks for a stop is
            # the last of its node.
            live.leave_service()
        if self._bridge is not None:
            self._bridge.post(self._stop_event.set)
            self._supervisor.spawn(
                report_blocked_loop(
                    self._bridge.thread_id, self._stopping, to_s(self._shutdown_timeout_ns)
                )
            )

    def add(self, live: LiveNode) -> None:
        """Initialise a node and let it tick, as soon as the loop is free.

        Thread: any.
        """
        self.bridge.post(lambda: self._spawn(self._bring_up(live)))

    def retime(self, live: LiveNode) -> None:
        """Adopt a node's changed rate.

        Thread: any.
        """

        def retime() -> None:
            home = self._homes.get(live)
            if home is not None:
                home.retime(live)

        self.bridge.run(retime)

    def remove(self, live: LiveNode) -> Future[None]:
        """Shut a node down while the others go on; done when `shutdown()` has run.

        Thread: any. Called on the loop's thread, a plain node whose home is free
        has been shut down when this returns.
        """
        removed: Future[None] = Future()

        def start() -> None:
            home = self._homes.pop(live, None)
            if home is None:
                removed.set_result(None)
                return
            home.disengage(live)

            def finish(_: object) -> None:
                live.stopped()
                removed.set_result(None)
                self.bridge.post(lambda: home.dismiss(live))

            if live.initialized:
                begin_shutdown(live, home).add_done_callback(finish)
            else:
                finish(None)

        self.bridge.run(start)
        return removed

    def is_home(self, live: LiveNode) -> bool:
        """Return whether the calling thread is the node's home.

        Thread: any.
        """
        return self._executors[live.spec.execution_class].is_home(live)

    @property
    def bridge(self) -> Bridge:
        """The way into the run's event loop."""
        if self._bridge is None:
            raise StateError("the run has not begun or is over")
        return self._bridge

    # -- the run ------------------------------------------------------------------

    def _open(self, resources: contextlib.ExitStack) -> None:
        """Acquire what the run needs; the stack gives it back in reverse."""
        # anyio loads its backend on first use, which takes tens of milliseconds:
        # now, not after the first release.
        anyio.current_effective_deadline()
        self._supervisor = Supervisor(self._name)
        self._supervisor.start()
        resources.callback(self._supervisor.close)
        bridge = Bridge(asyncio.get_running_loop())
        resources.callback(bridge.close)
        cycle = Cycle(bridge.loop, self._timeline)
        resources.callback(cycle.close)
        self._executors = self._make_executors(bridge, cycle)
        self._bridge = bridge
        if self._stop_requested.is_set():
            self._stop_event.set()

    async def _initialize(self, lives: list[LiveNode]) -> None:
        """Call `init()` of each node in order; one that fails is left out, others go on."""
        for live in lives:
            if self._stop_requested.is_set():
                return
            await self._adopt(live)

    async def _adopt(self, live: LiveNode) -> None:
        home = self._executors[live.spec.execution_class]
        self._homes[live] = home
        home.adopt(live)
        if live.state is NodeState.UNINITIALIZED:
            initialized = asyncio.wrap_future(home.call(live, "init"))
            # A stop ends the wait for an init() that hangs on another thread.
            stopped = asyncio.ensure_future(self._stop_event.wait())
            await asyncio.wait((initialized, stopped), return_when=asyncio.FIRST_COMPLETED)
            stopped.cancel()

    def _engage(self) -> None:
        """Start the release grid, and with it the ticks."""
        self._timeline.begin(self._timeline.now_ns() + _HEAD_START_NS)
        clock.set_ambient(self._timeline)
        for live in self._homes:
            self._engage_one(live)

    def _engage_one(self, live: LiveNode) -> None:
        if live.initialized and not self._stop_requested.is_set():
            self._homes[live].engage(live)

    async def _until_stopped(self, duration_s: float | None) -> None:
        if duration_s is None:
            await self._stop_event.wait()
            return
        with anyio.move_on_after(duration_s + to_s(_HEAD_START_NS)):
            await self._stop_event.wait()

    async def _bring_up(self, live: LiveNode) -> None:
        """Put a node that was added during the run into service."""
        if self._stopping.is_set():
            return
        await self._adopt(live)
        self._engage_one(live)

    async def _finish(self, shut_down_after: bool) -> None:
        if shut_down_after:
            await shut_down(self._homes, self._shutdown_timeout_ns)
            return
        await quiesce(self._homes, self._shutdown_timeout_ns)
        for live, home in self._homes.items():
            home.dismiss(live)

    def _spawn(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.ensure_future(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)


async def uninterrupted(work: Coroutine[Any, Any, None]) -> None:
    """Run `work` to its end whatever cancels the caller, then be cancelled after all.

    anyio's shield keeps away the cancellation of task groups and time limits,
    asyncio's shield a `task.cancel()`; an application may use either.
    """
    task = asyncio.ensure_future(work)
    cancelled: asyncio.CancelledError | None = None
    with anyio.CancelScope(shield=True):
        while not task.done():
            try:
                await asyncio.shield(task)
            except asyncio.CancelledError as exc:
                cancelled = exc
    task.result()
    if cancelled is not None:
        raise cancelled
