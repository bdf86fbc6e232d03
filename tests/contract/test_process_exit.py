"""run() comes to its end, and so does the process, whatever a callback does."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import threading
import time

import pytest

from horus import CallbackInterrupted, Node

from .helpers import PATIENCE_S, run_program

pytestmark = pytest.mark.realtime

BLOCKS = {
    "sleep": "time.sleep(600)",
    "lock": "threading.Event().wait()",
    "computation": "while True: hash('x')",
    "except Exception": """
        while True:
            try:
                time.sleep(600)
            except Exception:
                pass
    """,
}


@pytest.mark.parametrize("block", BLOCKS)
@pytest.mark.parametrize("phase", ["init", "tick", "shutdown"])
def test_a_callback_that_blocks_the_main_thread_is_interrupted_when_the_run_is_to_end(block, phase):
    """run() shuts every node down in order even if a callback never gives the loop back."""
    body = textwrap.indent(textwrap.dedent(BLOCKS[block]).strip(), " " * 8)
    program = (
        "import threading, time\n"
        "from horus import Node, Scheduler\n"
        "def blocks(node):\n"
        f"{body}\n"
        "def down(node):\n"
        "    print('down', node.name, flush=True)\n"
        "sched = Scheduler(shutdown_timeout=0.3)\n"
        "callbacks = {'tick': lambda node: None, 'shutdown': down}\n"
        "def stop_soon(node):\n"
        "    threading.Timer(0.2, sched.stop).start()\n"
        "sched.add(Node('motor', rate=100, order=0, init=stop_soon, **callbacks))\n"
        f"callbacks['{phase}'] = blocks\n"
        "sched.add(Node('stuck', order=1, **callbacks))\n"
        "sched.run()\n"
        "print('returned')\n"
    )

    done = run_program(program)

    owed = [] if phase in ("init", "shutdown") else ["down stuck"]
    assert done.stdout.splitlines() == [*owed, "down motor", "returned"]
    assert "stuck" in done.stderr
    assert "interrupted" in done.stderr


def test_a_callback_is_interrupted_with_something_it_can_tell_from_an_error(make, loop):
    """CallbackInterrupted is no Exception: only who asks for it catches it."""
    seen = []
    sched = make(loop=loop, shutdown_timeout=0.2)

    def blocks(node):
        try:
            time.sleep(PATIENCE_S)
        except CallbackInterrupted as exc:
            seen.append(exc)
            raise

    sched.add(Node("stuck", blocks))
    sched.run(duration=0.1)

    assert len(seen) == 1
    assert not isinstance(seen[0], Exception)
    assert sched.get_node_stats("stuck")["errors_count"] == 1


def test_a_program_of_its_own_is_never_interrupted(make, caplog):
    """In a thread that is not the main one, or under arun(), a blocked loop is only reported."""
    release = threading.Event()
    sched = make(shutdown_timeout=0.1)
    sched.add(Node("stuck", lambda node: release.wait(PATIENCE_S)))
    runner = threading.Thread(target=lambda: sched.run(duration=0.05))
    runner.start()
    try:
        give_up_at = time.monotonic() + PATIENCE_S
        while "blocked in" not in caplog.text and time.monotonic() < give_up_at:
            time.sleep(0.01)
        time.sleep(0.5)
        assert runner.is_alive(), "nothing but the tick itself can end it"
    finally:
        release.set()
        runner.join(PATIENCE_S)
    assert "interrupted" not in caplog.text
    assert sched.get_node_stats("stuck")["errors_count"] == 0


def test_a_callback_that_is_interrupted_can_clean_up(make, loop):
    """The exception comes once: a `finally` that takes its time is not cut short by another."""
    sched = make(loop=loop, shutdown_timeout=1.0)
    journal = []

    def blocks(node):
        try:
            time.sleep(PATIENCE_S)
        finally:
            time.sleep(0.4)
            journal.append("port closed")

    sched.add(Node("stuck", blocks, shutdown=lambda node: journal.append("shutdown")))
    sched.run(duration=0.1)

    assert journal == ["port closed", "shutdown"]
    assert sched.get_node_stats("stuck")["errors_count"] == 1


STUCK_IN_C = """
    import ctypes, threading, time
    from horus import Node, Scheduler

    c = ctypes.CDLL(None)
    mutex = ctypes.create_string_buffer(64)

    def deadlock(node):
        c.pthread_mutex_lock(mutex)
        c.pthread_mutex_lock(mutex)

    def nothing(node): pass
    async def nothing_async(node): pass

    def down(node):
        print("down", node.name, flush=True)
        if node.name == "hangs":
            time.sleep(60)

    async def down_async(node):
        down(node)

    sched = Scheduler(shutdown_timeout=0.3)
    sched.add(Node("stuck", deadlock, shutdown=down, order=9))
    safe = lambda node: print("safe", flush=True)
    sched.add(Node("motor", nothing, rate=100, order=0, safe_state=safe, shutdown=down))
    sched.add(Node("planner", nothing, rate=100, compute=True, order=1, shutdown=down))
    sched.add(Node("hangs", nothing, rate=100, order=2, shutdown=down))
    sched.add(Node("uploader", nothing_async, rate=100, order=3, shutdown=down_async))
    sched.add(Node("logger", nothing, order=4, shutdown=down))
    sched.run(duration=0.1)
"""


def test_a_main_thread_that_is_lost_in_an_extension_ends_the_process():
    """What cannot be interrupted is left: hooks, then every shutdown() in order, then the end."""
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(STUCK_IN_C)],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.returncode == 1
    in_order = ["stuck", "logger", "uploader", "hangs", "planner", "motor"]
    assert done.stdout.splitlines() == ["safe", *(f"down {name}" for name in in_order)]
    assert "does not come back" in done.stderr
    assert "'hangs'" in done.stderr


SECOND_SIGNAL = """
    import time
    from horus import Node, Scheduler

    def tell(node, said=[]):
        if not said:
            said.append(1)
            print("running", flush=True)

    def safe(node):
        print("safe", node.name, flush=True)
        if node.name == "hangs":
            time.sleep(60)

    def slow_end(node):
        print("stopping", flush=True)
        time.sleep(60)

    sched = Scheduler()
    for order, name in enumerate(("first", "hangs", "last")):
        sched.add(Node(name, lambda node: None, rate=100, order=order, safe_state=safe))
    sched.add(Node("slow", tell, order=9, safe_state=safe, shutdown=slow_end))
    sched.run()
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_second_signal_forces_exit_after_the_safe_state_hooks_ran(number):
    """A second signal calls every safe-state hook, each bounded, in shutdown order, then exits."""
    with subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(SECOND_SIGNAL)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            assert process.stdout.readline() == "running\n"
            process.send_signal(number)
            assert process.stdout.readline() == "stopping\n"
            process.send_signal(number)
            stdout, stderr = process.communicate(timeout=PATIENCE_S)
        finally:
            process.kill()
    assert process.returncode == 128 + number
    assert stdout.splitlines() == ["safe slow", "safe last", "safe hangs", "safe first"]
    assert "exiting at once" in stderr


def test_work_handed_to_a_thread_that_never_returns_does_not_keep_the_process():
    """A hung asyncio.to_thread() is left behind at exit, like every other thread."""
    program = """
        import asyncio, time
        from horus import Node, Scheduler

        async def tick(node):
            await asyncio.to_thread(time.sleep, 600)

        sched = Scheduler(shutdown_timeout=0.2)
        sched.add(Node("stuck", tick, rate=10))
        sched.run(duration=0.2)
        print("returned")
    """
    assert run_program(program).stdout == "returned\n"


def test_a_terminal_that_nobody_reads_does_not_keep_the_process():
    """A stderr that blocks for ever costs the log, not the run and not the end of the process."""
    program = """
        from horus import Node, Scheduler

        def tick(node):
            node.log_warning("x" * 1000)

        sched = Scheduler()
        sched.add(Node("motor", tick, rate=200))
        sched.run(duration=0.5)
        print("returned", sched.get_node_stats("motor")["total_ticks"] > 20, flush=True)
    """
    reader, writer = os.pipe()
    try:
        process = subprocess.Popen(
            [sys.executable, "-c", textwrap.dedent(program)],
            stdout=subprocess.PIPE,
            stderr=writer,
            text=True,
        )
        try:
            stdout, _ = process.communicate(timeout=PATIENCE_S)
        finally:
            process.kill()
    finally:
        os.close(reader)
        os.close(writer)
    assert stdout == "returned True\n"
    assert process.returncode == 0


def test_a_failure_is_raised_although_the_report_cannot_be_printed():
    """verbose=True on a closed stdout: what a fatal node has raised comes first."""
    done = run_program(
        """
        import os, sys
        from horus import Node, NodeError, Scheduler

        def fail(node):
            raise OSError("no echo")

        reader, writer = os.pipe()
        os.close(reader)
        sys.stdout = os.fdopen(writer, "w", buffering=1)
        sched = Scheduler(verbose=True)
        sched.add(Node("sonar", fail, failure_policy="fatal"))
        try:
            sched.run()
        except NodeError as exc:
            print("raised", exc, file=sys.stderr)
        sys.stdout = None
        """
    )
    assert "raised" in done.stderr
    assert "no echo" in done.stderr
