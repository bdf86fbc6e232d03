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


def takes_node(function: Callback) -> bool | None:
    """Return whether a callback asks for the node; None if it can be called neither way.

    It asks by a positional parameter without default. A parameter with a default
    was bound by the author (`lambda i=i: ...`) and is no place for the node.
    """
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):
        return True  # written in C: nothing is known
    asks = any(
        parameter.kind is parameter.VAR_POSITIONAL
        or (
            parameter.kind in (parameter.POSITIONAL_ONLY, parameter.POSITIONAL_OR_KEYWORD)
            and parameter.default is parameter.empty
        )
        for parameter in signature.parameters.values()
    )
    try:
        signature.bind(*[None] * asks)
    except TypeError:
        return None
    return asks
