"""Faults by hand: commands from the standard input while the robot runs."""

from __future__ import annotations

import os
import select
import sys
import time
from collections import deque
from collections.abc import Callable

from drill import report
from drill.observer import SYSTEM, Observer
from drill.robot import BUDGET_S, CRITICAL_S, OVERRUN_S, PARTS, Fault, Robot
from horus import StateError, ms, us

HELP = """\
freeze NODE [SECONDS]   its next tick does not return for 1 s, or as long as you say
raise NODE              its next tick raises
overrun NODE            its next tick takes longer than its budget
clear                   clear_safe_state()
stats                   what the scheduler knows of each node
wait SECONDS            read the next command later
help, quit"""

POLICIES = {
    "rt": {"on_miss": "safe_mode"},
    "best_effort": {"failure_policy": "restart"},
    "compute": {"on_miss": "skip"},
    "async": {"failure_policy": "skip"},
}
"""What the nodes of the interactive robot do about faults, where it is not the default."""

_POLL_S = 20 * ms


class Console:
    """Reads commands and shows what happens.

    Thread: one, beside the run.
    """

    def __init__(self, robot: Robot, observer: Observer) -> None:
        """Take over a robot that does not run yet, and make its motor critical."""
        self._robot = robot
        self._observer = observer
        self._kinds = {part.name: kind for kind, part in PARTS.items()}
        self._struck_s = observer.began_s
        self._not_before_s = 0.0
        self._lines: deque[str] = deque()
        self._unread = b""
        self._open = True
        for kind, policies in POLICIES.items():
            robot.fit(kind, **policies)
        for name in self._kinds:
            robot.scheduler.set_tick_budget(name, BUDGET_S / us)
        robot.scheduler.add_critical_node("motor", timeout_ms=CRITICAL_S / ms)

    def converse(self) -> None:
        """Obey and show until somebody quits, then stop the robot."""
        scheduler = self._robot.scheduler
        try:
            while scheduler.stop_reason is None and self._expects_more():
                self._show_events()
                self._read()
                if self._lines and time.monotonic() >= self._not_before_s:
                    self._obey(self._lines.popleft().split())
        finally:
            scheduler.stop("quit")

    def _expects_more(self) -> bool:
        return self._open or bool(self._lines) or time.monotonic() < self._not_before_s

    def _show_events(self) -> None:
        event = self._observer.next_event(_POLL_S)
        while event is not None:
            if event.kind == "fault":
                self._struck_s = event.at_s
            print(report.line(event, event.at_s - self._struck_s), flush=True)
            event = self._observer.next_event(0.001)
        self._observer.sample(self._robot.scheduler.get_all_nodes)

    def _read(self) -> None:
        """Take what has been typed; not with `input()`, which could not be left at the end."""
        if self._open and select.select([sys.stdin], [], [], 0)[0]:
            typed = os.read(sys.stdin.fileno(), 4096)
            self._open = bool(typed)
            *lines, self._unread = (self._unread + typed).split(b"\n")
            self._lines.extend(one.decode(errors="replace") for one in lines)

    def _obey(self, words: list[str]) -> None:
        commands: dict[str, Callable[[list[str]], None]] = {
            "freeze": self._strike,
            "raise": self._strike,
            "overrun": self._strike,
            "clear": self._clear,
            "stats": self._stats,
            "wait": self._wait,
            "help": lambda _: print(HELP),
            "quit": lambda _: self._robot.scheduler.stop("quit"),
        }
        if not words:
            return
        try:
            commands[words[0]](words)
        except (KeyError, IndexError, ValueError):
            print(f"not understood: {' '.join(words)}\n{HELP}\nnodes: {', '.join(self._kinds)}")

    def _strike(self, words: list[str]) -> None:
        kind, name = words[0], words[1]
        lasts_s = OVERRUN_S if kind == "overrun" else float(words[2]) if len(words) > 2 else 1.0
        self._robot.machines[self._kinds[name]].strike(Fault(kind, lasts_s))

    def _clear(self, _: list[str]) -> None:
        try:
            remain = self._robot.scheduler.clear_safe_state()
        except StateError as error:
            self._observer.note("refused", SYSTEM, str(error))
        else:
            if remain:
                self._observer.note("command", SYSTEM, f"cannot tick yet: {', '.join(remain)}")

    def _stats(self, _: list[str]) -> None:
        print(f"{'node':8}  {'state':10}  {'health':9}  ticks  skipped  errors  expirations")
        for name, one in self._robot.stats().items():
            print(
                f"{name:8}  {one['state']:10}  {one['health']:9}  {one['total_ticks']:5}  "
                f"{one['skipped']:7}  {one['errors_count']:6}  {one['watchdog_expirations']:11}"
            )
        safety = self._robot.scheduler.safety_stats()
        print(f"safe state: {safety['safe_state_reason'] or 'no'}")

    def _wait(self, words: list[str]) -> None:
        self._not_before_s = time.monotonic() + float(words[1])
