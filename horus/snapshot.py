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
import itertools
import operator
import pathlib
import re
import sys
import types
import uuid
from collections.abc import Callable, Iterable
from typing import Any

import msgspec

Thaw = Callable[[Any], Any] | None
Frozen = tuple[Any, Thaw]
Freezer = Callable[[Any, int], Frozen]

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
        type(Ellipsis),
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
_SMALL_DICT = 8
_LONG_LIST = 16
_MSGPACK_FLOAT64 = b"\xcb"
_MSGPACK_FLOAT64_SIZE = 9
_MAX_DEPTH = 8
"""Nesting up to which messages are copied part by part."""

_MAX_NESTING = 100
"""Nesting beyond which a message is refused: a receiver deep in its own calls must cope, too."""

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

    path = ""
    """Where in the message it is, e.g. `['map']['cells'][3]`."""

    def inside(self, key: object) -> UnsendableError:
        """Take note of the container's key on the way up."""
        self.path = f"[{key!r}]{self.path}"
        return self


def freeze(value: Any, depth: int = 0) -> Frozen:
    """Return a private copy of `value` and how to copy it for a receiver.

    Raises:
        UnsendableError: `value`, or something in it, cannot be copied.
        RecursionError: It is nested too deeply.
    """
    kind = type(value)
    if kind in ATOMS:
        return value, None
    if depth > _MAX_DEPTH:
        # deepcopy remembers what it has copied: a structure whose parts are
        # shared again and again would otherwise take time without end.
        _refuse_endless(value, set(), set())
        return _freeze_deep(value, depth)
    return (_freezers.get(kind) or _freezer_for(kind))(value, depth)


def _freeze_dict(value: dict[Any, Any], depth: int) -> Frozen:
    if _is_flat(value):
        return value.copy(), dict.copy
    if not _all_immutable(value, depth):
        return _freeze_deep(value, depth)
    payload = {}
    thaws = []
    for key, item in value.items():
        try:
            payload[key], thaw = freeze(item, depth + 1)
        except UnsendableError as exc:
            raise exc.inside(key)  # noqa: B904 - the same exception, on its way up
        if thaw is not None:
            thaws.append((key, thaw))
    return payload, functools.partial(_thaw_items, tuple(thaws)) if thaws else dict.copy


def _is_flat(value: dict[Any, Any]) -> bool:
    """Return whether keys and values are all atoms."""
    if len(value) > _SMALL_DICT:
        return _all_atoms(map(type, itertools.chain(value, value.values())))
    # For a few items a loop is faster than setting up the chain.
    for key, item in value.items():
        if type(item) not in ATOMS or type(key) not in ATOMS:
            return False
    return True


def _freeze_list(value: list[Any], depth: int) -> Frozen:
    if _is_long_float_list(value) or _all_atoms(map(type, value)):
        return value.copy(), list.copy
    payload, thaws = _freeze_sequence(value, depth)
    return payload, functools.partial(_thaw_items, thaws) if thaws else list.copy


def _is_long_float_list(value: list[Any]) -> bool:
    """Return whether this is a long list of nothing but floats, as laser scans are.

    Looking at the type of each item takes time. Encoding to MessagePack looks at
    them all in C, several times faster, and tells: a float is the only thing that
    becomes a 0xcb byte and eight more (the encoder refuses subclasses).
    """
    count = len(value)
    if count < _LONG_LIST or type(value[0]) is not float or type(value[-1]) is not float:
        return False
    try:
        encoded = _encode(value)
    except (TypeError, ValueError, OverflowError, RecursionError):
        return False
    header = len(encoded) - _MSGPACK_FLOAT64_SIZE * count
    if header not in (3, 5):
        return False
    return encoded[header::_MSGPACK_FLOAT64_SIZE] == _MSGPACK_FLOAT64 * count


def _freeze_sequence(value: Any, depth: int) -> tuple[list[Any], tuple[tuple[int, Any], ...]]:
    payload = []
    thaws = []
    for index, item in enumerate(value):
        try:
            frozen, thaw = freeze(item, depth + 1)
        except UnsendableError as exc:
            raise exc.inside(index)  # noqa: B904 - the same exception, on its way up
        payload.append(frozen)
        if thaw is not None:
            thaws.append((index, thaw))
    return payload, tuple(thaws)


def _freeze_tuple(value: tuple[Any, ...], depth: int) -> Frozen:
    if _all_atoms(map(type, value)):
        return value, None
    payload, thaws = _freeze_sequence(value, depth)
    if not thaws and all(map(operator.is_, payload, value)):
        return value, None
    build = getattr(type(value), "_make", type(value))
    return build(payload), functools.partial(_thaw_tuple, build, thaws) if thaws else None


_COMMON_THAWS: tuple[Thaw, ...] = (None, dict.copy, list.copy)


def shorten(frozen: Frozen) -> tuple[Any, Any]:
    """Return a frozen value, a number in place of a common way to copy it.

    Functions are slow to pickle: by name, which has to be looked for, also in a cold cache.
    """
    payload, thaw = frozen
    return payload, _COMMON_THAWS.index(thaw) if thaw in _COMMON_THAWS else thaw


def lengthen(short: tuple[Any, Any]) -> Frozen:
    """Return the frozen value that `shorten` was given."""
    payload, thaw = short
    return payload, _COMMON_THAWS[thaw] if isinstance(thaw, int) else thaw


def _thaw_items(thaws: tuple[tuple[Any, Any], ...], payload: Any) -> Any:
    fresh = payload.copy()
    for key, thaw in thaws:
        fresh[key] = thaw(fresh[key])
    return fresh


def _thaw_tuple(
    build: Callable[[list[Any]], Any], thaws: tuple[tuple[int, Any], ...], payload: Any
) -> Any:
    return build(_thaw_items(thaws, list(payload)))


def _freeze_bytearray(value: bytearray, depth: int) -> Frozen:
    return bytes(value), bytearray


def _freeze_set(value: set[Any], depth: int) -> Frozen:
    if _all_immutable(value, depth):
        return value.copy(), set.copy
    return _freeze_deep(value, depth)


def _freeze_frozenset(value: frozenset[Any], depth: int) -> Frozen:
    return (value, None) if _all_immutable(value, depth) else _freeze_deep(value, depth)


def _all_immutable(hashables: Iterable[Any], depth: int) -> bool:
    """Return whether keys or elements may be shared: hashable does not mean immutable."""
    return all(type(item) in ATOMS or _is_same(freeze(item, depth + 1), item) for item in hashables)


def _is_same(frozen: Frozen, original: Any) -> bool:
    return frozen[0] is original and frozen[1] is None


def _freeze_array(value: Any, depth: int) -> Frozen:
    if value.dtype.hasobject:
        raise UnsendableError("a NumPy array of Python objects; send a list or a numeric array")
    payload = value.copy()
    payload.flags.writeable = False
    # Each receiver gets a view of its own: the shape and the flags of an array
    # can be changed in place, and a view of a read-only array stays read-only.
    return payload, type(payload).view


def _refuse_array(value: Any, depth: int) -> Frozen:
    raise UnsendableError(
        f"a {type(value).__name__} may share more than its data; send numpy.asarray(x)"
    )


def _freeze_by_reference(value: Any, depth: int) -> Frozen:
    return value, None


def _freeze_struct(frozen_type: bool, value: Any, depth: int) -> Frozen:
    fields = [(name, getattr(value, name)) for name in value.__struct_fields__]
    changed, thaws = _freeze_fields(fields, depth)
    if frozen_type and not changed:
        return value, None
    return with_fields(copy.copy(value), changed), functools.partial(
        _thaw_fields, copy.copy, tuple(thaws)
    )


def _freeze_instance(slots: tuple[str, ...], frozen_type: bool, value: Any, depth: int) -> Frozen:
    fields = attributes(slots, value)
    changed, thaws = _freeze_fields(fields, depth)
    if frozen_type and not changed:
        return value, None
    duplicate = functools.partial(_copy_instance, slots)
    return with_fields(duplicate(value), changed), functools.partial(
        _thaw_fields, duplicate, tuple(thaws)
    )


def _freeze_fields(
    fields: list[tuple[str, Any]], depth: int
) -> tuple[list[tuple[str, Any]], list[tuple[str, Any]]]:
    """Return the fields whose frozen value is another object, and those to thaw."""
    changed = []
    thaws = []
    for name, item in fields:
        try:
            frozen, thaw = freeze(item, depth + 1)
        except UnsendableError as exc:
            raise exc.inside(name)  # noqa: B904 - the same exception, on its way up
        if frozen is not item or thaw is not None:
            changed.append((name, frozen))
        if thaw is not None:
            thaws.append((name, thaw))
    return changed, thaws


def _thaw_fields(
    duplicate: Callable[[Any], Any], thaws: tuple[tuple[str, Any], ...], payload: Any
) -> Any:
    fresh = duplicate(payload)
    return with_fields(fresh, [(name, thaw(getattr(fresh, name))) for name, thaw in thaws])


def with_fields(instance: Any, fields: list[tuple[str, Any]]) -> Any:
    """Set fields of an instance, and return it."""
    # Past the class's own __setattr__: frozen classes and validators refuse.
    if isinstance(instance, msgspec.Struct):
        for name, item in fields:
            msgspec.structs.force_setattr(instance, name, item)
        return instance
    own = getattr(instance, "__dict__", {})
    for name, item in fields:
        if name in own:
            own[name] = item
        else:
            object.__setattr__(instance, name, item)
    return instance


def _copy_instance(slots: tuple[str, ...], value: Any) -> Any:
    fresh = object.__new__(type(value))
    if hasattr(value, "__dict__"):
        fresh.__dict__.update(value.__dict__)
    return with_fields(fresh, _held_in_slots(slots, value))


def attributes(slots: tuple[str, ...], value: Any) -> list[tuple[str, Any]]:
    """Return all that an instance holds, declared as a field or not."""
    return [*getattr(value, "__dict__", {}).items(), *_held_in_slots(slots, value)]


def _held_in_slots(slots: tuple[str, ...], value: Any) -> list[tuple[str, Any]]:
    return [(name, getattr(value, name)) for name in slots if hasattr(value, name)]


def slots_of(kind: type) -> tuple[str, ...]:
    """Return the names of all slots of a class and its bases, as attributes."""
    return tuple(
        _mangled(base, name)
        for base in kind.__mro__
        for name in _as_tuple(base.__dict__.get("__slots__", ()))
        if name not in ("__dict__", "__weakref__")
    )


def _mangled(kind: type, name: str) -> str:
    private = name.startswith("__") and not name.endswith("__")
    return f"_{kind.__name__.lstrip('_')}{name}" if private else name


def _freeze_deep(value: Any, depth: int) -> Frozen:
    try:
        return copy.deepcopy(value), copy.deepcopy
    except RecursionError:
        raise
    except Exception as exc:
        raise UnsendableError(f"copying it failed with {type(exc).__name__}: {exc}") from exc


def _refuse_endless(value: Any, above: set[int], known: set[int]) -> None:
    """Refuse a container that is inside itself, or too deep."""
    if not isinstance(value, dict | list | tuple) or id(value) in known:
        return
    if id(value) in above:
        raise UnsendableError("it contains itself")
    if len(above) >= _MAX_NESTING:
        raise UnsendableError(f"it is nested more than {_MAX_NESTING} deep")
    above.add(id(value))
    for item in value.values() if isinstance(value, dict) else value:
        _refuse_endless(item, above, known)
    above.remove(id(value))
    known.add(id(value))


def _refuse(value: Any, depth: int) -> Frozen:
    raise UnsendableError(f"a {type(value).__name__} is code or a resource, not data")


_freezers: dict[type, Freezer] = {
    dict: _freeze_dict,
    list: _freeze_list,
    tuple: _freeze_tuple,
    set: _freeze_set,
    frozenset: _freeze_frozenset,
    bytearray: _freeze_bytearray,
}


def _freezer_for(kind: type) -> Freezer:
    """Decide once per type how its values are isolated."""
    freezer = _choose(kind)
    _freezers[kind] = freezer
    return freezer


def _choose(kind: type) -> Freezer:
    numpy = sys.modules.get("numpy")
    if numpy is not None:
        if kind is numpy.ndarray:
            return _freeze_array
        if issubclass(kind, numpy.ndarray):
            known = (numpy.memmap, numpy.recarray, numpy.ma.MaskedArray)
            return _freeze_deep if kind in known else _refuse_array
        if issubclass(kind, numpy.generic) and not issubclass(kind, numpy.void):
            return _freeze_by_reference
    if issubclass(kind, enum.Enum):
        return _freeze_by_reference
    if issubclass(kind, _UNSENDABLE):
        return _refuse
    if issubclass(kind, tuple) and hasattr(kind, "_make"):
        return _freeze_tuple
    if issubclass(kind, msgspec.Struct):
        return functools.partial(_freeze_struct, bool(kind.__struct_config__.frozen))
    if dataclasses.is_dataclass(kind) and is_plain(kind):
        frozen = bool(kind.__dataclass_params__.frozen)  # type: ignore[attr-defined]
        return functools.partial(_freeze_instance, slots_of(kind), frozen)
    return _freeze_deep


def is_plain(kind: type) -> bool:
    """Return whether an instance is nothing but its attributes."""
    hooks = ("__new__", "__reduce__", "__reduce_ex__", "__copy__", "__deepcopy__")
    return all(getattr(kind, hook, None) is getattr(object, hook, None) for hook in hooks)


def _as_tuple(slots: str | Iterable[str]) -> tuple[str, ...]:
    return (slots,) if isinstance(slots, str) else tuple(slots)
