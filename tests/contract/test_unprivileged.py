"""Real-time scheduling that is refused: in processes that have really given their rights away."""

from __future__ import annotations

import ctypes
import os
import resource
import subprocess
import sys
import textwrap
from collections.abc import Callable

import pytest

from horus import Scheduler

from .helpers import PATIENCE_S

pytestmark = [
    pytest.mark.realtime,
    pytest.mark.skipif(
        sys.platform != "linux" or os.geteuid() != 0, reason="only root can give rights away"
    ),
]

CAP_IPC_LOCK, CAP_SYS_NICE, CAP_SYS_RESOURCE = 14, 23, 24
PR_CAPBSET_DROP = 24

NO_FIFO = "SCHED_FIFO unavailable (no CAP_SYS_NICE) - using SCHED_OTHER"
NO_MLOCK = "mlockall not permitted (RLIMIT_MEMLOCK, no CAP_IPC_LOCK) - memory pages may be swapped"


def give_away(*capabilities: int) -> Callable[[], None]:
    """Return what drops capabilities, and the limits that stand in for them, before an exec."""

    def drop() -> None:
        libc = ctypes.CDLL(None)
        for capability in (*capabilities, CAP_SYS_RESOURCE):
            assert libc.prctl(PR_CAPBSET_DROP, capability, 0, 0, 0) == 0
        if CAP_IPC_LOCK in capabilities:
            resource.setrlimit(resource.RLIMIT_MEMLOCK, (0, 0))
        if CAP_SYS_NICE in capabilities:
            resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
            resource.setrlimit(resource.RLIMIT_NICE, (0, 0))

    return drop


def run_without(program: str, *capabilities: int) -> subprocess.CompletedProcess[str]:
    """Run a robot program that has given these capabilities away, to a good end."""
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", textwrap.dedent(program)],
        capture_output=True,
        text=True,
        timeout=3 * PATIENCE_S,
        check=False,
        preexec_fn=give_away(*capabilities),
    )
    assert done.returncode == 0, done.stderr
    return done


MIXED = """
    import asyncio, gc, os, sys, threading, time
    from horus import Node, Scheduler

    def status(field):
        for line in open("/proc/self/status"):
            if line.startswith(field):
                return line.split()[1]

    async def breathe(node):
        await asyncio.sleep(0.001)

    def mixed(**options):
        sched = Scheduler(**options)
        sched.add(Node("rt", lambda node: node.send("t", 1), rate=100, pubs="t", priority=80))
        sched.add(Node("pinned", lambda: None, rate=100, core=0))
        sched.add(Node("best_effort", lambda: None))
        sched.add(Node("event", lambda: None, on="t"))
        sched.add(Node("urgent", lambda: None, on="t", budget=0.1))
        sched.add(Node("async", breathe, rate=100))
        sched.add(Node("compute", lambda: None, rate=100, compute=True))
        return sched
"""


@pytest.mark.parametrize(
    ("missing", "expected"),
    [
        ((CAP_SYS_NICE, CAP_IPC_LOCK), [NO_FIFO, NO_MLOCK]),
        ((CAP_SYS_NICE,), [NO_FIFO]),
        ((CAP_IPC_LOCK,), [NO_MLOCK]),
        ((), []),
    ],
    ids=["neither", "no priorities", "no locked memory", "everything"],
)
def test_what_is_refused_is_said_and_nothing_else(missing, expected):
    """The scheduler degrades gracefully and says what it could not enable, before and after a run.

    has_full_rt() is True exactly when nothing that was requested was refused.
    """
    mine = Scheduler().capabilities()
    if len(missing) < 2 and not (mine["rt_scheduling"] and mine["memory_locking"]):
        pytest.skip("only who has a right can keep it")
    done = run_without(
        MIXED
        + """
    sched = mixed(rt=True, watchdog_ms=2000)
    before = sched.degradations(), sched.has_full_rt()
    sched.run(0.5)
    print(*before[0], sep="\\n")
    print("--")
    print(*sched.degradations(), sep="\\n")
    print("--", before[1], sched.has_full_rt())
    print(sched.capabilities()["rt_scheduling"], sched.capabilities()["memory_locking"])
    """,
        *missing,
    )
    before, after, verdict = done.stdout.split("--")
    assert before.strip().splitlines() == expected
    assert after.strip().splitlines() == expected
    full, granted = verdict.strip().splitlines()
    assert full == f"{not expected} {not expected}"
    assert granted == f"{CAP_SYS_NICE not in missing} {CAP_IPC_LOCK not in missing}"
    # Each of them is logged once, for whoever does not ask.
    for sentence in (NO_FIFO, NO_MLOCK):
        assert done.stderr.count(sentence) == (sentence in expected)


def test_nodes_of_every_class_tick_and_everything_is_given_back():
    """The scheduler still runs. Nodes still tick. And the process is as it was afterwards."""
    done = run_without(
        MIXED
        + """
    def facts():
        return (
            os.sched_getscheduler(0), os.getpriority(os.PRIO_PROCESS, 0), os.sched_getaffinity(0),
            gc.isenabled(), gc.get_freeze_count(), sys.getswitchinterval(), status("VmLck"),
        )

    before = facts()
    during = []
    sched = mixed(rt=True, watchdog_ms=2000)
    sched.add(Node("witness", lambda: during.append((os.sched_getscheduler(0), facts())), rate=10))
    sched.run(1.0)
    assert facts() == before, (before, facts())
    assert {policy for policy, _ in during} == {os.SCHED_OTHER}
    # What needs no permission is applied all the same.
    assert during[0][1][3] is False and during[0][1][5] < before[5]
    for info in sched.get_all_nodes():
        wanted = {"best_effort": 30, "witness": 10}.get(info["name"], 100)
        enough = info["total_ticks"] >= 0.5 * wanted
        print(info["name"], enough, info["health"], info["errors_count"])
    print(sched.safety_stats()["watchdog_expirations"])
    """,
        CAP_SYS_NICE,
        CAP_IPC_LOCK,
    )
    *nodes, expirations = done.stdout.splitlines()
    assert len(nodes) == 8
    assert {line.partition(" ")[2] for line in nodes} == {"True healthy 0"}
    assert expirations == "0"


def test_the_watchdog_works_without_priorities():
    """Supervision needs no permission: a frozen node is isolated, the safe state is entered."""
    done = run_without(
        MIXED
        + """
    sched = mixed(rt=True)
    hooks = []
    sched.add(
        Node("frozen", lambda: time.sleep(0.7), rate=0.1, watchdog=0.1,
             safe_state=lambda: hooks.append(1))
    )
    sched.add_critical_node("frozen", timeout_ms=150)
    sched.run(1.0)
    stats = sched.safety_stats()
    print(stats["health_states"]["frozen"], stats["watchdog_expirations"], hooks)
    print(stats["safe_state"], set(stats["health_states"].values()) == {"healthy", "isolated"})
    """,
        CAP_SYS_NICE,
        CAP_IPC_LOCK,
    )
    assert done.stdout.splitlines() == ["isolated 1 [1]", "True True"]
    assert done.stderr.count("safe state entered") == 1


def test_without_rt_only_explicit_wishes_are_refused():
    """Without rt=True, priority and core are hints: the one that is refused names its node."""
    done = run_without(
        MIXED
        + """
    sched = mixed()
    assert sched.has_full_rt() and sched.degradations() == []
    sched.run(0.3)
    print(*sched.degradations(), sep="\\n")
    print(sched.has_full_rt())
    """,
        CAP_SYS_NICE,
        CAP_IPC_LOCK,
    )
    assert done.stdout.splitlines() == [
        "node 'rt': priority 80 refused (no CAP_SYS_NICE)",
        "False",
    ]


def test_a_program_that_insists_can_refuse_to_go_on():
    """For production: check has_full_rt() at startup and refuse to continue if it is False."""
    done = run_without(
        """
        from horus import Node, Scheduler
        initialized = []
        sched = Scheduler(tick_rate=1000, rt=True)
        sched.add(Node("motor", lambda: None, rate=1000, init=lambda: initialized.append(1)))
        if not sched.has_full_rt():
            print("refused", initialized)
        else:
            sched.run(0.1)
        """,
        CAP_SYS_NICE,
        CAP_IPC_LOCK,
    )
    assert done.stdout == "refused []\n"
