"""A scheduler that records, or does not, beside a node that has to tick every millisecond.

The same on whatever ``horus`` the interpreter imports. ``HOME`` is a temporary directory meanwhile:
both packages put their recordings below it when they are given nothing but ``recording=True``.
"""

from __future__ import annotations

import contextlib
import importlib
import itertools
import os
import re
import struct
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from traffic import (
    SOURCE_RATE_HZ,
    TOGETHER_RATE_HZ,
    TOPICS,
    make_node_for_all,
    make_nodes,
    make_sources,
    now_ns,
    number_of,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from sizes import Series, Size
    from traffic import Source

CORES = 2
WARMUP_S = 0.5
"""Time from the first tick to the opening of the measured window [s]."""
MARGIN_S = 0.5
"""How much longer than the window the scheduler runs [s]: nothing is cut short."""
MOTOR_RATE_HZ = 1000.0


def release_teller() -> Callable[[], int] | None:
    """Return what tells the release of the tick that asks [ns]; None if the package has none."""
    try:
        current = importlib.import_module("horus.clock").current
    except ImportError:
        return None
    return lambda: current.get().release_ns


class Motor:
    """Ticks every millisecond, and does nothing but write down when."""

    def __init__(self, seconds: float) -> None:
        """Measure for so long after the warm-up [s]."""
        self.start_ns: list[int] = []
        self.late_ns: list[int] = []
        """How long after its release each tick began; empty where nothing tells the release."""
        self.marks: list[tuple[int, int]] = []
        """When the window opened and closed, and the CPU time of the process then [ns]."""
        self._release_of = release_teller()
        self._marks_at_ns = [round(1e9 * s) for s in (WARMUP_S, WARMUP_S + seconds)]

    def tick(self, _node: Any) -> None:
        """Take the time, first of all."""
        started_ns = now_ns()
        self.start_ns.append(started_ns)
        if self._release_of is not None:
            self.late_ns.append(started_ns - self._release_of())
        marks = self.marks
        if (
            len(marks) < len(self._marks_at_ns)
            and started_ns - self.start_ns[0] >= self._marks_at_ns[len(marks)]
        ):
            marks.append((started_ns, time.process_time_ns()))

    def window(self, name: str) -> Series:
        """Return the series of what was in the window, their names beginning with ``name``.

        Raises:
            RuntimeError: The window did not close.
        """
        if len(self.marks) < len(self._marks_at_ns):
            raise RuntimeError(f"the motor ticked {len(self.start_ns)} times and then no more")
        (opened_ns, cpu_before_ns), (closed_ns, cpu_after_ns) = self.marks
        inside = [
            index for index, start in enumerate(self.start_ns) if opened_ns <= start < closed_ns
        ]
        series = {
            f"{name}_start_us": [(self.start_ns[index] - opened_ns) / 1e3 for index in inside],
            f"{name}_cpu_percent": [
                100.0 * (cpu_after_ns - cpu_before_ns) / (closed_ns - opened_ns)
            ],
        }
        if self.late_ns:
            series[f"{name}_late_us"] = [self.late_ns[index] / 1e3 for index in inside]
        return series


class Setting(NamedTuple):
    """A mode of the scheduler, and who sends the messages."""

    rt: bool
    source_rate_hz: float
    make_nodes: Callable[[Any, Sequence[Source]], list[Any]]


SETTINGS: Mapping[str, Setting] = {
    "rt20": Setting(True, SOURCE_RATE_HZ, make_nodes),
    "plain20": Setting(False, SOURCE_RATE_HZ, make_nodes),
    "rt1": Setting(True, TOGETHER_RATE_HZ, make_node_for_all),
    "plain1": Setting(False, TOGETHER_RATE_HZ, make_node_for_all),
}
"""What series begin with, to what was run: ``rt=`` or not, and how many nodes send."""


def run(
    horus: Any, seconds: float, *, recording: bool, setting: Setting = SETTINGS["rt20"]
) -> tuple[Motor, list[Source]]:
    """Run all nodes for the warm-up and ``seconds`` [s]."""
    motor = Motor(seconds)
    sources = make_sources(WARMUP_S + seconds, rate_hz=setting.source_rate_hz)
    scheduler = horus.Scheduler(tick_rate=MOTOR_RATE_HZ, rt=setting.rt, recording=recording)
    scheduler.add(
        horus.Node(name="motor", tick=motor.tick, rate=MOTOR_RATE_HZ, order=0, on_miss="warn")
    )
    for node in setting.make_nodes(horus, sources):
        scheduler.add(node)
    scheduler.run(duration=WARMUP_S + seconds + MARGIN_S)
    return motor, sources


@contextlib.contextmanager
def home() -> Iterator[Path]:
    """Make ``HOME`` a temporary directory in the block."""
    before = dict(os.environ)
    with tempfile.TemporaryDirectory(prefix="horus-bench-") as directory:
        os.environ["HOME"] = directory
        for name in ("XDG_DATA_HOME", "HORUS_HOME"):
            os.environ.pop(name, None)
        try:
            yield Path(directory)
        finally:
            os.environ.clear()
            os.environ.update(before)


def use_two_cores() -> None:
    """Leave the process no more than two cores, where it has them and the system lets choose."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:CORES])


def record(horus: Any, _size: Size, seconds: float) -> Series:
    """Record for so long [s], then look into the files for what was sent."""
    use_two_cores()
    with home() as directory:
        _, sources = run(horus, seconds, recording=True)
        files = [path for path in directory.rglob("*") if path.is_file()]
        found = numbers_in(horus, files)
        written = sum(path.stat().st_size for path in files)
    # Each topic from its own first message to its own last: threads do not all start at once.
    spans_s = [(source.last_ns - source.first_ns) / 1e9 for source in sources]
    sent = sum(source.sent for source in sources)
    recorded = sum(intact(source, found.get(source.topic, [])) for source in sources)
    return {
        "sent": [sent],
        "recorded": [recorded],
        "sent_hz": [sum(s.sent / span for s, span in zip(sources, spans_s, strict=True))],
        "quota": [sum(source.quota for source in sources)],
        "written_mb": [written / 1e6],
    }


def intact(source: Source, found: list[int]) -> int:
    """Return how many of a topic's messages were found.

    Raises:
        RuntimeError: There is one that was not sent, or one that is not where it belongs.
    """
    if any(later <= earlier for earlier, later in itertools.pairwise(found)):
        raise RuntimeError(f"messages of {source.topic} are recorded twice or out of order")
    if not set(found) <= set(source.numbers()):
        raise RuntimeError(f"messages of {source.topic} are recorded that were never sent")
    return len(found)


def numbers_in(horus: Any, files: list[Path]) -> dict[str, list[int]]:
    """Return the numbers of the messages in recordings, by topic."""
    numbers: dict[str, list[int]] = defaultdict(list)
    for path in files:
        if path.suffix == ".mcap":
            with horus.RecordingReader(path) as reader:
                for entry in reader.messages():
                    number = number_of(entry.message())
                    sequence = number // len(TOPICS) + 1
                    if entry.sequence != sequence:
                        raise RuntimeError(
                            f"message {sequence} of {entry.topic} has number {entry.sequence}"
                        )
                    numbers[entry.topic].append(number)
    peer = [path for path in files if path.suffix == ".horus"]
    for number in sorted(set().union(*(numbers_in_bytes(path.read_bytes()) for path in peer))):
        numbers[TOPICS[number % len(TOPICS)]].append(number)
    return numbers


UNCOMPRESSED = b"HORUS\0\1\0\0\0"
"""How a file of horus-robotics begins whose messages are in it as they are."""
PACKED_X = re.compile(rb"\xa1x\xcb(.{8})", re.DOTALL)
"""The field that has a message's number, in MessagePack."""


def numbers_in_bytes(data: bytes) -> set[int]:
    """Return the numbers of all messages that are anywhere in a file of horus-robotics.

    It has what went into a tick and what came out of it, each message perhaps several times; all
    that can be found counts.

    Raises:
        RuntimeError: The file is not one that messages can be found in by looking at its bytes.
    """
    if not data.startswith(UNCOMPRESSED):
        raise RuntimeError(f"a recording begins with {data[:10]!r}, which is not known")
    return {int(struct.unpack(">d", packed)[0]) for packed in PACKED_X.findall(data)}


def motor(horus: Any, size: Size, seconds: float) -> Series:
    """Run without and with recording in turn; the two of a setting last ``seconds`` in all [s]."""
    use_two_cores()
    series: Series = {}
    window_s = seconds / size.pairs / 2
    for pair in range(size.pairs):
        for name, setting in SETTINGS.items():
            # Who is first alternates: a machine that slows down does so for both.
            for recording in (False, True) if pair % 2 == 0 else (True, False):
                with home():
                    ticking, _ = run(horus, window_s, recording=recording, setting=setting)
                series |= ticking.window(f"{name}_{'on' if recording else 'off'}{pair}")
    return series
