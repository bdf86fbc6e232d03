"""The test bench: puts faults into the robot, and compares what happens with what should."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from drill.observer import SYSTEM, Event, Observer
from drill.robot import PARTS, Fault, Machine, Robot
from horus import ms

PATIENCE_S = 2.0
"""How much longer than it should take something is waited for."""


class RunEndedError(Exception):
    """The robot was stopped before the drill was over."""


Match = Callable[[Event], bool]

_POLL_S = 5 * ms


def tolerance_s(due_s: float) -> float:
    """Return how late a reaction may come without being called late [s]."""
    return 0.1 * due_s + 5 * ms


@dataclass(slots=True, kw_only=True)
class Check:
    """Something that should happen, and whether it did."""

    what: str
    expected: str
    """When, in words; or "yes"."""
    due_s: float | None = None
    """After how long it is expected [s]; None where it is not a matter of time."""
    event: Event | None = None
    observed_s: float | None = None
    passed: bool = False

    @property
    def late(self) -> bool:
        """Whether it took noticeably longer than it should."""
        if self.due_s is None or self.observed_s is None:
            return False
        return self.observed_s > self.due_s + tolerance_s(self.due_s)


@dataclass(slots=True, kw_only=True)
class Record:
    """What went wrong in a drill, and what came of it."""

    kind: str
    """The class of the node, as on the command line."""
    fault: str
    variant: str
    machine: str
    struck_s: float = 0.0
    """When the fault began [s]."""
    events: list[Event] = field(default_factory=list)
    checks: list[Check] = field(default_factory=list)

    @property
    def passed(self) -> bool:
        """Whether everything happened that should."""
        return all(check.passed for check in self.checks)


class Bench:
    """Runs drills, one after another.

    Thread: one, beside the run.
    """

    def __init__(self, robot: Robot, observer: Observer, show: Callable[[Record], None]) -> None:
        """Test a robot; `show` is given the record of each drill when it is over."""
        self.robot = robot
        self.observer = observer
        self._show = show

    @contextmanager
    def drill(self, kind: str, fault: str, variant: str, **policies: Any) -> Iterator[Drill]:
        """Begin a drill with a healthy robot.

        Args:
            kind: The class of the node.
            fault: What goes wrong.
            variant: What is special about this drill.
            policies: Arguments of the node.
        """
        machine = self.robot.fit(kind, **policies) if policies else self.robot.machines[kind]
        record = Record(kind=kind, fault=fault, variant=variant, machine=machine.name)
        drill = Drill(record, machine, self.robot, self.observer)
        healthy = drill.until(lambda: machine.ticks > 0 and self._all_well())
        if not healthy:
            drill.confirm("healthy before the drill", False)
        try:
            yield drill
        finally:
            drill.end_fault()
        record.events = drill.saw(lambda _: True)
        self._show(record)

    def _all_well(self) -> bool:
        nodes = self.robot.stats().values()
        return all((one["state"], one["health"]) == ("running", "healthy") for one in nodes)


class Drill:
    """One drill: what goes wrong, in the order in which it is written down."""

    def __init__(self, record: Record, machine: Machine, robot: Robot, observer: Observer) -> None:
        """Record what happens to a machine of a robot."""
        self.robot = robot
        self.name = machine.name
        self.period_s = PARTS[record.kind].period_s
        self._record = record
        self._machine = machine
        self._observer = observer
        self._since_s = 0.0
        self._sign = ""
        self._first = 0
        self._fault: Fault | None = None

    def strike(self, fault: Fault) -> None:
        """Let something go wrong; times count from here."""
        self._first = len(self._observer.events)
        self._fault = fault
        self._machine.strike(fault)
        event = self._wait_for(lambda event: event.kind == "fault", PATIENCE_S)
        self._since_s = self._record.struck_s = event.at_s if event else time.monotonic()
        if event is None:
            self.confirm("the fault happens", False)

    def end_fault(self) -> None:
        """Let a frozen tick return."""
        if self._fault is not None:
            self._fault.ended.set()

    def command(self, text: str) -> None:
        """Say what the program does next; times count from here."""
        self._observer.note("command", SYSTEM, text)
        self._since_s, self._sign = time.monotonic(), "+"

    def expect(
        self,
        what: str,
        match: Match,
        due_s: float,
        *,
        earliest_s: float | None = None,
        words: str | None = None,
    ) -> None:
        """Wait for something to happen.

        Args:
            what: A name for it.
            match: Tells which event it is.
            due_s: When it should happen [s].
            earliest_s: When it may happen at the earliest [s], if that is not the same.
            words: When it should happen, in words.
        """
        check = Check(what=what, expected=self._sign + (words or f"{due_s / ms:.0f} ms"))
        check.due_s = due_s
        event = self._wait_for(match, due_s + PATIENCE_S)
        if event is not None:
            check.event, check.observed_s = event, event.at_s - self._since_s
            at_least_s = due_s - tolerance_s(due_s) if earliest_s is None else earliest_s
            check.passed = check.observed_s >= at_least_s
        self._record.checks.append(check)

    def confirm(self, what: str, passed: bool) -> None:
        """Note whether something is as it should be."""
        self._record.checks.append(Check(what=what, expected="yes", passed=passed))

    def saw(self, match: Match) -> list[Event]:
        """Return what has happened since the fault was ordered."""
        return [event for event in self._observer.events[self._first :] if match(event)]

    def pause(self, seconds: float) -> None:
        """Let time pass."""
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            self._take(_POLL_S)

    def until(self, condition: Callable[[], bool]) -> bool:
        """Wait for a condition; return whether it has come true."""
        give_up_s = time.monotonic() + PATIENCE_S
        while not condition():
            if time.monotonic() > give_up_s:
                return False
            self._take(_POLL_S)
        return True

    def _wait_for(self, match: Match, patience_s: float) -> Event | None:
        give_up_s = time.monotonic() + patience_s
        seen = self._first
        while True:
            while seen < len(self._observer.events):
                event = self._observer.events[seen]
                seen += 1
                if match(event):
                    return event
            if time.monotonic() > give_up_s:
                return None
            self._take(_POLL_S)

    def _take(self, timeout_s: float) -> None:
        if self.robot.scheduler.stop_reason is not None:
            raise RunEndedError
        self._observer.next_event(timeout_s)
        self._observer.sample(self.robot.scheduler.get_all_nodes)
