"""Messages as bytes and back, exactly: MessagePack, with extension types for what it lacks.

Plain data is plain MessagePack, which any library reads. What would come back as something
else, such as a tuple, is an extension; `docs/reference/recording-format.md` lists them.

Nothing is ever unpickled. Classes are not imported either: an object comes back if its class
is loaded already and consists of fields, or if the caller names it.

Thread: any.
"""

from __future__ import annotations

import collections
import dataclasses
import datetime as dt
import decimal
import enum
import fractions
import functools
import pathlib
import sys
import uuid
import zoneinfo
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import msgspec

from horus.snapshot import attributes, is_plain, slots_of, with_fields

TUPLE, INT, TEXT, BYTEARRAY, SET, FROZENSET, MAP = range(1, 8)
ARRAY, SCALAR, OBJECT, NAMED_TUPLE, ENUM, STANDARD = range(16, 22)

_INTACT = frozenset((str, float, bool, type(None), bytes))
_INTACT_OR_INT = _INTACT | {int}
_LEAST_INT, _MOST_INT = -(2**63), 2**64 - 1

Classes = Mapping[str, type]
"""Classes that may come back, by the name that `name_of` gives them."""

_encode = msgspec.msgpack.Encoder().encode


class UnrecordableError(TypeError):
    """A message, or something in it, that has no exact form as data."""


def name_of(kind: type) -> str:
    """Return what a class is called in a recording: `module:Outer.Inner`."""
    return f"{kind.__module__}:{kind.__qualname__}"


def encode(message: Any) -> bytes:
    """Return a message as bytes.

    Raises:
        UnrecordableError: It, or something in it, has no exact form as data.
        RecursionError: It is nested too deeply.
    """
    try:
        return _encode(_mark(message))
    except UnicodeEncodeError:
        # Half of a surrogate pair, which file names may contain. Rare: looked for only now.
        return _encode(_mark(message, _mark_text))


def decode(data: bytes | memoryview, classes: Classes | None = None) -> Any:
    """Return the message that `encode` was given.

    Args:
        data: The bytes.
        classes: Classes that may come back even if they do not consist of declared fields.

    Raises:
        ValueError: The bytes are not from `encode`, or are of a class that may not come back.
    """
    known: Classes = {} if classes is None else classes

    def revive(code: int, content: memoryview) -> Any:
        build = _REVIVALS.get(code)
        if build is None:
            raise ValueError(f"extension {code} is not known; was it written by a newer version?")
        return build(content, decoder.decode, known)

    decoder = msgspec.msgpack.Decoder(ext_hook=revive)
    try:
        return decoder.decode(data)
    except ValueError:
        raise
    except Exception as exc:
        # Whatever is made of bytes that nobody has checked.
        raise ValueError(f"{type(exc).__name__}: {exc}") from exc


# -- to bytes --------------------------------------------------------------------------------


def _mark(value: Any, mark_text: Callable[[str], Any] | None = None) -> Any:
    """Return what MessagePack keeps intact: `value` itself, or extensions in its place."""
    kind = type(value)
    if kind is str:
        return value if mark_text is None else mark_text(value)
    if kind in _INTACT:
        return value
    if kind is int:
        return value if _LEAST_INT <= value <= _MOST_INT else _ext_int(value)
    if kind is list:
        if mark_text is None and _is_intact(value):
            return value
        return [_mark(item, mark_text) for item in value]
    if kind is dict:
        if not all(type(key) is str for key in value):
            return _ext(MAP, _pairs(value.items(), mark_text))
        if mark_text is None:
            if _is_intact(value.values()):
                return value
            return {key: _mark(item) for key, item in value.items()}
        if any(mark_text(key) is not key for key in value):
            return _ext(MAP, _pairs(value.items(), mark_text))
        return {key: _mark(item, mark_text) for key, item in value.items()}
    if kind is tuple:
        return _ext(TUPLE, [_mark(item, mark_text) for item in value])
    marker = _MARKERS.get(kind) or _marker_for(kind)
    return marker(value, lambda item: _mark(item, mark_text))


def _is_intact(values: Iterable[Any]) -> bool:
    kinds = set(map(type, values))
    if int not in kinds:
        return kinds <= _INTACT
    if not kinds <= _INTACT_OR_INT:
        return False
    return all(_LEAST_INT <= value <= _MOST_INT for value in values if type(value) is int)


def _ext(code: int, content: Any) -> msgspec.msgpack.Ext:
    return msgspec.msgpack.Ext(code, _encode(content))


def _ext_int(value: int) -> msgspec.msgpack.Ext:
    size = value.bit_length() // 8 + 1
    return msgspec.msgpack.Ext(INT, value.to_bytes(size, "big", signed=True))


def _mark_text(value: str) -> Any:
    try:
        value.encode()
    except UnicodeEncodeError:
        return msgspec.msgpack.Ext(TEXT, value.encode("utf-8", "surrogatepass"))
    return value


def _pairs(
    items: Iterable[tuple[Any, Any]], mark_text: Callable[[str], Any] | None = None
) -> list[Any]:
    return [[_mark(key, mark_text), _mark(item, mark_text)] for key, item in items]


Mark = Callable[[Any], Any]
Marker = Callable[[Any, Mark], Any]


def _mark_elements(code: int) -> Marker:
    # Sorted: the hashes of texts, and so the order, are others in every process.
    return lambda value, mark: _ext(code, sorted(map(mark, value), key=_encode))


def _mark_object(fields_of: Callable[[Any], Iterable[tuple[str, Any]]]) -> Marker:
    def marker(value: Any, mark: Mark) -> Any:
        fields = [[name, mark(item)] for name, item in fields_of(value)]
        return _ext(OBJECT, [name_of(type(value)), fields])

    return marker


def _struct_fields(value: Any) -> list[tuple[str, Any]]:
    return [(name, getattr(value, name)) for name in value.__struct_fields__]


def _mark_named_tuple(value: Any, mark: Mark) -> Any:
    return _ext(NAMED_TUPLE, [name_of(type(value)), [mark(item) for item in value]])


def _mark_enum(value: enum.Enum, mark: Mark) -> Any:
    if isinstance(value, enum.Flag):
        return _ext(ENUM, [name_of(type(value)), mark(value.value)])
    return _ext(ENUM, [name_of(type(value)), value.name])


def _mark_array(value: Any, mark: Mark) -> Any:
    from numpy.lib import format as npy

    # Bytes in the order that they are in: a column-major array stays one.
    order = "F" if value.flags.f_contiguous and not value.flags.c_contiguous else "C"
    descr = mark(npy.dtype_to_descr(value.dtype))
    return _ext(ARRAY, [descr, list(value.shape), order, value.tobytes(order)])


def _mark_scalar(value: Any, mark: Mark) -> Any:
    return _ext(SCALAR, [value.dtype.str, value.tobytes()])


def _standard(name: str, parts: Callable[[Any], list[Any]]) -> Marker:
    return lambda value, mark: _ext(STANDARD, [name, [mark(part) for part in parts(value)]])


def _zone(zone: dt.tzinfo | None) -> list[Any] | None:
    if zone is None:
        return None
    if type(zone) is zoneinfo.ZoneInfo and zone.key is not None:
        return ["zone", zone.key]
    if type(zone) is dt.timezone:
        return ["offset", zone.utcoffset(None), zone.tzname(None)]
    raise UnrecordableError(f"the time zone {zone!r}")


def _unzone(parts: list[Any] | None) -> dt.tzinfo | None:
    if parts is None:
        return None
    if parts[0] == "zone":
        return zoneinfo.ZoneInfo(parts[1])
    _, offset, name = parts
    zone = dt.timezone(offset)
    return zone if zone.tzname(None) == name else dt.timezone(offset, name)


def _clock_parts(value: dt.datetime | dt.time) -> list[Any]:
    naive = value.replace(tzinfo=None, fold=0)
    return [naive.isoformat(), value.fold, _zone(value.tzinfo)]


_PATHS = (pathlib.PurePosixPath, pathlib.PureWindowsPath, type(pathlib.Path()))

_STANDARD: dict[type, tuple[Callable[[Any], list[Any]], Callable[..., Any]]] = {
    complex: (lambda v: [v.real, v.imag], complex),
    range: (lambda v: [v.start, v.stop, v.step], range),
    dt.date: (lambda v: [v.isoformat()], dt.date.fromisoformat),
    dt.time: (
        _clock_parts,
        lambda text, fold, zone: dt.time.fromisoformat(text).replace(
            tzinfo=_unzone(zone), fold=fold
        ),
    ),
    dt.datetime: (
        _clock_parts,
        lambda text, fold, zone: dt.datetime.fromisoformat(text).replace(
            tzinfo=_unzone(zone), fold=fold
        ),
    ),
    dt.timedelta: (lambda v: [v.days, v.seconds, v.microseconds], dt.timedelta),
    decimal.Decimal: (lambda v: [str(v)], decimal.Decimal),
    fractions.Fraction: (lambda v: [v.numerator, v.denominator], fractions.Fraction),
    uuid.UUID: (lambda v: [v.bytes], lambda data: uuid.UUID(bytes=data)),
    collections.OrderedDict: (
        lambda v: [[k, i] for k, i in v.items()],
        lambda *pairs: collections.OrderedDict(pairs),
    ),
    collections.Counter: (
        lambda v: [[k, i] for k, i in v.items()],
        lambda *pairs: collections.Counter(dict(pairs)),
    ),
    collections.deque: (
        lambda v: [v.maxlen, *v],
        lambda maxlen, *items: collections.deque(items, maxlen),
    ),
    **{kind: (lambda v: [str(v)], kind) for kind in _PATHS},
}

_MARKERS: dict[type, Marker] = {
    set: _mark_elements(SET),
    frozenset: _mark_elements(FROZENSET),
    bytearray: lambda value, mark: msgspec.msgpack.Ext(BYTEARRAY, bytes(value)),
    **{kind: _standard(kind.__name__, parts) for kind, (parts, _) in _STANDARD.items()},
}


def _marker_for(kind: type) -> Marker:
    """Decide once per type how its values are told."""
    marker = _choose(kind)
    if marker is None:
        raise UnrecordableError(
            f"a {kind.__name__}; send data, a dataclass or a msgspec.Struct instead"
        )
    _MARKERS[kind] = marker
    return marker


def _choose(kind: type) -> Marker | None:
    numpy = sys.modules.get("numpy")
    if numpy is not None:
        if kind is numpy.ndarray:
            return _mark_array
        if issubclass(kind, numpy.generic):
            return None if issubclass(kind, numpy.void) else _mark_scalar
    if issubclass(kind, enum.Enum):
        return _mark_enum
    if issubclass(kind, tuple) and hasattr(kind, "_make"):
        return _mark_named_tuple
    if issubclass(kind, msgspec.Struct):
        return _mark_object(_struct_fields)
    return _mark_object(functools.partial(attributes, slots_of(kind))) if _is_open(kind) else None


def _is_open(kind: type) -> bool:
    """Return whether instances are nothing but their attributes, none of them hidden in C."""
    if not is_plain(kind) or kind.__module__ == "builtins":
        return False
    try:
        object.__new__(kind)
    except TypeError:  # it is laid out by C code, or abstract
        return False
    return True


# -- from bytes ------------------------------------------------------------------------------

Decode = Callable[[Any], Any]
Revival = Callable[[memoryview, Decode, Classes], Any]


def _revive_object(content: memoryview, decode: Decode, known: Classes) -> Any:
    name, fields = decode(content)
    kind = _class_called(name, known)
    fresh: Any
    if issubclass(kind, msgspec.Struct):
        held = dict(fields)
        if held.keys() != set(kind.__struct_fields__):
            raise ValueError(f"{name} has other fields now than {sorted(held)}")
        # There is no other way to make one; what __post_init__ changes is put right below.
        fresh = kind(**held)
    elif _is_open(kind):
        fresh = object.__new__(kind)
    else:
        raise ValueError(f"{name} does not consist of its fields any more")
    if hasattr(fresh, "__dict__"):
        slots = {field for field, _ in fields if isinstance(getattr(kind, field, None), _SLOT)}
        fresh.__dict__.update((field, item) for field, item in fields if field not in slots)
        fields = [(field, item) for field, item in fields if field in slots]
    return with_fields(fresh, fields)


_SLOT = type(type("_", (), {"__slots__": ("slot",)}).slot)  # type: ignore[attr-defined]


def _revive_named_tuple(content: memoryview, decode: Decode, known: Classes) -> Any:
    name, items = decode(content)
    kind = _class_called(name, known)
    if not (issubclass(kind, tuple) and hasattr(kind, "_make")):
        raise ValueError(f"{name} is no named tuple any more")
    return kind._make(items)


def _revive_enum(content: memoryview, decode: Decode, known: Classes) -> Any:
    name, member = decode(content)
    kind = _class_called(name, known)
    if not issubclass(kind, enum.Enum):
        raise ValueError(f"{name} is no enumeration any more")
    return kind(member) if issubclass(kind, enum.Flag) else kind[member]


def _class_called(name: Any, known: Classes) -> type:
    """Return the class of that name, if its instances may come from a file."""
    if name in known:
        return known[name]
    module, _, path = str(name).partition(":")
    kind: Any = sys.modules.get(module)
    for part in path.split("."):
        kind = getattr(kind, part, None)
    if not isinstance(kind, type) or name_of(kind) != name:
        raise ValueError(f"there is no class {name}; import it first")
    if not _consists_of_fields(kind):
        raise ValueError(
            f"{name} is no dataclass, Struct, named tuple or Enum; pass it in classes="
        )
    return kind


def _consists_of_fields(kind: type) -> bool:
    """Return whether a class is made to hold data; what it does when deleted could harm."""
    if hasattr(kind, "__del__"):
        return False
    return (
        dataclasses.is_dataclass(kind)
        or issubclass(kind, msgspec.Struct | enum.Enum)
        or (issubclass(kind, tuple) and hasattr(kind, "_make"))
    )


def _revive_array(content: memoryview, decode: Decode, known: Classes) -> Any:
    import numpy as np
    from numpy.lib import format as npy

    descr, shape, order, data = decode(content)
    dtype = npy.descr_to_dtype(descr)
    if dtype.hasobject:
        raise ValueError("an array of Python objects")
    array = np.frombuffer(data, np.uint8) if data else np.empty(0, np.uint8)
    array = np.ndarray(shape, dtype, array, order=order)
    if array.nbytes != len(data):
        raise ValueError(f"an array of shape {shape} and dtype {dtype} has other bytes")
    array.flags.writeable = False
    return array


def _revive_scalar(content: memoryview, decode: Decode, known: Classes) -> Any:
    import numpy as np

    dtype, data = decode(content)
    return np.frombuffer(data, dtype)[0] if data else np.dtype(dtype).type()


def _revive_standard(content: memoryview, decode: Decode, known: Classes) -> Any:
    name, parts = decode(content)
    return _BUILDERS[name](*parts)


_BUILDERS = {kind.__name__: build for kind, (_, build) in _STANDARD.items()}

_REVIVALS: dict[int, Revival] = {
    TUPLE: lambda content, decode, known: tuple(decode(content)),
    INT: lambda content, decode, known: int.from_bytes(content, "big", signed=True),
    TEXT: lambda content, decode, known: bytes(content).decode("utf-8", "surrogatepass"),
    BYTEARRAY: lambda content, decode, known: bytearray(content),
    SET: lambda content, decode, known: set(decode(content)),
    FROZENSET: lambda content, decode, known: frozenset(decode(content)),
    MAP: lambda content, decode, known: dict(map(tuple, decode(content))),
    ARRAY: _revive_array,
    SCALAR: _revive_scalar,
    OBJECT: _revive_object,
    NAMED_TUPLE: _revive_named_tuple,
    ENUM: _revive_enum,
    STANDARD: _revive_standard,
}
