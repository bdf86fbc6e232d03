"""Event loops that are stepped from plain code: for `tick_once` and for virtual time."""

from __future__ import annotations

import asyncio
import contextlib
import contextvars
import logging
import selectors
import threading
import weakref
from collections.abc import Callable, Coroutine
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

from horus.clock import SimClock
from horus.errors import HorusError
from horus.loop.daemon_pool import DaemonPool
from horus.units import to_ns, to_s

T = TypeVar("T")

_log = logging.getLogger("horus.scheduler")

_LAST_STEPS_S = 1.0
"""How long cancelled tasks may take to end when a loop is closed [s]."""

_IO_PATIENCE_S = 5.0
"""How long virtual time stands still for sockets to answer, in real time [s]."""


class StepLoop:
    """An event loop of our own that a plain function can run for a while.

    A thread runs one event loop at a time. Called where one is running already
    (`sched.tick_once()` in an async test), the steps are taken on a helper
    thread while the caller waits.

    Unlike `asyncio.Runner`, it does not wait for ever for tasks that ignore
    their cancellation or for threads that hang.

    Thread: one at a time.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        """Take over `loop`, which must not be running."""
        self.loop = loop
        self._workers = DaemonPool("horus-to-thread")
        loop.set_default_executor(self._workers)
        self._helper: ThreadPoolExecutor | None = None
        self.running: tuple[asyncio.Task[Any], int] | None = None
        """The task that `run` is running, and on which thread."""

    def run(self, work: Coroutine[Any, Any, T], context: contextvars.Context | None = None) -> T:
        """Run a coroutine to its end and return its result."""
        task = self.loop.create_task(work, context=context)

        def run() -> None:
            self.running = (task, threading.get_ident())
            try:
                self.loop.run_until_complete(task)
            finally:
                self.running = None

        try:
            self.step(run)
        except KeyboardInterrupt:
            # The loop was left in the middle of a step: let the work end in order.
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                self.step(lambda: self.loop.run_until_complete(task))
            raise
        return task.result()

    def cancel(self) -> None:
        """Cancel the task that `run` is running, if it is.

        Thread: any.
        """
        running = self.running
        if running is not None:
            self.loop.call_soon_threadsafe(running[0].cancel)

    def step(self, run: Callable[[], object]) -> None:
        """Call something that runs the loop."""
        if asyncio._get_running_loop() is None:
            run()
            return
        if self._helper is None:
            self._helper = ThreadPoolExecutor(1, thread_name_prefix="horus-step")
        self._helper.submit(run).result()

    def finish(self, tasks: set[asyncio.Task[Any]]) -> None:
        """Let cancelled tasks end; those that refuse are left alone after a while."""
        self.loop.run_until_complete(asyncio.wait(tasks, timeout=_LAST_STEPS_S))

    def close(self) -> None:
        """Cancel what is left and close the loop."""
        self.step(self._end)
        if self._helper is not None:
            self._helper.shutdown()

    def _end(self) -> None:
        tasks = asyncio.all_tasks(self.loop)
        for task in tasks:
            task.cancel()
        if tasks:
            self.finish(tasks)
        for task in asyncio.all_tasks(self.loop):
            _log.error("task %s ignores its cancellation and is left behind", task.get_name())
        self.loop.run_until_complete(self.loop.shutdown_asyncgens())
        # On a thread that may be left behind: a function handed to a thread can
        # hang, and nothing can end it.
        last = threading.Thread(target=self._workers.shutdown, daemon=True)
        try:
            last.start()
        except RuntimeError:  # the process can have no more threads
            self._workers.shutdown(wait=False)
        else:
            last.join(_LAST_STEPS_S)
        self.loop.close()


class StuckError(HorusError):
    """A callback waits in virtual time for something that will never come."""

    def __init__(self) -> None:
        """Say what cannot happen."""
        super().__init__(
            "it waits, and nothing in virtual time will wake it: no timer, no message, no socket"
        )


class VirtualLoop(StepLoop):
    """An event loop on simulated time: `asyncio.sleep(60)` ends when the clock says so.

    Timers follow the simulation's clock. Work handed to threads runs at once,
    inline. Sockets are real: while a task waits for one, virtual time stands
    still, so that a server on this machine answers within the instant of the
    question.
    """

    def __init__(self, clock: SimClock) -> None:
        """Create a loop on `clock`."""
        self._clock = clock
        self._next_timer_ns: int | None = None
        self._selector = _IdleSelector()
        self._simulated = _SimulatedLoop(clock, self._selector)
        super().__init__(self._simulated)
        self._selector.attach(self.loop)

    @property
    def next_timer_ns(self) -> int | None:
        """The instant of the earliest timer [ns]; None when nothing waits for time."""
        return self._next_timer_ns

    @property
    def has_work(self) -> bool:
        """Whether something could go on without time passing."""
        return self._simulated.has_ready

    def settle(self) -> None:
        """Run until nothing can go on without time passing."""
        self.step(self.loop.run_forever)
        idle_s = self._selector.idle_s
        # At least 1 ns ahead: a timer a rounding error away must not stop time.
        self._next_timer_ns = (
            None if idle_s is None else self._clock.now_ns() + max(1, to_ns(idle_s))
        )

    def finish(self, tasks: set[asyncio.Task[Any]]) -> None:
        """Let cancelled tasks end, as far as they do without time passing."""
        self.loop.run_forever()

    def run(self, work: Coroutine[Any, Any, T], context: contextvars.Context | None = None) -> T:
        """Run a coroutine to its end, moving the clock from timer to timer.

        Raises:
            StuckError: It waits for what will never come.
        """
        task = self.loop.create_task(work, context=context)
        self.settle()
        while not task.done():
            if self._next_timer_ns is None:
                task.cancel()
                self.settle()
                raise StuckError
            self._clock.advance_to(self._next_timer_ns)
            self.settle()
        return task.result()


class _SimulatedLoop(asyncio.SelectorEventLoop):
    """asyncio's own loop with another clock and no threads."""

    def __init__(self, clock: SimClock, selector: selectors.BaseSelector) -> None:
        self._simulated = clock
        super().__init__(selector)

    @property
    def has_ready(self) -> bool:
        return bool(self._ready)  # type: ignore[attr-defined]

    def time(self) -> float:
        return to_s(self._simulated.now_ns())

    def run_in_executor(  # type: ignore[override]
        self, executor: object, func: Callable[..., T], *args: Any
    ) -> asyncio.Future[T]:
        """Call `func` here and now: a thread would finish when it likes."""
        future: asyncio.Future[T] = self.create_future()
        try:
            future.set_result(func(*args))
        except Exception as exc:
            future.set_exception(exc)
        return future


class _IdleSelector(selectors.DefaultSelector):
    """A selector that stops the loop where it would wait."""

    def __init__(self) -> None:
        super().__init__()
        self._loop: asyncio.AbstractEventLoop | None = None
        self.idle_s: float | None = None
        """How long the loop would have slept [s]; None for ever."""
        # What turned out not to be about a socket, or never to be answered.
        self._given_up: weakref.WeakSet[Any] = weakref.WeakSet()

    def attach(self, loop: asyncio.AbstractEventLoop) -> None:
        """Stop `loop` when it is idle."""
        self._loop = loop

    def select(self, timeout: float | None = None) -> list[Any]:
        events = super().select(0)
        if events or timeout == 0 or self._loop is None:
            return events
        # More than the loop's own wake-up pipe: somebody has a socket open.
        if len(self.get_map()) > 1 and (waits := self._waits_for_sockets(self._loop)):
            events = super().select(_IO_PATIENCE_S)
            if events:
                return events
            self._given_up.update(waits)
        self.idle_s = timeout
        self._loop.stop()
        return []

    def _waits_for_sockets(self, loop: asyncio.AbstractEventLoop) -> list[asyncio.Future[Any]]:
        """Return what tasks wait for that may be a socket."""
        waits = []
        for task in asyncio.all_tasks(loop):
            future = getattr(task, "_fut_waiter", None)
            if future is None or isinstance(future, asyncio.Task) or _waits_within(task.get_coro()):
                continue
            if future not in self._given_up:
                waits.append(future)
        return waits


def _waits_within(coroutine: Any) -> bool:
    """Return whether a coroutine waits for a timer, a lock, a queue or a task, not for a socket.

    At the bottom of its calls it is then in a module of asyncio that deals with these.
    """
    inner = coroutine
    while (below := getattr(inner, "cr_await", None)) is not None and hasattr(below, "cr_code"):
        inner = below
    code = getattr(inner, "cr_code", None)
    return code is not None and code.co_filename in _WAITING_ROOMS


_WAITING_ROOMS = {
    module.__file__ for module in (asyncio.locks, asyncio.queues, asyncio.tasks, asyncio.timeouts)
}
