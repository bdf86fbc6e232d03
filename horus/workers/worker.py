"""The worker's side: runs one node's callbacks, as the scheduler asks for them.

Started as `python -c ...` by `process.WorkerProcess`, with two sockets: one for the callbacks
in their turn, and one for a safe-state hook or a shutdown that must not wait for a
tick which does not end.
"""

from __future__ import annotations

import contextlib
import contextvars
import inspect
import logging
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import cloudpickle

from horus import clock, os_rt
from horus.clock import MonotonicClock, TickContext, Timeline
from horus.core import core_of
from horus.errors import StateError, TopicError
from horus.foxglove import Declaration
from horus.snapshot import Frozen
from horus.stats import NodeCounters
from horus.topics import Bus, Publisher, Subscription, Topic
from horus.workers import messages
from horus.workers.channel import Channel
from horus.workers.pickling import Unpickler, dumps, pack_error, unpack_error

_NICENESS = 5
"""Behind the scheduler's own threads."""


def main(turns: int, aside: int, stacks: int) -> None:
    """Serve the scheduler at the other end of the sockets with these descriptors until it ends.

    Args:
        turns: For the callbacks in their turn.
        aside: For what must not wait for them.
        stacks: A file; at SIGUSR1 the stack of the main thread is written to it.
    """
    os_rt.die_with_parent()
    for descriptor in (turns, aside, stacks):
        if descriptor >= 0:
            os.set_inheritable(descriptor, False)
    # A service manager tells all processes of a service. The scheduler ends this one in order.
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: None)
    if stacks >= 0:
        import faulthandler

        faulthandler.register(signal.SIGUSR1, file=stacks, all_threads=False)
    with contextlib.suppress(EOFError, BrokenPipeError):
        Worker(turns, aside).serve()


class Worker:
    """One node in a process of its own.

    Thread: the main one, and one for what is asked aside.
    """

    def __init__(self, turns: int, aside: int) -> None:
        """Take the sockets."""
        self._conversation = threading.local()
        self._turns = self._channel(turns)
        self._aside = self._channel(aside)
        self._conversation.channel = self._turns

    def _set_up(self) -> None:
        """Take the node out of its parcel."""
        setup: messages.Setup = self._turns.receive()
        self._listen(setup.levels)
        self._core = core_of(cloudpickle.loads(setup.parcel))
        self._bus = _RemoteBus(self)
        for topic, kind in setup.types.items():
            self._bus.topic(topic).declare_type(kind)
        self._core.connect(self._bus)
        self._core.request_stop = lambda reason: self.say(messages.Stop(reason))
        for topic, newest in setup.newest.items():
            self._bus.topic(topic).newest = self._unpack_newest(topic, newest)
        self._bus.declared = True
        tick_rate_hz, wall_offset_ns = setup.timeline
        timeline = Timeline(MonotonicClock(), tick_rate_hz, wall_offset_ns=wall_offset_ns)
        self._tick_context = TickContext(self._core.spec.name, timeline, NodeCounters())
        self._context = contextvars.copy_context()
        self._context.run(clock.current.set, self._tick_context)
        clock.set_ambient(timeline)

    def _settle(self, place: messages.Place) -> None:
        if os.getppid() != place.parent:
            raise EOFError("the scheduler is gone")
        sys.path[:] = place.path
        with contextlib.suppress(OSError):
            os_rt.run_behind(os_rt.niceness() + _NICENESS)
        if place.cores is not None:
            with contextlib.suppress(OSError):
                os_rt.run_on(place.cores)

    def serve(self) -> None:
        """Set up, and run callbacks until the scheduler hangs up."""
        self._settle(self._turns.receive())
        error = _attempt(self._set_up)
        self.say(messages.Done(error, ()))
        if error is not None:
            return
        threading.Thread(target=self._serve_aside, name="horus-aside", daemon=True).start()
        while True:
            try:
                call = messages.from_plain(self._turns.receive())
            except (EOFError, OSError):
                raise
            except Exception as exc:  # a message's own class
                self.say(messages.Done(pack_error(exc), self._queues(), False))
                continue
            self._deliver(call.inputs)
            self._tick_context.follow(call.moment)
            self.say(self._run(call.phase, self._context))

    def _serve_aside(self) -> None:
        self._conversation.channel = self._aside
        with contextlib.suppress(EOFError, BrokenPipeError):
            while True:
                call = messages.from_plain(self._aside.receive())
                # A copy: a tick that does not end still holds the node's own context.
                self.say(self._run(call.phase, self._context.copy()))

    def say(self, message: Any) -> None:
        """Tell the scheduler something, in the conversation of the calling thread."""
        channel: Channel = getattr(self._conversation, "channel", self._turns)
        channel.send(messages.to_plain(message))

    def ask(self, question: Any) -> bytes | None:
        """Ask the scheduler something, and return what it answers, pickled.

        Raises:
            StateError: Not in a callback: nobody would answer.
            BaseException: Why it cannot be had.
        """
        channel: Channel | None = getattr(self._conversation, "channel", None)
        if channel is None:
            raise StateError("topics are opened in callbacks; declare them with subs= and pubs=")
        channel.send(messages.to_plain(question))
        answer = messages.Answer(*channel.receive())
        if answer.error is not None:
            raise unpack_error(answer.error)
        return answer.content

    def _channel(self, descriptor: int) -> Channel:
        def loads(body: memoryview, buffers: Iterable[memoryview]) -> Any:
            return Unpickler(body, buffers, self._fetch).load()

        return Channel(socket.socket(fileno=descriptor), dumps, loads)

    def _fetch(self, name: str) -> Any:
        return cloudpickle.loads(self.ask(messages.Fetch(name)) or b"")

    def newest(self, topic: str) -> Frozen | None:
        """Return the newest message on a topic of the scheduler's."""
        return self._unpack_newest(topic, self.ask(messages.Open(topic)))

    def _unpack_newest(self, topic: str, packed: bytes | None) -> Frozen | None:
        if packed is None:
            return None
        try:
            newest: Frozen = Unpickler(memoryview(packed), [], self._fetch).load()
        except Exception as exc:
            text = "the newest message on topic %r cannot be understood in its process: %r"
            logging.getLogger(f"horus.node.{self._core.spec.name}").warning(text, topic, exc)
            return None
        return newest

    def _deliver(self, inputs: messages.Inputs) -> None:
        for topic, arrived in inputs:
            subscription = self._core.open_input(topic)
            for frozen in arrived:
                subscription.topic.newest = frozen
                if len(subscription.queue) == subscription.capacity:
                    subscription.note_overflow()
                subscription.queue.append(frozen)

    def _run(self, phase: str, context: contextvars.Context) -> messages.Done:
        callback = self._core.callbacks[phase]

        def call() -> None:
            result = None if callback is None else context.run(callback)
            if inspect.iscoroutine(result):
                result.close()
                raise TypeError(f"{phase}() returned a coroutine that nobody would await")

        error = _attempt(call)
        return messages.Done(error, self._queues())

    def _queues(self) -> list[tuple[str, int, int]]:
        return [
            (topic, subscription.received, len(subscription.queue))
            for topic, subscription in self._core.inputs.copy().items()
            if isinstance(topic, str)
        ]

    def _listen(self, levels: Mapping[str, int]) -> None:
        logging.getLogger().addHandler(_Forwarder(self))
        for name, level in levels.items():
            logging.getLogger(name).setLevel(level)


class _RemoteBus(Bus):
    """Topics whose subscriptions are filled by the scheduler, and whose publishers send there."""

    def __init__(self, worker: Worker) -> None:
        super().__init__()
        self._worker = worker
        self.declared = False
        """Whether the ports that the node has declared are open."""

    def subscribe(self, name: Any, owner: str, capacity: int = 0) -> Subscription:
        subscription = super().subscribe(name, owner, *((capacity,) if capacity else ()))
        if self.declared:
            subscription.topic.newest = self._worker.newest(subscription.topic.name)
        return subscription

    def make_topic(self, name: str) -> Topic:
        return _RemoteTopic(name, self._lock, self._worker)


class _RemoteTopic(Topic):
    """A topic of the scheduler's."""

    def __init__(self, name: str, lock: threading.Lock, worker: Worker) -> None:
        super().__init__(name, lock)
        self._worker = worker

    def make_publisher(self, owner: str, foxglove: Declaration | None = None) -> Publisher:
        # How it is shown is the scheduler's business, which records.
        return _RemotePublisher(self, owner, self._worker)


class _RemotePublisher(Publisher):
    """Sends to the scheduler's topic."""

    __slots__ = ("_worker",)

    def __init__(self, topic: Topic, owner: str, worker: Worker) -> None:
        super().__init__(topic, owner)
        self._worker = worker

    def deliver(self, frozen: Frozen) -> None:
        try:
            self._worker.say(messages.Sent(self.topic.name, frozen))
        except (OSError, EOFError):
            raise
        except Exception as exc:
            raise TopicError(
                f"topic {self.topic.name!r}: {self.owner} sent a {type(frozen[0]).__name__}, "
                f"which cannot leave its worker process: {exc}; send plain data, or keep the "
                "node on a thread with compute=True"
            ) from exc
        self.sent += 1


class _Forwarder(logging.Handler):
    """Hands log records to the scheduler."""

    def __init__(self, worker: Worker) -> None:
        super().__init__()
        self._worker = worker

    def emit(self, record: logging.LogRecord) -> None:
        try:
            fields = dict(record.__dict__)
            fields.update(msg=record.getMessage(), args=None, exc_info=None)
            if record.exc_info and not record.exc_text:
                fields["exc_text"] = logging.Formatter().formatException(record.exc_info)
            try:
                self._worker.say(messages.Logged(fields))
            except (EOFError, OSError):
                pass  # the scheduler is gone
            except Exception:  # something of `extra=` cannot travel
                plain = {
                    name: value
                    for name, value in fields.items()
                    if value is None or isinstance(value, str | int | float)
                }
                self._worker.say(messages.Logged(plain))
        except Exception:
            self.handleError(record)


def _attempt(function: Callable[[], None]) -> bytes | None:
    """Return the error that a function raises, packed; None if it raises none."""
    try:
        function()
    except BaseException as exc:
        exc.__traceback__ = _in_callback(exc)
        return pack_error(exc)
    return None


def _in_callback(exc: BaseException) -> Any:
    """Return the part of a traceback that is the callback's."""
    place = exc.__traceback__
    while place is not None and place.tb_frame.f_globals.get("__name__") == __name__:
        place = place.tb_next
    return place or exc.__traceback__
