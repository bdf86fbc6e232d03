"""Sees to it that a run ends, even if a callback blocks the event loop."""

from __future__ import annotations

import asyncio
import functools
import logging
from collections.abc import Callable
from typing import Protocol

from horus.loop.bridge import Bridge
from horus.loop.stacks import readable_stack, stack_of_thread
from horus.loop.supervisor_thread import SupervisorThread
from horus.units import to_s

_log = logging.getLogger("horus.supervisor")

_TRY_AGAIN_S = 0.1


class WayOut(Protocol):
    """What a run that owns the process may do about a blocked main thread.

    Thread: any other.
    """

    interrupted: bool
    """Whether the last `interrupt` has reached the callback."""

    def interrupt(self) -> None:
        """Raise an exception in the callback, if it executes Python code."""

    def force_exit(self, why: str) -> None:
        """Make the robot safe and end the process."""


class Ending:
    """Asks the event loop for a sign of life, from the moment on that the run is to end.

    A loop that gives none for a while is blocked by a callback. That is reported,
    with its stack. In a `run()` that owns the process the callback is interrupted, and
    if not even that helps, because it is in an extension, the process is ended: `run()`
    comes to its end even if a tick never returns.

    Thread: any for `expect` and `over`; the rest supervisor.
    """

    def __init__(
        self,
        supervisor: SupervisorThread,
        bridge: Bridge,
        stop: Callable[[], None],
        way_out: WayOut | None,
        patience_s: float,
    ) -> None:
        """Wait for the end of a run.

        Args:
            supervisor: Where this happens.
            bridge: The way into the loop.
            stop: Lets no further tick begin.
            way_out: What can be done about a callback that blocks the loop; None for
                nothing.
            patience_s: How long the loop may be silent [s].
        """
        self._supervisor = supervisor
        self._bridge = bridge
        self._stop = stop
        self._way_out = way_out
        self._patience_s = patience_s
        self._expected = asyncio.Event()
        self._over = False
        supervisor.spawn(self._see_to_it)

    def expect(self, in_ns: int = 0) -> None:
        """Expect the end now, or in a time [ns]."""
        loop = self._supervisor.loop
        self._supervisor.call(lambda: loop.call_later(to_s(in_ns), self._expected.set))

    def over(self) -> None:
        """Take note that it has ended."""
        self._over = True
        self.expect()

    async def _see_to_it(self) -> None:
        await self._expected.wait()
        while not self._over:
            answered = asyncio.Event()
            self._bridge.post(functools.partial(self._supervisor.call, answered.set))
            if not await _within(self._patience_s, answered) and not await _within(
                # Once more: a process that was suspended has had no chance.
                _TRY_AGAIN_S,
                answered,
            ):
                self._stop()
                self._report()
                if self._way_out is not None:
                    await self._take(self._way_out, answered)
            await asyncio.sleep(self._patience_s / 2)

    async def _take(self, way_out: WayOut, answered: asyncio.Event) -> None:
        """Interrupt the callback, once; if the loop gives no answer, force the process to exit.

        Interrupted again, it could not even clean up.
        """
        way_out.interrupt()
        for _ in range(max(1, round(self._patience_s / _TRY_AGAIN_S))):
            if await _within(_TRY_AGAIN_S, answered) or self._over:
                return
            if not way_out.interrupted:
                way_out.interrupt()
        way_out.force_exit("the event loop does not come back")

    def _report(self) -> None:
        stack = stack_of_thread(self._bridge.thread_id)
        consequence = "" if self._way_out is None else ", and is interrupted now"
        self._supervisor.report(
            lambda: _log.error(
                "the event loop has not reacted to a stop for %g s%s; it is blocked in:\n%s",
                self._patience_s,
                consequence,
                readable_stack(stack),
            )
        )


async def _within(timeout_s: float, event: asyncio.Event) -> bool:
    try:
        async with asyncio.timeout(timeout_s):
            await event.wait()
    except TimeoutError:
        return False
    return True
