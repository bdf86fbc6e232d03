"""Where a thread or a task is: the Python stack of somebody else."""

from __future__ import annotations

import asyncio
import sys
import traceback
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any

_TICK_PATH = str(Path(__file__).resolve().parent.parent / "tick_path.py")

Stack = traceback.StackSummary
"""Lines of code, innermost call last. Source files are read when it is formatted, not before."""


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


def computes(task: asyncio.Task[Any]) -> bool:
    """Return whether a task executes at this moment. Thread: any."""
    return bool(getattr(task.get_coro(), "cr_running", False))


def readable_stack(stack: Stack) -> str:
    """Return a stack as text, as tracebacks show it; of a tick, what the node called."""
    return "".join(stack.format()).rstrip("\n") or "  (no Python code)"


def _capture(frames: Iterator[tuple[FrameType, int]]) -> Stack:
    stack = traceback.StackSummary.extract(frames, lookup_lines=False)
    places = [place for place, line in enumerate(stack) if line.filename == _TICK_PATH]
    return Stack.from_list(stack[places[-1] + 1 :]) if places else stack
