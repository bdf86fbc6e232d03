"""What a thread waits for: given, kept, and waited for no longer than asked."""

from __future__ import annotations

import sys
import threading

import pytest

from horus import os_rt
from horus.clock import monotonic_ns
from horus.executors.permit import LockPermit, make_permit
from horus.units import NS_PER_MS, NS_PER_S

KINDS = [LockPermit, *([os_rt.Semaphore] if sys.platform == "linux" else [])]


@pytest.fixture(params=KINDS)
def permit(request):
    """Return one of each kind in turn."""
    return request.param()


def test_given_before_it_is_waited_for_it_is_kept(permit):
    """However often: then it is one."""
    permit.give()
    permit.give()
    assert permit.take()
    assert not permit.take(0)
    permit.give()
    assert permit.take(monotonic_ns() + NS_PER_S)


def test_nobody_waits_past_the_instant(permit):
    """And not at all for one that is past."""
    until_ns = monotonic_ns() + 30 * NS_PER_MS
    assert not permit.take(until_ns)
    assert 0 <= monotonic_ns() - until_ns < NS_PER_S
    for past_ns in (until_ns, 0, -1):
        assert not permit.take(past_ns)


@pytest.mark.parametrize("limited", [False, True])
def test_none_is_lost_between_two_threads(permit, limited):
    """Each finds what the other has left, however their steps interleave."""
    answer = type(permit)()
    rounds = 5000
    done = []

    def other():
        for number in range(rounds):
            assert permit.take(monotonic_ns() + 10 * NS_PER_S if limited else None)
            done.append(number)
            answer.give()

    thread = threading.Thread(target=other, daemon=True)
    thread.start()
    for _ in range(rounds):
        permit.give()
        assert answer.take(monotonic_ns() + 10 * NS_PER_S)
    thread.join(10)
    assert done == list(range(rounds))


@pytest.mark.skipif(sys.platform != "linux", reason="sem_clockwait is of Linux")
def test_where_the_c_library_lacks_it_a_lock_does(monkeypatch):
    """An older one, or another."""
    assert isinstance(make_permit(), os_rt.Semaphore)

    def lacking():
        raise OSError("sem_clockwait is not available on this platform")

    monkeypatch.setattr(os_rt, "_libc_of_semaphores", lacking)
    assert isinstance(make_permit(), LockPermit)
