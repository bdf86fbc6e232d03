"""What is done about ticks that do not end."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable

from horus.clock import NEVER
from horus.live import LiveNode
from horus.loop.safety import Safety
from horus.loop.stacks import Stack, readable_stack
from horus.loop.supervisor_thread import Report
from horus.loop.watchdog import Finding, Watchdog
from horus.spec import Health
from horus.units import readable

_log = logging.getLogger("horus.supervisor")

_LEVELS = {
    Health.HEALTHY: logging.INFO,
    Health.WARNING: logging.WARNING,
    Health.UNHEALTHY: logging.ERROR,
    Health.ISOLATED: logging.ERROR,
}


class Inspector:
    """Acts on what the watchdog finds, then has it logged.

    ============== ================================================================
    lasts longer   what follows
    ============== ================================================================
    1 x timeout    Warning: logged with the stack of what is frozen
    2 x timeout    Unhealthy: logged as an error; its releases go by
    3 x timeout    Isolated: taken out of the schedule, its safe-state hook is called
    critical       the whole system enters its safe state
    ============== ================================================================

    Thread: one, which no node can block; in virtual time that of the simulation.
    """

    def __init__(
        self,
        watchdog: Watchdog,
        safety: Safety,
        now_ns: Callable[[], int],
        report: Report,
    ) -> None:
        """Act on what `watchdog` finds."""
        self._watchdog = watchdog
        self._safety = safety
        self._now_ns = now_ns
        self._report = report

    @property
    def next_ns(self) -> int:
        """When to `inspect` again [ns]."""
        return self._watchdog.next_ns

    def look_again(self) -> None:
        """Take note that something has changed that `next_ns` depends on."""
        self._watchdog.next_ns = NEVER

    def inspect(self) -> None:
        """Find what has run out by now, and act."""
        times_cleared = self._safety.times_cleared
        for finding in self._watchdog.look(self._now_ns()):
            self._act(finding, times_cleared)

    def critical_late(self, live: LiveNode, lasted_ns: int, times_cleared: int) -> None:
        """Act on a critical node that was owed a tick for too long [ns] before anybody looked.

        Because the whole process stood still, say: the motor was not controlled either.
        When that was seen, the safe state had been cleared so many times.
        """
        if live.critical_ns is None:
            return
        live.standing.expired_unseen()
        reason = (
            f"critical node {live.name} was owed a tick for {readable(lasted_ns)}, longer than "
            f"its limit of {readable(live.critical_ns)}, before anybody could look"
        )
        if self._safety.enter(reason, self._watchdog.watched, times_cleared):
            self._report(functools.partial(_tell_of_entry, reason))

    def _act(self, finding: Finding, times_cleared: int) -> None:
        live, health = finding.live, finding.health
        before = live.standing.health
        if finding.critical and health is Health.HEALTHY:
            health = Health.WARNING
        news = health is not before or health is Health.HEALTHY
        # First: isolation cuts async ticks short, and then they are nowhere.
        stack = finding.home.stack(live)
        isolated = health is Health.ISOLATED
        if isolated:
            if not self._safety.isolate(live, finding.ticks):
                return
            finding.home.isolate(live)
        elif health is not before:
            live.standing.expire(health)
        entered: str | None = None
        if live.critical_ns is not None and (finding.critical or isolated):
            reason = (
                f"critical node {live.name} {_lasting(finding)}, longer than its limit of "
                + readable(live.critical_ns if finding.critical else 3 * self._timeout_ns(live))
            )
            if self._safety.enter(reason, self._watchdog.watched, times_cleared):
                entered = reason
        if news or entered is not None:
            self._report(functools.partial(self._tell, finding, health, news, entered, stack))

    def _timeout_ns(self, live: LiveNode) -> int:
        return self._watchdog.timeout_of(live) or 0

    def _limit_of(self, finding: Finding) -> str:
        timeout_ns, critical_ns = self._timeout_ns(finding.live), finding.live.critical_ns
        only_critical = finding.lasted_ns <= timeout_ns
        if critical_ns is not None and finding.critical and only_critical:
            return f"its limit as a critical node is {readable(critical_ns)}"
        return f"its watchdog timeout is {readable(timeout_ns)}"

    def _tell(
        self, finding: Finding, health: Health, news: bool, entered: str | None, stack: Stack
    ) -> None:
        """Log what was done.

        Thread: that of the reports.
        """
        live = finding.live
        if entered is not None:
            _tell_of_entry(entered)
        if news and health is Health.HEALTHY:
            live.emit(logging.INFO, "healthy again")
        elif news:
            live.emit(
                _LEVELS[health],
                f"{health.value}: its tick {_lasting(finding)}, "
                f"{self._limit_of(finding)}{_CONSEQUENCES[health]}; it is in:\n"
                f"{readable_stack(stack)}",
            )


_CONSEQUENCES = {
    Health.WARNING: "",
    Health.UNHEALTHY: "; its releases are skipped",
    Health.ISOLATED: "; it is taken out of the schedule",
}


def _tell_of_entry(reason: str) -> None:
    _log.critical("safe state entered: %s", reason)


def _lasting(finding: Finding) -> str:
    if finding.running:
        return f"has been running for {readable(finding.lasted_ns)}"
    waits = f"has been due for {readable(finding.lasted_ns)} and cannot begin"
    return waits if finding.blamed is None else f"{waits} because of {finding.blamed.name}"
