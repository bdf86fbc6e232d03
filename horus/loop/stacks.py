"""Where a thread or a task is: the Python stack of somebody else."""

from __future__ import annotations

import asyncio
import os
import sys
import traceback
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any

_PACKAGE = str(Path(__file__).resolve().parent.parent) + os.sep
_CALLERS = ("run_tick", "call", "run_phase_async")
"""The functions of ours that call or await a node's callbacks."""

Stack = traceback.StackSummary
"""Lines of code, innermost call last; of a callback, only what is the node's own.

Source files are read when it is formatted, not before.
"""


def stack_of_thread(thread_id: int | None) -> Stack:
    """Return the current Python stack of a thread; empty if there is no such thread.

    Thread: any other.
    """
    frame = None if thread_id is None else sys._current_frames().get(thread_id)
    return _capture(reversed(list(traceback.walk_stack(frame))) if frame is not None else iter(()))


def stack_of_task(task: asyncio.Task[Any], thread_id: int | None) -> Stack:
    """Return where a task waits, or the thread's stack while the task computes.

    `Task.get_stack()` shows the outermost coroutine alone: here are those that it
    awaits, too.

    Args:
        task: The task.
        thread_id: The thread of its event loop.

    Thread: any other.
    """
    if computes(task):
        return stack_of_thread(thread_id)
    coroutine: Any = task.get_coro()
    frames: list[tuple[FrameType, int]] = []
    while (frame := getattr(coroutine, "cr_frame", None)) is not None:
        frames.append((frame, frame.f_lineno))
        coroutine = getattr(coroutine, "cr_await", None)
    return _capture(iter(frames))


def in_callback(frame: FrameType | None) -> bool:
    """Return whether a thread that is at `frame` executes code of a node's callback.

    Not what the callback has called of ours: there, locks may be held.
    """
    if frame is None or _is_ours(frame):
        return False
    caller: FrameType | None = frame
    while caller is not None and not _is_ours(caller):
        caller = caller.f_back
    return caller is not None and caller.f_code.co_name in _CALLERS


def computes(task: asyncio.Task[Any]) -> bool:
    """Return whether a task executes at this moment. Thread: any."""
    return bool(getattr(task.get_coro(), "cr_running", False))


def readable_stack(stack: Stack) -> str:
    """Return a stack as text, as tracebacks show it."""
    return "".join(stack.format()).rstrip("\n") or "  (no Python code)"


def _is_ours(frame: FrameType) -> bool:
    return frame.f_code.co_filename.startswith(_PACKAGE)


def _capture(frames: Iterator[tuple[FrameType, int]]) -> Stack:
    stack = traceback.StackSummary.extract(frames, lookup_lines=False)
    places = [
        place
        for place, line in enumerate(stack)
        if line.filename.startswith(_PACKAGE) and line.name in _CALLERS
    ]
    return Stack.from_list(stack[places[-1] + 1 :]) if places else stack
