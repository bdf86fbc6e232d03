"""The safe state's gate, without anybody who runs."""

from __future__ import annotations

from collections.abc import Sequence

from horus import Node
from horus.clock import SimClock, Timeline
from horus.live import LiveNode
from horus.loop.control import RunControl
from horus.loop.safety import Safety


def make_live(name: str, sequence: int, *, order: int = 0, hook: bool = True) -> LiveNode:
    """Return a node that is initialised and in service."""
    safe_state = (lambda: None) if hook else None
    node = Node(name, lambda: None, order=order, safe_state=safe_state)
    live = LiveNode(
        node, Timeline(SimClock(), 1000.0), RunControl(None, lambda live, lasted_ns: None), sequence
    )
    live.run_phase("init")
    live.enter_service()
    return live


class Hooks:
    """Takes note of the hooks that are to be called, and says that they have returned."""

    def __init__(self) -> None:
        self.called: list[str] = []

    def __call__(self, lives: Sequence[LiveNode]) -> None:
        for live in lives:
            assert live.standing.held
            self.called.append(live.name)
            live.standing.hook_returned.set()


def test_all_are_held_before_the_first_hook_is_called() -> None:
    """The gate is closed for all of them first; hooks follow in shutdown order, once."""
    hooks = Hooks()
    safety = Safety(hooks)
    lives = [
        make_live("a", 0, order=5),
        make_live("b", 1, order=1),
        make_live("c", 2, order=5),
        make_live("reporter", 3, hook=False),
    ]
    assert safety.enter("because", lambda: lives, safety.times_cleared)
    assert not safety.enter("again", lambda: lives, safety.times_cleared)

    assert hooks.called == ["c", "a", "b"]
    assert [live.standing.held for live in lives] == [True, True, True, False]
    assert safety.reason == "because"


def test_a_node_that_comes_at_that_moment_is_held() -> None:
    """Who takes part is asked for once the safe state is active: between the two, nobody slips."""
    hooks = Hooks()
    safety = Safety(hooks)
    before, late = make_live("before", 0), make_live("late", 1)
    safety.join(before)
    assert not before.standing.held

    def members() -> list[LiveNode]:
        assert safety.active
        return [before]

    safety.enter("because", members, safety.times_cleared)
    safety.join(late)

    assert before.standing.held
    assert late.standing.held
    assert hooks.called == ["before", "late"]


def test_a_tick_that_has_ended_is_not_isolated() -> None:
    """Who was found frozen and has ended meanwhile goes on."""
    hooks = Hooks()
    safety = Safety(hooks)
    live = make_live("a", 0)
    live.counters.ticks = 5

    assert not safety.isolate(live, 4)
    assert not live.standing.held
    assert hooks.called == []
    assert safety.isolate(live, 5)
    assert live.standing.held
    assert hooks.called == ["a"]


def test_what_was_seen_before_the_safe_state_was_cleared_does_not_enter_it_again() -> None:
    """Clearing may come between a look and what follows from it: that has been dealt with."""
    hooks = Hooks()
    safety = Safety(hooks)
    live = make_live("motor", 0)
    seen = safety.times_cleared
    assert safety.enter("because", lambda: [live], seen)
    assert safety.clear([live]) == []

    assert not safety.enter("because", lambda: [live], seen)
    assert safety.enter("again", lambda: [live], safety.times_cleared)
    assert hooks.called == ["motor", "motor"]


def test_a_node_that_was_held_is_owed_nothing_from_before() -> None:
    """Its releases went by on purpose."""
    safety = Safety(Hooks())
    live = make_live("motor", 0)
    safety.enter("because", lambda: [live], safety.times_cleared)
    before = live.timeline.now_ns()
    safety.clear([live])

    assert live.owed_from_ns >= before
