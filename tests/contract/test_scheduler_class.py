"""The Scheduler class: creating, adding, running, the context manager."""

from __future__ import annotations

import asyncio
import inspect
import threading
import time

import pytest

import horus
from horus import (
    ConfigError,
    Node,
    NodeError,
    Scheduler,
    StateError,
    ms,
    us,
)

from .helpers import (
    PATIENCE_S,
    TRIGGER,
    all_have_ticked,
    node_of,
    nothing,
    run_async,
    run_until,
    running,
    until,
    wait_until,
)

DEFAULTS = {
    "tick_rate": 1000.0,
    "rt": False,
    "deterministic": False,
    "blackbox_mb": 0,
    "watchdog_ms": 0,
    "recording": False,
    "name": None,
    "cores": None,
    "max_deadline_misses": None,
    "verbose": False,
    "telemetry": None,
}


@pytest.mark.parametrize(("name", "default"), DEFAULTS.items())
def test_scheduler_parameters_reference(name, default):
    """Every parameter of the Scheduler Parameters Reference exists with its default."""
    parameter = inspect.signature(Scheduler).parameters[name]
    assert parameter.default == default


@pytest.mark.parametrize(("name", "default"), DEFAULTS.items())
def test_every_scheduler_default_can_be_written_out(name, default):
    """Writing a default out is the same as leaving it away."""
    Scheduler(**{name: default})


def test_all_configuration_happens_through_keyword_arguments():
    """All configuration happens through keyword arguments, none by position."""
    with pytest.raises(TypeError):
        Scheduler(1000.0)


def test_the_scheduler_of_the_contract_can_be_created():
    """Creating a Scheduler as the contract shows."""
    sched = Scheduler(
        tick_rate=1000.0,
        rt=True,
        watchdog_ms=500,
        blackbox_mb=16,
        max_deadline_misses=50,
    )
    assert sched.status() == "idle"


def test_full_rt_is_true_when_nothing_was_requested():
    """has_full_rt() is true exactly when nothing requested was refused."""
    assert Scheduler().has_full_rt() is True
    assert Scheduler().degradations() == []


def test_a_scheduler_without_recording_says_so():
    """Without recording=, is_recording() is False and there are no files."""
    sched = Scheduler()
    assert sched.is_recording() is False
    assert sched.stop_recording() == []


def test_add_returns_self_so_that_calls_can_be_chained(make):
    """add() returns self, so you can chain."""
    sched = make()
    chained = sched.add(Node("sensor", nothing)).add(Node("ctrl", nothing))
    assert chained is sched
    assert chained.add(Node("motor", nothing)) is sched
    assert sched.get_node_names() == ["sensor", "ctrl", "motor"]


def test_adding_nodes_as_the_contract_shows(make):
    """Adding nodes: safety, motor and planner, with their classes."""
    sched = make(tick_rate=1000)
    sched.add(Node(name="safety", tick=nothing, rate=1000, order=0))
    sched.add(Node(name="motor", tick=nothing, rate=1000, order=5, budget=300 * us))
    sched.add(Node(name="planner", tick=nothing, rate=50, order=50, compute=True))
    classes = {info["name"]: info["execution_class"] for info in sched.get_all_nodes()}
    assert classes == {"safety": "Rt", "motor": "Rt", "planner": "Compute"}


@pytest.mark.realtime
def test_run_goes_on_until_stop(make, loop):
    """Run forever: until Ctrl+C or .stop()."""
    sched = make(loop=loop)
    sched.add(Node("node", nothing, rate=100))
    with running(sched) as thread:
        wait_until(lambda: sched.get_node_stats("node")["total_ticks"] >= 5)
        assert thread.is_alive()
    assert sched.status() == "stopped"


@pytest.mark.realtime
def test_run_for_a_fixed_duration(make, loop):
    """Run for a fixed duration, in seconds: all releases of that time and no more."""
    ticks = []
    sched = make(loop=loop)
    sched.add(Node("node", lambda: ticks.append(1), rate=50))
    begun = time.monotonic()

    sched.run(duration=0.3)

    assert 0.3 <= time.monotonic() - begun < 2.0
    # Fifteen releases, and one more if the end comes a little late.
    assert len(ticks) <= 16


def test_run_for_a_fixed_duration_in_deterministic_mode(make):
    """A deterministic run of an hour has every tick of the hour, and ends at once."""
    ticks = []
    sched = make(tick_rate=10, deterministic=True)
    sched.add(Node("node", lambda: ticks.append(horus.now()), rate=1))
    begun = time.monotonic()

    sched.run(duration=3600.0)

    assert len(ticks) == 3600
    assert ticks[-1] == 3599.0
    assert time.monotonic() - begun < 30.0


@pytest.mark.realtime
def test_the_context_manager_calls_stop_automatically_on_exit(loop):
    """The context manager calls stop() on exit; every node is shut down by then."""
    journal = []
    with Scheduler(tick_rate=100, loop=loop) as sched:
        sched.add(Node("sensor", nothing, rate=100, order=0, shutdown=lambda: journal.append("s")))
        sched.add(Node("logger", nothing, rate=10, order=100, shutdown=lambda: journal.append("l")))
        sched.run(duration=0.05)
    assert journal == ["l", "s"]
    assert sched.status() == "stopped"


def test_the_context_manager_shuts_down_what_steps_have_initialised(deterministic):
    """Clean shutdown also after tick_once(): leaving the block runs shutdown() once."""
    journal = []
    with Scheduler(tick_rate=100, deterministic=deterministic) as sched:
        for name in ("a", "b"):
            sched.add(Node(name, nothing, rate=100, shutdown=lambda n: journal.append(n.name)))
        sched.tick_once()
        assert journal == []
    assert journal == ["b", "a"]


def fail_in_block(sched: Scheduler) -> None:
    """Start a scheduler, then fail as an application does."""
    with sched:
        sched.tick_once()
        raise LookupError("application error")


def test_the_context_manager_ensures_clean_shutdown_even_if_an_exception_occurs(
    make, deterministic
):
    """stop() is called, ensuring clean shutdown, even if an exception occurs in the block."""
    journal = []
    sched = make(tick_rate=100, deterministic=deterministic)
    sched.add(Node("a", nothing, rate=100, shutdown=lambda: journal.append("down")))

    with pytest.raises(LookupError, match="application error"):
        fail_in_block(sched)

    assert journal == ["down"]
    assert sched.status() == "stopped"


@pytest.mark.realtime
def test_leaving_the_context_waits_for_a_run_on_another_thread(make, loop):
    """After the block, a run on another thread is over and all nodes are shut down."""
    journal = []
    sched = make(loop=loop)

    def shutdown(node):
        time.sleep(50 * ms)
        journal.append("down")

    sched.add(Node("node", nothing, rate=100, shutdown=shutdown))
    thread = threading.Thread(target=sched.run)
    with sched:
        thread.start()
        wait_until(lambda: all_have_ticked(sched))
    assert journal == ["down"]
    thread.join(PATIENCE_S)


@pytest.mark.realtime
def test_the_async_context_manager_runs_in_the_background(make, loop):
    """`async with Scheduler()` runs beside the application and shuts down at the end."""
    journal = []
    sched = make(tick_rate=100)
    sched.add(Node("node", lambda: journal.append("tick"), shutdown=lambda: journal.append("down")))

    async def main():
        async with sched:
            assert sched.is_running()
            await until(lambda: journal)
        return list(journal)

    result = run_async(main(), loop)

    assert result[0] == "tick"
    assert result[-1] == "down"
    assert sched.status() == "stopped"


@pytest.mark.realtime
def test_the_async_context_manager_raises_what_a_fatal_node_raised(make, loop):
    """A fatal node error inside `async with` reaches the application."""
    sched = make(tick_rate=100)

    def fail(node):
        raise OSError("gone")

    sched.add(Node("node", fail, failure_policy="fatal"))

    async def main():
        async with sched:
            await until(lambda: not sched.is_running())

    with pytest.raises(NodeError, match="gone"):
        run_async(main(), loop)


@pytest.mark.realtime
def test_the_async_context_manager_shuts_down_when_the_application_fails(make, loop):
    """An exception in the `async with` block: clean shutdown first, then it goes on."""
    down = []
    sched = make(tick_rate=100)
    sched.add(Node("node", nothing, shutdown=lambda: down.append(1)))

    async def main():
        async with sched:
            await until(lambda: all_have_ticked(sched))
            raise LookupError("application error")

    with pytest.raises(LookupError, match="application error"):
        run_async(main(), loop)

    assert down == [1]


@pytest.mark.realtime
def test_two_schedulers_share_one_event_loop(make, loop):
    """Two robots in one application: two schedulers run beside each other on one loop."""
    ticks = {"a": 0, "b": 0}
    scheds = {name: make(tick_rate=100, name=name) for name in ticks}

    async def tick(node):
        ticks[node.name] += 1

    for name, sched in scheds.items():
        sched.add(Node(name, tick, rate=100))

    async def main():
        async with scheds["a"], scheds["b"]:
            await until(lambda: min(ticks.values()) >= 3)

    run_async(main(), loop)

    assert {sched.status() for sched in scheds.values()} == {"stopped"}


def test_a_name_is_unique_in_a_scheduler(make):
    """Two nodes of one name are refused where the second is added."""
    sched = make()
    sched.add(Node("motor", nothing))
    with pytest.raises(ConfigError, match="motor"):
        sched.add(Node("motor", nothing))
    assert sched.get_node_count() == 1


@pytest.mark.realtime
def test_a_running_scheduler_refuses_a_second_run(make):
    """run, tick_once and tick_for exclude each other; the error says what to do."""
    sched = make()
    sched.add(Node("node", nothing, rate=100))
    with running(sched):
        for call in (sched.run, sched.tick_once, lambda: sched.tick_for(0.01)):
            with pytest.raises(StateError, match="already running"):
                call()
        assert sched.is_running()


@pytest.mark.realtime
def test_a_node_may_not_run_its_own_scheduler(make, loop, kind):
    """Calling run() or tick_once() inside a tick is an error, not a deadlock."""
    errors = []
    sched = make(tick_rate=100, loop=loop)

    def tick(node):
        for call in (sched.run, sched.tick_once):
            try:
                call()
            except StateError as exc:
                errors.append(exc)
        node.request_stop()

    sched.add(node_of(kind, "node", tick))
    sched.publish(TRIGGER, 1)

    sched.run()

    assert len(errors) == 2


def test_run_inside_an_event_loop_points_to_arun(make, loop):
    """run() in a running event loop would block it: the error names arun()."""
    sched = make()
    sched.add(Node("node", nothing))

    async def main():
        with pytest.raises(StateError, match="arun"):
            sched.run(duration=0.01)

    run_async(main(), loop)


def test_arun_in_deterministic_mode_leaves_the_loop_free(make, loop):
    """A simulation started with arun() does not block the application's loop."""
    sched = make(tick_rate=100, deterministic=True)
    beats = []
    ticks = []

    def tick(node):
        ticks.append(horus.now())
        if beats and horus.tick() > 100:
            node.request_stop()

    sched.add(Node("node", tick, rate=100))

    async def main():
        async def heart():
            while True:
                beats.append(1)
                await asyncio.sleep(1 * ms)

        heartbeat = asyncio.ensure_future(heart())
        await sched.arun()
        heartbeat.cancel()

    run_async(main(), loop)

    assert beats
    assert ticks[:3] == pytest.approx([0.0, 0.01, 0.02])


def test_a_node_belongs_to_one_running_scheduler_at_a_time(make):
    """A node that a running scheduler uses is refused by another one."""
    node = Node("node", nothing, rate=100)
    first, second = make(), make()
    first.add(node)
    with running(first), pytest.raises(StateError, match="remove it there first"):
        second.add(node)
    second.add(node)
    assert not first.has_node("node")
    assert second.has_node("node")


def test_verbose_prints_the_timing_report_at_the_end_of_run(make, capsys, deterministic):
    """verbose=True prints a timing report when run() ends."""
    sched = make(tick_rate=100, verbose=True, deterministic=deterministic)
    sched.add(Node("motor", nothing, rate=100))

    sched.run(duration=0.05)

    printed = capsys.readouterr().out
    assert "motor" in printed
    assert str(sched.timing_report()) in printed


@pytest.mark.parametrize("name", ["uvloop", "asyncio"])
def test_the_loop_argument_chooses_the_event_loop_of_run(make, name):
    """loop="uvloop" | "asyncio" chooses for run()."""
    modules = set()
    sched = make(loop=name)
    sched.add(Node("node", lambda: modules.add(type(asyncio.get_running_loop()).__module__)))

    run_until(sched, lambda: modules)

    assert {module.split(".")[0] for module in modules} == {name}
