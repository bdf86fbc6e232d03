"""What systemd hears from run(): READY=1, WATCHDOG=1 while all is well, STOPPING=1."""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from horus import Node, StateError

from .helpers import PATIENCE_S, nothing, run_async, running, wait_until

pytestmark = pytest.mark.realtime


class Manager:
    """Stands in for the service manager: collects what arrives at its socket."""

    def __init__(self, address: str) -> None:
        self.heard: list[tuple[float, str]] = []
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(address)
        self._socket.settimeout(0.05)
        self._closing = False
        self._thread = threading.Thread(target=self._listen, name="test-manager")
        self._thread.start()

    def states(self) -> list[str]:
        return [state for _, state in self.heard]

    def count(self, state: str) -> int:
        return self.states().count(state)

    def close(self) -> None:
        self._closing = True
        self._thread.join()
        self._socket.close()

    def _listen(self) -> None:
        while not self._closing:
            try:
                state = self._socket.recv(256).decode()
            except TimeoutError:
                continue
            self.heard.append((time.monotonic(), state))


@pytest.fixture(params=("path", "abstract"))
def manager(request, tmp_path: Path, monkeypatch) -> Iterator[Manager]:
    if request.param == "path":
        bound = named = str(tmp_path / "notify")
    else:
        bound, named = f"\0horus-test-{os.getpid()}", f"@horus-test-{os.getpid()}"
    made = Manager(bound)
    monkeypatch.setenv("NOTIFY_SOCKET", named)
    monkeypatch.setenv("WATCHDOG_USEC", "100000")
    monkeypatch.setenv("WATCHDOG_PID", str(os.getpid()))
    yield made
    made.close()


def test_a_run_tells_that_it_is_ready_alive_and_stopping(make, manager):
    """READY=1 when every node is initialised, WATCHDOG=1 meanwhile, STOPPING=1 at the end."""
    ready_at_init = []
    sched = make()
    init = lambda node: ready_at_init.append(manager.count("READY=1"))  # noqa: E731
    sched.add(Node("node", nothing, rate=100, init=init))

    sched.run(duration=0.5)

    wait_until(lambda: "STOPPING=1" in manager.states())
    assert ready_at_init == [0]
    assert manager.count("READY=1") == 1
    assert manager.states().index("READY=1") < manager.states().index("STOPPING=1")
    assert manager.count("WATCHDOG=1") >= 5


def test_no_sign_of_life_while_a_critical_node_is_frozen(make, manager):
    """The supervisor feeds systemd's watchdog only while critical nodes are healthy."""
    release = threading.Event()
    sched = make()

    def tick(node):
        release.wait(PATIENCE_S)

    sched.add(Node("motor", tick, rate=100))
    sched.add_critical_node("motor", timeout_ms=100)

    def cleared() -> bool:
        try:
            return not sched.clear_safe_state()
        except StateError:
            return False

    with running(sched):
        wait_until(lambda: sched.safety_stats()["safe_state"])
        time.sleep(0.1)
        while_frozen = manager.count("WATCHDOG=1")
        time.sleep(0.5)
        still_frozen = manager.count("WATCHDOG=1")
        release.set()
        wait_until(cleared)
        time.sleep(0.5)
        healthy = manager.count("WATCHDOG=1")

    assert while_frozen == still_frozen
    assert healthy > still_frozen


def test_an_application_of_its_own_is_left_alone(make, manager):
    """arun() and tick_for() tell the service manager nothing: the process is not theirs."""
    sched = make()
    sched.add(Node("node", nothing, rate=100))
    run_async(sched.arun(0.1), "asyncio")
    sched.tick_for(0.1)
    sched.stop()
    time.sleep(0.1)
    assert manager.heard == []


@pytest.mark.parametrize(
    "environment",
    [
        {"NOTIFY_SOCKET": "/nowhere/at/all"},
        {"NOTIFY_SOCKET": "nonsense"},
        {"NOTIFY_SOCKET": ""},
    ],
    ids=lambda environment: environment["NOTIFY_SOCKET"] or "empty",
)
def test_a_manager_that_does_not_listen_is_no_trouble(make, monkeypatch, environment):
    """A socket that is not there costs the run nothing."""
    for name, value in {"WATCHDOG_USEC": "50000", **environment}.items():
        monkeypatch.setenv(name, value)
    sched = make()
    sched.add(Node("node", nothing, rate=100))
    sched.run(duration=0.2)
    assert sched.get_node_stats("node")["total_ticks"] > 0


def test_a_watchdog_that_is_meant_for_another_process_is_not_fed(
    make, manager, monkeypatch, caplog
):
    """WATCHDOG_PID names another process: READY=1 and STOPPING=1 are sent all the same."""
    monkeypatch.setenv("WATCHDOG_PID", "1")
    sched = make()
    sched.add(Node("node", nothing, rate=100))
    sched.run(duration=0.3)
    wait_until(lambda: "STOPPING=1" in manager.states())
    assert set(manager.states()) == {"READY=1", "STOPPING=1"}
    assert "failed" not in caplog.text
