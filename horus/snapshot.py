"""Message isolation: what was sent is what arrives, whoever changes what afterwards.

`freeze(message)` returns `(payload, thaw)`. The payload is a private copy that
nobody outside the bus ever holds a mutable reference to; `thaw(payload)` makes
a copy for one receiver. `thaw` is None where the payload cannot be changed and
may be handed to everybody as it is.

Copying structurally beats serialising: a flat dict costs one C-level type check
and one C-level copy, tuples stay tuples, inf and nan stay themselves, and a
second receiver costs a copy instead of another decoding.
"""

from __future__ import annotations

import copy
import dataclasses
import datetime
import decimal
import enum
import fractions
import functools
import operator
import pathlib
import re
import sys
import types
import uuid
from collections.abc import Callable
from typing import Any

import msgspec

Thaw = Callable[[Any], Any] | None
Frozen = tuple[Any, Thaw]
Freezer = Callable[[Any], Frozen]

ATOMS: frozenset[type] = frozenset(
    {
        type(None),
        bool,
        int,
        float,
        complex,
        str,
        bytes,
        range,
        slice,
        type(Ellipsis),
        frozenset,
        datetime.date,
        datetime.datetime,
        datetime.time,
        datetime.timedelta,
        datetime.timezone,
        decimal.Decimal,
        fractions.Fraction,
        uuid.UUID,
        re.Pattern,
        pathlib.PurePosixPath,
        pathlib.PureWindowsPath,
        pathlib.PosixPath,
        pathlib.WindowsPath,
    }
)
"""Types whose values nobody can change: they pass by reference."""

_all_atoms = ATOMS.issuperset
_encode = msgspec.msgpack.Encoder().encode
_LONG_LIST = 16
_MSGPACK_FLOAT64 = b"\xcb"
_MSGPACK_FLOAT64_SIZE = 9
_UNSENDABLE = (
    types.FunctionType,
    types.BuiltinFunctionType,
    types.MethodType,
    types.ModuleType,
    types.GeneratorType,
    types.CoroutineType,
    types.AsyncGeneratorType,
    types.FrameType,
    type,
)


class UnsendableError(TypeError):
    """A value that cannot be isolated; the bus adds the topic to the message."""


def freeze(value: Any) -> Frozen:
    """Return a private copy of `value` and how to copy it for a receiver.

    Raises:
        UnsendableError: `value`, or something in it, cannot be copied.
        RecursionError: `value` contains itself.
    """
    kind = type(value)
    if kind in ATOMS:
        return value, None
    return (_freezers.get(kind) or _freezer_for(kind))(value)


def _freeze_dict(value: dict[Any, Any]) -> Frozen:
    # Keys are hashable and thereby immutable as far as Python can tell.
    if _all_atoms(map(type, value.values())):
        return value.copy(), dict.copy
    payload = {}
    thaws = []
    for key, item in value.items():
        payload[key], thaw = freeze(item)
        if thaw is not None:
            thaws.append((key, thaw))
    return payload, functools.partial(_thaw_items, tuple(thaws)) if thaws else dict.copy


def _freeze_list(value: list[Any]) -> Frozen:
    if _is_long_float_list(value) or _all_atoms(map(type, value)):
        return value.copy(), list.copy
    payload, thaws = _freeze_sequence(value)
    return payload, functools.partial(_thaw_items, thaws) if thaws else list.copy


def _is_long_float_list(value: list[Any]) -> bool:
    """Return whether this is a long list of nothing but floats, as laser scans are.

    Looking at the type of each item costs 20 ns a beam. Encoding to MessagePack
    looks at them all in C for a fifth of that, and tells: a float is the only
    thing that becomes a 0xcb byte and eight more (the encoder refuses subclasses).
    """
    count = len(value)
    if count < _LONG_LIST or type(value[0]) is not float or type(value[-1]) is not float:
        return False
    try:
        encoded = _encode(value)
    except (TypeError, ValueError, OverflowError, RecursionError):
        return False
    body = len(encoded) - _MSGPACK_FLOAT64_SIZE * count
    if body not in (3, 5):
        return False
    return encoded[body::_MSGPACK_FLOAT64_SIZE] == _MSGPACK_FLOAT64 * count


def _freeze_sequence(value: Any) -> tuple[list[Any], tuple[tuple[int, Any], ...]]:
    payload = []
    thaws = []
    for index, item in enumerate(value):
        frozen, thaw = freeze(item)
        payload.append(frozen)
        if thaw is not None:
            thaws.append((index, thaw))
    return payload, tuple(thaws)


def _freeze_tuple(value: tuple[Any, ...]) -> Frozen:
    if _all_atoms(map(type, value)):
        return value, None
    payload, thaws = _freeze_sequence(value)
    if all(map(operator.is_, payload, value)):
        return value, None
    build = _tuple_builder(type(value))
    return build(payload), functools.partial(_thaw_tuple, build, thaws) if thaws else None


def _tuple_builder(kind: type) -> Callable[[list[Any]], Any]:
    return getattr(kind, "_make", kind)


def _thaw_items(thaws: tuple[tuple[Any, Any], ...], payload: Any) -> Any:
    fresh = payload.copy()
    for key, thaw in thaws:
        fresh[key] = thaw(fresh[key])
    return fresh


def _thaw_tuple(
    build: Callable[[list[Any]], Any], thaws: tuple[tuple[int, Any], ...], payload: Any
) -> Any:
    return build(_thaw_items(thaws, list(payload)))


def _freeze_bytearray(value: bytearray) -> Frozen:
    return bytes(value), bytearray


def _freeze_set(value: set[Any]) -> Frozen:
    return value.copy(), set.copy


def _freeze_array(value: Any) -> Frozen:
    if value.dtype.hasobject:
        raise UnsendableError("a NumPy array of Python objects; send a list or a numeric array")
    payload = value.copy()
    payload.flags.writeable = False
    return payload, None


def _freeze_by_reference(value: Any) -> Frozen:
    return value, None


def _freeze_fields(names: tuple[str, ...], value: Any) -> Frozen:
    payload = copy.copy(value)
    thaws = []
    for name in names:
        frozen, thaw = freeze(getattr(value, name))
        setattr(payload, name, frozen)
        if thaw is not None:
            thaws.append((name, thaw))
    return payload, functools.partial(_thaw_fields, tuple(thaws))


def _thaw_fields(thaws: tuple[tuple[str, Any], ...], payload: Any) -> Any:
    fresh = copy.copy(payload)
    for name, thaw in thaws:
        setattr(fresh, name, thaw(getattr(fresh, name)))
    return fresh


def _freeze_deep(value: Any) -> Frozen:
    try:
        return copy.deepcopy(value), copy.deepcopy
    except RecursionError:
        raise
    except Exception as exc:
        raise UnsendableError(f"copying it failed with {type(exc).__name__}: {exc}") from exc


def _refuse(value: Any) -> Frozen:
    raise UnsendableError(f"a {type(value).__name__} is code or a resource, not data")


_freezers: dict[type, Freezer] = {
    dict: _freeze_dict,
    list: _freeze_list,
    tuple: _freeze_tuple,
    set: _freeze_set,
    bytearray: _freeze_bytearray,
}


def _freezer_for(kind: type) -> Freezer:
    """Decide once per type how its values are isolated."""
    freezer = _choose(kind)
    _freezers[kind] = freezer
    return freezer


def _choose(kind: type) -> Freezer:
    numpy = sys.modules.get("numpy")
    if numpy is not None and issubclass(kind, numpy.ndarray):
        return _freeze_array
    if numpy is not None and issubclass(kind, numpy.generic):
        return _freeze_by_reference
    if issubclass(kind, enum.Enum):
        return _freeze_by_reference
    if issubclass(kind, _UNSENDABLE):
        return _refuse
    if issubclass(kind, tuple) and hasattr(kind, "_make"):
        return _freeze_tuple
    if issubclass(kind, msgspec.Struct):
        if kind.__struct_config__.frozen:
            return _freeze_by_reference
        return functools.partial(_freeze_fields, kind.__struct_fields__)
    if dataclasses.is_dataclass(kind):
        if kind.__dataclass_params__.frozen:  # type: ignore[attr-defined]
            return _freeze_by_reference
        names = tuple(field.name for field in dataclasses.fields(kind))
        return functools.partial(_freeze_fields, names)
    return _freeze_deep
