"""Node scheduling parameters: the reference table, the units, and the ways to write a node."""

from __future__ import annotations

import functools
import inspect
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import pytest

import horus
from horus import (
    ConfigError,
    ConfigWarning,
    FailurePolicy,
    Health,
    Miss,
    Node,
    NodeState,
    Pub,
    Scheduler,
    Sub,
    TopicError,
    ms,
    us,
)

from .helpers import nothing


@pytest.mark.parametrize(
    ("name", "default"),
    [
        ("order", 100),
        ("budget", None),
        ("deadline", None),
        ("on_miss", None),
        ("failure_policy", None),
        ("compute", False),
        ("on", None),
        ("priority", None),
        ("core", None),
        ("watchdog", None),
    ],
)
def test_node_parameter_reference(name, default):
    """Every parameter of the Node Parameter Reference exists with its default."""
    assert inspect.signature(Node).parameters[name].default == default


def test_rate_reads_30_and_order_reads_100_when_not_given():
    """The rate defaults to 30 Hz and the order to 100."""
    node = Node("node", nothing)
    assert node.rate == 30
    assert node.order == 100


def test_a_node_without_a_rate_ticks_at_30_hz(make):
    """rate: node tick rate in Hz, 30 when not given."""
    ticks = []
    sched = make(deterministic=True)
    sched.add(Node("node", lambda: ticks.append(horus.now())))

    sched.tick_for(10.0)

    assert len(ticks) == 300


def test_every_scheduling_parameter_is_set_on_the_node_constructor():
    """Every scheduling parameter is set on the Node constructor, by keyword."""
    node = Node(
        name="motor",
        tick=nothing,
        rate=1000,
        order=5,
        budget=300 * us,
        deadline=900 * us,
        on_miss="safe_mode",
        failure_policy="fatal",
        safe_state=nothing,
    )
    assert (node.name, node.rate, node.order) == ("motor", 1000, 5)
    assert node.budget == pytest.approx(300 * us)
    assert node.deadline == pytest.approx(900 * us)


def test_the_scheduler_reads_the_parameters_when_you_call_add(make):
    """The scheduler reads a node's parameters when you call add()."""
    sched = make()
    sched.add(Node("motor", nothing, rate=200, order=5))
    assert sched.get_node_info("motor") == 5
    assert sched.get_node_stats("motor")["rate"] == 200


def test_lower_order_means_earlier(make):
    """order: lower = earlier, from critical 0 to background 200 and beyond."""
    journal = []
    sched = make(tick_rate=100, deterministic=True)
    for order in (250, 0, 199, 9, 10, 100, 49, 50, 99, 200):
        sched.add(Node(f"n{order}", lambda n: journal.append(n.order), rate=100, order=order))

    sched.tick_once()

    assert journal == [0, 9, 10, 49, 50, 99, 100, 199, 200, 250]


def test_name_and_tick_can_be_given_by_position():
    """Node("name", tick) works positionally too."""
    node = Node("sensor", nothing)
    assert node.name == "sensor"


def test_everything_but_name_and_tick_is_keyword_only():
    """A third positional argument is refused: scheduling intent is spelt out."""
    with pytest.raises(TypeError):
        Node("sensor", nothing, 100)


# -- units ---------------------------------------------------------------------------


def test_us_and_ms_convert_to_seconds():
    """Us = 1e-6 and ms = 1e-3: plain floats that make seconds."""
    assert us == 1e-6
    assert ms == 1e-3
    assert isinstance(300 * us, float)


@pytest.mark.parametrize(
    ("argument", "value", "seconds"),
    [
        ("budget", 300 * us, 0.0003),
        ("deadline", 900 * us, 0.0009),
        ("deadline", 5 * ms, 0.005),
    ],
)
def test_budget_and_deadline_are_in_seconds(argument, value, seconds):
    """Budget and deadline are in seconds: 300 * us means 300 microseconds."""
    node = Node("node", nothing, rate=100, **{argument: value})
    assert getattr(node, argument) == pytest.approx(seconds, rel=1e-6)


@pytest.mark.parametrize("argument", ["budget", "deadline"])
@pytest.mark.parametrize("rate", [None, 1000])
def test_budget_300_means_300_seconds_and_warns(argument, rate):
    """budget=300 means 300 seconds, almost certainly not what you want: it warns of `us`."""
    with pytest.warns(ConfigWarning, match=rf"{argument}.*300(\.00)? s.*us"):
        node = Node("node", nothing, rate=rate, **{argument: 300})
    assert getattr(node, argument) == 300.0


@pytest.mark.parametrize("argument", ["budget", "deadline"])
def test_a_limit_longer_than_the_period_warns(argument):
    """A limit longer than the period of an explicit rate warns and names both."""
    with pytest.warns(ConfigWarning, match=r"20\.00 ms.*period of 10\.00 ms"):
        Node("node", nothing, rate=100, **{argument: 20 * ms})


def test_reasonable_limits_do_not_warn():
    """A long limit on a slow node is fine: no warning cries wolf."""
    Node("node", nothing, rate=0.1, budget=5.0, deadline=9.0)
    Node("node", nothing, budget=10.0)


# -- policies as strings and enums -----------------------------------------------------


@pytest.mark.parametrize("policy", list(Miss))
def test_on_miss_takes_a_string_or_an_enum_member(policy):
    """on_miss: "warn", "skip", "safe_mode", "stop", or the member of Miss."""
    Node("node", nothing, rate=10, on_miss=policy)
    Node("node", nothing, rate=10, on_miss=str(policy))


def test_the_policies_are_those_of_the_contract():
    """The values of Miss and FailurePolicy are the words of the contract."""
    assert {str(policy) for policy in Miss} == {"warn", "skip", "safe_mode", "stop"}
    assert {str(policy) for policy in FailurePolicy} == {"fatal", "restart", "skip", "ignore"}


@pytest.mark.parametrize("policy", list(FailurePolicy))
def test_failure_policy_takes_a_string_or_an_enum_member(policy):
    """failure_policy: "fatal", "restart", "skip", "ignore", or the member of FailurePolicy."""
    Node("node", nothing, failure_policy=policy)
    Node("node", nothing, failure_policy=str(policy))


def test_states_and_health_are_strings_too():
    """NodeState and Health are StrEnums: they compare equal to what the stats show."""
    sched = Scheduler()
    sched.add(Node("node", nothing))
    stats = sched.get_node_stats("node")
    assert NodeState(stats["state"]) == stats["state"]
    assert stats["health"] == Health.HEALTHY


# -- callbacks -------------------------------------------------------------------------


def no_parameters() -> None:
    """Take nothing."""
    calls.append(())


def takes_node(node: Node) -> None:
    """Take the node."""
    calls.append((type(node),))


def takes_defaults(bound: int = 5) -> None:
    """Take nothing but a bound value."""
    calls.append((bound,))


def takes_two(first: Any, node: Node) -> None:
    """Take the node second."""
    calls.append((type(first), type(node)))


class CallableObject:
    """A callable with state."""

    def __call__(self, node: Node) -> None:
        """Take the node."""
        calls.append((type(node),))

    def method(self, node: Node) -> None:
        """Take the node."""
        calls.append((type(node),))


calls: list[tuple] = []


@pytest.mark.parametrize(
    ("callback", "seen"),
    [
        (no_parameters, ()),
        (takes_node, (Node,)),
        (takes_defaults, (5,)),
        (CallableObject(), (Node,)),
        (CallableObject().method, (Node,)),
        (functools.partial(takes_node), (Node,)),
        (functools.partial(takes_two, "bound"), (str, Node)),
        (lambda: calls.append(()), ()),
        (lambda n: calls.append((type(n),)), (Node,)),
        (lambda *args: calls.append(tuple(map(type, args))), (Node,)),
    ],
)
@pytest.mark.parametrize("phase", ["tick", "init", "shutdown"])
def test_a_callback_may_take_the_node_or_nothing(make, callback, seen, phase):
    """A callback may take the node or nothing."""
    calls.clear()
    sched = make(tick_rate=100, deterministic=True)
    callbacks = {"tick": nothing, phase: callback}
    sched.add(Node("node", rate=100, **callbacks))

    sched.tick_once()
    sched.stop()

    assert calls == [seen]


class Motor(Node):
    """A node as a class."""

    def __init__(self, journal: list[str]) -> None:
        """Configure the node."""
        super().__init__("motor", rate=100, order=3, on_miss="safe_mode", subs=["cmd"])
        self.journal = journal

    def init(self) -> None:
        """Start up."""
        self.journal.append("init")

    def tick(self) -> None:
        """Work."""
        self.journal.append("tick")

    def shutdown(self) -> None:
        """Halt."""
        self.journal.append("shutdown")

    def enter_safe_state(self) -> None:
        """Brake."""
        self.journal.append("safe state")


def test_a_subclass_of_node_with_methods_works_beside_callbacks(make):
    """Subclassing Node with tick/init/shutdown/enter_safe_state methods works."""
    journal = []
    sched = make(tick_rate=100, deterministic=True)
    sched.add(Motor(journal))
    sched.add(Node("callback", lambda: journal.append("callback"), rate=100, order=4))

    sched.tick_once()
    sched.stop()

    assert journal == ["init", "tick", "callback", "shutdown"]


def test_a_subclass_with_an_async_tick_is_an_async_node(make):
    """An `async def tick` method makes the subclass an AsyncIo node."""

    class Uploader(Node):
        def __init__(self):
            super().__init__("uploader", rate=100)
            self.count = 0

        async def tick(self):
            self.count += 1

    sched = make(tick_rate=100, deterministic=True)
    uploader = Uploader()
    sched.add(uploader)

    sched.tick_for(0.05)

    assert uploader.execution_class == "AsyncIo"
    assert uploader.count == 5


def test_a_callback_given_twice_is_refused():
    """A callback given as an argument and as a method is refused: one of them would be lost."""

    class Sensor(Node):
        def tick(self):
            pass

    with pytest.raises(ConfigError, match=r"tick.*keep one"):
        Sensor("sensor", nothing)


def test_a_subclass_that_forgets_super_init_is_refused_with_the_remedy(make):
    """A Node subclass that never called super().__init__() is refused by add()."""

    class Sensor(Node):
        def __init__(self):
            pass

        def tick(self):
            pass

    with pytest.raises(ConfigError, match=r"super\(\).__init__"):
        make().add(Sensor())


# -- topics ----------------------------------------------------------------------------


@dataclass(frozen=True)
class Scan:
    """A message class."""

    ranges: tuple[float, ...]


@pytest.mark.parametrize(
    "ports",
    [
        "Scan",
        ["Scan"],
        ("Scan",),
        {"Scan"},
        Scan,
        [Scan],
        {"Scan": Scan},
        {"Scan": None},
    ],
    ids=str,
)
def test_every_way_to_declare_topics_works(make, ports):
    """pubs/subs: a string, a list of strings, message classes, or a dict."""
    received = []
    sched = make(tick_rate=100, deterministic=True)
    sched.add(Node("a", lambda n: n.send("Scan", Scan((1.0,))), rate=100, order=0, pubs=ports))
    sched.add(Node("b", lambda n: received.append(n.recv("Scan")), rate=100, order=1, subs=ports))

    sched.tick_once()

    assert received == [Scan((1.0,))]


def test_pub_and_sub_declare_type_and_capacity(make):
    """Pub/Sub(topic, type=None, capacity=1024) declare type and queue of a topic."""
    received = []
    sched = make(tick_rate=100, deterministic=True)

    def flood(node):
        for index in range(5):
            node.send("value", index)

    sched.add(Node("a", flood, rate=100, order=0, pubs=[Pub("value", int)]))
    sched.add(
        Node(
            "b",
            lambda n: received.extend(n.recv_all("value")),
            rate=100,
            order=1,
            subs=[Sub("value", int, capacity=1)],
        )
    )

    sched.tick_once()

    assert Sub("value").capacity == 1024
    assert Sub("value").type is None
    assert received == [4]


def test_a_topic_is_named_after_its_message_class(make):
    """A message class stands for the topic named after it, also in send and recv."""
    received = []
    sched = make(tick_rate=100, deterministic=True)
    sched.add(Node("a", lambda n: n.send(Scan, Scan(())), rate=100, order=0, pubs=[Scan]))
    sched.add(Node("b", lambda n: received.append(n.recv(Scan)), rate=100, order=1, subs=[Scan]))
    sched.add(Node("c", lambda n: received.append(n.recv("Scan")), rate=100, order=2, subs="Scan"))

    sched.tick_once()

    assert received == [Scan(()), Scan(())]


def test_a_declared_type_is_checked_at_send(make):
    """Declared types are checked at send: the error names topic, type and sender."""
    errors = []
    sched = make(tick_rate=100, deterministic=True)

    def tick(node):
        try:
            node.send("count", "seven")
        except TopicError as exc:
            errors.append(str(exc))

    sched.add(Node("a", tick, rate=100, pubs={"count": int}))

    sched.tick_once()

    assert len(errors) == 1
    assert all(word in errors[0] for word in ("count", "int", "str", "seven", "a"))


def test_an_undeclared_send_and_recv_work_with_one_warning_per_node_and_topic(make, caplog):
    """Undeclared send/recv works: declared on first use, one warning per node and topic."""
    received = []
    sched = make(tick_rate=100, deterministic=True)
    sched.add(Node("a", lambda n: n.send("x", horus.tick()), rate=100, order=1))
    sched.add(Node("b", lambda n: received.append(n.recv("x")), rate=100, order=0))

    sched.tick_for(0.04)

    assert received == [None, 0, 1, 2]
    warnings = [r.getMessage() for r in caplog.records if "did not declare" in r.getMessage()]
    assert len(warnings) == 2
    assert {text.split()[0] for text in warnings} == {"a", "b"}


def test_rates_may_be_any_real_number(make):
    """A rate may be whole, fractional or below 1 Hz."""
    for rate in (1, 0.1, 33.3, 1e-3, float(Fraction(100, 3))):
        ticks = []
        sched = make(tick_rate=10, deterministic=True)
        sched.add(Node("node", lambda ticks=ticks: ticks.append(horus.now()), rate=rate))
        sched.tick_for(3.0 / rate)
        assert len(ticks) == 3
