"""The workloads of the service benchmark, run by path in a child interpreter.

``python -P service_workloads.py NAME --contender horus|pool --out FILE [--quick]`` runs one
workload and writes its raw samples as JSON. Nothing in here decides what a sample means: the
statistics are in ``service.py``.
"""

from __future__ import annotations

import argparse
import asyncio
import hashlib
import importlib
import itertools
import json
import multiprocessing
import os
import platform
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

Series = dict[str, list[float]]
"""Raw samples of one child run, by series name; the unit is the suffix of the name."""

# Counts from the boot of the machine, and so alike in all of its processes.
now_ns = time.monotonic_ns


@dataclass(frozen=True, slots=True, kw_only=True)
class Size:
    """How much of each workload to run; what is run does not depend on it."""

    round_trips: int
    crashes: int
    pairs: int
    """How often a window without a scheduler and one with it are measured."""
    window_s: float
    settle_s: float
    """What passes before a window opens [s]."""
    plans: int
    """Ticks of each planner."""


FULL = Size(round_trips=500, crashes=5, pairs=6, window_s=1.0, settle_s=0.3, plans=30)
QUICK = Size(round_trips=30, crashes=2, pairs=2, window_s=0.25, settle_s=0.1, plans=5)

RATE_HZ = 100.0
WARMUP_TRIPS = 20
"""Round trips that are not counted: the first ones fill caches and make segments."""
START_S = 20.0
"""How long a worker may take to start, beyond what is measured [s]."""
QUESTION, ANSWER, LIFE_SIGN = "question", "answer", "life.sign"

IMAGE_SHAPE = (480, 640, 3)
NUMBERS = 256
"""How many messages can be told apart: more than are ever on their way."""


def make_dict3(number: int) -> dict[str, float]:
    """Return a message of three floats."""
    return {"x": 1.25, "y": -0.5, "theta": float(number)}


def number_of_dict3(message: Mapping[str, float]) -> int:
    """Return the number that it was made with."""
    return int(message["theta"])


def make_image(number: int) -> Any:
    """Return a colour image of 921 kB: (480, 640, 3) uint8."""
    import numpy as np

    return np.full(IMAGE_SHAPE, number, np.uint8)


def number_of_image(message: Any) -> int:
    """Return the number that it was made with."""
    return int(message[0, 0, 0])


class Kind(NamedTuple):
    """A kind of message: how to make one from a number, and which number one was made from."""

    make: Callable[[int], Any]
    number_of: Callable[[Any], int]


KINDS: Mapping[str, Kind] = {
    "dict3": Kind(make_dict3, number_of_dict3),
    "image": Kind(make_image, number_of_image),
}


def ask_node(horus: Any, kind: Kind, trips: int) -> list[float]:
    """Send messages through a node in a process; return the time each was away [µs].

    From just before ``send`` in the tick of a node to the answer in the hands of an event node.
    """
    sent_ns: dict[int, int] = {}
    away_us: list[float] = []
    numbers = itertools.cycle(range(NUMBERS))

    def ask(node: Any) -> None:
        number = next(numbers)
        message = kind.make(number)
        sent_ns[number] = now_ns()
        node.send(QUESTION, message)

    def give_back(node: Any) -> None:
        for message in node.recv_all(QUESTION):
            node.send(ANSWER, message)

    def note(node: Any) -> None:
        while (message := node.recv(ANSWER)) is not None:
            arrived_ns = now_ns()
            away_us.append((arrived_ns - sent_ns[kind.number_of(message)]) / 1e3)
        if len(away_us) >= WARMUP_TRIPS + trips:
            scheduler.stop()

    scheduler = horus.Scheduler(tick_rate=1000.0)
    scheduler.add(horus.Node(name="source", tick=ask, rate=RATE_HZ, order=0, pubs=[QUESTION]))
    scheduler.add(
        horus.Node(
            name="echo",
            tick=give_back,
            rate=RATE_HZ,
            order=10,
            compute="process",
            subs=[QUESTION],
            pubs=[ANSWER],
        )
    )
    scheduler.add(horus.Node(name="sink", tick=note, on=ANSWER, order=20, subs=[ANSWER]))
    limit_s = START_S + 2.0 * (WARMUP_TRIPS + trips) / RATE_HZ
    scheduler.run(duration=limit_s)
    if len(away_us) < WARMUP_TRIPS + trips:
        raise RuntimeError(f"only {len(away_us)} messages came back within {limit_s:g} s")
    return away_us[WARMUP_TRIPS:]


def roundtrip(horus: Any, size: Size) -> Series:
    """Measure round trips of each kind of message through a node in a process."""
    return {f"{name}_us": ask_node(horus, kind, size.round_trips) for name, kind in KINDS.items()}


def echo(message: Any) -> Any:
    """Give a message back."""
    return message


async def ask_pool(pool: ProcessPoolExecutor, kind: Kind, trips: int) -> list[float]:
    """Send messages through a process pool; return the time each was away [µs]."""
    loop = asyncio.get_running_loop()
    away_us: list[float] = []
    period_ns = round(1e9 / RATE_HZ)
    # Before the first release, the pool has started its process.
    await loop.run_in_executor(pool, echo, kind.make(0))
    epoch_ns = now_ns()
    for trip in range(WARMUP_TRIPS + trips):
        await asyncio.sleep(max(0, epoch_ns + trip * period_ns - now_ns()) / 1e9)
        number = trip % NUMBERS
        message = kind.make(number)
        sent_ns = now_ns()
        answer = await loop.run_in_executor(pool, echo, message)
        arrived_ns = now_ns()
        if kind.number_of(answer) != number:
            raise RuntimeError(f"asked {number}, the answer is {kind.number_of(answer)}")
        away_us.append((arrived_ns - sent_ns) / 1e3)
    return away_us[WARMUP_TRIPS:]


def roundtrip_pool(_package: Any, size: Size) -> Series:
    """Measure round trips through a process pool, from the event loop that a scheduler runs on."""
    import uvloop

    context = multiprocessing.get_context("spawn")
    with (
        ProcessPoolExecutor(1, mp_context=context) as pool,
        asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner,
    ):
        return {
            f"{name}_us": runner.run(ask_pool(pool, kind, size.round_trips))
            for name, kind in KINDS.items()
        }


CRASH_TICK = 10


def recover_ms(horus: Any) -> float:
    """Crash a node's worker; return the time to the next sign of life, back-off included [ms].

    Every tick sends the time, the one that crashes just before it does. The node that comes back
    is another process; its first message counts, when it arrives.
    """
    last_ns: dict[int, int] = {}
    recoveries_ms: list[float] = []
    ticks = itertools.count()

    def work(node: Any) -> None:
        # Counted in the worker: one that crashes forgets.
        crash = next(ticks) == CRASH_TICK
        node.send(LIFE_SIGN, (os.getpid(), now_ns()))
        if crash:
            os._exit(1)

    def watch(node: Any) -> None:
        for pid, sent_ns in node.recv_all(LIFE_SIGN):
            if last_ns and pid not in last_ns and not recoveries_ms:
                (crashed_ns,) = last_ns.values()
                recoveries_ms.append((now_ns() - crashed_ns) / 1e6)
                scheduler.stop()
            last_ns[pid] = sent_ns

    scheduler = horus.Scheduler(tick_rate=1000.0)
    scheduler.add(
        horus.Node(
            name="worker",
            tick=work,
            rate=RATE_HZ,
            order=0,
            compute="process",
            failure_policy="restart",
            pubs=[LIFE_SIGN],
        )
    )
    scheduler.add(horus.Node(name="watch", tick=watch, on=LIFE_SIGN, order=10, subs=[LIFE_SIGN]))
    scheduler.run(duration=START_S)
    if not recoveries_ms:
        raise RuntimeError(f"no sign of life after the crash; {len(last_ns)} workers were heard")
    return recoveries_ms[0]


def crash(horus: Any, size: Size) -> Series:
    """Measure recoveries, each from the first crash of a scheduler of its own."""
    return {"recovery_ms": [recover_ms(horus) for _ in range(size.crashes)]}


PLANNING_S = 0.040
"""CPU time of one tick of a planner [s]."""
PLANNER_RATE_HZ = 10.0
PLAN = "plan"
CHUNK = bytes(1 << 20)


def compute_in_python() -> None:
    """Count cells; the interpreter is needed all the time."""
    cells = 0
    for cell in range(100):
        cells += cell & 1


def compute_in_library() -> None:
    """Hash a megabyte in compiled code, which lets go of the interpreter meanwhile."""
    hashlib.sha256(CHUNK)


PLANNERS: Mapping[str, tuple[bool | str, Callable[[], None]]] = {
    "thread_python": (True, compute_in_python),
    "thread_library": (True, compute_in_library),
    "process_python": ("process", compute_in_python),
}
"""Where a planner computes, and what."""


def plan_beside(
    horus: Any, compute: bool | str, work: Callable[[], None], size: Size
) -> tuple[list[float], list[float]]:
    """Run a planner beside a fast node of the event loop.

    Returns how late the ticks of the fast one started after their release [µs], and how long
    those of the planner took [ms].
    """
    release_of = importlib.import_module("horus.clock").current
    late_us: list[float] = []
    took_ms: list[float] = []

    def follow(_node: Any) -> None:
        started_ns = now_ns()
        if took_ms:
            late_us.append((started_ns - release_of.get().release_ns) / 1e3)

    def plan(node: Any) -> None:
        started_ns = now_ns()
        # CPU time: a planner that is interrupted has as much left to do as before.
        until_s = time.thread_time() + PLANNING_S
        while time.thread_time() < until_s:
            work()
        node.send(PLAN, (now_ns() - started_ns) / 1e6)

    def note(node: Any) -> None:
        took_ms.extend(node.recv_all(PLAN))
        # The first one opens the window.
        if len(took_ms) > size.plans:
            scheduler.stop()

    scheduler = horus.Scheduler(tick_rate=1000.0)
    scheduler.add(
        horus.Node(
            name="planner",
            tick=plan,
            rate=PLANNER_RATE_HZ,
            order=0,
            compute=compute,
            pubs=[PLAN],
        )
    )
    scheduler.add(horus.Node(name="tracker", tick=follow, rate=RATE_HZ, order=10))
    scheduler.add(horus.Node(name="note", tick=note, on=PLAN, order=20, subs=[PLAN]))
    limit_s = START_S + 2.0 * size.plans / PLANNER_RATE_HZ
    scheduler.run(duration=limit_s)
    if len(took_ms) <= size.plans:
        raise RuntimeError(f"only {len(took_ms)} plans came within {limit_s:g} s")
    return late_us, took_ms[1:]


def planner(horus: Any, size: Size) -> Series:
    """Measure planners in a thread and in a process, and a fast node beside them."""
    series: Series = {}
    for name, (compute, work) in PLANNERS.items():
        late_us, took_ms = plan_beside(horus, compute, work, size)
        series[f"{name}_late_us"], series[f"{name}_tick_ms"] = late_us, took_ms
    return series


HOST = "127.0.0.1"
LOAD = Path(__file__).resolve().with_name("service_load.py")
BODY = {"robot": "agv", "state": "driving", "x_m": 1.25, "y_m": -0.5}
EMBEDDED_NODES, EMBEDDED_RATE_HZ = 10, 10.0


class Service:
    """An HTTP service that counts what it has answered, and who keeps asking it."""

    def __init__(self) -> None:
        """Prepare; nothing is served yet."""
        from aiohttp import web

        self.answered = 0
        """Requests answered so far."""
        self._asked = asyncio.Event()
        self._load: asyncio.subprocess.Process | None = None
        self._json_response = web.json_response
        app = web.Application()
        app.router.add_get("/", self._answer)
        self._runner = web.AppRunner(app, access_log=None)
        self._make_site = web.TCPSite

    async def _answer(self, _request: Any) -> Any:
        self.answered += 1
        self._asked.set()
        return self._json_response(BODY)

    async def start(self) -> None:
        """Serve, and start a process that keeps asking."""
        await self._runner.setup()
        await self._make_site(self._runner, HOST, 0).start()
        port = str(self._runner.addresses[0][1])
        self._load = await asyncio.create_subprocess_exec(sys.executable, "-P", str(LOAD), port)
        async with asyncio.timeout(START_S):
            await self._asked.wait()

    async def stop(self) -> None:
        """End the process that asks, and serve no more."""
        if self._load is not None:
            self._load.kill()
            await self._load.wait()
        await self._runner.cleanup()

    async def rate_hz(self, size: Size) -> float:
        """Return how many requests are answered per second in one window."""
        await asyncio.sleep(size.settle_s)
        before, opened_ns = self.answered, now_ns()
        await asyncio.sleep(size.window_s)
        rate = 1e9 * (self.answered - before) / (now_ns() - opened_ns)
        if not rate:
            raise RuntimeError("nothing was asked in a whole window")
        return rate


async def serve_in_pairs(horus: Any, size: Size) -> Series:
    """Measure windows without and with a scheduler, and what the asking took."""
    ticks = 0

    def tick(_node: Any) -> None:
        nonlocal ticks
        ticks += 1

    scheduler = horus.Scheduler(tick_rate=1000.0)
    for index in range(EMBEDDED_NODES):
        scheduler.add(horus.Node(name=f"n{index}", tick=tick, rate=EMBEDDED_RATE_HZ, order=index))
    series: Series = {"without_hz": [], "with_hz": []}
    service = Service()
    begun_ns, before = now_ns(), os.times()
    try:
        await service.start()
        for pair in range(size.pairs):
            # Who is first alternates: a machine that slows down does so for both.
            for inside in (False, True) if pair % 2 == 0 else (True, False):
                if inside:
                    async with scheduler:
                        series["with_hz"].append(await service.rate_hz(size))
                else:
                    series["without_hz"].append(await service.rate_hz(size))
    finally:
        await service.stop()
    due = EMBEDDED_NODES * EMBEDDED_RATE_HZ * size.pairs * size.window_s
    if ticks < 0.5 * due:
        raise RuntimeError(f"the scheduler inside ran {ticks} of at least {due:g} ticks")
    after = os.times()
    asking_s = after.children_user + after.children_system
    asking_s -= before.children_user + before.children_system
    series["asking_percent"] = [100.0 * asking_s / ((now_ns() - begun_ns) / 1e9)]
    return series


def embed(horus: Any, size: Size) -> Series:
    """Measure the requests that a service answers, without and with an idle scheduler inside."""
    return asyncio.run(serve_in_pairs(horus, size))


class Contender(NamedTuple):
    """A package that is measured, and the workloads it takes part in."""

    package: str
    workloads: Mapping[str, Callable[[Any, Size], Series]]


CONTENDERS: Mapping[str, Contender] = {
    "horus": Contender(
        "horus", {"roundtrip": roundtrip, "crash": crash, "planner": planner, "embed": embed}
    ),
    "pool": Contender("concurrent.futures", {"roundtrip": roundtrip_pool}),
}


def provenance(package: Any) -> dict[str, str]:
    """Return what exactly was measured: the imported file, the version, the interpreter."""
    return {
        "file": str(package.__file__),
        # What has no version of its own comes with the interpreter.
        "version": getattr(package, "__version__", platform.python_version()),
        "python": platform.python_version(),
        "executable": sys.executable,
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Run one workload and write its samples to the file asked for."""
    parser = argparse.ArgumentParser(description="Run one workload of the service benchmark.")
    parser.add_argument("name", choices=CONTENDERS["horus"].workloads)
    parser.add_argument("--contender", choices=CONTENDERS, default="horus")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    parser.add_argument("--quick", action="store_true", help="fewer samples, same workload")
    options = parser.parse_args(argv)

    contender = CONTENDERS[options.contender]
    package = importlib.import_module(contender.package)
    size = QUICK if options.quick else FULL
    series = contender.workloads[options.name](package, size)
    result = {"package": provenance(package), "size": asdict(size), "series": series}
    options.out.write_text(json.dumps(result), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
