"""Run one workload of the recording benchmark in this interpreter and write its raw samples.

``python -P recording_workloads NAME --contender KEY --seconds N --out FILE [--quick]``. Nothing in
here decides what a sample means: the statistics are in ``benchmarks/recording.py``.

Python puts a directory that it runs on the import path, and with ``-P`` nothing else: the modules
here find each other, and ``horus`` is the contender's.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import platform
import sys
from dataclasses import asdict
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from sizes import FULL, QUICK

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence


class Contender(NamedTuple):
    """A package that is measured."""

    package: str
    distribution: str
    workloads: Mapping[str, tuple[str, str]]
    """Module and function of each workload that it takes part in."""


EVERYBODY = {"record": ("session", "record"), "motor": ("session", "motor")}
CONTENDERS: Mapping[str, Contender] = {
    "horus": Contender(
        "horus",
        "horus-scheduler",
        {
            **EVERYBODY,
            "cost": ("cost", "cost"),
            "write": ("files", "write"),
            "replay": ("files", "replay"),
            "recover": ("files", "recover"),
            "telemetry": ("telemetry", "telemetry"),
        },
    ),
    "horus-robotics": Contender("horus", "horus-robotics", EVERYBODY),
    "mcap": Contender("mcap", "mcap", {"write": ("files", "write_mcap")}),
}


def provenance(package: Any, distribution: str) -> dict[str, str]:
    """Return what exactly was measured: the imported file, the version, the interpreter."""
    return {
        "file": str(package.__file__),
        "version": metadata.version(distribution),
        "python": platform.python_version(),
        "executable": sys.executable,
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Run one workload and write its samples to the file asked for."""
    parser = argparse.ArgumentParser(description="Run one workload of the recording benchmark.")
    parser.add_argument("name", choices=CONTENDERS["horus"].workloads)
    parser.add_argument("--contender", choices=CONTENDERS, default="horus")
    parser.add_argument("--seconds", type=float, required=True, help="length of a run")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    parser.add_argument("--quick", action="store_true", help="fewer samples, same workload")
    options = parser.parse_args(argv)

    contender = CONTENDERS[options.contender]
    package = importlib.import_module(contender.package)
    module, function = contender.workloads[options.name]
    size = QUICK if options.quick else FULL
    series = getattr(importlib.import_module(module), function)(package, size, options.seconds)
    result = {
        "package": provenance(package, contender.distribution),
        "size": asdict(size),
        "series": series,
    }
    options.out.write_text(json.dumps(result), encoding="utf-8")
    return 0


if __name__ == "__main__":
    # Some packages leave threads behind that keep the interpreter from ending; the samples are on
    # disk by now, so nothing is lost by not waiting for them.
    status = main()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)
