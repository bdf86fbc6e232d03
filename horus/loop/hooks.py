"""Calls safe-state hooks from threads that nothing else needs, each bounded in time."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable, Iterable

from horus.live import LiveNode
from horus.loop.bridge import Bridge
from horus.loop.safety import HOOK_TIMEOUT_S
from horus.loop.stacks import readable_stack, stack_of_thread
from horus.loop.supervisor_thread import Report
from horus.spec import Health

_LAST_TICK_MS = 20
"""How long a hook waits for the end of a healthy tick in progress [ms]."""

_LOOP_TIMEOUT_S = 0.02
"""How long the event loop may take to begin an async hook [s]."""


class HookCaller:
    """Calls the hooks of nodes one after another.

    A hook runs on a thread of its own, not in its node's home, which may be what
    is frozen. An async hook runs on the event loop if that is free, and on a loop
    of its own if it is not. One that does not return in time is left to itself, and
    named.

    Thread: any.
    """

    def __init__(
        self,
        enter_thread: Callable[[], None],
        bridge: Callable[[], Bridge | None],
        report: Report,
    ) -> None:
        """Prepare.

        Args:
            enter_thread: Sets up each thread.
            bridge: Returns the way into the event loop; None where there is none.
            report: Takes what is to be logged.
        """
        self._enter_thread = enter_thread
        self._bridge = bridge
        self._report = report

    def start(self, lives: Iterable[LiveNode]) -> None:
        """Call the hooks of these nodes, in this order; return at once."""
        _start_thread(lambda: self._call_alive(lives), "horus-safe-state")

    def call(self, lives: Iterable[LiveNode]) -> None:
        """Call the hooks of these nodes, in this order, each for a bounded time."""
        for live in lives:
            self._call_one(live)

    def _call_alive(self, lives: Iterable[LiveNode]) -> None:
        for live in lives:
            if live.initialized:
                self._call_one(live)
            else:
                live.hook_returned.set()  # shut down meanwhile: nothing may follow

    def _call_one(self, live: LiveNode) -> None:
        # Its last command must come before the hook's, not after.
        nap = threading.Event()
        for _ in range(_LAST_TICK_MS):
            if live.ticking and live.health is Health.HEALTHY:
                nap.wait(0.001)

        def run() -> None:
            self._enter_thread()
            try:
                self._run(live)
            finally:
                live.hook_returned.set()

        thread = _start_thread(run, f"horus-safe-state:{live.name}")
        thread.join(HOOK_TIMEOUT_S)
        if thread.is_alive():
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


def _start_thread(work: Callable[[], None], name: str) -> threading.Thread:
    thread = threading.Thread(target=work, name=name, daemon=True)
    thread.start()
    return thread
