"""What an application waits for: that the nodes run, that one has ticked, that one answers."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

from horus.errors import StateError
from horus.session import Session
from horus.spec import NodeState
from horus.stream import MessageStream

_LOOK_EVERY_S = 0.002


async def started(session: Session) -> None:
    """Wait until every node of the present run, or of the next one, may tick.

    Raises:
        StateError: The run ended before.

    Thread: that of an asyncio event loop, whichever runs the nodes.
    """
    before = session.runs_started - session.started
    await _until(session, lambda: session.runs_started > before, "its nodes could tick")


async def ticked(session: Session, name: str, ticks: int) -> None:
    """Wait until a node has completed so many ticks in all.

    Raises:
        UnknownNodeError: There is no such node, or it was removed.
        StateError: The run ended before, or its `init()` failed.

    Thread: that of an asyncio event loop, whichever runs the nodes.
    """

    def enough() -> bool:
        live = session.registry.get(name)
        if live.counters.ticks >= ticks:
            return True
        if live.state is NodeState.ERROR:
            raise StateError(f"node {name!r} does not tick: its init() failed")
        return False

    times = "once" if ticks == 1 else f"{ticks} times"
    await _until(session, enough, f"node {name!r} had ticked {times}")


async def answer(replies: MessageStream, timeout_s: float | None) -> Any:
    """Wait for the first message of a stream.

    Raises:
        TimeoutError: There was none in time [s].
        StateError: The run ended before.

    Thread: that of an asyncio event loop.
    """
    try:
        async with asyncio.timeout(timeout_s):
            async for message in replies:
                return message
    except TimeoutError:
        raise TimeoutError(f"no answer on topic {replies.topic!r} in {timeout_s:g} s") from None
    raise StateError(f"the run ended before there was an answer on topic {replies.topic!r}")


async def _until(session: Session, holds: Callable[[], bool], what: str) -> None:
    # Looked at now and then: the tick path has nobody to tell.
    ended_before = session.runs_ended
    while not holds():
        if session.runs_ended > ended_before:
            reason = session.control.stop_reason or "its time was over"
            raise StateError(f"the run ended before {what}: {reason}")
        await asyncio.sleep(_LOOK_EVERY_S)
