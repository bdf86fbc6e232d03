"""The interpreter lock: how long a busy thread may keep an Rt thread waiting."""

from __future__ import annotations

import contextlib
import sys
import threading
from collections.abc import Iterator

_SWITCH_INTERVAL_S = 50e-6
"""Longest time a thread computes on while another one waits for its turn [s].

At CPython's default of 5 ms a single busy planner makes each Rt thread
milliseconds late. Below some 50 us the switching itself costs too much.
"""

_lock = threading.Lock()
_users = 0
_before_s = 0.0


@contextlib.contextmanager
def prompt_switching() -> Iterator[None]:
    """Shorten the switch interval of the process while any run needs it, then restore it."""
    global _users, _before_s
    with _lock:
        if _users == 0:
            _before_s = sys.getswitchinterval()
            sys.setswitchinterval(min(_before_s, _SWITCH_INTERVAL_S))
        _users += 1
    try:
        yield
    finally:
        with _lock:
            _users -= 1
            if _users == 0:
                sys.setswitchinterval(_before_s)
