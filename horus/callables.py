"""What a user's function tells about itself: whether it is async, and what it takes."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import Any

Callback = Callable[..., Any]


def is_async_callable(function: Callback | None) -> bool:
    """Return whether calling `function` gives an awaitable by its declaration."""
    while isinstance(function, functools.partial):
        function = function.func
    return inspect.iscoroutinefunction(function) or (
        not inspect.isroutine(function) and inspect.iscoroutinefunction(type(function).__call__)
    )


def takes_node(function: Callback) -> bool:
    """Return whether a callback asks for the node: by a positional parameter without default."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return True
    # A default marks a value that the author bound (`lambda i=i: ...`), not a
    # place for the node.
    return any(
        parameter.kind is parameter.VAR_POSITIONAL
        or (
            parameter.kind in (parameter.POSITIONAL_ONLY, parameter.POSITIONAL_OR_KEYWORD)
            and parameter.default is parameter.empty
        )
        for parameter in parameters
    )
