"""When to write: in the gaps between the releases of Rt nodes.

The thread that writes has the interpreter, and a core. A node that is released meanwhile starts
some tens of microseconds late under real-time scheduling and, under ordinary scheduling, by as
much as the kernel lets a thread run.
"""

from __future__ import annotations

from collections.abc import Collection

from horus.timing import FOREVER_NS, Grid
from horus.units import NS_PER_US

SHORTEST_NS = 100 * NS_PER_US
LONGEST_NS = 1000 * NS_PER_US
"""Other nodes, and other threads, are to have the interpreter now and then."""
_BEFORE_NS = 120 * NS_PER_US
"""A gap ends so long before a release [ns]: nodes wake up early."""
_AFTER_NS = 100 * NS_PER_US
"""A gap begins so long after a release [ns]: most ticks are over by then."""
_TRIES = 4


def next_gap(grids: Collection[Grid], from_ns: int, least_ns: int = SHORTEST_NS) -> tuple[int, int]:
    """Return when the next gap begins, and when it ends [ns].

    Where releases leave no gap of that length, it is a short one at once.

    Args:
        grids: When nodes are released.
        from_ns: The earliest beginning [ns].
        least_ns: How long it has to be [ns].
    """
    begin_ns = from_ns
    for _ in range(_TRIES):
        due_ns = FOREVER_NS
        for grid in grids:
            index = grid.index_at(begin_ns)
            begin_ns = max(begin_ns, grid.at(index) + _AFTER_NS)
            due_ns = min(due_ns, grid.at(index + 1))
        end_ns = min(due_ns - _BEFORE_NS, begin_ns + LONGEST_NS)
        if end_ns - begin_ns >= least_ns:
            return begin_ns, end_ns
        begin_ns = due_ns
    return from_ns, from_ns + SHORTEST_NS
