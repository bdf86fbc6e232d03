"""Pure time arithmetic: rates, periods and the absolute release grid."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Protocol

from horus.units import NS_PER_S

FOREVER_NS = 1 << 63
"""An instant [ns] that does not come."""

_MAX_DENOMINATOR = 1_000_000
_SAME_RATE = Fraction(1, 10**12)


class Grid(Protocol):
    """The instants at which something is released, counted from 0."""

    def at(self, k: int) -> int:
        """Return the instant of release `k` [ns]."""

    def index_at(self, instant_ns: int) -> int:
        """Return the last release at or before `instant_ns`; negative before release 0."""

    def has(self, instant_ns: int) -> bool:
        """Return whether something is released at exactly this instant."""

    def first_from(self, instant_ns: int) -> int:
        """Return the first release at or after `instant_ns`, at least 0."""


@dataclass(frozen=True, slots=True)
class ReleaseGrid:
    """The instants at which something of a given rate is released.

    Release k is `epoch_ns + floor(k / rate)`, computed in whole numbers from an
    exact fraction, so that 30 Hz meets 1 kHz at every 100 ms for as long as the
    robot runs: adding a rounded period again and again would drift.
    """

    epoch_ns: int
    rate_hz: float
    _numerator: int = field(init=False, repr=False)
    _denominator: int = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Derive the exact period as a fraction of nanoseconds."""
        period = NS_PER_S / _exact(self.rate_hz)
        object.__setattr__(self, "_numerator", period.numerator)
        object.__setattr__(self, "_denominator", period.denominator)

    @property
    def period_ns(self) -> int:
        """The period [ns], rounded down."""
        return self._numerator // self._denominator

    def at(self, k: int) -> int:
        """Return the instant of release `k` [ns]."""
        return self.epoch_ns + k * self._numerator // self._denominator

    def index_at(self, instant_ns: int) -> int:
        """Return the last release at or before `instant_ns`; negative before release 0."""
        # floor(k*p) <= d  <=>  k*p < d + 1  <=>  k <= ceil((d + 1) / p) - 1
        after = instant_ns - self.epoch_ns + 1
        return -(-after * self._denominator // self._numerator) - 1

    def has(self, instant_ns: int) -> bool:
        """Return whether something is released at exactly this instant."""
        return self.at(self.index_at(instant_ns)) == instant_ns

    def first_from(self, instant_ns: int) -> int:
        """Return the first release at or after `instant_ns`, at least 0."""
        return max(0, self.index_at(instant_ns - 1) + 1)


@dataclass(frozen=True, slots=True)
class ReleaseTimes:
    """Releases at instants of their own, such as those of a recording; after them, none."""

    epoch_ns: int
    offsets_ns: Sequence[int]
    """The instants after the epoch, ascending, each once."""

    def at(self, k: int) -> int:
        """Return the instant of release `k` [ns]."""
        return self.epoch_ns + self.offsets_ns[k] if k < len(self.offsets_ns) else FOREVER_NS

    def index_at(self, instant_ns: int) -> int:
        """Return the last release at or before `instant_ns`; negative before release 0."""
        return bisect_right(self.offsets_ns, instant_ns - self.epoch_ns) - 1

    def has(self, instant_ns: int) -> bool:
        """Return whether something is released at exactly this instant."""
        return self.at(self.first_from(instant_ns)) == instant_ns

    def first_from(self, instant_ns: int) -> int:
        """Return the first release at or after `instant_ns`, at least 0."""
        return bisect_left(self.offsets_ns, instant_ns - self.epoch_ns)


def _exact(rate_hz: float) -> Fraction:
    """Return the fraction a person meant: 1/3 Hz for 0.333..., not its binary neighbour."""
    binary = Fraction(rate_hz)
    meant = binary.limit_denominator(_MAX_DENOMINATOR)
    return meant if abs(meant - binary) <= binary * _SAME_RATE else binary


def period_ns(rate_hz: float) -> int:
    """Return the period of a rate [Hz] in nanoseconds [ns], rounded down."""
    return ReleaseGrid(0, rate_hz).period_ns
