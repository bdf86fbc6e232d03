"""The AGV on dora-rs: a process per node, ticked by dora's timers, messages as Arrow structs.

``run`` writes the dataflow and starts ``dora run``, which starts this directory again once per
node (``run_node``). Every node ends by itself; dora ends when all have.
"""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
from collections import deque
from pathlib import Path
from typing import Any

from scenario import (
    MARGIN_S,
    MODES,
    QUEUE_CAPACITY,
    RATES_HZ,
    RECEIVES,
    SENDS,
    WARMUP_S,
    Mode,
    Recorder,
    make_motor,
    make_ticks,
    now_ns,
)

START_AND_END_S = 30.0
"""How long dora may take beyond the drive itself [s]."""
# Nothing in here needs a network: the processes find each other without asking around in it.
ZENOH_OVERLAY = {"scouting": {"multicast": {"enabled": False}}}


class DoraNode:
    """Gives a dora node the ``has_msg``, ``recv`` and ``send`` of the scenario."""

    def __init__(self, node: Any, name: str) -> None:
        """Wrap ``node``, whose events the caller reads."""
        import pyarrow

        self._array = pyarrow.array
        self._send = node.send_output
        self.name = name
        self.queue: deque[Any] = deque(maxlen=QUEUE_CAPACITY)

    def has_msg(self, _topic: str) -> bool:
        """Return whether a message waits."""
        return bool(self.queue)

    def recv(self, _topic: str) -> Any:
        """Return the oldest message."""
        return self.queue.popleft().to_pylist()[0]

    def send(self, topic: str, message: Any) -> None:
        """Send a message as an array of one struct."""
        self._send(topic, self._array([message]))

    def log_warning(self, message: str) -> None:
        """Print; dora collects it."""
        print(f"{self.name}: {message}")


def run_node(name: str, mode: Mode, seconds: float, out: Path) -> None:
    """Be one node of the dataflow; the motor writes the raw series to ``out``."""
    import dora

    total_s = WARMUP_S + seconds + MARGIN_S
    recorder = Recorder(total_s)
    tick = make_ticks(mode, recorder, make_motor(recorder), awaits=False)[name]
    events = dora.Node()
    node = DoraNode(events, name)
    end_ns = 0
    for event in events:
        if event["type"] == "STOP":
            break
        if event["type"] != "INPUT":
            continue
        if event["id"] != "tick":
            node.queue.append(event["value"])
            continue
        tick(node)
        if not end_ns:
            end_ns = now_ns() + int(total_s * 1e9)
        elif now_ns() >= end_ns:
            break
    if name == "motor":
        # The safety node is another process: its progress is not to be seen from here, and
        # dora offers no order among nodes.
        series = recorder.series(releases=False, order=False)
        out.write_text(json.dumps(series), encoding="utf-8")


def dataflow(mode_name: str, seconds: float, out: Path) -> dict[str, Any]:
    """Return the description that ``dora run`` takes; timers have whole milliseconds."""
    here = str(Path(__file__).parent)
    sender = {topic: name for name, topic in SENDS.items()}
    nodes = []
    for name, rate_hz in RATES_HZ.items():
        inputs = {"tick": f"dora/timer/millis/{round(1000 / rate_hz)}"}
        if name in RECEIVES:
            topic = RECEIVES[name]
            inputs[topic] = f"{sender[topic]}/{topic}"
        args = ["-P", here, mode_name, "--contender", "dora", "--dora-node", name]
        args += ["--seconds", str(seconds), "--out", str(out)]
        node: dict[str, Any] = {"id": name, "path": sys.executable, "args": shlex.join(args)}
        node["inputs"] = inputs
        if name in SENDS:
            node["outputs"] = [SENDS[name]]
        nodes.append(node)
    return {"nodes": nodes}


def run(mode: Mode, seconds: float) -> tuple[dict[str, str], dict[str, list[int]]]:
    """Drive for the warm-up and ``seconds`` [s] in the current directory, as one dataflow."""
    mode_name = next(name for name, each in MODES.items() if each is mode)
    out = Path("motor.json").absolute()
    # A JSON document is a YAML document, and needs no package to write.
    Path("agv.yml").write_text(json.dumps(dataflow(mode_name, seconds, out)), encoding="utf-8")
    overlay = Path("zenoh.json5").absolute()
    overlay.write_text(json.dumps(ZENOH_OVERLAY), encoding="utf-8")
    limit_s = WARMUP_S + seconds + MARGIN_S + START_AND_END_S
    child = subprocess.run(
        [
            Path(sys.executable).with_name("dora"),
            "run",
            "agv.yml",
            "--stop-after",
            f"{limit_s:.0f}s",
        ],
        env={**os.environ, "DORA_ZENOH_CONFIG_OVERLAY": str(overlay)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        check=False,
    )
    if child.returncode != 0 or not out.exists():
        tail = " | ".join(child.stdout.strip().splitlines()[-3:])
        raise RuntimeError(f"dora run ended with status {child.returncode}: {tail}")
    series: dict[str, list[int]] = json.loads(out.read_text(encoding="utf-8"))
    return {}, series
