"""Where the thread that writes finds room between releases."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from horus.recording.gaps import LONGEST_NS, SHORTEST_NS, next_gap
from horus.timing import ReleaseGrid

MS = 1_000_000
US = 1_000
EPOCH_NS = 5 * MS
AT_1_KHZ = ReleaseGrid(EPOCH_NS, 1000.0)


def test_without_rt_nodes_there_is_room_at_once() -> None:
    """And for no longer than a millisecond."""
    assert next_gap([], 7 * MS) == (7 * MS, 7 * MS + LONGEST_NS)


def test_a_gap_keeps_clear_of_the_releases_around_it() -> None:
    """It begins after the ticks and ends before the nodes wake up."""
    begin_ns, end_ns = next_gap([AT_1_KHZ], 7 * MS + 10 * US)
    assert 7 * MS + 50 * US <= begin_ns <= 7 * MS + 200 * US
    assert 8 * MS - 200 * US <= end_ns <= 8 * MS - 50 * US


def test_what_is_left_of_a_gap_is_used_if_it_is_long_enough() -> None:
    """Otherwise the next one is."""
    middle_ns = 7 * MS + 500 * US
    assert next_gap([AT_1_KHZ], middle_ns)[0] == middle_ns
    assert next_gap([AT_1_KHZ], middle_ns, 600 * US)[0] > 8 * MS


def test_before_the_first_release_there_is_room() -> None:
    """The grid begins when the run does."""
    begin_ns, end_ns = next_gap([ReleaseGrid(100 * MS, 10.0)], 50 * MS)
    assert (begin_ns, end_ns) == (50 * MS, 51 * MS)


def test_releases_that_leave_no_gap_do_not_keep_it_from_writing() -> None:
    """20 kHz: a short slice at once."""
    assert next_gap([ReleaseGrid(0, 20_000.0)], 7 * MS) == (7 * MS, 7 * MS + SHORTEST_NS)


@given(
    st.lists(st.floats(0.1, 900.0), max_size=5),
    st.integers(0, 10**12),
    st.integers(SHORTEST_NS, 600 * US),
)
def test_a_gap_is_soon_found_and_never_long(
    rates_hz: list[float], from_ns: int, least_ns: int
) -> None:
    """It begins within some periods of the fastest node; no release is in it if it was found."""
    grids = [ReleaseGrid(0, rate_hz) for rate_hz in rates_hz]
    begin_ns, end_ns = next_gap(grids, from_ns, least_ns)
    fastest_ns = min((grid.period_ns for grid in grids), default=0)
    assert from_ns <= begin_ns <= from_ns + 5 * fastest_ns
    assert SHORTEST_NS <= end_ns - begin_ns <= LONGEST_NS
    if end_ns - begin_ns > SHORTEST_NS:
        for grid in grids:
            assert grid.index_at(begin_ns) == grid.index_at(end_ns)
