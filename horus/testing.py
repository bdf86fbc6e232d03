"""What tests of nodes are made with: the pytest fixtures of horus return these.

They can be used without pytest, too.
"""

from __future__ import annotations

import asyncio
import functools
import gc
import os
import threading
import weakref
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from horus import clock
from horus.core import core_of
from horus.errors import StateError, UnknownNodeError
from horus.node import Node
from horus.scheduler import Scheduler
from horus.units import NS_PER_S, to_ns

_GRACE_S = 3.0
"""How long threads and processes may take to end after a test [s]."""

_LOOK_EVERY_S = 0.002
_FROZEN_NAP_S = 0.01


class SchedulerClock:
    """The time of a scheduler, as its nodes see it.

    Thread: any.
    """

    def __init__(self, scheduler: Scheduler) -> None:
        """Tell the time of `scheduler`."""
        self._timeline = scheduler._session.timeline

    def now(self) -> float:
        """Return wall time [s]; virtual time in deterministic mode."""
        return self._timeline.wall_s()

    def elapsed(self) -> float:
        """Return the time since the scheduler first started [s]."""
        return self._timeline.elapsed_s()

    def tick(self) -> int:
        """Return the cycle number."""
        return self._timeline.current_cycle()


class TopicProbe:
    """Collects what is sent on a topic.

    Thread: that of the test.
    """

    def __init__(self, scheduler: Scheduler, topic: str | type, capacity: int = 10_000) -> None:
        """Listen from now on; more than `capacity` messages between two looks are dropped.

        Raises:
            TopicError: The topic name was refused.
        """
        self._scheduler = scheduler
        self._stream = scheduler.subscribe(topic, capacity)
        self._collected: list[Any] = []

    @property
    def messages(self) -> list[Any]:
        """All messages since the beginning, or since `clear()`, oldest first."""
        self._collected += self._stream.recv_all()
        return self._collected

    @property
    def latest(self) -> Any:
        """The newest message; None if there is none."""
        messages = self.messages
        return messages[-1] if messages else None

    def __len__(self) -> int:
        """Return how many messages there are."""
        return len(self.messages)

    def __iter__(self) -> Iterator[Any]:
        """Iterate over the messages so far."""
        return iter(list(self.messages))

    def clear(self) -> None:
        """Forget the messages so far."""
        self.messages.clear()

    def wait(self, count: int = 1, timeout: float = 1.0) -> list[Any]:
        """Run the scheduler until there are `count` messages, and return them all.

        A scheduler that is running already, on another thread, is waited for instead.

        Args:
            count: How many messages there are to be in all.
            timeout: How long to wait for them [s], in virtual time if the scheduler has it.

        Raises:
            AssertionError: There were fewer in time.
            StateError: Inside an event loop that the scheduler would need; `await arrived()` there.
        """
        if self._scheduler.is_running() and _in_event_loop():
            raise StateError("wait() would block the event loop; use 'await probe.arrived()'")
        clock_ns = self._scheduler._session.timeline.now_ns
        nap = threading.Event()
        step_s = max(_LOOK_EVERY_S, 1.0 / self._scheduler._spec.tick_rate_hz)
        give_up_ns = clock_ns() + to_ns(timeout)
        while len(self) < count:
            left_s = (give_up_ns - clock_ns()) / NS_PER_S
            if left_s <= 0:
                raise self._too_few(count, timeout)
            if self._scheduler.is_running():
                nap.wait(_LOOK_EVERY_S)
            else:
                self._scheduler.tick_for(min(step_s, left_s))
        return self.messages

    async def arrived(self, count: int = 1, timeout: float = 1.0) -> list[Any]:
        """Wait until there are `count` messages, and return them all.

        For a scheduler that runs beside the test, as in `async with scheduler:`.

        Args:
            count: How many messages there are to be in all.
            timeout: How long to wait for them, in real time [s].

        Raises:
            AssertionError: There were fewer in time.
        """
        try:
            async with asyncio.timeout(timeout):
                while len(self) < count:
                    self._collected.append(await anext(self._stream))
        except (TimeoutError, StopAsyncIteration):
            raise self._too_few(count, timeout) from None
        return self.messages

    def close(self) -> None:
        """Listen no more."""
        self._stream.close()

    def _too_few(self, count: int, timeout: float) -> AssertionError:
        return AssertionError(
            f"topic {self._stream.topic!r}: {len(self)} of {count} messages in {timeout:g} s: "
            f"{self.messages!r}"
        )


class _Trouble:
    """What happens at the beginning of a tick, until it is over."""

    def __init__(self, seconds: float | None = None, error: BaseException | None = None) -> None:
        self.seconds = seconds
        """How much longer the tick takes [s]; None for ever."""
        self.error = error
        self.over = threading.Event()


class Faults:
    """Makes nodes of a scheduler freeze, raise and slow down on command.

    Nodes that are added from now on can be told to. What a plain tick does takes no virtual
    time: there, only async nodes freeze and slow down. A worker process is out of reach.

    Thread: any.
    """

    def __init__(self, scheduler: Scheduler) -> None:
        """Reach into the ticks of the nodes that `scheduler` is given from now on."""
        self._scheduler = scheduler
        self._troubles: dict[str, _Trouble] = {}
        self._nodes: dict[str, Node] = {}
        add = scheduler.add

        @functools.wraps(add)
        def prepare(node: Node) -> Scheduler:
            self._prepare(node)
            return add(node)

        # Instead of a subclass: the scheduler may be anybody's.
        scheduler.add = prepare  # type: ignore[method-assign]

    def freeze(self, name: str) -> None:
        """Let the next tick of a node not end before `clear()`.

        Raises:
            UnknownNodeError: There is no such node, or it was added before.
            StateError: Its ticks cannot take time, or are out of reach.
        """
        self._takes_time(name)
        self._troubles[name] = _Trouble()

    def slow(self, name: str, seconds: float) -> None:
        """Let each tick of a node take so much longer [s], until `clear()`.

        Raises:
            UnknownNodeError: There is no such node, or it was added before.
            StateError: Its ticks cannot take time, or are out of reach.
        """
        self._takes_time(name)
        self._troubles[name] = _Trouble(seconds)

    def fail(self, name: str, error: BaseException | None = None) -> None:
        """Let each tick of a node raise, until `clear()`; a `RuntimeError` if nothing is given.

        Raises:
            UnknownNodeError: There is no such node, or it was added before.
            StateError: Its ticks are out of reach.
        """
        self._node(name)
        self._troubles[name] = _Trouble(error=error or RuntimeError(f"injected into {name}"))

    def clear(self, name: str | None = None) -> None:
        """Let a node, or all of them, tick as they do by themselves; frozen ticks go on."""
        for each in list(self._troubles) if name is None else [name]:
            trouble = self._troubles.pop(each, None)
            if trouble is not None:
                trouble.over.set()

    def _node(self, name: str) -> Node:
        node = self._nodes.get(name)
        if node is None:
            raise UnknownNodeError(name, sorted(self._nodes))
        spec = core_of(node).spec
        if spec.process and not self._scheduler._spec.deterministic:
            raise StateError(
                f"node {name!r} ticks in a worker process, out of reach; test it with compute=True"
            )
        return node

    def _takes_time(self, name: str) -> None:
        is_async = core_of(self._node(name)).is_async
        if self._scheduler._spec.deterministic and not is_async:
            raise StateError(
                f"node {name!r} has a plain tick, which takes no virtual time; "
                "use a scheduler in real time: @pytest.mark.horus(deterministic=False)"
            )

    def _prepare(self, node: Node) -> None:
        core = core_of(node)
        name = core.spec.name
        if self._nodes.get(name) is node:
            return
        self._nodes[name] = node
        if core.spec.process and not self._scheduler._spec.deterministic:
            return
        tick = core.callbacks["tick"]
        assert tick is not None
        wrap = self._async_tick if core.is_async else self._plain_tick
        core.callbacks["tick"] = wrap(name, tick)

    def _plain_tick(self, name: str, tick: Callable[[], Any]) -> Callable[[], Any]:
        def faulty() -> Any:
            trouble = self._troubles.get(name)
            if trouble is not None:
                if trouble.error is not None:
                    raise trouble.error
                trouble.over.wait(trouble.seconds)
            return tick()

        return faulty

    def _async_tick(self, name: str, tick: Callable[[], Any]) -> Callable[[], Any]:
        async def faulty() -> None:
            trouble = self._troubles.get(name)
            if trouble is not None:
                if trouble.error is not None:
                    raise trouble.error
                if trouble.seconds is not None:
                    await asyncio.sleep(trouble.seconds)
                else:
                    while not trouble.over.is_set():  # noqa: ASYNC110 - set by any thread
                        await asyncio.sleep(_FROZEN_NAP_S)
            await tick()

        return faulty


class Belongings(NamedTuple):
    """The threads and processes that there are."""

    threads: frozenset[threading.Thread]
    processes: frozenset[int]

    @classmethod
    def now(cls) -> Belongings:
        """Return what there is now."""
        return cls(frozenset(threading.enumerate()), _children())

    def check(self) -> None:
        """Fail if there are more by now, and they do not end soon.

        Raises:
            AssertionError: It names them.
        """
        give_up_ns = clock.monotonic_ns() + to_ns(_GRACE_S)
        while more := self._more():
            if clock.monotonic_ns() > give_up_ns:
                raise AssertionError(f"the test has left behind {', '.join(more)}")
            threading.Event().wait(_LOOK_EVERY_S)

    def _more(self) -> list[str]:
        threads = sorted(thread.name for thread in {*threading.enumerate()} - self.threads)
        processes = sorted(_children() - self.processes)
        return [
            *(f"thread {name!r}" for name in threads),
            *(f"process {pid}" for pid in processes),
        ]


def pending_tasks() -> weakref.WeakSet[asyncio.Task[Any]]:
    """Return the asyncio tasks that have not ended, but those of other threads' loops."""
    # asyncio keeps no list of those of all loops.
    tasks = (thing for thing in gc.get_objects() if isinstance(thing, asyncio.Task))
    return weakref.WeakSet(
        task for task in tasks if not task.done() and _is_at_rest(task.get_loop())
    )


def check_tasks(before: Collection[asyncio.Task[Any]], scheduler: Scheduler | None) -> None:
    """Fail if there are tasks that have not ended and were not there before.

    Args:
        before: Those that were.
        scheduler: One whose run may still be open; it has tasks of its own.

    Raises:
        AssertionError: It names them.
    """
    private = None if scheduler is None else scheduler._session.private_loop
    more = [
        repr(task)
        for task in pending_tasks()
        if task not in before and (private is None or task.get_loop() is not private)
    ]
    if more:
        raise AssertionError(f"the test has left behind {', '.join(more)}")


def _in_event_loop() -> bool:
    try:
        asyncio.get_running_loop()
    except RuntimeError:
        return False
    return True


def _is_at_rest(loop: asyncio.AbstractEventLoop) -> bool:
    return not loop.is_running() and not loop.is_closed()


def _children() -> frozenset[int]:
    """Return the processes that this one has started; empty where the kernel does not tell."""
    found: set[int] = set()
    for task in Path(f"/proc/{os.getpid()}/task").glob("*/children"):
        try:
            found.update(map(int, task.read_text().split()))
        except OSError:
            continue  # that thread has just ended
    return frozenset(found)
