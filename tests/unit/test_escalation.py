"""The policy tables, row by row, without running anything."""

from __future__ import annotations

import dataclasses

import pytest
from hypothesis import given
from hypothesis import strategies as st

from horus import FailurePolicy, Miss
from horus.escalation import Action, Outcome, decide

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
