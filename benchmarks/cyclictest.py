"""The machine's own limit: Debian's cyclictest, a C program that does nothing but wake up.

``python cyclictest.py NAME --seconds N --out FILE`` runs it and writes its latencies as raw
samples, like any other workload; the name only says which workload it runs beside. It also asks the
kernel to keep the processor from sleeping (``/dev/cpu_dma_latency``), which none of the others do.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

HISTOGRAM_US = 5000
"""Latencies from here on are counted, not binned [µs]."""
PACKAGE = "rt-tests"
NOT_INSTALLED = f"cyclictest is not installed (Debian: apt install {PACKAGE})"


@dataclass(frozen=True, slots=True, kw_only=True)
class Latencies:
    """What one thread of cyclictest reports."""

    histogram: Mapping[int, int] = field(default_factory=dict)
    """Whole microseconds of latency to how often it occurred."""
    overflows: int = 0
    """How many latencies were longer than the histogram."""
    max_us: int = 0

    def samples_ns(self) -> list[int]:
        """Return one latency per wake-up [ns], ascending.

        Of those beyond the histogram only the longest is known: each counts as that one.
        """
        samples = [1000 * us for us in sorted(self.histogram) for _ in range(self.histogram[us])]
        return samples + [1000 * self.max_us] * self.overflows


def find() -> str | None:
    """Return where cyclictest is; None if it is not installed."""
    # Debian puts it in /usr/bin, others in a directory that only root searches.
    return shutil.which("cyclictest") or shutil.which("cyclictest", path="/usr/sbin:/sbin")


def command(executable: str, seconds: float) -> list[str]:
    """Return the call: one thread, SCHED_FIFO 80, memory locked, every millisecond."""
    options = ["-q", "-m", "-t1", "-p80", "-i1000", "-h", str(HISTOGRAM_US)]
    # It takes whole seconds only.
    return [executable, *options, "-D", str(max(1, round(seconds)))]


def parse_report(text: str) -> Latencies:
    """Read the histogram that cyclictest prints for a single thread.

    Raises:
        ValueError: There is none, so nothing was measured.
    """
    histogram: dict[int, int] = {}
    facts = {"# Histogram Overflows": 0, "# Max Latencies": 0}
    for line in text.splitlines():
        label, colon, value = line.partition(":")
        if line[:1].isdigit():
            latency_us, count = line.split()
            if int(count):
                histogram[int(latency_us)] = int(count)
        elif colon and label in facts:
            facts[label] = int(value.split()[0])
    if not histogram:
        raise ValueError(f"no histogram in cyclictest's output: {text.strip()[-200:]!r}")
    return Latencies(
        histogram=histogram,
        overflows=facts["# Histogram Overflows"],
        max_us=facts["# Max Latencies"],
    )


def version(executable: str) -> str:
    """Return the version that its help names."""
    result = subprocess.run([executable, "--help"], capture_output=True, text=True, check=False)
    words = (result.stdout or result.stderr).split("\n", 1)[0].split()
    return words[-1] if words else "unknown"


def main(argv: Sequence[str] | None = None) -> int:
    """Run cyclictest and write its samples to the file asked for."""
    parser = argparse.ArgumentParser(description="Measure the machine with cyclictest.")
    parser.add_argument("name", help="the workload that it runs beside")
    parser.add_argument("--seconds", type=float, required=True)
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    parser.add_argument("--quick", action="store_true", help="changes nothing: --seconds does")
    options = parser.parse_args(argv)
    executable = find()
    if executable is None:
        print(NOT_INSTALLED, file=sys.stderr)
        return 1
    run = subprocess.run(
        command(executable, options.seconds), capture_output=True, text=True, check=False
    )
    if run.returncode != 0:
        print((run.stderr or run.stdout).strip(), file=sys.stderr)
        return run.returncode
    package = {"file": executable, "version": version(executable)}
    result = {"package": package, "series": {"latency_ns": parse_report(run.stdout).samples_ns()}}
    options.out.write_text(json.dumps(result), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
