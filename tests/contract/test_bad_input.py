"""Bad input: refused where it is written, with argument, value and remedy in the message."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from horus import ConfigError, HorusError, Node, Scheduler, Sub, TopicError, UnknownNodeError
from horus.timing import ReleaseGrid

from .helpers import KINDS, named, node_of, nothing, run_until

NOT_A_NUMBER_OF_HZ = [0, 0.0, -1, -0.5, math.nan, math.inf, -math.inf, "100", True, [100], 1j]
"""Values that are no rate, budget or deadline, whatever else they are."""

NO_SUCH_CORE = os.cpu_count() or 1


def assert_refused(refused: pytest.ExceptionInfo, argument: str, value: object, remedy: str):
    """Check that a message names the argument, the value and the remedy."""
    message = str(refused.value)
    assert argument in message
    assert repr(value)[:40] in message
    assert remedy in message


# -- Node ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("rate", NOT_A_NUMBER_OF_HZ, ids=named)
def test_a_rate_must_be_a_finite_number_of_hz_above_zero(rate):
    """Rates that are NaN, inf, negative, zero or no number are refused."""
    with pytest.raises(ConfigError) as refused:
        Node("node", nothing, rate=rate)
    assert_refused(refused, "rate", rate, "Hz")


@pytest.mark.parametrize("argument", ["budget", "deadline", "watchdog"])
@pytest.mark.parametrize("value", NOT_A_NUMBER_OF_HZ, ids=named)
def test_limits_must_be_finite_numbers_of_seconds_above_zero(argument, value):
    """Budgets, deadlines and watchdogs that are no duration are refused."""
    with pytest.raises(ConfigError) as refused:
        Node("node", nothing, **{argument: value})
    assert_refused(refused, argument, value, "seconds")


@pytest.mark.parametrize("order", [-1, 1.5, "first", math.nan, True, None])
def test_an_order_must_be_a_whole_number(order):
    """Orders that are negative or not whole are refused."""
    with pytest.raises(ConfigError) as refused:
        Node("node", nothing, order=order)
    assert_refused(refused, "order", order, "whole number")


@pytest.mark.parametrize("argument", ["on_miss", "failure_policy"])
@pytest.mark.parametrize("value", ["explode", "WARN", "", 3, ["skip"], True])
def test_unknown_policies_are_refused_with_the_known_ones(argument, value):
    """Unknown policies are refused; the message lists the ones there are."""
    with pytest.raises(ConfigError) as refused:
        Node("node", nothing, **{argument: value})
    assert_refused(refused, argument, value, "'skip'")


@pytest.mark.parametrize("priority", [0, 100, -1, 50.0, "high", True])
def test_priorities_outside_1_to_99_are_refused(priority):
    """Priorities outside 1-99 are refused."""
    with pytest.raises(ConfigError) as refused:
        Node("node", nothing, priority=priority)
    assert_refused(refused, "priority", priority, "1 to 99")


@pytest.mark.parametrize("core", [NO_SUCH_CORE, 4096, -1, 0.0, "0", True])
def test_cores_that_do_not_exist_are_refused(core):
    """Cores that this machine does not have are refused."""
    with pytest.raises(ConfigError) as refused:
        Node("node", nothing, core=core)
    assert_refused(refused, "core", core, "core")


@pytest.mark.parametrize("tick", [None, 5, "tick", [nothing], {}])
def test_a_tick_must_be_callable(tick):
    """Non-callable ticks are refused."""
    with pytest.raises(ConfigError, match="tick") as refused:
        Node("node", tick)
    assert_refused(refused, "tick", tick, "")


@pytest.mark.parametrize("argument", ["tick", "init", "shutdown", "safe_state"])
@pytest.mark.parametrize(
    "function", [lambda node, extra: None, lambda *, needed: None], ids=["two", "keyword"]
)
def test_a_callback_takes_the_node_or_nothing(argument, function):
    """A callback that could never be called with the node, or without, is refused."""
    callbacks = {"tick": nothing, argument: function}
    with pytest.raises(ConfigError, match=argument):
        Node("node", **callbacks)


@pytest.mark.parametrize("argument", ["init", "shutdown", "safe_state", "on_error"])
@pytest.mark.parametrize("value", [5, "setup"])
def test_other_callbacks_must_be_callable_too(argument, value):
    """Non-callable callbacks are refused."""
    with pytest.raises(ConfigError) as refused:
        Node("node", nothing, **{argument: value})
    assert_refused(refused, argument, value, "callable")


@pytest.mark.parametrize("compute", [1, "yes", None, "fork"])
def test_compute_must_be_true_or_false(compute):
    """compute= takes True, False or "thread"."""
    with pytest.raises(ConfigError) as refused:
        Node("node", nothing, compute=compute)
    assert_refused(refused, "compute", compute, "True")


BAD_NAMES = [
    "",
    " ",
    "a b",
    "a/b",
    "../etc/passwd",
    "..",
    ".",
    "a..b",
    "a\\b",
    "a\nb",
    "a\x00",
    "a\x1b[31m",
    "ä",
    "x" * 129,
    ".hidden",
    None,
    5,
    b"bytes",
    ["list"],
]


@pytest.mark.parametrize("name", BAD_NAMES, ids=named)
def test_node_names_become_file_and_metric_names(name):
    """Node names are validated: letters, digits, `_`, `-` and `.`, no path tricks."""
    with pytest.raises(ConfigError) as refused:
        Node(name, nothing)
    assert_refused(refused, "name", name, "letters, digits")


@pytest.mark.parametrize("topic", [name for name in BAD_NAMES if name is not None], ids=named)
@pytest.mark.parametrize("where", ["pubs", "subs", "on", "Sub", "publish", "subscribe"])
def test_topic_names_with_path_separators_or_control_characters_are_refused(topic, where):
    """Topic names with path separators or control characters are refused where written."""
    sched = Scheduler()
    use = {
        "pubs": lambda: Node("node", nothing, pubs=[topic]),
        "subs": lambda: Node("node", nothing, subs=[topic]),
        "on": lambda: Node("node", nothing, on=topic),
        "Sub": lambda: Sub(topic),
        "publish": lambda: sched.publish(topic, 1),
        "subscribe": lambda: sched.subscribe(topic),
    }[where]
    with pytest.raises((TopicError, ConfigError)) as refused:
        use()
    assert repr(topic)[:40] in str(refused.value)
    assert "letters, digits" in str(refused.value)


@pytest.mark.parametrize("name", ["motor", "front.scan", "a-b_c.9", "X", "emergency.stop"])
def test_ordinary_names_are_fine(name):
    """Letters, digits, underscore, hyphen and inner dots make a name."""
    Node(name, nothing, pubs=[name], subs=[name])


@pytest.mark.parametrize("argument", ["pubs", "subs"])
@pytest.mark.parametrize("value", [5, 1.5, object()], ids=named)
def test_ports_of_another_kind_are_refused(argument, value):
    """pubs/subs that are no topics are refused, with what they may be."""
    with pytest.raises(ConfigError) as refused:
        Node("node", nothing, **{argument: value})
    assert_refused(refused, argument, value, "topic")


def test_a_topic_named_twice_is_refused():
    """The same topic twice in one list is a mistake that is told."""
    with pytest.raises(ConfigError, match=r"subs.*'x' twice"):
        Node("node", nothing, subs=["x", "x"])


@pytest.mark.parametrize("capacity", [0, -1, 1.5, "many", math.inf, True, None])
def test_a_capacity_must_be_a_whole_number_of_messages(capacity):
    """Capacities below 1 or not whole are refused."""
    with pytest.raises(ConfigError) as refused:
        Sub("x", capacity=capacity)
    assert_refused(refused, "capacity", capacity, "whole number")


@pytest.mark.parametrize("kind", ["int", 5, [int]])
def test_a_declared_type_must_be_a_class(kind):
    """A type that is no class is refused."""
    with pytest.raises(ConfigError) as refused:
        Sub("x", kind)
    assert_refused(refused, "type", kind, "class")


def test_an_unknown_argument_of_a_node_is_refused():
    """A misspelt argument is an error, not silence."""
    with pytest.raises(TypeError, match="rates"):
        Node("node", nothing, rates=100)


# -- Scheduler -----------------------------------------------------------------------------------


@pytest.mark.parametrize("tick_rate", [*NOT_A_NUMBER_OF_HZ, None], ids=named)
def test_a_tick_rate_must_be_a_finite_number_of_hz_above_zero(tick_rate):
    """Tick rates that are NaN, inf, negative, zero or no number are refused."""
    with pytest.raises(ConfigError) as refused:
        Scheduler(tick_rate=tick_rate)
    assert_refused(refused, "tick_rate", tick_rate, "Hz")


@pytest.mark.parametrize("flag", ["rt", "deterministic", "verbose"])
@pytest.mark.parametrize("value", [1, "yes", None])
def test_flags_must_be_true_or_false(flag, value):
    """Flags that are neither True nor False are refused."""
    with pytest.raises(ConfigError) as refused:
        Scheduler(**{flag: value})
    assert_refused(refused, flag, value, "True or False")


@pytest.mark.parametrize("argument", ["blackbox_mb", "watchdog_ms", "seed"])
@pytest.mark.parametrize("value", [-1, 1.5, "16", True, None])
def test_counts_must_be_whole_numbers(argument, value):
    """Sizes and timeouts that are negative or not whole are refused."""
    with pytest.raises(ConfigError) as refused:
        Scheduler(**{argument: value})
    assert_refused(refused, argument, value, "whole number")


@pytest.mark.parametrize("value", [0, -1, 1.5, "50", True])
def test_max_deadline_misses_must_be_a_whole_number_above_zero(value):
    """A threshold below 1 or not whole is refused."""
    with pytest.raises(ConfigError) as refused:
        Scheduler(max_deadline_misses=value)
    assert_refused(refused, "max_deadline_misses", value, "whole number >= 1")


@pytest.mark.parametrize(
    "cores", [[NO_SUCH_CORE], [-1], [0.5], [], "0", 0, ["0"], [True]], ids=named
)
def test_cores_must_exist(cores):
    """cores= must be a list of cores that this machine has."""
    with pytest.raises(ConfigError, match="core"):
        Scheduler(cores=cores)


@pytest.mark.parametrize("name", [name for name in BAD_NAMES if name is not None], ids=named)
def test_scheduler_names_are_checked_as_well(name):
    """Scheduler names become file names, too."""
    with pytest.raises(ConfigError) as refused:
        Scheduler(name=name)
    assert_refused(refused, "name", name, "letters, digits")


@pytest.mark.parametrize("telemetry", [5, True, b"http://x", ""])
def test_a_telemetry_endpoint_must_be_a_url(telemetry):
    """telemetry= must be an endpoint URL, or None."""
    with pytest.raises(ConfigError) as refused:
        Scheduler(telemetry=telemetry)
    assert_refused(refused, "telemetry", telemetry, "URL")


@pytest.mark.parametrize("loop", ["trio", "", None, 5])
def test_the_loop_must_be_one_of_two(loop):
    """loop= is "uvloop" or "asyncio"."""
    with pytest.raises(ConfigError) as refused:
        Scheduler(loop=loop)
    assert_refused(refused, "loop", loop, "'uvloop' or 'asyncio'")


@pytest.mark.parametrize("value", list(NOT_A_NUMBER_OF_HZ), ids=named)
def test_a_shutdown_timeout_must_be_a_duration(value):
    """shutdown_timeout= is a finite number of seconds above zero."""
    with pytest.raises(ConfigError) as refused:
        Scheduler(shutdown_timeout=value)
    assert_refused(refused, "shutdown_timeout", value, "seconds")


def test_duplicate_names_are_refused_where_the_second_is_added(make):
    """Duplicate names are refused by add(), and the first node stays."""
    sched = make()
    sched.add(Node("motor", nothing, order=1))
    with pytest.raises(ConfigError) as refused:
        sched.add(Node("motor", nothing, order=2))
    assert_refused(refused, "name", "motor", "unique")
    assert sched.get_node_info("motor") == 1


@pytest.mark.parametrize("thing", [None, nothing, "motor", Node, [Node("a", nothing)]], ids=named)
def test_only_nodes_can_be_added(make, thing):
    """What is not a Node is refused by add()."""
    with pytest.raises(ConfigError, match="must be a Node"):
        make().add(thing)


@pytest.mark.parametrize("duration", NOT_A_NUMBER_OF_HZ, ids=named)
@pytest.mark.parametrize("method", ["run", "tick_for"])
def test_a_duration_must_be_a_finite_number_of_seconds_above_zero(make, method, duration):
    """Durations that are NaN, inf, negative, zero or no number are refused."""
    sched = make(deterministic=True)
    sched.add(Node("node", nothing))
    with pytest.raises(ConfigError) as refused:
        getattr(sched, method)(duration)
    assert_refused(refused, "duration" if method == "run" else "seconds", duration, "seconds")
    assert sched.status() == "idle"


def test_tick_for_needs_a_time(make):
    """tick_for(None) is refused: it would run for ever."""
    sched = make(deterministic=True, tick_rate=100)
    ticks = []

    def tick(node):
        ticks.append(1)
        if len(ticks) > 1000:
            node.request_stop()

    sched.add(Node("node", tick, rate=100))
    with pytest.raises(ConfigError, match="seconds=None"):
        sched.tick_for(None)
    assert ticks == []


@pytest.mark.parametrize("rate", [*NOT_A_NUMBER_OF_HZ, None], ids=named)
def test_set_node_rate_checks_its_rate(make, rate):
    """set_node_rate() refuses what Node(rate=...) refuses, and changes nothing then."""
    sched = make()
    sched.add(Node("node", nothing, rate=10))
    with pytest.raises(ConfigError) as refused:
        sched.set_node_rate("node", rate)
    assert_refused(refused, "rate", rate, "Hz")
    assert sched.get_node_stats("node")["rate"] == 10


@pytest.mark.parametrize("budget", [*NOT_A_NUMBER_OF_HZ, None], ids=named)
def test_set_tick_budget_checks_its_budget_in_microseconds(make, budget):
    """set_tick_budget() refuses what is no number of microseconds, and says microseconds."""
    sched = make()
    sched.add(Node("node", nothing, rate=10))
    with pytest.raises(ConfigError) as refused:
        sched.set_tick_budget("node", budget)
    assert_refused(refused, "budget", budget, "microseconds")


@pytest.mark.parametrize("timeout", [*NOT_A_NUMBER_OF_HZ, None], ids=named)
def test_add_critical_node_checks_its_timeout(make, timeout):
    """add_critical_node() refuses a timeout that is no number of milliseconds."""
    sched = make()
    sched.add(Node("node", nothing, rate=10))
    with pytest.raises(ConfigError) as refused:
        sched.add_critical_node("node", timeout)
    assert_refused(refused, "timeout_ms", timeout, "milliseconds")


USES_OF_A_NAME = {
    "set_node_rate": lambda sched, name: sched.set_node_rate(name, 10),
    "set_tick_budget": lambda sched, name: sched.set_tick_budget(name, 10),
    "add_critical_node": lambda sched, name: sched.add_critical_node(name, 10),
    "get_node_info": lambda sched, name: sched.get_node_info(name),
    "get_node_stats": lambda sched, name: sched.get_node_stats(name),
    "tick_once": lambda sched, name: sched.tick_once([name]),
    "tick_for": lambda sched, name: sched.tick_for(0.01, [name]),
}
"""Every call that takes the name of a node that must exist."""


@pytest.mark.parametrize("use", USES_OF_A_NAME.values(), ids=USES_OF_A_NAME)
@pytest.mark.parametrize("name", ["lidar", "", "motor "], ids=named)
def test_unknown_names_are_errors_that_list_the_known_ones(make, use, name):
    """Unknown names are errors; the message lists the nodes there are."""
    sched = make(deterministic=True)
    sched.add(Node("motor", nothing)).add(Node("sensor", nothing))
    with pytest.raises(UnknownNodeError, match=r"motor, sensor") as refused:
        use(sched, name)
    assert repr(name) in str(refused.value)
    assert isinstance(refused.value, HorusError)


@pytest.mark.parametrize(
    "use",
    [
        *USES_OF_A_NAME.values(),
        lambda sched, name: sched.has_node(name),
        lambda sched, name: sched.remove_node(name),
    ],
    ids=[*USES_OF_A_NAME, "has_node", "remove_node"],
)
@pytest.mark.parametrize("name", [None, 5, ["motor"]], ids=named)
def test_names_that_are_no_strings_are_refused(make, use, name):
    """A name of a wrong type is refused, with the argument and the value."""
    sched = make(deterministic=True)
    sched.add(Node("motor", nothing))
    with pytest.raises(HorusError, match="name") as refused:
        use(sched, name)
    assert repr(name) in str(refused.value)


def test_asking_whether_a_node_exists_is_no_error(make):
    """has_node() and remove_node() of an unknown name answer False."""
    sched = make()
    sched.add(Node("motor", nothing))
    assert sched.has_node("lidar") is False
    assert sched.remove_node("lidar") is False


@pytest.mark.parametrize("names", ["motor", 42, 1.5, nothing], ids=named)
@pytest.mark.parametrize("method", ["tick_once", "tick_for"])
def test_names_must_be_a_list_of_names(make, method, names):
    """A selection that is no list of names is refused."""
    sched = make(deterministic=True)
    sched.add(Node("motor", nothing))
    with pytest.raises(ConfigError, match="names"):
        sched.tick_once(names) if method == "tick_once" else sched.tick_for(0.01, names)


# -- messages ------------------------------------------------------------------------------------


def test_an_unsendable_message_fails_the_tick_that_sends_it(make, caplog):
    """An unsendable message raises in the sender's tick; its failure policy applies."""
    sched = make(tick_rate=100, deterministic=True)
    sched.add(Node("sender", lambda n: n.send("x", nothing), rate=100, pubs=["x"]))
    sched.add(Node("reader", lambda n: n.recv("x"), rate=100, subs=["x"]))

    sched.tick_once()

    assert sched.get_node_stats("sender")["errors_count"] == 1
    assert sched.get_node_stats("reader")["errors_count"] == 0
    assert any("topic 'x'" in r.getMessage() for r in caplog.records)


class Hostile:
    """A value that cannot even be shown."""

    def __repr__(self) -> str:
        """Fail."""
        raise RuntimeError("no repr")


@pytest.mark.parametrize(
    "use",
    [
        lambda: Node("node", nothing, rate=Hostile()),
        lambda: Node("node", Hostile()),
        lambda: Node(Hostile(), nothing),
        lambda: Node("node", nothing, on_miss=Hostile()),
        lambda: Scheduler(tick_rate=Hostile()),
        lambda: Scheduler().add(Hostile()),
        lambda: Scheduler().publish(Hostile(), 1),
        lambda: Scheduler().get_node_stats(Hostile()),
    ],
)
def test_a_value_that_cannot_be_shown_is_refused_all_the_same(use):
    """A refusal never fails itself, not even over a value whose repr raises."""
    with pytest.raises(HorusError):
        use()


# -- any number at all ---------------------------------------------------------------------------

ANY_NUMBER = (
    st.floats()
    | st.integers()
    | st.sampled_from([5e-324, 1e-300, 1e308, 10**400, -(10**400), 2**63, 1e-9, 1e9, 1e12])
)


def refusal_of(use: Callable[[], object]) -> ConfigError | None:
    """Return the ConfigError that a use of a value ends in, or None if it is accepted."""
    try:
        use()
    except ConfigError as refused:
        return refused
    return None


@pytest.mark.filterwarnings("ignore::horus.ConfigWarning")
@settings(deadline=None, max_examples=40)
@given(rate=ANY_NUMBER, kind=st.sampled_from([kind for kind in KINDS if kind != "Event"]))
def test_any_number_as_a_rate_is_accepted_or_refused(rate, kind):
    """Any number for a rate is either accepted, and then ticks, or a ConfigError."""
    ticks = []

    def use():
        node = node_of(kind, "node", lambda node: ticks.append(1), rate=rate)
        with Scheduler(tick_rate=1e6, deterministic=True) as sched:
            sched.add(node)
            sched.set_node_rate("node", rate)
            sched.tick_once(["node"])
        assert ticks == [1]
        assert node.rate > 0
        assert math.isfinite(node.rate)

    refused = refusal_of(use)
    assert refused is None or refused.argument == "rate"


@pytest.mark.filterwarnings("ignore::horus.ConfigWarning")
@settings(deadline=None, max_examples=40)
@given(value=ANY_NUMBER, argument=st.sampled_from(["budget", "deadline"]))
def test_any_number_as_a_limit_is_accepted_or_refused(value, argument):
    """Any number for a budget or deadline is either accepted or a ConfigError."""

    def use():
        node = Node("node", nothing, **{argument: value})
        assert getattr(node, argument) > 0

    refused = refusal_of(use)
    assert refused is None or repr(value)[:20] in str(refused)


@settings(deadline=None, max_examples=40)
@given(value=ANY_NUMBER)
def test_any_number_as_a_timeout_or_tick_budget_is_accepted_or_refused(value):
    """Any number for shutdown_timeout or set_tick_budget() is accepted or a ConfigError."""
    sched = Scheduler()
    sched.add(Node("node", nothing))
    for use in (
        lambda: Scheduler(shutdown_timeout=value),
        lambda: sched.set_tick_budget("node", value),
    ):
        refused = refusal_of(use)
        assert refused is None or repr(value)[:20] in str(refused)


@settings(deadline=None, max_examples=50)
@given(duration=ANY_NUMBER.filter(lambda value: not value > 100))
def test_any_number_as_a_run_time_is_accepted_or_refused(duration):
    """Any number of seconds for run() and tick_for() is either run or a ConfigError."""
    with Scheduler(tick_rate=1, deterministic=True) as sched:
        sched.add(Node("node", nothing, rate=1))
        for method in (sched.run, sched.tick_for):
            refused = refusal_of(lambda method=method: method(duration))
            assert refused is None or repr(duration)[:20] in str(refused)


@pytest.mark.parametrize("duration", [1e308, 10**400], ids=["1e308", "10**400"])
@pytest.mark.parametrize("method", ["run", "tick_for"])
def test_a_duration_beyond_all_clocks_is_refused_or_run(make, method, duration):
    """A duration of more seconds than there have been is refused, or ends by a stop."""
    sched = make(tick_rate=1, deterministic=True)
    sched.add(Node("node", lambda node: node.request_stop(), rate=1))
    refused = refusal_of(lambda: getattr(sched, method)(duration))
    assert refused is None or refused.argument in ("duration", "seconds")


@pytest.mark.realtime
@pytest.mark.parametrize("kind", ["Rt", "Compute", "AsyncIo"])
@pytest.mark.parametrize("rate", [1e-9, 1e-3, 1e6])
def test_extreme_rates_that_are_accepted_work_in_real_time(make, loop, kind, rate):
    """A node at an extreme rate ticks, and is shut down without delay."""
    ticks = []
    sched = make(loop=loop)
    refused = refusal_of(
        lambda: sched.add(node_of(kind, "node", lambda node: ticks.append(1), rate=rate))
    )
    if refused is None:
        run_until(sched, lambda: ticks)
        assert sched.get_node_stats("node")["state"] == "stopped"
    else:
        assert refused.argument == "rate"


@pytest.mark.realtime
def test_a_machine_too_slow_for_the_period_still_ticks(make, monkeypatch):
    """Finding the latest release takes longer than a period: it is not looked for for ever."""
    index_at = ReleaseGrid.index_at

    def slow(grid, instant_ns):
        time.sleep(50e-6)
        return index_at(grid, instant_ns)

    monkeypatch.setattr(ReleaseGrid, "index_at", slow)
    ticks = []
    sched = make()
    sched.add(node_of("Rt", "node", lambda node: ticks.append(1), rate=1e6))
    run_until(sched, lambda: len(ticks) > 10)
    assert sched.get_node_stats("node")["skipped"] > 0


@settings(deadline=None, max_examples=40)
@given(name=st.text(max_size=40) | st.from_regex(r"[A-Za-z0-9_.\-]{1,130}", fullmatch=True))
def test_any_text_as_a_name_is_accepted_or_refused(name):
    """Any text is either a usable name, safe as a file name, or a ConfigError."""
    refused = refusal_of(lambda: Node(name, nothing))
    if refused is None:
        assert os.path.basename(name) == name
        assert name not in ("", ".", "..")
        assert name.isascii()
        assert name.isprintable()
    else:
        assert refused.argument == "name"
