"""Logging from nodes: standard logging, bound to callbacks."""

from __future__ import annotations

import asyncio
import logging
import threading

import pytest

import horus
from horus import Node

from .helpers import KINDS, TRIGGER, node_of, nothing, run_async, run_program, run_until

LEVELS = {
    "log_debug": "DEBUG",
    "log_info": "INFO",
    "log_warning": "WARNING",
    "log_error": "ERROR",
}


def records_of(caplog, node="node"):
    """Return what a node has logged."""
    return [record for record in caplog.records if record.name == f"horus.node.{node}"]


@pytest.mark.parametrize(("method", "level"), LEVELS.items())
@pytest.mark.parametrize("phase", ["init", "tick", "shutdown"])
def test_logging_methods_work_in_init_tick_and_shutdown(make, caplog, method, level, phase):
    """log_info, log_warning, log_error, log_debug work inside init, tick, and shutdown."""
    caplog.set_level(logging.DEBUG, logger="horus")
    sched = make(tick_rate=100, deterministic=True)
    callbacks = {"tick": nothing, phase: lambda node: getattr(node, method)("hello")}
    sched.add(Node("node", rate=100, **callbacks))

    sched.run(duration=0.01)

    (record,) = records_of(caplog)
    assert (record.levelname, record.getMessage()) == (level, "hello")


@pytest.mark.realtime
def test_logging_works_in_every_class(make, caplog, loop, kind):
    """Nodes of every class log alike, wherever they run."""
    caplog.set_level(logging.INFO, logger="horus")
    sched = make(tick_rate=100, loop=loop)
    sched.add(node_of(kind, "node", lambda node: node.log_info("here")))
    sched.publish(TRIGGER, 1)

    run_until(sched, lambda: records_of(caplog))

    assert records_of(caplog)[0].getMessage() == "here"


def test_records_carry_the_node_and_the_cycle_number(make, caplog):
    """Logger horus.node.<name>; cycle number and node are attributes of the record."""
    caplog.set_level(logging.INFO, logger="horus")
    sched = make(tick_rate=100, deterministic=True)
    sched.add(Node("node", lambda node: node.log_info("tick %d", horus.tick()), rate=50))

    sched.tick_for(0.06)

    records = records_of(caplog)
    assert [record.node for record in records] == ["node"] * 3
    assert [record.cycle for record in records] == [0, 2, 4]
    assert [record.getMessage() for record in records] == ["tick 0", "tick 2", "tick 4"]


def test_records_name_the_callers_line(make, caplog):
    """A record points to the line of the node's code, not into the library."""
    caplog.set_level(logging.INFO, logger="horus")
    sched = make(tick_rate=100, deterministic=True)

    def my_tick(node):
        node.log_info("here")

    sched.add(Node("node", my_tick, rate=100))
    sched.tick_once()

    (record,) = records_of(caplog)
    assert record.funcName == "my_tick"
    assert record.filename == "test_logging.py"


def test_a_message_with_a_percent_sign_is_logged_as_it_is(make, caplog):
    """A message without arguments is not a format: "100 %" survives."""
    caplog.set_level(logging.INFO, logger="horus")
    sched = make(tick_rate=100, deterministic=True)
    sched.add(Node("node", lambda node: node.log_info("battery at 100 %s"), rate=100))

    sched.tick_once()

    assert records_of(caplog)[0].getMessage() == "battery at 100 %s"


def test_calling_outside_callbacks_drops_the_message_with_one_warning(make, caplog):
    """Calling them outside these contexts drops the message, with one warning."""
    caplog.set_level(logging.DEBUG, logger="horus")
    sched = make(tick_rate=100, deterministic=True)
    node = Node("node", nothing, rate=100)
    sched.add(node)
    sched.tick_once()

    for _ in range(5):
        node.log_error("lost in space")

    assert records_of(caplog) == []
    warnings = [r for r in caplog.records if r.levelname == "WARNING"]
    assert len(warnings) == 1
    assert "node" in warnings[0].getMessage()


def test_calling_from_a_foreign_thread_of_the_application_drops_the_message(make, caplog):
    """A thread that the application started itself is outside the callbacks."""
    caplog.set_level(logging.DEBUG, logger="horus")
    sched = make(tick_rate=100, deterministic=True)
    node = Node("node", nothing, rate=100)
    sched.add(node)
    thread = threading.Thread(target=lambda: node.log_info("from afar"))
    thread.start()
    thread.join()
    assert records_of(caplog) == []


def test_a_disabled_level_costs_nothing_and_logs_nothing(make, caplog):
    """Debug messages are not logged unless debug is on."""
    caplog.set_level(logging.INFO, logger="horus")
    sched = make(tick_rate=100, deterministic=True)
    sched.add(Node("node", lambda node: node.log_debug("details"), rate=100))
    sched.tick_once()
    assert records_of(caplog) == []


def test_verbose_adds_debug_level(make, caplog):
    """verbose=True adds debug level while it runs, and takes it back afterwards."""
    level = logging.getLogger("horus").level
    sched = make(tick_rate=100, deterministic=True, verbose=True)
    sched.add(Node("node", lambda node: node.log_debug("details"), rate=100))

    sched.run(duration=0.01)

    assert [r.getMessage() for r in records_of(caplog)] == ["details"]
    assert logging.getLogger("horus").level == level


@pytest.mark.parametrize("kind", KINDS)
def test_logging_and_the_application_s_own_loggers_live_together(make, caplog, kind):
    """A tick may use its own loggers as well; nothing is swallowed or doubled."""
    caplog.set_level(logging.INFO)
    sched = make(tick_rate=100)

    def tick(node):
        logging.getLogger("application").info("mine")
        node.log_info("theirs")

    sched.add(node_of(kind, "node", tick))
    sched.publish(TRIGGER, 1)

    sched.tick_once()

    assert [r.getMessage() for r in caplog.records if r.name == "application"] == ["mine"]
    assert [r.getMessage() for r in records_of(caplog)].count("theirs") == 1


# -- what a person sees ----------------------------------------------------------------------


def test_node_logs_are_visible_without_configuration():
    """run() installs a readable stderr handler, if logging is unconfigured."""
    done = run_program(
        """
        import logging
        from horus import Node, run

        def tick(node):
            node.log_info("driving")
            node.log_debug("details")
            node.request_stop()

        run(Node("motor", tick, rate=100))
        print(logging.getLogger("horus").handlers, logging.getLogger().handlers)
        """
    )
    lines = [line for line in done.stderr.splitlines() if "driving" in line]
    assert len(lines) == 1
    assert "motor" in lines[0]
    assert "INFO" in lines[0]
    assert "details" not in done.stderr
    assert done.stdout == "[] []\n"


def test_configured_logging_is_left_alone():
    """run() installs no handler where the application has configured logging."""
    done = run_program(
        """
        import logging
        from horus import Node, run

        logging.basicConfig(format="MINE %(message)s", level="INFO")

        def tick(node):
            node.log_info("driving")
            node.request_stop()

        run(Node("motor", tick, rate=100))
        """
    )
    assert done.stderr.splitlines().count("MINE driving") == 1
    assert len([line for line in done.stderr.splitlines() if "driving" in line]) == 1


def test_arun_installs_no_handler():
    """arun() never installs a handler: that is the application's affair."""
    done = run_program(
        """
        import asyncio
        from horus import Node, Scheduler

        def tick(node):
            node.log_info("driving")
            node.request_stop()

        sched = Scheduler()
        sched.add(Node("motor", tick, rate=100))
        asyncio.run(sched.arun())
        """
    )
    assert "driving" not in done.stderr


def test_verbose_shows_debug_messages_and_the_timing_report():
    """verbose=True shows debug messages and prints the timing report at the end."""
    done = run_program(
        """
        from horus import Node, run

        run(
            Node("motor", lambda node: node.log_debug("details"), rate=100),
            verbose=True,
            deterministic=True,
            duration=0.05,
        )
        """
    )
    assert "details" in done.stderr
    assert "motor" in done.stdout
    assert "Rt" in done.stdout


def test_the_last_words_of_a_node_are_logged(make, caplog, loop):
    """Records logged in shutdown(), right before the end of a run, are not lost."""
    caplog.set_level(logging.INFO, logger="horus")
    sched = make(tick_rate=100)
    sched.add(Node("node", nothing, shutdown=lambda node: node.log_info("last words")))

    async def main():
        async with sched:
            await asyncio.sleep(0.05)

    run_async(main(), loop)

    assert [r.getMessage() for r in records_of(caplog)] == ["last words"]


@pytest.mark.parametrize(
    "options", ["", "recording=True", "blackbox_mb=1", "recording=True, blackbox_mb=1"]
)
@pytest.mark.parametrize(
    ("run", "shown"),
    [
        ("sched.run(duration=0.2)", ["told", "warned"]),
        ("asyncio.run(sched.arun(duration=0.2))", ["warned"]),
    ],
    ids=["run", "arun"],
)
def test_recording_does_not_take_the_log_away(options, run, shown, tmp_path):
    """Who has configured no logging sees of it what he sees without recording, and once."""
    program = f"""
        import asyncio
        from horus import Node, Scheduler

        def tick(node):
            node.log_info("told")
            node.log_warning("warned")
            node.request_stop()

        sched = Scheduler({options})
        sched.add(Node("node", tick))
        {run}
    """
    lines = run_program(program, HORUS_HOME=str(tmp_path)).stderr.splitlines()
    said = [word for line in lines for word in ("told", "warned") if word in line]
    assert said == shown
    for path in tmp_path.rglob("session*.mcap"):
        with horus.RecordingReader(path) as reader:
            recorded = [fact["message"] for fact in reader.facts("horus/log")]
        assert [text for text in recorded if text in ("told", "warned")] == shown
