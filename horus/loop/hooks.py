"""Calls safe-state hooks from threads that nothing else needs, each bounded in time."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable, Iterable

from horus.live import LiveNode
from horus.loop.bridge import Bridge
from horus.loop.realtime import RealTime
from horus.loop.safety import HOOK_TIMEOUT_S
from horus.loop.stacks import readable_stack, stack_of_thread
from horus.loop.supervisor_thread import Report
from horus.spec import Health

_LAST_TICK_S = 0.02
"""How long the hooks that follow are kept waiting by a healthy tick in progress [s]."""

_LOOP_TIMEOUT_S = 0.02
"""How long the event loop may take to begin an async hook [s]."""


class HookCaller:
    """Calls the hooks of nodes one after another.

    A hook runs on a thread of its own, not in its node's home, which may be what
    is frozen; if the process can have no more threads, where it is asked for. An async
    hook runs on the event loop if that is free, and on a loop of its own if it is not.
    One that does not return in time is left to itself, and named.

    A node's last command must come before its hook's. So a hook waits for the end of
    a healthy tick in progress: 20 ms in its turn, and 100 ms after all the others.

    Thread: any.
    """

    def __init__(
        self,
        real_time: RealTime,
        bridge: Callable[[], Bridge | None],
        report: Report,
    ) -> None:
        """Prepare.

        Args:
            real_time: Gives each thread its priority.
            bridge: Returns the way into the event loop; None where there is none.
            report: Takes what is to be logged.
        """
        self._real_time = real_time
        self._bridge = bridge
        self._report = report

    @staticmethod
    def limit_s(count: int) -> float:
        """Return how long `call` takes at most for so many nodes [s]."""
        return count * (_LAST_TICK_S + 2 * HOOK_TIMEOUT_S)

    def start(self, lives: Iterable[LiveNode]) -> None:
        """Call the hooks of these nodes, in this order; return at once."""
        # Shut down meanwhile: nothing may follow.
        _run_aside(lambda: self._call_all(lives, lambda live: live.initialized), "horus-safe-state")

    def call(self, lives: Iterable[LiveNode]) -> None:
        """Call the hooks of these nodes, in this order, each for a bounded time."""
        self._call_all(lives, lambda live: True)

    def _call_all(self, lives: Iterable[LiveNode], owed: Callable[[LiveNode], bool]) -> None:
        ticking = []
        for live in lives:
            if _tick_ends(live, _LAST_TICK_S):
                self._call_one(live, owed)
            else:
                ticking.append(live)
        for live in ticking:
            _tick_ends(live, HOOK_TIMEOUT_S)
            self._call_one(live, owed)

    def _call_one(self, live: LiveNode, owed: Callable[[LiveNode], bool]) -> None:
        if not owed(live):
            live.standing.hook_returned.set()
            return

        def run() -> None:
            if threading.current_thread() is not asker:
                self._real_time.enter_hook_thread()
            try:
                self._run(live)
            finally:
                live.standing.hook_returned.set()

        asker = threading.current_thread()
        thread = _run_aside(run, f"horus-safe-state:{live.name}")
        if thread is None:
            return
        thread.join(HOOK_TIMEOUT_S)
        if thread.is_alive():
            self._real_time.demote_hook_thread(thread)
            stack = stack_of_thread(thread.ident)
            self._report(
                lambda: live.emit(
                    logging.ERROR,
                    f"safe_state() has not returned for {HOOK_TIMEOUT_S:g} s and is left to "
                    f"itself; it is in:\n{readable_stack(stack)}",
                )
            )

    def _run(self, live: LiveNode) -> None:
        # A copy: a frozen tick still holds the node's own context.
        context = live.context.copy()
        if not live.is_async:
            context.run(live.run_phase, "safe_state")
            return
        bridge = self._bridge()
        claim = threading.Lock()
        done = threading.Event()

        def run_on_loop() -> None:
            if bridge is not None and bridge.on_loop_thread() and claim.acquire(blocking=False):
                task = bridge.loop.create_task(
                    live.run_phase_async("safe_state"),
                    name=f"horus-safe-state:{live.name}",
                    context=context,
                )
                task.add_done_callback(lambda _: done.set())

        if bridge is not None and bridge.thread_id is not None:
            bridge.post(run_on_loop)
            done.wait(_LOOP_TIMEOUT_S)
        if claim.acquire(blocking=False):
            context.run(asyncio.run, live.run_phase_async("safe_state"))
        else:
            done.wait()


def _tick_ends(live: LiveNode, timeout_s: float) -> bool:
    """Wait for the end of a healthy tick; return whether there is none (any more)."""
    nap = threading.Event()
    for _ in range(round(timeout_s * 1000)):
        if not (live.ticking and live.standing.health is Health.HEALTHY):
            return True
        nap.wait(0.001)
    return False


def _run_aside(work: Callable[[], None], name: str) -> threading.Thread | None:
    """Run something on a thread of its own; here and now, and None, if there can be none."""
    thread = threading.Thread(target=work, name=name, daemon=True)
    try:
        thread.start()
    except RuntimeError:  # the process has all the threads that it may have
        work()
        return None
    return thread
