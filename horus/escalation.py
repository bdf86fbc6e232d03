"""What to do about a tick that failed, overran, came late or does not end: pure decisions.

`decide` looks at an outcome and the node's policies and returns an `Action`;
`grade` looks at how long a tick has lasted. Both read no clock, take no lock and
call nobody, so that every row of the policy tables can be tested without running
anything. The tick path and the supervisor act.
"""

from __future__ import annotations

from dataclasses import dataclass

from horus.spec import FailurePolicy, Health, Miss


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a tick ended; the excesses are 0 when the limit was kept."""

    over_budget_ns: int = 0
    """Execution time beyond the budget [ns]."""
    past_deadline_ns: int = 0
    """Response time beyond the deadline [ns]."""
    failed: bool = False
    """Whether the callback raised."""
    died: bool = False
    """Whether the node's worker process has ended, and with it what `init()` had made."""

    @property
    def missed(self) -> bool:
        """Whether a limit was exceeded, so that `on_miss` fires."""
        return self.over_budget_ns > 0 or self.past_deadline_ns > 0


@dataclass(frozen=True, slots=True)
class Action:
    """What the tick path does next."""

    warn: bool = False
    """Log the exceeded limit (rate limited)."""
    skip_next: bool = False
    """Do not run the next release."""
    enter_safe_state: bool = False
    """Call the node's safe-state hook."""
    stop: bool = False
    """Stop the scheduler because of the exceeded limit."""
    restart: bool = False
    """Run `init()` again after the back-off."""
    fatal: bool = False
    """Stop the scheduler because of the exception."""


def decide(
    outcome: Outcome, *, on_miss: Miss, failure_policy: FailurePolicy | None, in_episode: bool
) -> Action:
    """Return what follows from a tick's outcome.

    Args:
        outcome: What happened.
        on_miss: The node's policy for exceeded limits.
        failure_policy: The node's policy for exceptions.
        in_episode: Whether limits were exceeded in the previous tick already; the
            safe state is entered once per episode.
    """
    missed = outcome.missed
    return Action(
        warn=missed,
        skip_next=missed and on_miss is Miss.SKIP,
        enter_safe_state=missed and on_miss is Miss.SAFE_MODE and not in_episode,
        stop=missed and on_miss is Miss.STOP,
        restart=(outcome.failed and failure_policy is FailurePolicy.RESTART)
        or (outcome.died and failure_policy is not FailurePolicy.FATAL),
        fatal=outcome.failed and failure_policy is FailurePolicy.FATAL,
    )


GRADES = (Health.HEALTHY, Health.WARNING, Health.UNHEALTHY, Health.ISOLATED)
"""What a node is after no, one, two and three watchdog timeouts."""


def grade(lasted_ns: int, timeout_ns: int) -> Health:
    """Return the health of a node whose tick has lasted this long without an end [ns]."""
    timeouts = max(0, lasted_ns - 1) // timeout_ns
    return GRADES[min(timeouts, len(GRADES) - 1)]
