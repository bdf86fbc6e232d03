"""How messages, nodes and errors travel between a scheduler and a worker.

Messages are pickled by the standard library, which is fast and takes classes by
reference. What it refuses, such as classes defined in a function, cloudpickle takes by value.
A worker has another `__main__` than the program: a class of the program's is looked for there, and
asked for (`Unpickler.fetch`) if it is not there yet; so it is the same class in both directions.
"""

from __future__ import annotations

import functools
import io
import pickle
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from types import CodeType, FunctionType, MethodType
from typing import Any

import cloudpickle

from horus.core import NodeCore
from horus.errors import WorkerError
from horus.snapshot import Frozen
from horus.workers.messages import Inputs

_DEEPEST = 8
"""So many steps are followed to what cannot be pickled."""

BufferCallback = Callable[[pickle.PickleBuffer], None] | None


def dumps(message: Any, buffer_callback: BufferCallback) -> bytes:
    """Pickle a message, its large buffers apart.

    Raises:
        Exception: It cannot be pickled.
    """
    buffers: list[pickle.PickleBuffer] = []
    try:
        callback = None if buffer_callback is None else buffers.append
        body = pickle.dumps(message, 5, buffer_callback=callback)
    except Exception:
        buffers.clear()
        with io.BytesIO() as file:
            _Pickler(file, 5, buffer_callback=callback).dump(message)
            body = file.getvalue()
    if buffer_callback is not None:
        for buffer in buffers:
            buffer_callback(buffer)
    return body


def loads(body: memoryview, buffers: Iterable[memoryview]) -> Any:
    """Unpickle what `dumps` has made, in the program itself."""
    return pickle.loads(body, buffers=buffers)


class _Pickler(cloudpickle.Pickler):  # type: ignore[misc]
    """Takes by value what cannot be found by its name."""

    def reducer_override(self, obj: Any) -> Any:
        """Take a class of `__main__` by reference, as far as it has a name there."""
        if isinstance(obj, type) and obj.__module__ == "__main__" and "." not in obj.__qualname__:
            main = sys.modules["__main__"]
            if getattr(main, obj.__qualname__, obj) is obj:
                setattr(main, obj.__qualname__, obj)
                return NotImplemented
        return super().reducer_override(obj)


class Unpickler(pickle.Unpickler):
    """Unpickles in a worker."""

    def __init__(
        self,
        body: memoryview,
        buffers: Iterable[memoryview],
        fetch: Callable[[str], Any],
    ) -> None:
        """Unpickle one message; `fetch` asks the program for something of its `__main__`."""
        super().__init__(io.BytesIO(body), buffers=buffers)
        self._fetch = fetch

    def find_class(self, module: str, name: str) -> Any:
        """Return what is called `name` in `module`."""
        main = sys.modules["__main__"]
        if module == "__main__" and "." not in name and not hasattr(main, name):
            setattr(main, name, self._fetch(name))
        return super().find_class(module, name)


def pack(core: NodeCore) -> bytes:
    """Return a node as it is now, with its callbacks, closures and classes, as bytes.

    Raises:
        WorkerError: Something in it cannot go to another process; the message names it.
    """
    try:
        # The node, which leads to its core: that is complete before the node then.
        return bytes(cloudpickle.dumps(core.node, 5))
    except Exception as exc:
        raise WorkerError(f"node {core.spec.name!r}: {_culprit(core) or exc}") from exc


def part(inputs: Inputs) -> tuple[list[tuple[str, list[Frozen]]], list[tuple[str, Frozen]]]:
    """Part messages that can travel from those that cannot."""
    kept: list[tuple[str, list[Frozen]]] = []
    refused: list[tuple[str, Frozen]] = []
    for topic, arrived in inputs:
        kept.append((topic, [frozen for frozen in arrived if _travels(frozen)]))
        refused += [(topic, frozen) for frozen in arrived if not _travels(frozen)]
    return kept, refused


def by_value(name: str) -> bytes:
    """Return something of this program's `__main__` by value."""
    return bytes(cloudpickle.dumps(getattr(sys.modules["__main__"], name), 5))


class RemoteTraceback(Exception):
    """The traceback in the worker, as the cause of an exception that came from there."""

    def __str__(self) -> str:
        """Show it as it would have been shown there."""
        return f'\n"""\n{self.args[0]}"""'


def pack_error(error: BaseException) -> bytes:
    """Return an exception as bytes that can be unpacked; one that cannot, as a WorkerError."""
    text = "".join(traceback.format_exception(error))
    try:
        packed = dumps((error, text), None)
        pickle.loads(packed)
    except Exception:
        packed = pickle.dumps((WorkerError(f"{type(error).__name__}: {error}"), text), 5)
    return packed


def unpack_error(packed: bytes) -> BaseException:
    """Return an exception from a worker, its traceback there as the cause."""
    error: BaseException
    error, text = pickle.loads(packed)
    error.__cause__ = RemoteTraceback(text)
    return error


def _culprit(core: NodeCore) -> str | None:
    """Return what cannot be pickled, in words, if it can be found."""
    for phase, function in core.functions.items():
        # A method of the node leads to the node, whose attributes come last.
        plain = getattr(function, "__func__", function)
        if not _travels(plain) and (found := _inmost(plain)) is not None:
            return _refusal(f"{phase}()", *found)
    for name, value in getattr(core.node, "__dict__", {}).items():
        if not name.startswith("_horus") and not _travels(value):
            steps, inmost = _inmost(value) or ([], value)
            return _refusal("it", [f"has .{name}", *steps], inmost)
    return None


def _inmost(value: object) -> tuple[list[str], object] | None:
    """Return the way to what does not travel in something, and that; None if it is not found."""
    steps: list[str] = []
    while len(steps) < _DEEPEST:
        for step, part_of_it in _parts(value):
            if not _travels(part_of_it):
                steps.append(step)
                value = part_of_it
                break
        else:
            break
    return (steps, value) if steps else None


def _refusal(subject: str, steps: list[str], value: object) -> str:
    way, kind = ", which ".join(steps), type(value)
    return (
        f"{subject} {way}, a {kind.__module__}.{kind.__qualname__}, which cannot go to a worker "
        "process; make it in init(), which runs there, or keep the node on a thread with "
        "compute=True"
    )


def _parts(value: object) -> Iterator[tuple[str, object]]:
    """Yield what something leads to when it is pickled, with words for the step."""
    if isinstance(value, FunctionType):
        for name, used in _used_by(value).items():
            yield f"uses {name!r}", used
    elif isinstance(value, functools.partial):
        yield "calls a function", value.func
        for place, argument in enumerate(value.args):
            yield f"has argument {place}", argument
        for name, argument in value.keywords.items():
            yield f"has argument {name!r}", argument
    elif isinstance(value, Mapping):
        for key, item in value.items():
            yield f"has [{key!r}]", item
    elif isinstance(value, list | tuple | set | frozenset):
        for place, item in enumerate(value):
            yield f"has [{place}]", item
    elif isinstance(value, MethodType):
        yield "belongs to an object", value.__self__
    else:
        for name, attribute in getattr(value, "__dict__", {}).items():
            yield f"has .{name}", attribute


def _used_by(function: FunctionType) -> Mapping[str, Any]:
    """Return what a function refers to by name: globals, closure and defaults."""
    used = {
        name: function.__globals__[name]
        for name in _names_in(function.__code__)
        if name in function.__globals__
    }
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        try:
            used[name] = cell.cell_contents
        except ValueError:
            continue  # not assigned yet
    defaults = function.__defaults__ or ()
    code = function.__code__
    names = code.co_varnames[: code.co_argcount]
    used.update(zip(names[len(names) - len(defaults) :], defaults, strict=True))
    used.update(function.__kwdefaults__ or {})
    return used


def _names_in(code: CodeType) -> Iterator[str]:
    """Yield the names of globals in code and in the functions and comprehensions in it."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names_in(constant)


def _travels(value: object) -> bool:
    try:
        cloudpickle.dumps(value, 5)
    except Exception:
        return False
    return True
