"""The pytest plugin, in test runs of its own."""

from __future__ import annotations

import subprocess
import sys

import pytest

pytest_plugins = ["pytester"]

CONTRACT = '''
import time

from horus import Node


def test_counter_node(horus_scheduler, topic_probe):
    """Test that counter increments each tick."""

    def counter_tick(node):
        count = (node.recv("count") or 0) + 1
        node.send("count", count)

    counts = topic_probe("count")
    horus_scheduler.add(
        Node(name="counter", tick=counter_tick, rate=1000, order=0, pubs=["count"], subs=["count"])
    )

    horus_scheduler.tick_once()
    horus_scheduler.tick_once()
    horus_scheduler.tick_once()

    assert counts.messages == [1, 2, 3]


def test_sensor_to_motor_pipeline(horus_scheduler, run_for, topic_probe):
    """Test that sensor data flows through the controller to the motor."""

    def fake_sensor(node):
        node.send("scan", {"ranges": [0.5, 1.0, 1.5]})

    def controller(node):
        if node.has_msg("scan"):
            scan = node.recv("scan")
            node.send("cmd", {"speed": min(scan["ranges"])})

    commands = topic_probe("cmd")
    sched = horus_scheduler
    sched.add(Node(name="sensor", tick=fake_sensor, rate=100, order=0, pubs=["scan"]))
    sched.add(Node(name="ctrl", tick=controller, rate=100, order=10, subs=["scan"], pubs=["cmd"]))

    run_for(0.1)

    assert len(commands) == 10
    assert commands.latest["speed"] == 0.5


import pytest


@pytest.mark.horus(tick_rate=10, watchdog_ms=100, deterministic=False)
def test_watchdog_detects_frozen_node(horus_scheduler, fault):
    """Verify the watchdog catches a node that hangs."""
    horus_scheduler.add(Node(name="frozen", tick=lambda node: None, rate=10, order=0))
    fault.slow("frozen", 0.5)

    horus_scheduler.tick_once()

    assert horus_scheduler.safety_stats()["watchdog_expirations"] > 0
'''

SYNC = """
import threading
import time

import pytest

import horus
from horus import Node, StateError


def beat(node):
    node.send("beat", horus.tick())


def test_clock_and_virtual_time(horus_scheduler, horus_clock, run_for):
    horus_scheduler.add(Node("beat", beat, rate=10, pubs=["beat"]))
    began = time.monotonic()
    before = horus_clock.now()
    run_for(3600)
    assert horus_clock.elapsed() == pytest.approx(3600)
    assert horus_clock.now() - before == pytest.approx(3600)
    assert horus_clock.tick() == 3_600_000
    assert time.monotonic() - began < 60


def test_the_probe_waits_in_virtual_time(horus_scheduler, horus_clock, topic_probe):
    horus_scheduler.add(Node("beat", beat, rate=10, pubs=["beat"]))
    probe = topic_probe("beat")
    assert len(probe.wait(5)) == 5
    assert horus_clock.elapsed() == pytest.approx(0.4, abs=0.01)
    probe.clear()
    assert probe.latest is None
    assert list(probe) == []
    with pytest.raises(AssertionError, match=r"topic 'beat': 10 of 100 messages in 1 s"):
        probe.wait(100)


@pytest.mark.horus(deterministic=False, tick_rate=100)
def test_the_probe_waits_in_real_time(horus_scheduler, topic_probe):
    horus_scheduler.add(Node("beat", beat, rate=50, pubs=["beat"]))
    probe = topic_probe("beat")
    assert len(probe.wait(3, timeout=10)) >= 3
    with pytest.raises(AssertionError, match="topic 'beat'"):
        probe.wait(100_000, timeout=0.1)


@pytest.mark.horus(deterministic=False, tick_rate=100)
def test_the_probe_waits_for_a_run_on_another_thread(horus_scheduler, topic_probe):
    horus_scheduler.add(Node("beat", beat, rate=50, pubs=["beat"]))
    probe = topic_probe("beat")
    thread = threading.Thread(target=horus_scheduler.run)
    thread.start()
    assert len(probe.wait(3, timeout=10)) >= 3
    horus_scheduler.stop()
    thread.join()


def test_failures_on_command(horus_scheduler, run_for, fault, topic_probe):
    horus_scheduler.add(Node("beat", beat, rate=10, pubs=["beat"]))
    probe = topic_probe("beat")
    run_for(1)
    fault.fail("beat", ValueError("on command"))
    run_for(1)
    assert horus_scheduler.get_node_stats("beat")["errors_count"] == 10
    assert len(probe) == 10
    fault.clear("beat")
    run_for(1)
    assert len(probe) == 20


@pytest.mark.parametrize("kind", [{}, {"rate": 100, "budget": 0.005}, {"compute": True}])
@pytest.mark.horus(deterministic=False, tick_rate=100, watchdog_ms=50)
def test_freezes_on_command_in_real_time(horus_scheduler, topic_probe, fault, kind):
    horus_scheduler.add(Node("beat", beat, pubs=["beat"], **kind))
    probe = topic_probe("beat")
    thread = threading.Thread(target=horus_scheduler.run)
    thread.start()
    probe.wait(3, timeout=10)
    fault.freeze("beat")
    give_up = time.monotonic() + 10
    while horus_scheduler.get_node_stats("beat")["health"] != "isolated":
        assert time.monotonic() < give_up
        time.sleep(0.01)
    fault.clear()
    while horus_scheduler.clear_safe_state():
        time.sleep(0.01)
    probe.clear()
    probe.wait(3, timeout=10)
    horus_scheduler.stop()
    thread.join()


async def async_beat(node):
    node.send("beat", horus.tick())


@pytest.mark.horus(watchdog_ms=50)
def test_async_nodes_freeze_and_slow_down_in_virtual_time(horus_scheduler, run_for, fault):
    horus_scheduler.add(Node("beat", async_beat, rate=10, pubs=["beat"]))
    fault.slow("beat", 0.25)
    run_for(1)
    assert horus_scheduler.get_node_stats("beat")["skipped"] > 0
    fault.clear()
    run_for(1)
    fault.freeze("beat")
    run_for(1)
    assert horus_scheduler.get_node_stats("beat")["health"] == "isolated"


def test_what_faults_refuse(horus_scheduler, fault):
    horus_scheduler.add(Node("beat", beat, rate=10, pubs=["beat"]))
    with pytest.raises(StateError, match="takes no virtual time"):
        fault.slow("beat", 1.0)
    with pytest.raises(StateError, match="takes no virtual time"):
        fault.freeze("beat")
    with pytest.raises(horus.UnknownNodeError, match="beat"):
        fault.fail("other")


@pytest.mark.horus(deterministic=False)
def test_faults_and_worker_processes(horus_scheduler, fault, topic_probe):
    horus_scheduler.add(Node("beat", beat, rate=50, pubs=["beat"], compute="process"))
    with pytest.raises(StateError, match="compute=True"):
        fault.fail("beat")
    topic_probe("beat").wait(2, timeout=20)


def test_a_worker_process_is_inline_in_virtual_time(horus_scheduler, fault, run_for):
    horus_scheduler.add(Node("beat", beat, rate=10, pubs=["beat"], compute="process"))
    fault.fail("beat")
    run_for(1)
    assert horus_scheduler.get_node_stats("beat")["errors_count"] == 10


class TestMarkers:
    pytestmark = pytest.mark.horus(tick_rate=200, name="outer")

    @pytest.mark.horus(name="inner")
    def test_the_nearest_marker_counts(self, horus_scheduler):
        assert horus_scheduler.scheduler_name() == "inner"
        horus_scheduler.tick_for(1)
        assert horus_scheduler.current_tick() == 200
"""

ASYNC = """
import asyncio

import pytest

import horus
from horus import Node

{mark}


def beat(node):
    node.send("beat", horus.tick())


async def async_beat(node):
    await asyncio.sleep(0.001)
    node.send("beat", horus.tick())


@pytest.mark.parametrize("tick", [beat, async_beat])
@pytest.mark.horus(deterministic=False, tick_rate=100)
async def test_beside_a_test(horus_scheduler, topic_probe, tick{fixture}):
    assert type(asyncio.get_running_loop()).__module__.startswith({loop!r})
    horus_scheduler.add(Node("beat", tick, rate=50, pubs=["beat"]))
    probe = topic_probe("beat")
    async with horus_scheduler:
        await horus_scheduler.started()
        assert len(await probe.arrived(3, timeout=10)) >= 3
        with pytest.raises(horus.StateError, match="arrived"):
            probe.wait(100)
        with pytest.raises(AssertionError, match="topic 'beat'"):
            await probe.arrived(100_000, timeout=0.05)


@pytest.mark.parametrize("tick", [beat, async_beat])
async def test_virtual_time_in_an_async_test(horus_scheduler, topic_probe, run_for, tick{fixture}):
    horus_scheduler.add(Node("beat", tick, rate=10, pubs=["beat"]))
    probe = topic_probe("beat")
    run_for(10)
    assert len(probe) == 100
    assert len(probe.wait(110)) == 110


async def test_arun_in_virtual_time(horus_scheduler, topic_probe{fixture}):
    horus_scheduler.add(Node("beat", beat, rate=10, pubs=["beat"]))
    probe = topic_probe("beat")
    await horus_scheduler.arun(10)
    assert len(probe) == 100
"""

UVLOOP = """
import pytest, uvloop


@pytest.fixture(scope="session")
def event_loop_policy():
    return uvloop.EventLoopPolicy()
"""


def run(pytester: pytest.Pytester, *arguments: str, **counts: int) -> pytest.RunResult:
    """Run pytest in a process of its own, where nothing may be warned about."""
    settings = ("-W", "error", "-o", "asyncio_default_fixture_loop_scope=function")
    result = pytester.runpytest_subprocess("-p", "no:cacheprovider", *settings, *arguments)
    result.assert_outcomes(**counts)
    return result


def test_the_examples_of_the_contract(pytester: pytest.Pytester) -> None:
    """A counter, a pipeline, a frozen node."""
    pytester.makepyfile(CONTRACT)
    run(pytester, passed=3)


def test_fixtures(pytester: pytest.Pytester) -> None:
    """Clock, probe, run_for and fault, in virtual and in real time."""
    pytester.makepyfile(SYNC)
    run(pytester, passed=13)


@pytest.mark.parametrize("mode", ["strict", "auto"])
@pytest.mark.parametrize("loop", ["asyncio", "uvloop"])
def test_with_pytest_asyncio(pytester: pytest.Pytester, mode: str, loop: str) -> None:
    """In its two modes, on either loop."""
    mark = "pytestmark = pytest.mark.asyncio" if mode == "strict" else ""
    pytester.makepyfile(ASYNC.format(mark=mark, fixture="", loop=loop))
    if loop == "uvloop":
        pytester.makeconftest(UVLOOP)
    ignored = ["-W", "ignore::DeprecationWarning"] if loop == "uvloop" else []
    run(pytester, f"--asyncio-mode={mode}", *ignored, passed=5)


@pytest.mark.parametrize("loop", ["asyncio", "uvloop"])
def test_with_anyio(pytester: pytest.Pytester, loop: str) -> None:
    """Its own plugin, on its asyncio backend."""
    pytester.makepyfile(ASYNC.format(mark="pytestmark = pytest.mark.anyio", fixture="", loop=loop))
    pytester.makeconftest(
        f"""
        import pytest

        @pytest.fixture
        def anyio_backend():
            return ("asyncio", {{"use_uvloop": {loop == "uvloop"}}})
        """
    )
    run(pytester, passed=5)


def test_leaks_fail_the_test(pytester: pytest.Pytester) -> None:
    """Threads, processes and tasks; what fixtures of others keep is not held against a test."""
    pytester.makepyfile(
        """
        import asyncio, subprocess, sys, threading, time
        import pytest

        kept = []

        @pytest.fixture
        def server(horus_scheduler):
            event = threading.Event()
            thread = threading.Thread(target=event.wait)
            thread.start()
            yield
            event.set()
            thread.join()

        def test_good(horus_scheduler, server):
            pass

        def test_thread(horus_scheduler):
            threading.Thread(target=time.sleep, args=(60,), name="forgotten", daemon=True).start()

        def test_process(horus_leak_check):
            kept.append(subprocess.Popen([sys.executable, "-c", "import time; time.sleep(30)"]))

        def test_clean_up():
            kept.pop().kill()

        @pytest.mark.asyncio
        async def test_task(horus_scheduler):
            kept.append(asyncio.create_task(asyncio.sleep(60), name="left alone"))

        @pytest.mark.asyncio
        async def test_good_task(horus_scheduler):
            await asyncio.create_task(asyncio.sleep(0))

        def test_not_asked():
            threading.Thread(target=time.sleep, args=(60,), daemon=True).start()
        """
    )
    result = run(pytester, "-W", "ignore::ResourceWarning", passed=6, failed=1, errors=2)
    result.stdout.fnmatch_lines(
        [
            "*left behind thread 'forgotten'*",
            "*left behind process *",
            "*left behind <Task pending name='left alone'*",
        ]
    )


def test_leaks_of_every_test(pytester: pytest.Pytester) -> None:
    """With the setting, also of those that do not ask."""
    pytester.makeini("[pytest]\nhorus_leak_check = true\n")
    pytester.makepyfile(
        """
        import threading, time

        def test_thread():
            threading.Thread(target=time.sleep, args=(60,), name="forgotten", daemon=True).start()

        def test_good():
            pass
        """
    )
    run(pytester, passed=2, errors=1)


def test_a_node_that_fails_for_good_fails_the_test(pytester: pytest.Pytester) -> None:
    """With its traceback; the nodes are shut down."""
    pytester.makepyfile(
        """
        from horus import Node

        def bad(node):
            raise ZeroDivisionError("in the tick")

        def test_bad(horus_scheduler, run_for):
            node = Node("bad", bad, rate=10, failure_policy="fatal", shutdown=lambda: print("down"))
            horus_scheduler.add(node)
            run_for(1)
        """
    )
    result = run(pytester, failed=1)
    result.stdout.fnmatch_lines(["*ZeroDivisionError: in the tick*"])


def test_a_recording_is_replayed_to_the_nodes_under_test(pytester: pytest.Pytester) -> None:
    """`run_for(replay(path, nodes))` runs them on what was recorded."""
    pytester.makepyfile(
        """
        from horus import Node, Scheduler

        def test_replay(replay, run_for, horus_scheduler, topic_probe, tmp_path):
            recorder = Scheduler(tick_rate=100, deterministic=True, recording=tmp_path)
            recorder.add(Node("lidar", lambda node: node.send("scan", 1.5), rate=50, pubs=["scan"]))
            recorder.run(duration=1.0)
            (path,) = recorder.stop_recording()

            def control(node):
                for scan in node.recv_all("scan"):
                    node.send("cmd", 2 * scan)

            commands = topic_probe("cmd")
            horus_scheduler.add(Node("control", control, rate=100, subs=["scan"], pubs=["cmd"]))
            seconds = replay(path, ["lidar"])
            assert 0.98 <= seconds <= 1.0
            run_for(seconds)
            assert commands.messages == [3.0] * 50
        """
    )
    run(pytester, passed=1)


def test_horus_is_imported_by_the_first_fixture_that_needs_it() -> None:
    """Other people's tests do not wait for it, and coverage sees all of it."""
    code = "import sys, pytest_horus; print(*(name for name in sys.modules if name == 'horus'))"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout.strip() == ""


def test_the_fixtures_are_listed_with_their_descriptions(pytester: pytest.Pytester) -> None:
    """`pytest --fixtures` and `--markers` tell what there is."""
    listed = pytester.runpytest_subprocess("--fixtures").stdout.str()
    for name in ("horus_scheduler", "horus_clock", "run_for", "topic_probe", "fault", "replay"):
        assert f"\n{name}" in listed
    assert "horus(**options)" in pytester.runpytest_subprocess("--markers").stdout.str()
