"""Contract: "Real-Time Features", "CPU Pinning and Priority"."""

from __future__ import annotations

import ctypes
import gc
import os
import resource
import subprocess
import sys
import textwrap
import threading
import weakref

import pytest

from horus import Node, Scheduler

pytestmark = [
    pytest.mark.realtime,
    pytest.mark.usefixtures("leaves_nothing_behind"),
    pytest.mark.skipif(sys.platform != "linux", reason="SCHED_FIFO is a Linux interface"),
]


def permitted() -> bool:
    return bool(Scheduler().capabilities()["rt_scheduling"])


needs_permission = pytest.mark.skipif(not permitted(), reason="needs CAP_SYS_NICE")


def policy() -> tuple[int, int, set[int]]:
    """Return the calling thread's policy, priority and cores."""
    return (
        os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK,
        os.sched_getparam(0).sched_priority,
        os.sched_getaffinity(0),
    )


@needs_permission
def test_rt_enables_sched_fifo_for_all_rt_class_nodes():
    """rt=True enables SCHED_FIFO for Rt nodes, rate-monotonically where no priority is given."""
    seen = {}
    sched = Scheduler(rt=True)
    for name, rate, priority in (("fast", 1000, None), ("slow", 10, None), ("own", 100, 42)):
        sched.add(
            Node(
                name,
                lambda name=name: seen.setdefault(name, policy()),
                rate=rate,
                priority=priority,
            )
        )
    sched.add(Node("best", lambda: seen.setdefault("best", policy())))
    sched.run(0.3)
    assert {seen[name][0] for name in ("fast", "slow", "own")} == {os.SCHED_FIFO}
    assert seen["fast"][1] > seen["slow"][1]
    assert seen["own"][1] == 42
    assert seen["best"][0] == os.SCHED_OTHER
    assert sched.degradations() == []
    assert sched.has_full_rt()


@needs_permission
@pytest.mark.parametrize(("rt", "niceness"), [(True, -20), (False, 0)])
def test_no_other_program_takes_the_core_of_who_has_the_interpreter(rt, niceness, tmp_path):
    """The event loop, compute nodes and the thread that records run at nice -20, with rt=True."""
    found = {}

    def look(name, thread_id):
        found[name] = os.getpriority(os.PRIO_PROCESS, thread_id)

    def best():
        look("best", threading.get_native_id())
        (recorder,) = (
            thread for thread in threading.enumerate() if thread.name == "horus-recorder"
        )
        look("recorder", recorder.native_id)

    sched = Scheduler(rt=rt, recording=tmp_path)
    sched.add(Node("rt", lambda: None, rate=100))
    sched.add(Node("best", best))
    sched.add(Node("planner", lambda: look("planner", threading.get_native_id()), compute=True))
    sched.run(0.3)
    assert found == {"best": niceness, "recorder": niceness, "planner": niceness}


@needs_permission
def test_what_a_node_starts_does_not_inherit_its_priority():
    """A driver's helper thread or a subprocess gets ordinary scheduling, not the motor's."""
    seen = []

    def tick(node):
        helper = threading.Thread(target=lambda: seen.append(policy()[0]))
        helper.start()
        helper.join()
        node.request_stop()

    sched = Scheduler(rt=True)
    sched.add(Node("motor", tick, rate=100))
    sched.run(5.0)
    assert seen == [os.SCHED_OTHER]


@needs_permission
def test_priority_and_core_without_rt_are_applied_as_well_as_they_can_be():
    """Without rt=True, priority and core are hints, applied on a best-effort basis."""
    seen = []
    sched = Scheduler()
    sched.add(Node("motor", lambda: seen.append(policy()), rate=100, core=0, priority=80))
    sched.run(0.1)
    assert seen[0] == (os.SCHED_FIFO, 80, {0})
    assert sched.degradations() == []


def test_cores_pin_the_entire_scheduler_and_are_put_back():
    """cores=[0] pins the event loop and the node threads, and the caller's cores come back."""
    before = os.sched_getaffinity(0)
    seen = {}
    sched = Scheduler(cores=[0])
    sched.add(Node("loop", lambda: seen.setdefault("loop", policy()[2])))
    sched.add(Node("rt", lambda: seen.setdefault("rt", policy()[2]), rate=100))
    sched.run(0.2)
    assert seen == {"loop": {0}, "rt": {0}}
    assert os.sched_getaffinity(0) == before


def locked_kb() -> int:
    with open("/proc/self/status", encoding="ascii") as status:
        return next(int(line.split()[1]) for line in status if line.startswith("VmLck"))


def test_everything_changed_in_the_process_is_restored():
    """Scheduling, affinity, memory locks, garbage collection and switch interval come back."""
    before = (policy(), sys.getswitchinterval(), gc.isenabled(), gc.get_freeze_count())
    during = []
    sched = Scheduler(rt=True)
    sched.add(
        Node(
            "rt",
            lambda: during.append((sys.getswitchinterval(), gc.isenabled(), locked_kb())),
            rate=100,
        )
    )
    sched.run(0.1)
    assert during[-1][0] < before[1]
    assert during[-1][1] is False
    if sched.capabilities()["memory_locking"]:
        assert during[-1][2] > 0
    assert (policy(), sys.getswitchinterval(), gc.isenabled(), gc.get_freeze_count()) == before
    assert locked_kb() == 0


def test_garbage_is_still_collected():
    """With automatic collection off, what ticks leave behind in cycles does not pile up."""

    class Cycle:
        pass

    seen = []

    def tick():
        cycle = Cycle()
        cycle.itself = cycle
        seen.append(weakref.ref(cycle))

    sched = Scheduler(rt=True)
    sched.add(Node("rt", tick, rate=100))
    alive = []
    sched.add(Node("watch", lambda: alive.append(seen[0]() is not None), rate=2, order=200))
    sched.run(2.2)
    assert alive[-1] is False


def test_degradations_are_known_before_the_run():
    """has_full_rt() and degradations() answer at startup, so that a program can refuse to go on."""
    sched = Scheduler(rt=True)
    assert sched.has_full_rt() is (sched.degradations() == [])
    caps = sched.capabilities()
    assert {"rt_scheduling", "memory_locking", "cpu_isolation"} <= set(caps)
    assert sched.has_full_rt() is (caps["rt_scheduling"] and caps["memory_locking"])


def give_privileges_away() -> None:
    """Drop CAP_IPC_LOCK (14) and CAP_SYS_NICE (23) and their limits for what is executed next."""
    libc = ctypes.CDLL(None)
    for capability in (14, 23):
        assert libc.prctl(24, capability, 0, 0, 0) == 0  # PR_CAPBSET_DROP
    resource.setrlimit(resource.RLIMIT_MEMLOCK, (65536, 65536))
    resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give capabilities away")
def test_unprivileged_the_scheduler_still_runs_with_degradations():
    """Without CAP_SYS_NICE and CAP_IPC_LOCK it degrades in readable words, and nodes still tick."""
    program = """
        from horus import Node, Scheduler
        ticks = []
        sched = Scheduler(rt=True)
        before = sched.degradations()
        sched.add(Node("motor", lambda: ticks.append(1), rate=100, priority=80))
        sched.run(0.5)
        print(len(ticks) > 20, sched.has_full_rt(), sched.capabilities()["rt_scheduling"])
        print(*sched.degradations(), sep="\\n")
        assert set(before) <= set(sched.degradations())
    """
    found = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(program)],
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
        preexec_fn=give_privileges_away,
    )
    first, *degradations = found.stdout.splitlines()
    assert first == "True False False"
    assert len(degradations) == 2
    assert "SCHED_FIFO unavailable (no CAP_SYS_NICE) - using SCHED_OTHER" in degradations
    assert any(
        "mlockall" in text and "memory pages may be swapped" in text for text in degradations
    )


def test_the_kernel_s_answers_become_errors():
    """A refused call raises with the kernel's reason; nothing is passed over."""
    from horus import os_rt

    with pytest.raises(OSError, match="Invalid argument"):
        os_rt.run_on([4095])
    assert os_rt.timer_slack_ns() > 0
