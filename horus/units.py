"""Unit constants: multiply a number by them to get seconds.

`budget=300 * us` is plain arithmetic: a float in seconds.
"""

from __future__ import annotations

us = 1e-6
"""One microsecond [s]."""

ms = 1e-3
"""One millisecond [s]."""

NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000
NS_PER_US = 1_000


def to_ns(seconds: float) -> int:
    """Convert seconds [s] to the nearest whole nanosecond [ns]."""
    return round(seconds * NS_PER_S)


def to_s(nanoseconds: int) -> float:
    """Convert nanoseconds [ns] to seconds [s]."""
    return nanoseconds / NS_PER_S


def readable(nanoseconds: float) -> str:
    """Format a duration [ns] with the unit a person would choose, e.g. `1.40 ms`."""
    size = abs(nanoseconds)
    if size >= NS_PER_S:
        return f"{nanoseconds / NS_PER_S:.2f} s"
    if size >= NS_PER_MS:
        return f"{nanoseconds / NS_PER_MS:.2f} ms"
    return f"{nanoseconds / NS_PER_US:.1f} us"
