"""The release grid is absolute and exact."""

from __future__ import annotations

from fractions import Fraction

from hypothesis import given
from hypothesis import strategies as st

from horus.timing import ReleaseGrid, period_ns

rates = st.one_of(
    st.integers(1, 10_000).map(float),
    st.floats(1e-3, 1e5, allow_nan=False),
    st.sampled_from([30.0, 1 / 3, 59.94, 400.0, 0.2]),
)
epochs = st.integers(0, 10**18)
indices = st.integers(0, 10**9)


@given(epochs, rates, indices)
def test_index_at_inverts_at(epoch: int, rate: float, k: int) -> None:
    """The release at instant at(k) is k, and one nanosecond earlier it is the one before."""
    grid = ReleaseGrid(epoch, rate)
    instant = grid.at(k)
    assert grid.at(grid.index_at(instant)) == instant
    assert grid.at(grid.index_at(instant - 1)) < instant


@given(epochs, rates, indices, st.integers(-(10**6), 10**6))
def test_first_from_is_the_first_release_not_before(
    epoch: int, rate: float, k: int, offset: int
) -> None:
    """`first_from(t)` is at or after t, and the release before it is not."""
    grid = ReleaseGrid(epoch, rate)
    instant = grid.at(k) + offset
    first = grid.first_from(instant)
    assert grid.at(first) >= instant
    assert first == 0 or grid.at(first - 1) < instant


@given(rates, indices)
def test_releases_never_drift(rate: float, k: int) -> None:
    """Release k is within a nanosecond of k / rate, however large k is."""
    exact = Fraction(10**9) / Fraction(rate).limit_denominator(10**6) * k
    if abs(Fraction(rate).limit_denominator(10**6) - Fraction(rate)) > Fraction(rate) / 10**12:
        exact = Fraction(10**9) / Fraction(rate) * k
    assert 0 <= exact - ReleaseGrid(0, rate).at(k) < 1


def test_30_hz_meets_1_khz_every_100_ms() -> None:
    """Nodes of 30 Hz and 1 kHz are released at the very same instants, for ever."""
    slow, fast = ReleaseGrid(17, 30.0), ReleaseGrid(17, 1000.0)
    for second in (0, 1, 3600, 10_000_000):
        assert slow.at(30 * second + 3) == fast.at(1000 * second + 100)


def test_period() -> None:
    """A period is 1 / rate in whole nanoseconds."""
    assert period_ns(1000.0) == 1_000_000
    assert period_ns(30.0) == 33_333_333
