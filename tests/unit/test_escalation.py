"""The policy tables, row by row, without running anything."""

from __future__ import annotations

import dataclasses

import pytest
from hypothesis import given
from hypothesis import strategies as st

from horus import FailurePolicy, Health, Miss
from horus.escalation import GRADES, Action, Outcome, decide, grade

outcomes = st.builds(Outcome, st.integers(0, 10**9), st.integers(0, 10**9), st.booleans())
policies = st.sampled_from(Miss)
failure_policies = st.one_of(st.none(), st.sampled_from(FailurePolicy))


@given(policies, failure_policies, st.booleans())
def test_a_healthy_tick_never_escalates(
    on_miss: Miss, failure_policy: FailurePolicy | None, in_episode: bool
) -> None:
    """A tick that keeps both limits and does not raise has no consequence, ever."""
    action = decide(
        Outcome(), on_miss=on_miss, failure_policy=failure_policy, in_episode=in_episode
    )
    assert action == Action()


@pytest.mark.parametrize("outcome", [Outcome(1, 0), Outcome(0, 1), Outcome(1, 1)])
@pytest.mark.parametrize(
    ("policy", "expected"),
    [
        (Miss.WARN, Action(warn=True)),
        (Miss.SKIP, Action(warn=True, skip_next=True)),
        (Miss.SAFE_MODE, Action(warn=True, enter_safe_state=True)),
        (Miss.STOP, Action(warn=True, stop=True)),
    ],
)
def test_on_miss_fires_for_budget_and_deadline_alike(
    outcome: Outcome, policy: Miss, expected: Action
) -> None:
    """`on_miss` fires when a tick exceeds its deadline or its budget, once per tick."""
    assert decide(outcome, on_miss=policy, failure_policy=None, in_episode=False) == expected


@pytest.mark.parametrize(
    ("policy", "expected"),
    [
        (None, Action()),
        (FailurePolicy.SKIP, Action()),
        (FailurePolicy.IGNORE, Action()),
        (FailurePolicy.RESTART, Action(restart=True)),
        (FailurePolicy.FATAL, Action(fatal=True)),
    ],
)
def test_failure_policies(policy: FailurePolicy | None, expected: Action) -> None:
    """Only `restart` and `fatal` do more than log and go on."""
    outcome = Outcome(failed=True)
    assert decide(outcome, on_miss=Miss.WARN, failure_policy=policy, in_episode=False) == expected


@given(st.lists(outcomes, max_size=50))
def test_the_safe_state_is_entered_once_per_episode(history: list[Outcome]) -> None:
    """`safe_mode` calls the hook at the first exceeded limit of an episode only."""
    in_episode = False
    for outcome in history:
        action = decide(outcome, on_miss=Miss.SAFE_MODE, failure_policy=None, in_episode=in_episode)
        assert action.enter_safe_state == (outcome.missed and not in_episode)
        in_episode = outcome.missed


@given(outcomes, policies, failure_policies, st.booleans())
def test_deciding_is_pure(
    outcome: Outcome, on_miss: Miss, failure_policy: FailurePolicy | None, in_episode: bool
) -> None:
    """The same outcome and policies give the same action, and nothing is changed."""
    before = dataclasses.replace(outcome)
    arguments = {
        "on_miss": on_miss,
        "failure_policy": failure_policy,
        "in_episode": in_episode,
    }
    assert decide(outcome, **arguments) == decide(outcome, **arguments)
    assert outcome == before


@pytest.mark.parametrize(
    ("lasted_ns", "expected"),
    [
        (-5, Health.HEALTHY),
        (0, Health.HEALTHY),
        (100, Health.HEALTHY),
        (101, Health.WARNING),
        (200, Health.WARNING),
        (201, Health.UNHEALTHY),
        (300, Health.UNHEALTHY),
        (301, Health.ISOLATED),
        (10**18, Health.ISOLATED),
    ],
)
def test_the_watchdog_s_table(lasted_ns: int, expected: Health) -> None:
    """More than 1x the timeout: Warning; more than 2x: Unhealthy; more than 3x: Isolated."""
    assert grade(lasted_ns, 100) is expected


@given(st.integers(1, 10**12), st.integers(0, 10**13), st.integers(0, 10**13))
def test_health_never_improves_while_a_tick_lasts(timeout_ns: int, lasted: int, more: int) -> None:
    """The longer a tick lasts, the worse: stages are passed one after another."""
    before, after = grade(lasted, timeout_ns), grade(lasted + more, timeout_ns)
    assert GRADES.index(before) <= GRADES.index(after)
    assert (before is Health.HEALTHY) == (lasted <= timeout_ns)


@given(st.integers(1, 10**6), st.integers(0, 10**7), st.integers(1, 10**3))
def test_stages_are_multiples_of_the_timeout_whatever_its_unit(
    timeout_ns: int, lasted_ns: int, scale: int
) -> None:
    """Grading looks at the ratio alone."""
    assert grade(lasted_ns * scale, timeout_ns * scale) is grade(lasted_ns, timeout_ns)
