"""Checks of arguments where they are written: each names the argument, the value and the remedy."""

from __future__ import annotations

import math
import numbers
import os
import re
from collections.abc import Iterable
from enum import StrEnum
from typing import Any, TypeGuard, TypeVar

from horus.errors import ConfigError, TopicError, describe
from horus.units import NS_PER_MS, NS_PER_S, NS_PER_US

E = TypeVar("E", bound=StrEnum)

_LOWEST_RATE_HZ, _HIGHEST_RATE_HZ = 1e-6, 1e6
_LONGEST_NS = 10**9 * NS_PER_S
_NS_PER_UNIT = {"seconds": NS_PER_S, "milliseconds": NS_PER_MS, "microseconds": NS_PER_US}
_NAME = re.compile(r"[A-Za-z0-9_](?:[A-Za-z0-9_.\-]{0,126}[A-Za-z0-9_\-])?")


def check_name(argument: str, value: object) -> str:
    """Return a name, refusing one that could not be a file name and a metric label.

    Raises:
        ConfigError: Not a string, empty, too long, or with other characters than
            letters, digits, `_`, `-` and `.`.
    """
    if not isinstance(value, str) or not _NAME.fullmatch(value) or ".." in value:
        raise ConfigError(
            argument,
            value,
            "must be 1 to 128 ASCII letters, digits, '_', '-' or '.', "
            "with no leading, trailing or double dot: names become file and metric names",
        )
    return value


def check_topic(value: Any) -> str:
    """Return a usable topic name; a message class stands for its own name.

    Raises:
        TopicError: The name has path separators, control or other odd characters.
    """
    name = value.__name__ if isinstance(value, type) else value
    if not isinstance(name, str) or not _NAME.fullmatch(name) or ".." in name:
        raise TopicError(
            f"topic {describe(value)}: must be 1 to 128 ASCII letters, digits, '_', '-' or '.', "
            "e.g. 'front.scan'; path separators and control characters are refused"
        )
    return name


def check_rate(value: object, argument: str = "rate") -> float:
    """Return a rate [Hz] as float.

    Raises:
        ConfigError: Not a number from 1e-6 to 1e6.
    """
    return _check_range(argument, value, "Hz", _LOWEST_RATE_HZ, _HIGHEST_RATE_HZ)


def check_duration(argument: str, value: object, unit: str = "seconds") -> int:
    """Return a duration, given in `unit`, in nanoseconds [ns].

    Raises:
        ConfigError: Not a number above zero and below thirty years.
    """
    scale = _NS_PER_UNIT[unit]
    least = 1 / scale
    return round(_check_range(argument, value, unit, least, _LONGEST_NS / scale) * scale)


def optional_duration(argument: str, value: object) -> int | None:
    """Return a duration [s] in nanoseconds [ns]; None stays None.

    Raises:
        ConfigError: Neither None nor a number above zero and below thirty years.
    """
    return None if value is None else check_duration(argument, value)


def _check_range(argument: str, value: object, unit: str, least: float, most: float) -> float:
    # NaN fails the comparison, and so does what is too large for a float.
    if not is_number(value) or not least <= value <= most:
        example = f", e.g. {argument}=300 * us" if unit == "seconds" else ""
        raise ConfigError(
            argument, value, f"must be a number of {unit} from {least:g} to {most:g}{example}"
        )
    return float(value)


def check_core(argument: str, value: object) -> int:
    """Return a CPU core index that this machine has.

    Raises:
        ConfigError: Not a whole number, or no such core.
    """
    count = os.cpu_count() or 1
    if not is_int(value) or value < 0:
        raise ConfigError(argument, value, "must be a core index >= 0")
    if value >= count:
        raise ConfigError(argument, value, f"this machine has {count} cores, 0 to {count - 1}")
    return int(value)


def check_priority(value: object) -> int | None:
    """Return a SCHED_FIFO priority, or None; refuse what is not from 1 to 99."""
    if value is None:
        return None
    if not is_int(value) or not 1 <= value <= 99:
        raise ConfigError("priority", value, "must be a SCHED_FIFO priority from 1 to 99")
    return int(value)


def check_compute(value: object) -> tuple[bool, bool]:
    """Return whether a node is a compute node, and whether it has a process of its own.

    Raises:
        ConfigError: There is no such kind, or no worker processes on this platform.
    """
    if value == "process":
        if os.name != "posix":
            raise ConfigError(
                "compute",
                value,
                "there are no worker processes on this platform; "
                "compute=True runs the node on a thread of its own",
            )
        return True, True
    if value == "thread":
        return True, False
    if not isinstance(value, bool):
        raise ConfigError("compute", value, "must be True, False, 'thread' or 'process'")
    return value, False


def member(kind: type[E], argument: str, value: object) -> E:
    """Return the member of an enumeration that a string names; refuse others."""
    try:
        return kind(value if isinstance(value, str) else "")
    except ValueError:
        names = ", ".join(repr(member.value) for member in kind)
        raise ConfigError(argument, value, f"must be one of {names}") from None


def is_number(value: object) -> TypeGuard[float]:
    """Return whether `value` is a real number, also one of NumPy's; a bool is not."""
    return isinstance(value, numbers.Real) and not isinstance(value, bool)


def is_int(value: object) -> TypeGuard[int]:
    """Return whether `value` is a whole number, also one of NumPy's; a bool is not."""
    return isinstance(value, numbers.Integral) and not isinstance(value, bool)


def check_flag(argument: str, value: object) -> bool:
    """Return a bool; refuse what merely looks like one."""
    if not isinstance(value, bool):
        raise ConfigError(argument, value, "must be True or False")
    return value


def check_count(argument: str, value: object, least: int = 0) -> int:
    """Return a whole number of at least `least`."""
    if not is_int(value) or value < least:
        raise ConfigError(argument, value, f"must be a whole number >= {least}")
    return int(value)


def check_speed(value: object) -> float:
    """Return the speed of a replay: a multiple of the recorded one, or infinity."""
    slowest, fastest = 0.01, 100.0
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ConfigError("speed", value, "must be a number: 1.0 is the recorded speed")
    if value != math.inf and not slowest <= value <= fastest:
        raise ConfigError("speed", value, f"must be between {slowest} and {fastest}, or math.inf")
    return float(value)


def check_cores(value: object) -> tuple[int, ...] | None:
    """Return CPU core indices that this machine has, or None."""
    if value is None:
        return None
    if isinstance(value, str) or not isinstance(value, Iterable):
        raise ConfigError("cores", value, "must be a list of core indices, e.g. [0, 1]")
    cores = tuple(check_core("cores", core) for core in value)
    if not cores:
        raise ConfigError("cores", value, "must name at least one core, or be None")
    return cores
