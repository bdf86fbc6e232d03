"""The measured workloads, run by path in the interpreter of the package under test.

``python -P workloads.py NAME --out FILE [--quick]`` runs one workload against whatever ``horus``
that interpreter imports and writes raw samples as JSON. The file uses the standard library and the
documented ``horus`` API only, so the same code runs unchanged on every package that offers it:

* constructors are called with keyword arguments that mean the same everywhere;
* time, CPU and tick counts are taken here, never from the package's own report;
* results go to a file, because a package may write to standard output itself.

Nothing in here decides what a sample means: the statistics are in ``micro.py``.
"""

from __future__ import annotations

import argparse
import asyncio
import bisect
import json
import os
import platform
import subprocess
import sys
import threading
import time
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

Series = dict[str, list[float]]
"""Raw samples of one child run, by series name; the unit is the suffix of the name."""

now_ns = time.perf_counter_ns


@dataclass(frozen=True, slots=True, kw_only=True)
class Size:
    """How much of each workload to run; what is run does not depend on it."""

    topic_ticks: int
    tick_once_calls: int
    event_s: float
    cpu_warmup_s: float
    cpu_window_s: float
    wakeups: int
    imports: int


FULL = Size(
    topic_ticks=25,
    tick_once_calls=300,
    event_s=5.0,
    cpu_warmup_s=2.0,
    cpu_window_s=5.0,
    wakeups=400,
    imports=10,
)
QUICK = Size(
    topic_ticks=6,
    tick_once_calls=40,
    event_s=1.0,
    cpu_warmup_s=1.0,
    cpu_window_s=1.0,
    wakeups=50,
    imports=3,
)

TOPIC_BATCH = 100
"""Messages per tick of the topic workload: enough to hide the clock reads, well below capacity."""
TOPIC_GAP_S = 0.045
TOPIC_RATE_HZ = 25.0
TICK_ONCE_GAP_S = 0.0015
TICK_ONCE_RATE_HZ = 1000.0
EVENT_RATE_HZ = 200.0

MESSAGES: dict[str, object] = {
    "float": 3.14159,
    "dict3": {"x": 1.25, "y": -0.5, "theta": 0.7853981},
    "scan360": {"ranges": [0.35 + 0.0271 * beam for beam in range(360)], "angle_min": -1.57},
    "str1k": "horus-0123456789" * 64,
}


def spin_for(seconds: float) -> None:
    """Busy-wait, so that the next release is due and the processor has not gone to sleep."""
    until_ns = now_ns() + int(seconds * 1e9)
    while now_ns() < until_ns:
        pass


def topic_us(
    horus: Any, size: Size, message: object, *, subscribers: int = 1, burst: int = 1
) -> list[float]:
    """Send and receive inside the ticks of a node; return the time per message of each tick [µs].

    ``burst`` messages are sent, then every subscriber receives them all, and so on until
    ``TOPIC_BATCH`` messages have passed: a burst of one is a round trip, a longer one lets the
    queues grow. Publisher and subscribers are nodes of their own; the publisher's tick also calls
    the subscribers' ``recv``, so that both sides are under one pair of clock readings.
    """
    topic = "bench.topic"
    elapsed_ns: list[int] = []
    wrong = 0

    def round_trips(node: Any) -> None:
        nonlocal wrong
        send = node.send
        received = None
        start_ns = now_ns()
        for _ in range(TOPIC_BATCH):
            send(topic, message)
            for recv in receivers:
                received = recv(topic)
        elapsed_ns.append(now_ns() - start_ns)
        wrong += received != message

    def bursts(node: Any) -> None:
        nonlocal wrong
        send = node.send
        received = None
        start_ns = now_ns()
        for _ in range(TOPIC_BATCH // burst):
            for _ in range(burst):
                send(topic, message)
            for recv in receivers:
                for _ in range(burst):
                    received = recv(topic)
        elapsed_ns.append(now_ns() - start_ns)
        wrong += received != message

    def idle(_node: Any) -> None:
        """Leave receiving to the publisher's tick."""

    scheduler = horus.Scheduler(tick_rate=1000.0)
    publisher = horus.Node(
        name="publisher",
        tick=round_trips if burst == 1 else bursts,
        rate=TOPIC_RATE_HZ,
        order=0,
        pubs=[topic],
    )
    scheduler.add(publisher)
    nodes = [
        horus.Node(
            name=f"subscriber{index}", tick=idle, rate=TOPIC_RATE_HZ, order=1 + index, subs=[topic]
        )
        for index in range(subscribers)
    ]
    receivers = [node.recv for node in nodes]
    for node in nodes:
        scheduler.add(node)
    # A scheduler may spend its first cycle on set-up without ticking anybody, and the first ticks
    # fill caches: they are run and thrown away.
    for _ in range(3):
        spin_for(TOPIC_GAP_S)
        scheduler.tick_once()
    elapsed_ns.clear()
    wrong = 0
    for _ in range(size.topic_ticks):
        spin_for(TOPIC_GAP_S)
        scheduler.tick_once()
    if wrong or len(elapsed_ns) != size.topic_ticks:
        raise RuntimeError(
            f"topic workload did not run as written: {wrong} wrong messages, "
            f"{len(elapsed_ns)} of {size.topic_ticks} ticks"
        )
    return [sample / TOPIC_BATCH / 1e3 for sample in elapsed_ns]


def topics(horus: Any, size: Size) -> Series:
    """Measure round trips of each message, to five subscribers, and bursts."""
    dict3, scan360 = MESSAGES["dict3"], MESSAGES["scan360"]
    series = {f"{name}_us": topic_us(horus, size, message) for name, message in MESSAGES.items()}
    series["dict3_to5_us"] = topic_us(horus, size, dict3, subscribers=5)
    series["dict3_burst_us"] = topic_us(horus, size, dict3, burst=TOPIC_BATCH)
    series["scan360_burst_us"] = topic_us(horus, size, scan360, burst=TOPIC_BATCH)
    return series


def tick_once(horus: Any, size: Size) -> Series:
    """Time ``tick_once()`` per node for empty ticks, and the bare calls of the same functions.

    Calls are spaced by more than a period, so that every node is due in every call under any rate
    control; a sample only counts if all nodes did tick.
    """
    series: Series = {}
    for nodes in (1, 10, 100):
        ticks = [0] * nodes

        def make_tick(index: int, ticks: list[int] = ticks) -> Callable[[Any], None]:
            def tick(_node: Any) -> None:
                ticks[index] += 1

            return tick

        functions = [make_tick(index) for index in range(nodes)]
        scheduler = horus.Scheduler(tick_rate=1000.0)
        for index, function in enumerate(functions):
            scheduler.add(
                horus.Node(name=f"n{index}", tick=function, rate=TICK_ONCE_RATE_HZ, order=index)
            )
        for _ in range(20):
            spin_for(TICK_ONCE_GAP_S)
            scheduler.tick_once()
        per_node_us: list[float] = []
        incomplete = 0
        for _ in range(size.tick_once_calls):
            spin_for(TICK_ONCE_GAP_S)
            before = sum(ticks)
            start_ns = now_ns()
            scheduler.tick_once()
            elapsed_ns = now_ns() - start_ns
            if sum(ticks) - before == nodes:
                per_node_us.append(elapsed_ns / nodes / 1e3)
            else:
                incomplete += 1
        if incomplete * 2 > size.tick_once_calls:
            raise RuntimeError(
                f"tick_once ran all {nodes} nodes in only {len(per_node_us)} of "
                f"{size.tick_once_calls} calls"
            )
        bare_us: list[float] = []
        for _ in range(size.tick_once_calls):
            spin_for(TICK_ONCE_GAP_S)
            start_ns = now_ns()
            for function in functions:
                function(None)
            bare_us.append((now_ns() - start_ns) / nodes / 1e3)
        series[f"nodes{nodes}_us"] = per_node_us
        series[f"nodes{nodes}_bare_us"] = bare_us
        series[f"nodes{nodes}_incomplete"] = [float(incomplete)]
    return series


def event_latency(horus: Any, size: Size) -> Series:
    """Time from just before a periodic node's ``send`` to the entry of the event node's tick.

    The send time is handed over beside the topic, so that a package whose queue lags by a message
    is charged for the wake-up only, and only the first entry after a send counts.
    """
    topic = "bench.event"
    latencies_us: list[float] = []
    pending_ns: int | None = None
    sent = 0
    handled = 0

    def publish(node: Any) -> None:
        nonlocal pending_ns, sent
        sent += 1
        pending_ns = now_ns()
        node.send(topic, 1.0)

    def handle(node: Any) -> None:
        nonlocal pending_ns, handled
        entry_ns = now_ns()
        sent_ns, pending_ns = pending_ns, None
        if sent_ns is not None:
            latencies_us.append((entry_ns - sent_ns) / 1e3)
        while node.recv(topic) is not None:
            handled += 1

    scheduler = horus.Scheduler(tick_rate=1000.0)
    scheduler.add(
        horus.Node(name="publisher", tick=publish, rate=EVENT_RATE_HZ, order=0, pubs=[topic])
    )
    scheduler.add(horus.Node(name="handler", tick=handle, on=topic, order=1, subs=[topic]))
    scheduler.run(duration=size.event_s)
    if not latencies_us:
        raise RuntimeError(f"the event node never ticked; {sent} messages were sent")
    return {
        "latency_us": latencies_us,
        "handled_ratio": [handled / sent],
        "bare_wakeup_us": bare_wakeups(size.wakeups, 1.0 / EVENT_RATE_HZ),
    }


def bare_wakeups(count: int, period_s: float) -> list[float]:
    """Time the wake-up of a thread that blocks on a pipe: what the machine allows at best.

    The same period and the same interpreter as the events, and nothing else between the write and
    the reader's first statement; the latency of events is to be read against it.
    """
    reader, writer = os.pipe()
    written_ns = 0
    latencies_us: list[float] = []

    def write() -> None:
        nonlocal written_ns
        for _ in range(count):
            time.sleep(period_s)
            written_ns = now_ns()
            os.write(writer, b"x")

    thread = threading.Thread(target=write, daemon=True)
    thread.start()
    for _ in range(count):
        os.read(reader, 1)
        latencies_us.append((now_ns() - written_ns) / 1e3)
    thread.join()
    os.close(reader)
    os.close(writer)
    return latencies_us


def achieved_ratio(
    stamps_s: Sequence[Sequence[float]], since_s: float, window_s: float, rate_hz: float
) -> float:
    """Return ticks run over ticks due within a window, averaged over nodes.

    Each node's window opens half a period before its first tick after ``since_s``: an exactly
    periodic node then counts exactly ``window_s * rate_hz`` whatever its phase, where a window cut
    at fixed instants would be off by one tick per node.

    Args:
        stamps_s: Ascending tick times of each node [s].
        since_s: Earliest window opening [s].
        window_s: Length of the window [s].
        rate_hz: Rate asked for [Hz].
    """
    ran = 0
    for stamps in stamps_s:
        first = bisect.bisect_left(stamps, since_s)
        if first < len(stamps):
            opens_s = stamps[first] - 0.5 / rate_hz
            ran += bisect.bisect_left(stamps, opens_s + window_s) - first
    return ran / (len(stamps_s) * window_s * rate_hz)


def cpu_of(horus: Any, size: Size, *, nodes: int, rate_hz: float, await_s: float = 0.0) -> Series:
    """Run many small nodes and report the process's CPU time and the ticks achieved.

    CPU time is that of the whole process, all threads, over a window that begins after start-up and
    ends before shutdown.
    """
    stamps_s: list[list[float]] = [[] for _ in range(nodes)]
    clock = time.perf_counter

    def make_tick(mine_s: list[float]) -> Callable[[Any], Any]:
        def tick(_node: Any) -> None:
            mine_s.append(clock())

        async def tick_async(_node: Any) -> None:
            await asyncio.sleep(await_s)
            mine_s.append(clock())

        return tick_async if await_s else tick

    scheduler = horus.Scheduler(tick_rate=1000.0)
    for index, mine_s in enumerate(stamps_s):
        scheduler.add(
            horus.Node(name=f"n{index}", tick=make_tick(mine_s), rate=rate_hz, order=index)
        )
    marks: list[tuple[float, float]] = []

    def sample() -> None:
        for wait_s in (size.cpu_warmup_s, size.cpu_window_s):
            time.sleep(wait_s)
            marks.append((clock(), time.process_time()))

    sampler = threading.Thread(target=sample, daemon=True)
    sampler.start()
    scheduler.run(duration=size.cpu_warmup_s + size.cpu_window_s + 0.5)
    sampler.join()
    (opened_s, cpu_before_s), (closed_s, cpu_after_s) = marks
    return {
        "cpu_percent": [100.0 * (cpu_after_s - cpu_before_s) / (closed_s - opened_s)],
        "tick_ratio": [achieved_ratio(stamps_s, opened_s, size.cpu_window_s, rate_hz)],
    }


def cpu_idle(horus: Any, size: Size) -> Series:
    """Run ten nodes at 10 Hz whose ticks do nothing but note the time."""
    return cpu_of(horus, size, nodes=10, rate_hz=10.0)


def cpu_loaded(horus: Any, size: Size) -> Series:
    """Run ten nodes at 500 Hz whose ticks do nothing but note the time."""
    return cpu_of(horus, size, nodes=10, rate_hz=500.0)


def async_nodes(horus: Any, size: Size) -> Series:
    """Run 500 ``async def`` nodes at 10 Hz, each awaiting 50 ms per tick."""
    return cpu_of(horus, size, nodes=500, rate_hz=10.0, await_s=0.05)


def import_time(_horus: Any, size: Size) -> Series:
    """Time fresh interpreters that import the package, and bare ones, in turn.

    The names that every program uses are imported as a case of their own: a package that loads
    its parts on first use does not hide their cost that way.
    """
    cases = {
        "bare_ms": "pass",
        "import_ms": "import horus",
        "import_names_ms": "from horus import Node, Scheduler",
    }
    samples: Series = {name: [] for name in cases}
    # Byte code files are written by the first import, which is not counted.
    subprocess.run([sys.executable, "-P", "-c", cases["import_names_ms"]], check=True)
    for _ in range(size.imports):
        for name, code in cases.items():
            start_ns = now_ns()
            subprocess.run([sys.executable, "-P", "-c", code], check=True)
            samples[name].append((now_ns() - start_ns) / 1e6)
    return samples


WORKLOADS: Mapping[str, Callable[[Any, Size], Series]] = {
    "topics": topics,
    "tick_once": tick_once,
    "event": event_latency,
    "idle": cpu_idle,
    "loaded": cpu_loaded,
    "async500": async_nodes,
    "import": import_time,
}


def provenance(horus: Any) -> dict[str, str]:
    """Return what exactly was measured: the imported file, the version, the interpreter."""
    if horus.__file__ is None:
        raise RuntimeError(f"horus is a directory without code: {list(horus.__path__)}")
    distributions = metadata.packages_distributions().get("horus", [])
    version = getattr(horus, "__version__", None)
    if version is None:
        version = metadata.version(distributions[0]) if distributions else "unknown"
    return {
        "file": str(horus.__file__),
        "version": version,
        "python": platform.python_version(),
        "executable": sys.executable,
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Run one workload and write its samples to the file asked for."""
    parser = argparse.ArgumentParser(description="Run one workload on the importable horus.")
    parser.add_argument("name", choices=WORKLOADS)
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    parser.add_argument("--quick", action="store_true", help="fewer samples, same workload")
    options = parser.parse_args(argv)

    import horus

    size = QUICK if options.quick else FULL
    package = provenance(horus)
    series = WORKLOADS[options.name](horus, size)
    result = {"package": package, "size": asdict(size), "series": series}
    options.out.write_text(json.dumps(result), encoding="utf-8")
    return 0


if __name__ == "__main__":
    # Some packages leave threads behind that keep the interpreter from ending; the samples are on
    # disk by now, so nothing is lost by not waiting for them.
    status = main()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)
