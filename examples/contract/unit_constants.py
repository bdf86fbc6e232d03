"""Write durations with `us` and `ms`: a bare number is in seconds.

Prints:
    300 us is 0.0003 s, 5 ms is 0.005 s
    budget=300 means 300 seconds: node 'typo': budget is ...
"""

from __future__ import annotations

import warnings

from horus import ConfigWarning, Node, ms, us


def tick() -> None:
    """Do nothing."""


if __name__ == "__main__":
    print(f"300 us is {300 * us:g} s, 5 ms is {5 * ms:g} s")
    Node(name="motor", tick=tick, rate=1000, budget=300 * us, deadline=900 * us)

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", ConfigWarning)
        Node(name="typo", tick=tick, rate=1000, budget=300)
    print(f"budget=300 means 300 seconds: {caught[0].message}")
