"""The scheduler's side of a worker process: starts it, has it run callbacks, sees it end."""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

from horus import clock
from horus.errors import WorkerDied, WorkerError
from horus.live import LiveNode
from horus.loop.realtime import RealTime
from horus.tick_path import worker_died
from horus.topics import Subscription
from horus.workers import messages
from horus.workers.channel import Channel
from horus.workers.pickling import by_value, dumps, loads, pack, pack_error, part, unpack_error

_CODE = (
    "import sys; sys.path.insert(0, sys.argv[1]); "
    "from horus.workers.worker import main; main(*map(int, sys.argv[2:]))"
)
_ROOT = Path(__file__).resolve().parents[2]
_LAST_STEPS_S = 1.0
"""How long a worker may take to end by itself [s]."""

_STACK_TIMEOUT_S = 0.01
_FRAME = re.compile(r'  File "(.*)", line (\d+) in (.*)')


class WorkerProcess:
    """One process, with what it says and what it is told.

    Thread: any.
    """

    def __init__(self, name: str, on_end: Callable[[WorkerProcess], None]) -> None:
        """Start it.

        Args:
            name: The node's.
            on_end: Called with it when it has ended, on a thread of its own.

        Raises:
            WorkerError: It cannot be started.
        """
        self._name = name
        self._on_end = on_end
        self._over = threading.Event()
        self._status = 0
        self._stacks = -1
        self._looking = threading.Lock()
        self.answers = False
        """Whether it has said something: it can be asked for its stack from then on."""
        with contextlib.ExitStack() as undo:
            try:
                turns, their_turns = map(undo.enter_context, socket.socketpair())
                aside, their_aside = map(undo.enter_context, socket.socketpair())
                if hasattr(os, "memfd_create"):
                    self._stacks = os.memfd_create("horus-stacks")
            except OSError as exc:
                raise WorkerError(f"node {name!r}: no worker process can be had: {exc}") from exc
            undo.pop_all()
        self.turns = Channel(turns, dumps, loads)
        self.aside = Channel(aside, dumps, loads)
        started: Future[subprocess.Popen[bytes]] = Future()
        # The kernel kills the worker when the thread that has started it ends: it stays.
        keeper = threading.Thread(
            target=self._keep,
            args=(started, their_turns, their_aside),
            name=f"horus-worker:{name}",
            daemon=True,
        )
        try:
            keeper.start()
            self._process = started.result()
        except Exception as exc:
            self.close()
            raise WorkerError(f"node {name!r}: no worker process can be had: {exc}") from exc

    def death(self) -> WorkerDied:
        """Return how it has ended; one that only does not answer any more is killed first."""
        if not self._over.wait(_LAST_STEPS_S):
            self.kill()
            self._over.wait(_LAST_STEPS_S)
        return WorkerDied(self._name, self._status)

    def kill(self) -> None:
        """End it at once."""
        self._process.kill()

    def end(self) -> None:
        """Let it end by itself, for a while, and give everything back."""
        self.close()
        if not self._over.wait(_LAST_STEPS_S):
            self.kill()
            self._over.wait(_LAST_STEPS_S)

    def close(self) -> None:
        """Hang up."""
        self.turns.close()
        self.aside.close()
        with self._looking:
            if self._stacks >= 0:
                os.close(self._stacks)
                self._stacks = -1

    def stack(self) -> traceback.StackSummary | None:
        """Return where its main thread is; None before it has said anything.

        Written by `faulthandler` in a signal handler: also of an extension that holds
        the interpreter.
        """
        with self._looking:
            return self._look(self._stacks) if self.answers and self._stacks >= 0 else None

    def _look(self, file: int) -> traceback.StackSummary:
        # The two share a file offset.
        os.ftruncate(file, 0)
        os.lseek(file, 0, os.SEEK_SET)
        with contextlib.suppress(OSError):
            self._process.send_signal(signal.SIGUSR1)
        give_up_ns = clock.monotonic_ns() + round(_STACK_TIMEOUT_S * 1e9)
        text = size = 0
        while clock.monotonic_ns() < give_up_ns:
            text, size = size, os.fstat(file).st_size
            if size and size == text:
                break
            self._over.wait(0.001)
        lines = os.pread(file, size, 0).decode(errors="replace").splitlines()
        frames = [found.groups() for line in lines if (found := _FRAME.match(line))]
        return traceback.StackSummary.from_list(
            [traceback.FrameSummary(path, int(line), name) for path, line, name in reversed(frames)]
        )

    def _keep(self, started: Future[subprocess.Popen[bytes]], *theirs: socket.socket) -> None:
        descriptors = [each.fileno() for each in theirs]
        given = [*descriptors, self._stacks] if self._stacks >= 0 else descriptors
        try:
            process = subprocess.Popen(
                [
                    sys.executable,
                    *_interpreter_options(),
                    "-c",
                    _CODE,
                    str(_ROOT),
                    *map(str, descriptors),
                    str(self._stacks),
                ],
                stdin=subprocess.DEVNULL,
                pass_fds=given,
                start_new_session=True,  # Ctrl+C is for the scheduler, which ends it in order
            )
        except BaseException as exc:
            started.set_exception(exc)
            return
        finally:
            for each in theirs:
                each.close()
        started.set_result(process)
        self._status = process.wait()
        self._over.set()
        # A child of its may hold its ends of the sockets open.
        self.turns.hang_up()
        self.aside.hang_up()
        self._on_end(self)


class RemoteNode:
    """A node whose callbacks run in a worker process, from `init` to `shutdown`.

    Thread: the node's, unless a method says otherwise.
    """

    def __init__(
        self,
        live: LiveNode,
        real_time: RealTime,
        post: Callable[[Callable[[], None]], None],
    ) -> None:
        """Prepare.

        Args:
            live: The node.
            real_time: Tells where the worker runs.
            post: Runs a job on the node's thread, after what is in progress.
        """
        self._live = live
        self._real_time = real_time
        self._post = post
        self._process: WorkerProcess | None = None
        self._dismissed = False
        self._turn = threading.Lock()
        self._aside = threading.Lock()
        self._received_before: dict[str, int] = {}

    def callbacks(self) -> dict[str, Callable[[], Any] | None]:
        """Return what runs the node's callbacks in the worker."""
        remote: dict[str, Callable[[], Any] | None] = {
            "init": self._init,
            "tick": self._tick,
            "shutdown": self._shutdown,
            "safe_state": None,
        }
        if self._live.core.callbacks["safe_state"] is not None:
            remote["safe_state"] = functools.partial(self._run, "safe_state")
        return remote

    def kill(self) -> None:
        """End the worker at once. Thread: any."""
        process = self._process
        if process is not None:
            process.kill()

    def dismiss(self) -> None:
        """End the worker at once, and have no other. Thread: any."""
        self._dismissed = True
        self.kill()

    def end(self) -> None:
        """End the worker, if there is one. Thread: any."""
        process, self._process = self._process, None
        if process is not None:
            process.end()
        for subscription in self._subscriptions().values():
            subscription.away = 0

    def stack(self) -> traceback.StackSummary | None:
        """Return where the worker's main thread is; None without a worker. Thread: any."""
        process = self._process
        return None if process is None else process.stack()

    # -- callbacks ---------------------------------------------------------------------

    def _init(self) -> None:
        """Run the node's `init()`, in a new worker unless there is one: after a tick has failed."""
        try:
            if self._process is None:
                self._start()
            self._run("init")
        except BaseException:
            self.end()
            raise

    def _start(self) -> None:
        live = self._live
        place = messages.Place(os.getpid(), sys.path, self._real_time.cores_of_worker(live))
        setup = self._setup(pack(live.core))
        with self._turn:  # a safe-state hook that comes now goes aside
            process = self._process = WorkerProcess(
                live.name, lambda process: self._post(functools.partial(self._ended, process))
            )
            if self._dismissed:
                raise WorkerError(f"node {live.name!r} was dismissed before its process had begun")
            try:
                process.turns.send(place)
                process.turns.send(setup)
                done, failed = self._listen(process.turns)
            except (EOFError, OSError) as exc:
                raise process.death() from exc
            process.answers = True
            _raise_first(done, failed)

    def _ended(self, process: WorkerProcess) -> None:
        """Act on the end of a worker, unless a callback has met it already."""
        if self._process is process:
            self.end()
            worker_died(self._live, process.death())

    def _tick(self) -> None:
        try:
            self._run("tick")
        except WorkerDied:
            self.end()
            raise

    def _shutdown(self) -> None:
        """Run the node's `shutdown()`, unless its worker is gone, and end the worker."""
        if self._process is None:
            self._live.emit(logging.WARNING, "no shutdown(): its worker process is gone")
            return
        try:
            self._run("shutdown")
        finally:
            self.end()

    def _run(self, phase: str) -> None:
        """Run a callback in the worker.

        In its turn; a hook or a shutdown aside, if a tick is in progress.

        Raises:
            WorkerDied: The worker has ended.
            BaseException: What the callback has raised.

        Thread: any.
        """
        process = self._process
        if process is None:
            raise WorkerError(f"node {self._live.name!r} has no worker process")
        waits = phase in ("init", "tick")
        if self._turn.acquire(blocking=waits):
            with contextlib.ExitStack() as turn:
                turn.callback(self._turn.release)
                self._converse(process, process.turns, phase)
        else:
            with self._aside:
                self._converse(process, process.aside, phase)

    def _converse(self, process: WorkerProcess, channel: Channel, phase: str) -> None:
        in_turn = channel is process.turns
        inputs = self._inputs() if in_turn else ()
        call = messages.Call(phase, self._live.tick_context.moment(), inputs)
        try:
            lost = self._send(call, channel)
            done, failed = self._listen(channel)
            if phase != "tick" and not done.understood and done.error is not None:
                lost = unpack_error(done.error)
                self._send(call._replace(inputs=()), channel)
                done, failed = self._listen(channel)
        except (EOFError, OSError) as exc:
            raise process.death() from exc
        if in_turn:
            self._count(done)
        if lost is not None and phase != "tick":
            self._live.emit(logging.WARNING, f"messages that waited for it are lost: {lost}")
            lost = None
        _raise_first(done, failed or lost)

    def _listen(self, channel: Channel) -> tuple[messages.Done, Exception | None]:
        """Hear what the worker says until it is done; return what could not be understood, too."""
        failed: Exception | None = None
        while True:
            try:
                said = messages.from_plain(channel.receive())
            except (EOFError, OSError):
                raise
            except Exception as exc:  # a message's own class
                failed = failed or exc
                continue
            if isinstance(said, messages.Done):
                return said, failed
            if isinstance(said, messages.Open | messages.Fetch):
                self._answer(said, channel)
                continue
            try:
                self._hear(said)
            except Exception as exc:  # a filter of the application's log, say
                failed = failed or exc

    def _send(self, call: messages.Call, channel: Channel) -> BaseException | None:
        """Ask for a callback; return what is wrong with messages that are lost on the way."""
        try:
            channel.send(messages.to_plain(call))
        except (EOFError, OSError):
            raise
        except Exception as exc:
            kept, refused = part(call.inputs)
            if not refused:
                raise
            for topic, _ in refused:
                self._subscriptions()[topic].away -= 1
            channel.send(messages.to_plain(call._replace(inputs=kept)))
            topic, (payload, _) = refused[0]
            return WorkerError(
                f"topic {topic!r}: a {type(payload).__name__} cannot go to the worker process of "
                f"node {self._live.name!r}: {exc}; send plain data, or keep the node on a "
                "thread with compute=True"
            )
        return None

    def _hear(self, said: Any) -> None:
        core = self._live.core
        match said:
            case messages.Sent(topic, message):
                publisher = core.outputs.get(topic) or core.open_output(topic, warn=False)
                publisher.deliver(message)
            case messages.Logged(record):
                logging.getLogger(record["name"]).handle(logging.makeLogRecord(dict(record)))
            case messages.Stop(reason):
                self._live.control.request_stop(reason)

    def _answer(self, question: messages.Open | messages.Fetch, channel: Channel) -> None:
        """Answer with what was asked for, or with the reason why not."""
        try:
            answer = messages.Answer(None, self._find(question))
        except Exception as exc:
            answer = messages.Answer(pack_error(exc), None)
        channel.send(tuple(answer))

    def _find(self, question: messages.Open | messages.Fetch) -> bytes | None:
        match question:
            case messages.Open(topic):
                return self._pack_newest(self._live.core.open_input(topic, warn=False))
            case messages.Fetch(name):
                return by_value(name)

    def _pack_newest(self, subscription: Subscription) -> bytes | None:
        """Return the newest message of a topic; None if there is none that can travel."""
        topic = subscription.topic
        try:
            return None if topic.newest is None else dumps(topic.newest, None)
        except Exception as exc:
            text = f"the newest message on topic {topic.name!r} cannot go to its process: {exc}"
            self._live.emit(logging.WARNING, text)
            return None

    # -- topics --------------------------------------------------------------------------

    def _setup(self, parcel: bytes) -> messages.Setup:
        live = self._live
        subscriptions = self._subscriptions()
        self._received_before = {
            topic: subscription.received for topic, subscription in subscriptions.items()
        }
        topics = [publisher.topic for publisher in live.core.outputs.values()]
        topics += [subscription.topic for subscription in subscriptions.values()]
        newest = {name: self._pack_newest(each) for name, each in subscriptions.items()}
        loggers = ("", "horus", f"horus.node.{live.name}")
        return messages.Setup(
            levels={name: logging.getLogger(name).getEffectiveLevel() for name in loggers},
            timeline=(live.timeline.tick_rate_hz, live.timeline.wall_offset_ns),
            parcel=parcel,
            types={topic.name: topic.type for topic in topics if topic.type is not None},
            newest=newest,
        )

    def _inputs(self) -> messages.Inputs:
        waiting = self._subscriptions().items()
        return [(topic, handed) for topic, each in waiting if (handed := each.hand_over())]

    def _count(self, done: messages.Done) -> None:
        subscriptions = self._subscriptions()
        for topic, received, waiting in done.queues:
            subscription = subscriptions[topic]
            subscription.received = self._received_before.setdefault(topic, 0) + received
            subscription.away = waiting

    def _subscriptions(self) -> dict[str, Subscription]:
        inputs = self._live.core.inputs.copy().items()
        return {topic: subscription for topic, subscription in inputs if isinstance(topic, str)}


def _interpreter_options() -> list[str]:
    """Return options that make an interpreter treat assertions and warnings as this one does."""
    # Not the working directory: what is called like a standard module there is not meant.
    options = ["-P", *["-O"] * sys.flags.optimize, *["-B"] * sys.flags.dont_write_bytecode]
    options += ["-I"] * sys.flags.isolated + ["-E"] * sys.flags.ignore_environment
    options += ["-s"] * sys.flags.no_user_site
    options += [f"-W{option}" for option in sys.warnoptions]
    for name, value in sys._xoptions.items():
        options += ["-X", name if value is True else f"{name}={value}"]
    return options


def _raise_first(done: messages.Done, failed: BaseException | None) -> None:
    """Raise what the callback has raised, or else what went wrong with its messages."""
    if done.error is not None:
        raise unpack_error(done.error)
    if failed is not None:
        raise failed
