"""The pytest plugin of horus: schedulers, probes and faults for tests of nodes.

pytest loads this module at every start, also for tests that have nothing to do with robots, and
before coverage is measured: `horus` itself is imported by the first fixture that is used.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Iterable, Iterator
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from horus import Scheduler
    from horus.testing import Faults, SchedulerClock, TopicProbe

_CHECKED = pytest.StashKey[bool]()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the plugin's setting."""
    parser.addini(
        "horus_leak_check",
        "check every test for leaked threads, processes and tasks, not only those that ask for it",
        type="bool",
        default=False,
    )


def pytest_configure(config: pytest.Config) -> None:
    """Announce the marker."""
    config.addinivalue_line(
        "markers",
        "horus(**options): make horus_scheduler with these arguments of Scheduler(); "
        "it is deterministic unless they say otherwise",
    )


@pytest.fixture(autouse=True)
def _horus_leak_check(request: pytest.FixtureRequest) -> None:
    if request.config.getini("horus_leak_check"):
        request.getfixturevalue("horus_leak_check")


@pytest.fixture
def horus_leak_check(request: pytest.FixtureRequest) -> Iterator[None]:
    """Fail the test if it leaves threads, processes or asyncio tasks behind.

    Tasks are looked for when the test's own code has ended, threads and processes when the
    fixtures that came later than this one are torn down: those of pytest-asyncio and anyio are
    not held against it. `horus_scheduler` asks for it.
    """
    from horus.testing import Belongings

    before = Belongings.now()
    request.node.stash[_CHECKED] = True
    yield
    before.check()


@pytest.hookimpl(wrapper=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> Generator[None, object, object]:
    """Look for tasks that the test has left on its event loop, while that is still there."""
    if not pyfuncitem.stash.get(_CHECKED, False):
        return (yield)
    from horus.testing import check_tasks, pending_tasks

    before = pending_tasks()
    scheduler: Any = pyfuncitem.funcargs.get("horus_scheduler")
    result = yield
    check_tasks(before, scheduler)
    return result


@pytest.fixture
def horus_scheduler(request: pytest.FixtureRequest, horus_leak_check: None) -> Iterator[Scheduler]:
    """Return a deterministic scheduler; it is stopped, and its nodes shut down, with the test.

    `@pytest.mark.horus(tick_rate=100, deterministic=False)` passes arguments to it.
    """
    from horus import Scheduler

    options: dict[str, Any] = {"deterministic": True}
    for mark in reversed(list(request.node.iter_markers("horus"))):
        options.update(mark.kwargs)
    with Scheduler(**options) as scheduler:
        yield scheduler


@pytest.fixture
def horus_clock(horus_scheduler: Scheduler) -> SchedulerClock:
    """Return what tells the time of `horus_scheduler`: `now()`, `elapsed()` and `tick()`."""
    from horus.testing import SchedulerClock

    return SchedulerClock(horus_scheduler)


@pytest.fixture
def run_for(horus_scheduler: Scheduler) -> Callable[..., None]:
    """Return a function that runs `horus_scheduler` for so many seconds, of virtual time if it can.

    The nodes stay initialised, as with `Scheduler.tick_for`.
    """

    def run(seconds: float, names: Iterable[str] | None = None) -> None:
        horus_scheduler.tick_for(seconds, names)

    return run


@pytest.fixture
def topic_probe(horus_scheduler: Scheduler) -> Iterator[Callable[..., TopicProbe]]:
    """Return a function that listens to a topic of `horus_scheduler`: see `TopicProbe`."""
    from horus.testing import TopicProbe

    probes: list[TopicProbe] = []

    def listen(topic: str | type, capacity: int = 10_000) -> TopicProbe:
        probes.append(TopicProbe(horus_scheduler, topic, capacity))
        return probes[-1]

    yield listen
    for probe in probes:
        probe.close()


@pytest.fixture
def fault(horus_scheduler: Scheduler) -> Iterator[Faults]:
    """Return what makes nodes of `horus_scheduler` freeze, raise and slow down: see `Faults`.

    Ask for it before the nodes are added.
    """
    from horus.testing import Faults

    faults = Faults(horus_scheduler)
    yield faults
    faults.clear()


@pytest.fixture
def replay(horus_scheduler: Scheduler) -> Callable[..., float]:
    """Return a function that replays a recording in `horus_scheduler`, and its length [s].

    It takes the arguments of `Scheduler.add_replay`: `run_for(replay(path, ["lidar"]))` runs
    the nodes under test on what the node `lidar` has sent.
    """

    def play(path: str | os.PathLike[str], nodes: Iterable[str] | None = None, **how: Any) -> float:
        horus_scheduler.add_replay(path, nodes, **how)
        return horus_scheduler._session.replays.length_ns() / 1e9

    return play
