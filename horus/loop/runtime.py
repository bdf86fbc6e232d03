"""One run of a scheduler, from the first `init()` to the last `shutdown()`."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import threading
from collections import deque
from collections.abc import Callable, Coroutine, Iterable, Mapping
from concurrent.futures import Future
from typing import Any

import anyio

from horus import clock
from horus.clock import Timeline
from horus.live import LiveNode
from horus.loop.bridge import Bridge
from horus.loop.cycle import Cycle
from horus.loop.ending import Ending, WayOut
from horus.loop.executor import Executor, Home
from horus.loop.gil import prompt_switching
from horus.loop.realtime import RealTime
from horus.loop.safety import Safety
from horus.loop.shutdown import (
    begin_shutdown,
    hook_over,
    leave_behind,
    quiesce,
    shut_down,
    shut_down_without_loop,
)
from horus.loop.supervisor import Supervisor
from horus.spec import ExecutionClass, NodeState
from horus.units import NS_PER_MS, to_s

_HEAD_START_NS = 2 * NS_PER_MS
"""From the last `init()` to release 0 [ns]: time for every thread to be ready for it."""

MakeExecutors = Callable[[Bridge, Cycle, RealTime], Mapping[ExecutionClass, Executor]]
Members = Callable[[], Iterable[LiveNode]]


class Runtime:
    """Owns what real-time runs need: loop hooks and the nodes' homes.

    `play` runs the nodes for a while, again and again if need be; their homes,
    and what `init()` opened in them, stay until `close`.

    Thread: loop, except the methods that say otherwise. Those only leave a note
    (`_post`) for the loop, which alone decides who takes part.
    """

    def __init__(
        self,
        timeline: Timeline,
        real_time: RealTime,
        supervisor: Supervisor,
        safety: Safety,
        make_executors: MakeExecutors,
        shutdown_timeout_ns: int,
    ) -> None:
        """Describe runs; nothing happens before `play`."""
        self._timeline = timeline
        self._real_time = real_time
        self._supervisor = supervisor
        self._safety = safety
        self._make_executors = make_executors
        self._shutdown_timeout_ns = shutdown_timeout_ns
        self.way_out: WayOut | None = None
        """What can be done about a callback that blocks the loop, if anything."""
        self._resources = contextlib.ExitStack()
        self._homes: dict[LiveNode, Executor] = {}
        self._stuck: set[LiveNode] = set()
        self._joining: deque[LiveNode] = deque()
        self._playing = False
        self._closing = False
        self._stop_requested = False
        self._ending: Ending | None = None
        self._stop_event = asyncio.Event()
        self._tasks: set[asyncio.Task[None]] = set()
        # Re-entrant: a signal handler that stops the run may interrupt `_post`.
        self._lock = threading.RLock()
        self._bridge: Bridge | None = None
        self._over = False
        self._notes: deque[Callable[[], None]] = deque()

    async def play(
        self,
        members: Members,
        duration_ns: int | None,
        *,
        final: bool,
        on_ready: Callable[[], None],
    ) -> None:
        """Initialise the nodes that are new, and tick until stopped or for a time.

        Args:
            members: Tells the nodes that take part.
            duration_ns: How long to tick [ns]; None until stopped.
            final: Whether `close` comes next, so that async ticks need not end in peace.
            on_ready: Called when every node is initialised and may tick.
        """
        bridge = self._bridge or self._open()
        bridge.attach()
        self._ending = self._supervisor.see_end(bridge, self.request_stop, self.way_out)
        try:
            with contextlib.ExitStack() as while_playing:
                await self._initialize(members())
                # Time for the watch to get ready: collecting garbage takes a while.
                self._supervisor.look_again()
                while_playing.enter_context(self._real_time.in_process())
                if any(live.spec.execution_class is ExecutionClass.RT for live in self._homes):
                    while_playing.enter_context(prompt_switching())
                self._engage(set(members()), duration_ns)
                on_ready()
                await self._until_stopped()
        finally:
            self._playing = False
            self._timeline.pause()
            await uninterrupted(functools.partial(self._pause, cancel=final))
            self._ending.over()
            bridge.detach()

    async def depart(self, removed: Future[None]) -> None:
        """Run the loop until a node that was removed between two plays has left."""
        if self._bridge is not None:
            self._bridge.attach()
            try:
                await asyncio.wrap_future(removed)
            finally:
                self._bridge.detach()

    async def close(self) -> None:
        """Bring every node to rest in order, and give everything back."""
        self._closing = True
        ending = None
        if self._bridge is not None:
            self._bridge.attach()
            ending = self._supervisor.see_end(self._bridge, self.request_stop, self.way_out)
            ending.expect()
        try:
            await uninterrupted(self._shut_down)
        finally:
            if ending is not None:
                ending.over()
            for live, home in self._homes.items():
                home.dismiss(live)
            self._homes.clear()
            with self._lock:
                self._bridge, self._over = None, True
            self._resources.close()

    # -- from anywhere ------------------------------------------------------------

    def request_stop(self) -> None:
        """End the run in order; returns at once.

        Thread: any, also a signal handler.
        """
        if self._stop_requested:
            return
        self._stop_requested = True
        for live in tuple(self._homes):
            # At once, not when the loop gets to it: a tick that asks for a stop is
            # the last of its node.
            live.leave_service()
        self._post(self._end_waiting, at_once=False)
        if self._ending is not None:
            self._ending.expect()

    def _end_waiting(self) -> None:
        if self._stop_requested:
            self._stop_event.set()

    def rearm(self) -> None:
        """Forget an earlier stop: another `play` is about to begin.

        Thread: any, while nothing runs.
        """
        self._stop_requested = False
        self._stop_event.clear()

    def add(self, live: LiveNode) -> None:
        """Initialise a node and let it tick, as soon as the loop is free.

        Thread: any.
        """
        self._post(lambda: self._join(live))

    def retime(self, live: LiveNode) -> None:
        """Adopt a node's changed rate.

        Thread: any.
        """

        def retime() -> None:
            home = self._homes.get(live)
            if home is not None:
                home.retime(live)

        self._post(retime)

    def remove(self, live: LiveNode) -> Future[None]:
        """Shut a node down while the others go on; done when `shutdown()` has run.

        Thread: any. Called on the loop's thread, a plain node whose home is free
        has been shut down when this returns. While the whole run shuts down, the
        node has its turn there, and the future is done at once.
        """
        removed: Future[None] = Future()
        live.removed = True
        live.leave_service()
        self._post(lambda: self._leave(live, removed))
        return removed

    def is_home(self, live: LiveNode) -> bool:
        """Return whether the calling thread is the node's home.

        Thread: any.
        """
        home = self._homes.get(live)
        return home is not None and home.is_home(live)

    def shut_down_without_loop(self) -> None:
        """Call every `shutdown()` that is owed: the process ends, for the loop is blocked.

        Thread: any other.
        """
        shut_down_without_loop(
            self._homes.copy(), self._shutdown_timeout_ns, self._supervisor.report
        )

    @property
    def bridge(self) -> Bridge | None:
        """The way into the event loop; None before the first play and after the last."""
        return self._bridge

    def members(self) -> list[tuple[LiveNode, Home]]:
        """Return the nodes that have a home.

        Thread: any.
        """
        return list(self._homes.copy().items())

    def _post(self, note: Callable[[], None], *, at_once: bool = True) -> None:
        """Do something on the loop's thread: now if this is it, else soon.

        Before the loop is open, notes wait; when the run is over, nobody takes part
        any more and they are done here and now. With `at_once=False` the loop does
        it in any case: a signal handler may have interrupted it anywhere, also where
        it has looked at an event and does not wait for it yet.

        Thread: any.
        """
        with self._lock:
            bridge = self._bridge
            if bridge is None and not self._over:
                self._notes.append(note)
                return
        if bridge is None:
            note()
        elif at_once:
            bridge.run(note)
        else:
            bridge.post(note)

    # -- the run ------------------------------------------------------------------

    def _open(self) -> Bridge:
        """Acquire what runs need; the stack gives it back in reverse."""
        # anyio loads its backend on first use, which takes tens of milliseconds:
        # now, not after the first release.
        anyio.current_effective_deadline()
        self._resources.enter_context(self._real_time.in_loop_thread())
        self._supervisor.start()
        bridge = Bridge(asyncio.get_running_loop())
        self._resources.callback(bridge.close)
        cycle = Cycle(bridge.loop, self._timeline)
        self._resources.callback(cycle.close)
        self._executors = self._make_executors(bridge, cycle, self._real_time)
        with self._lock:
            self._bridge = bridge
        while self._notes:
            self._notes.popleft()()
        self._supervisor.attend()
        return bridge

    async def _initialize(self, lives: Iterable[LiveNode]) -> None:
        """Call `init()` of each new node in order; one that fails is left out, others go on."""
        self._joining.extend(sorted(lives, key=lambda live: live.rank))
        while self._joining and not self._stop_requested:
            # Nodes that are added by an init() come after those that were there.
            await self._adopt(self._joining.popleft())

    async def _adopt(self, live: LiveNode) -> None:
        if live.removed or live in self._homes:
            return
        home = self._executors[live.spec.execution_class]
        self._homes[live] = home
        home.adopt(live)
        if live.state is not NodeState.UNINITIALIZED:
            return
        initialized = asyncio.wrap_future(home.call(live, "init"))
        # A stop ends the wait for an init() that hangs on another thread.
        stopped = asyncio.ensure_future(self._stop_event.wait())
        try:
            await asyncio.wait((initialized, stopped), return_when=asyncio.FIRST_COMPLETED)
        finally:
            stopped.cancel()

    def _engage(self, members: set[LiveNode], duration_ns: int | None) -> None:
        """Start the release grid, and with it the ticks."""
        self._timeline.begin(self._timeline.now_ns() + _HEAD_START_NS, duration_ns)
        clock.set_ambient(self._timeline)
        self._playing = True
        if duration_ns is not None and self._ending is not None:
            self._ending.expect(_HEAD_START_NS + duration_ns)
        for live in self._homes:
            if live in members:
                self._engage_one(live, self._timeline.epoch_ns)

    def _engage_one(self, live: LiveNode, from_ns: int) -> None:
        if live.initialized and not live.removed and not self._stop_requested:
            self._safety.join(live)
            self._homes[live].engage(live, from_ns)
            self._supervisor.look_again()

    async def _until_stopped(self) -> None:
        timeline = self._timeline
        if timeline.end_ns == clock.FOREVER_NS:
            await self._stop_event.wait()
            return
        while (left_ns := timeline.end_ns - timeline.now_ns()) > 0:
            # Loop timers may fire early: look again.
            with anyio.move_on_after(to_s(left_ns)):
                await self._stop_event.wait()
                return

    def _join(self, live: LiveNode) -> None:
        """Let a node that was added take part: in this run, or in the next."""
        if not self._playing:
            self._joining.append(live)
        elif not self._stop_requested:
            self._spawn(self._bring_up(live))

    async def _bring_up(self, live: LiveNode) -> None:
        await self._adopt(live)
        if live in self._homes and self._playing:
            self._engage_one(live, self._timeline.now_ns())

    def _leave(self, live: LiveNode, removed: Future[None]) -> None:
        """Take a node out of the run, when its home is free."""
        home = self._homes.get(live)
        if home is None or self._closing:
            removed.set_result(None)
            return
        home.disengage(live)
        home.cancel(live)

        def finish(_: object) -> None:
            live.stopped()
            if not removed.done():
                removed.set_result(None)
            self._post(lambda: self._dismiss(live))

        def begin() -> None:
            begin_shutdown(live, home).add_done_callback(finish)

        async def begin_after_hook() -> None:
            await hook_over(live)
            begin()

        def shut_down(_: object) -> None:
            if live.standing.hook_returned.is_set():
                begin()
            else:
                self._post(lambda: self._spawn(begin_after_hook()))

        def give_up() -> None:
            if not free.done():
                leave_behind(live)
                begin_shutdown(live, None).add_done_callback(finish)

        # Whatever runs in the home comes first, also an init() that has just begun.
        # The rest happens in the home, not here: a tick that removes another node
        # may be what keeps this loop busy.
        free = home.call(live, None)
        free.add_done_callback(shut_down)
        asyncio.get_running_loop().call_later(to_s(self._shutdown_timeout_ns), give_up)

    def _dismiss(self, live: LiveNode) -> None:
        home = self._homes.pop(live, None)
        if home is not None:
            home.dismiss(live)

    async def _pause(self, *, cancel: bool) -> None:
        self._stuck = await quiesce(self._homes, self._shutdown_timeout_ns, cancel=cancel)

    async def _shut_down(self) -> None:
        if self._stuck:
            # It may have come back since.
            await self._pause(cancel=True)
        await shut_down(self._homes, self._stuck, self._shutdown_timeout_ns)

    def _spawn(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)


async def uninterrupted(work: Callable[[], Coroutine[Any, Any, None]]) -> None:
    """Run `work` to its end whatever cancels the caller, then be cancelled after all.

    anyio's shield keeps away the cancellation of task groups and time limits,
    asyncio's shield a `task.cancel()`; an application may use either. One that
    cancels all tasks it can find hits the work itself, which then starts anew.
    """
    cancelled: asyncio.CancelledError | None = None
    with anyio.CancelScope(shield=True):
        while True:
            task = asyncio.ensure_future(work())
            while not task.done():
                try:
                    await asyncio.shield(task)
                except asyncio.CancelledError as exc:
                    cancelled = exc
            if not task.cancelled():
                break
    task.result()
    if cancelled is not None:
        raise cancelled
