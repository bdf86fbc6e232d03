"""A thread pool that cannot keep the process from ending."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from queue import SimpleQueue
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")

_Job = Callable[[], None]


class DaemonPool(ThreadPoolExecutor):
    """Runs functions for `asyncio.to_thread`, also such that never return.

    The interpreter waits for the threads of an ordinary `ThreadPoolExecutor` when it
    exits, however long they hang. asyncio insists on that type, so this is one by
    name, with threads of its own: daemons, as many as there is work at once, up to a
    limit.

    Thread: any.
    """

    def __init__(self, name: str, limit: int = 32) -> None:
        """Begin without threads; they are named `name` and number at most `limit`."""
        super().__init__(max_workers=limit, thread_name_prefix=name)
        self._name, self._limit = name, limit
        self._jobs: SimpleQueue[_Job | None] = SimpleQueue()
        self._guard = threading.Lock()
        self._serving: set[threading.Thread] = set()
        self._idle = 0
        self._closed = False

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Run a function on one of the threads.

        Raises:
            RuntimeError: The pool was shut down.
        """
        future: Future[T] = Future()

        def job() -> None:
            if not future.set_running_or_notify_cancel():
                return
            try:
                result = fn(*args, **kwargs)
            except BaseException as exc:
                future.set_exception(exc)
            else:
                future.set_result(result)

        with self._guard:
            if self._closed:
                raise RuntimeError("cannot schedule new work after shutdown")
            self._jobs.put(job)
            if self._idle:
                self._idle -= 1
            elif len(self._serving) < self._limit:
                thread = threading.Thread(target=self._serve, name=self._name, daemon=True)
                self._serving.add(thread)
                thread.start()
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Take no more work; with `wait`, return when what there is has been done."""
        with self._guard:
            self._closed = True
            threads = tuple(self._serving)
        for _ in threads:
            self._jobs.put(None)
        if wait:
            for thread in threads:
                thread.join()

    def _serve(self) -> None:
        try:
            while (job := self._jobs.get()) is not None:
                job()
                with self._guard:
                    # What waits already is ours anyway; counted idle, we are spoken for.
                    self._idle += self._jobs.empty()
        finally:
            with self._guard:
                self._serving.discard(threading.current_thread())
