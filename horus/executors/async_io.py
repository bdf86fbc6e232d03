"""AsyncIo nodes: `async def tick` as tasks on the event loop, never overlapping themselves."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from concurrent.futures import Future
from typing import Any, NamedTuple

from horus.executors.base import LoopExecutor
from horus.live import LiveNode
from horus.loop.bridge import Bridge
from horus.loop.cycle import Cycle
from horus.loop.stacks import Stack, computes, stack_of_task, stack_of_thread
from horus.tick_path import RunTickAsync, build_async_tick


class _Tick(NamedTuple):
    """An async tick that was started."""

    task: asyncio.Task[None]
    release_ns: int


class TaskRunner:
    """Runs async callbacks, one at a time per node, each in a task of the node's context.

    Thread: loop, except the methods that say otherwise.
    """

    def __init__(self, bridge: Bridge) -> None:
        """Serve nodes on the bridge's loop."""
        self._bridge = bridge
        self._loop = bridge.loop
        self._run_ticks: dict[LiveNode, RunTickAsync] = {}
        self._ticks: dict[LiveNode, _Tick] = {}
        self._latest: dict[LiveNode, asyncio.Task[None]] = {}

    def adopt(self, live: LiveNode) -> None:
        """Build the node's tick path."""
        self._run_ticks[live] = build_async_tick(live)

    def forget(self, live: LiveNode) -> None:
        """Forget the node's tick path."""
        self._run_ticks.pop(live, None)

    def busy(self, live: LiveNode) -> bool:
        """Return whether a callback is in progress."""
        return live in self._latest

    def start(self, live: LiveNode, release_ns: int) -> asyncio.Task[None]:
        """Start a tick; the caller has made sure that the node is not busy."""
        task = self._spawn(live, self._run_ticks[live](release_ns))
        self._ticks[live] = _Tick(task, release_ns)
        task.add_done_callback(lambda _: self._ticks.pop(live, None))
        return task

    def cancel(self, live: LiveNode) -> None:
        """Cancel the tick in progress, unless it is the one that calls.

        A safe-state hook that the tick has led to is not cut short.
        """
        tick = self._ticks.get(live)
        if tick is None or not live.busy or live.after_tick:
            return
        if tick.task is not _current_task():
            tick.task.cancel()

    def due_ns(self, live: LiveNode) -> int | None:
        """Return the release of a tick that was started and waits for the loop [ns].

        Thread: any.
        """
        tick = self._ticks.get(live)
        return None if tick is None else tick.release_ns

    def computes(self, live: LiveNode) -> bool:
        """Return whether the tick in progress has the loop at this moment.

        Thread: any.
        """
        tick = self._ticks.get(live)
        return tick is not None and computes(tick.task)

    def stack(self, live: LiveNode) -> Stack:
        """Return where the tick in progress waits; without one, where the loop is.

        Thread: any.
        """
        tick = self._ticks.get(live)
        thread_id = self._bridge.thread_id
        if tick is None or not live.busy:
            return stack_of_thread(thread_id)
        return stack_of_task(tick.task, thread_id)

    def call(self, live: LiveNode, phase: str | None) -> Future[bool]:
        """Run a callback once those before it have ended.

        Thread: any.
        """
        future: Future[bool] = Future()
        self._bridge.run(
            lambda: self._spawn(live, self._call(live, phase, future, self._latest.get(live)))
        )
        return future

    def _spawn(self, live: LiveNode, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        task = self._loop.create_task(work, name=f"horus:{live.name}", context=live.context)
        self._latest[live] = task

        def forget(_: object) -> None:
            if self._latest.get(live) is task:
                del self._latest[live]

        task.add_done_callback(forget)
        return task

    async def _call(
        self,
        live: LiveNode,
        phase: str | None,
        future: Future[bool],
        previous: asyncio.Task[None] | None,
    ) -> None:
        try:
            if previous is not None:
                await asyncio.wait([previous])
            success = True if phase is None else await live.run_phase_async(phase)
        except BaseException:
            future.cancel()
            raise
        if future.set_running_or_notify_cancel():
            future.set_result(success)


class TaskExecutor(LoopExecutor):
    """Base of the executors whose nodes may tick in tasks."""

    def __init__(self, bridge: Bridge, cycle: Cycle) -> None:
        """Serve the nodes of one run."""
        super().__init__(bridge, cycle)
        self._tasks = TaskRunner(bridge)

    def cancel(self, live: LiveNode) -> None:
        """Cancel an async tick in progress."""
        self._tasks.cancel(live)

    def computes(self, live: LiveNode) -> bool:
        """Return whether the node's task has the loop at this moment."""
        return self._tasks.computes(live)

    def stack(self, live: LiveNode) -> Stack:
        """Return where the node's task waits, or where the loop is."""
        return self._tasks.stack(live)

    def isolate(self, live: LiveNode) -> None:
        """Cancel an async tick in progress, as soon as the loop is free."""
        self._bridge.post(lambda: self._tasks.cancel(live))


class AsyncIoExecutor(TaskExecutor):
    """Starts a task per release; a release that finds the node still busy is skipped."""

    def adopt(self, live: LiveNode) -> None:
        """Build the node's tick path."""
        self._tasks.adopt(live)

    def engage(self, live: LiveNode, from_ns: int) -> None:
        """Release the node on its grid."""
        live.enter_service()
        self._cycle.add(live, self._release, from_ns)

    def due_ns(self, live: LiveNode, now_ns: int) -> int | None:
        """Return the release that waits for the loop."""
        started_ns = self._tasks.due_ns(live)
        return super().due_ns(live, now_ns) if started_ns is None else started_ns

    def call(self, live: LiveNode, phase: str | None) -> Future[bool]:
        """Run a callback in a task."""
        return self._tasks.call(live, phase)

    def dismiss(self, live: LiveNode) -> None:
        """Forget the node."""
        self._tasks.forget(live)

    def _release(self, live: LiveNode, release_ns: int) -> None:
        if self._tasks.busy(live):
            live.counters.skipped += 1
        else:
            self._tasks.start(live, release_ns)


def _current_task() -> asyncio.Task[object] | None:
    try:
        return asyncio.current_task()
    except RuntimeError:
        return None
