"""Time: the only module that reads the operating system's clocks.

A `Timeline` is one scheduler's account of time: where its release grid begins,
what wall time that was, and which clock moves it on. A `TickContext` is what
`horus.now()`, `horus.dt()` and their siblings look at: the node whose callback
is running. It travels in a context variable, so it follows a callback through
threads and `await` alike.
"""

from __future__ import annotations

import os
import time
import weakref
from collections.abc import Callable
from contextvars import ContextVar
from typing import TYPE_CHECKING, NamedTuple, Protocol

from horus.stats import NodeCounters
from horus.timing import FOREVER_NS as FOREVER_NS
from horus.timing import ReleaseGrid
from horus.units import NS_PER_S, to_s

if TYPE_CHECKING:
    import random

monotonic_ns: Callable[[], int] = time.monotonic_ns
"""CLOCK_MONOTONIC [ns]: never jumps, not even when the wall clock is set."""

process_time_ns: Callable[[], int] = time.process_time_ns
"""CPU time of this process [ns]."""

wall_ns: Callable[[], int] = time.time_ns
"""Wall clock [ns since 1970]: for stamping what people read, never for scheduling."""

NEVER = -1
"""In place of an instant [ns] that has not come yet."""


def _entropy_float() -> float:
    """Return 53 random bits of the operating system as a float in [0, 1)."""
    return (int.from_bytes(os.urandom(7)) >> 3) * 2.0**-53


class Clock(Protocol):
    """What the scheduler needs to know of time."""

    @property
    def now_ns(self) -> Callable[[], int]:
        """A bound function that returns the current instant [ns]."""
        ...


class MonotonicClock:
    """The clock of a robot: CLOCK_MONOTONIC."""

    def __init__(self) -> None:
        """Bind the system call itself, so that a reading costs one C call."""
        self.now_ns: Callable[[], int] = monotonic_ns


class SimClock:
    """A clock that stands still until the simulation moves it; starts at 0."""

    def __init__(self) -> None:
        """Start at instant 0."""
        self._instant_ns = 0

    def now_ns(self) -> int:
        """Return the simulated instant [ns]."""
        return self._instant_ns

    def advance_to(self, instant_ns: int) -> None:
        """Move to `instant_ns`; moving back is ignored."""
        self._instant_ns = max(self._instant_ns, instant_ns)


class Position(NamedTuple):
    """Where a timeline stands."""

    epoch_ns: int
    first_cycle: int
    paused_at: int | None
    started_ns: int | None


class Moment(NamedTuple):
    """What the clock functions of a callback depend on: it goes to a worker process with a call."""

    position: Position
    ticking: bool
    release_ns: int
    start_ns: int
    previous_ns: int
    budget_ns: int | None
    nominal_dt_s: float
    ticks: int


class Timeline:
    """One scheduler's time: its clock, its epoch and its cycle count.

    `epoch_ns` is the instant of release 0 of every node. It moves when a run
    starts, so that a scheduler can run again; the cycle count goes on.
    """

    def __init__(
        self,
        clock: Clock,
        tick_rate_hz: float,
        *,
        seed: int | None = None,
        wall_offset_ns: int | None = None,
    ) -> None:
        """Begin at the current instant.

        Args:
            clock: Tells the time.
            tick_rate_hz: Cycles per second [Hz].
            seed: Makes the timeline deterministic.
            wall_offset_ns: Of a timeline that this one is to agree with [ns].
        """
        self.clock = clock
        self.now_ns = clock.now_ns
        self.seed = seed
        self.tick_rate_hz = tick_rate_hz
        self._first_cycle = 0
        self._paused_at: int | None = 0
        if wall_offset_ns is None:
            wall_offset_ns = 0 if self.deterministic else wall_ns() - monotonic_ns()
        self.wall_offset_ns = wall_offset_ns
        """Wall time less the clock's [ns]."""
        self.started_ns: int | None = None
        self.end_ns = FOREVER_NS
        """The end of a run of limited time [ns]: no release at or after it."""
        self.grid = ReleaseGrid(self.now_ns(), tick_rate_hz)

    @property
    def deterministic(self) -> bool:
        """Whether time is simulated."""
        return self.seed is not None

    @property
    def epoch_ns(self) -> int:
        """The instant of release 0 [ns]."""
        return self.grid.epoch_ns

    def position(self) -> Position:
        """Return where it stands, for `follow` in another process."""
        return Position(self.grid.epoch_ns, self._first_cycle, self._paused_at, self.started_ns)

    def follow(self, position: Position) -> None:
        """Stand where another timeline with the same clock does."""
        if position != self.position():
            epoch_ns, self._first_cycle, self._paused_at, self.started_ns = position
            self.grid = ReleaseGrid(epoch_ns, self.tick_rate_hz)

    def begin(self, epoch_ns: int, duration_ns: int | None = None) -> None:
        """Start the grid at `epoch_ns`; the cycle count goes on."""
        self.end_ns = FOREVER_NS if duration_ns is None else epoch_ns + duration_ns
        if self.started_ns is None:
            self.started_ns = epoch_ns
        self._first_cycle = self.current_cycle()
        self._paused_at = None
        self.grid = ReleaseGrid(epoch_ns, self.tick_rate_hz)

    def count_from(self, cycle: int) -> None:
        """Let the first cycle have this number; nothing runs yet."""
        self._paused_at = cycle

    def pause(self) -> None:
        """End the present cycle and count no more: nothing runs."""
        if self._paused_at is None:
            self._paused_at = self.current_cycle() + 1

    def begin_step(self) -> int:
        """Begin a single cycle outside of any grid; return the instant [ns]."""
        now_ns = self.now_ns()
        if self.started_ns is None:
            self.started_ns = now_ns
        return now_ns

    def end_step(self) -> None:
        """Count the cycle that `begin_step` began."""
        if self._paused_at is not None:
            self._paused_at += 1

    def cycle_at(self, instant_ns: int) -> int:
        """Return the number of the cycle that `instant_ns` falls in."""
        if self._paused_at is not None:
            return self._paused_at
        return self._first_cycle + max(0, self.grid.index_at(instant_ns))

    def current_cycle(self) -> int:
        """Return the number of the cycle now, or of the next one when nothing runs."""
        return self.cycle_at(self.now_ns())

    def wall_s(self) -> float:
        """Return wall time [s]: fixed at construction plus monotonic progress."""
        return (self.now_ns() + self.wall_offset_ns) / NS_PER_S

    def elapsed_s(self) -> float:
        """Return the time since the scheduler first started [s]."""
        return 0.0 if self.started_ns is None else to_s(self.now_ns() - self.started_ns)


class TickContext:
    """What the clock functions can see of the callback that is running.

    Written by the tick path of one node, read by that node's own callbacks.
    """

    __slots__ = (
        "budget_ns",
        "counters",
        "finish_ns",
        "fixed_dt_s",
        "node",
        "nominal_dt_s",
        "previous_ns",
        "random",
        "release_ns",
        "start_ns",
        "ticking",
        "timeline",
    )

    def __init__(self, node: str, timeline: Timeline, counters: NodeCounters) -> None:
        """Describe a node that has not ticked yet."""
        self.node = node
        self.counters = counters
        self.timeline = timeline
        self.nominal_dt_s = 0.0
        self.fixed_dt_s: float | None = None
        self.budget_ns: int | None = None
        self.previous_ns = NEVER
        self.release_ns = 0
        self.start_ns = NEVER
        self.finish_ns = NEVER
        self.ticking = False
        self.random: tuple[int, random.Random] | None = None

    def moment(self) -> Moment:
        """Return what another context has to `follow` to answer as this one does."""
        return Moment(
            self.timeline.position(),
            self.ticking,
            self.release_ns,
            self.start_ns,
            self.previous_ns,
            self.budget_ns,
            self.nominal_dt_s,
            self.counters.ticks,
        )

    def follow(self, moment: Moment) -> None:
        """Answer as the context does that this moment is from."""
        self.timeline.follow(moment.position)
        self.ticking = moment.ticking
        self.release_ns = moment.release_ns
        self.start_ns = moment.start_ns
        self.previous_ns = moment.previous_ns
        self.budget_ns = moment.budget_ns
        self.nominal_dt_s = moment.nominal_dt_s
        self.counters.ticks = moment.ticks

    def dt_s(self) -> float:
        """Return the time since the previous tick [s]; nominal on the first."""
        if self.fixed_dt_s is not None:
            return self.fixed_dt_s
        if self.previous_ns == NEVER:
            return self.nominal_dt_s
        return to_s(self.start_ns - self.previous_ns)

    def cycle(self) -> int:
        """Return the scheduler's cycle number of this tick."""
        instant_ns = self.release_ns if self.ticking else self.timeline.now_ns()
        return self.timeline.cycle_at(instant_ns)

    def budget_left_s(self) -> float:
        """Return what is left of the budget [s], down to 0; inf without one."""
        if self.budget_ns is None or not self.ticking:
            return float("inf")
        return to_s(max(0, self.budget_ns - (self.timeline.now_ns() - self.start_ns)))

    def rng_float(self) -> float:
        """Return the next random float in [0, 1) of this tick."""
        seed = self.timeline.seed
        if seed is None:
            return _entropy_float()
        tick = self.counters.ticks
        if self.random is None or self.random[0] != tick:
            import random  # only simulations need it, and it is slow to load

            # Seeded per tick, not per run: a node that draws once more in one
            # tick does not shift the numbers of every later tick.
            self.random = (tick, random.Random(f"{seed}/{self.node}/{tick}"))
        return self.random[1].random()


current: ContextVar[TickContext | None] = ContextVar("horus_tick", default=None)
"""The context of the callback that is running here, if one is."""

_ambient: list[weakref.ref[Timeline]] = []


def set_ambient(timeline: Timeline) -> None:
    """Let the clock functions answer for `timeline` when called outside callbacks.

    With several schedulers, the one that began last answers, until it ends.
    """
    if _outside() is not timeline:
        clear_ambient(timeline)
        _ambient.append(weakref.ref(timeline))


def clear_ambient(timeline: Timeline) -> None:
    """Forget `timeline`."""
    _ambient[:] = [ref for ref in _ambient if ref() not in (None, timeline)]


def _outside() -> Timeline | None:
    return _ambient[-1]() if _ambient else None


def now() -> float:
    """Return the current time [s].

    Wall time in normal mode, which never jumps back while a scheduler lives;
    simulated time, starting at 0, in deterministic mode.

    Thread: any.
    """
    context = current.get()
    timeline = context.timeline if context is not None else _outside()
    return wall_ns() / NS_PER_S if timeline is None else timeline.wall_s()


def dt() -> float:
    """Return the time since this node's previous tick started [s].

    The nominal `1/rate` on a node's first tick, exactly `1/rate` on every tick
    in deterministic mode (event nodes: the simulated time between messages).
    Outside callbacks: one cycle of the active scheduler, or 0.0 without one.

    Thread: any.
    """
    context = current.get()
    if context is not None:
        return context.dt_s()
    timeline = _outside()
    return 0.0 if timeline is None else 1.0 / timeline.tick_rate_hz


def elapsed() -> float:
    """Return the time since the scheduler started [s]; 0.0 without a scheduler.

    Thread: any.
    """
    context = current.get()
    timeline = context.timeline if context is not None else _outside()
    return 0.0 if timeline is None else timeline.elapsed_s()


def tick() -> int:
    """Return the scheduler's cycle number: it only ever grows, by `tick_rate` a second.

    Thread: any.
    """
    context = current.get()
    if context is not None:
        return context.cycle()
    timeline = _outside()
    return 0 if timeline is None else timeline.current_cycle()


def budget_remaining() -> float:
    """Return what is left of this tick's budget [s], never below 0.

    `float("inf")` when the node has no budget, and outside ticks.

    Thread: any.
    """
    context = current.get()
    return float("inf") if context is None else context.budget_left_s()


def rng_float() -> float:
    """Return a random float in [0.0, 1.0).

    From the operating system's entropy in normal mode; in deterministic mode
    from a generator seeded by (seed, node, tick), the same in every run.

    Thread: any.
    """
    context = current.get()
    return _entropy_float() if context is None else context.rng_float()
