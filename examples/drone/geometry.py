"""Vectors and unit quaternions (w, x, y, z) as plain tuples.

At three or four components, tuples and `math` are several times faster than arrays.
"""

from __future__ import annotations

import math
from typing import TypeAlias

Vector: TypeAlias = tuple[float, float, float]
Quaternion: TypeAlias = tuple[float, float, float, float]


NOTHING: Vector = (0.0, 0.0, 0.0)


def difference(a: Vector, b: Vector) -> Vector:
    """Return a - b."""
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def moved(start: Vector, gain: float, by: Vector) -> Vector:
    """Return start + gain * by."""
    return (start[0] + gain * by[0], start[1] + gain * by[1], start[2] + gain * by[2])


def inverse(q: Quaternion) -> Quaternion:
    """Return the opposite turn."""
    w, x, y, z = q
    return (w, -x, -y, -z)


def to_world(q: Quaternion, v: Vector) -> Vector:
    """Turn a vector from the body's axes into the world's."""
    w, x, y, z = q
    a, b, c = v
    # v + 2 w (u x v) + 2 u x (u x v), with u the vector part of q.
    s, t, r = 2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a)
    return (
        a + w * s + y * r - z * t,
        b + w * t + z * s - x * r,
        c + w * r + x * t - y * s,
    )


def turned(q: Quaternion, rates_radps: Vector, dt_s: float) -> Quaternion:
    """Return the attitude after turning at body rates for a time [s]."""
    w, x, y, z = q
    a, b, c = (rate * 0.5 * dt_s for rate in rates_radps)
    half = math.sqrt(a * a + b * b + c * c)
    cos = math.cos(half)
    sinc = math.sin(half) / half if half > 1e-9 else 1.0
    a, b, c = a * sinc, b * sinc, c * sinc
    w, x, y, z = (
        w * cos - x * a - y * b - z * c,
        x * cos + w * a + y * c - z * b,
        y * cos + w * b + z * a - x * c,
        z * cos + w * c + x * b - y * a,
    )
    norm = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    return (w * norm, x * norm, y * norm, z * norm)


def roll_pitch_yaw(q: Quaternion) -> Vector:
    """Return the attitude as angles about x, then y, then z, intrinsically z-y-x [rad]."""
    w, x, y, z = q
    return (
        math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
        math.asin(max(-1.0, min(2 * (w * y - z * x), 1.0))),
        math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
    )


def wrapped(angle_rad: float) -> float:
    """Return the same angle between -pi and pi [rad]."""
    return math.remainder(angle_rad, math.tau)
