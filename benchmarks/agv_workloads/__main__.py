"""Run one workload of the AGV benchmark in this interpreter and write its raw samples.

``python -P agv_workloads MODE --contender NAME --seconds N --out FILE`` drives the AGV;
``python -P agv_workloads baton|estop|watchdog|soak --seconds N --out FILE`` measures how this
package reacts. Nothing in here decides what a sample means: the statistics are in
``benchmarks/agv_report.py``.

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
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scenario import MODES, RATES_HZ, REACTIONS, SOAK, WARMUP_S

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

CONTENDERS: Mapping[str, tuple[str, str, str]] = {
    "horus": ("horus_agv", "run", "horus"),
    "dora": ("dora_agv", "run", "dora"),
    "threads": ("plain_agv", "run_threads", "threading"),
    "uvloop": ("plain_agv", "run_uvloop", "uvloop"),
}
"""Contender to its module, its function, and the package that is measured."""


def provenance(package: str) -> dict[str, str]:
    """Return what exactly was measured: the imported file, the version, the interpreter."""
    module = importlib.import_module(package)
    if module.__file__ is None:
        raise RuntimeError(f"{package} is a directory without code: {list(module.__path__)}")
    version = getattr(module, "__version__", None)
    if version is None:
        distributions = metadata.packages_distributions().get(package, [])
        # What belongs to no distribution comes with the interpreter.
        version = metadata.version(distributions[0]) if distributions else platform.python_version()
    return {
        "file": str(module.__file__),
        "version": version,
        "python": platform.python_version(),
        "executable": sys.executable,
    }


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    """Parse the command line of a child."""
    parser = argparse.ArgumentParser(description="Run one workload of the AGV benchmark.")
    parser.add_argument("name", choices=(*MODES, *REACTIONS, SOAK))
    parser.add_argument("--contender", choices=CONTENDERS, default="horus")
    parser.add_argument("--seconds", type=float, required=True, help="length of the window")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    parser.add_argument("--dora-node", choices=RATES_HZ, help="be this node of a dora dataflow")
    return parser.parse_args(argv)


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """Run the workload and return the document to write."""
    if options.name not in MODES:
        reaction = getattr(importlib.import_module("reaction"), options.name)
        return {"package": provenance("horus"), "series": reaction(options.seconds)}
    module, function, package = CONTENDERS[options.contender]
    facts, series = getattr(importlib.import_module(module), function)(
        MODES[options.name], options.seconds
    )
    series["window_s"] = [WARMUP_S, options.seconds]
    return {"package": {**provenance(package), **facts}, "series": series}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one workload, or one node of it, and write its samples to the file asked for."""
    options = parse(argv)
    if options.dora_node is not None:
        node = importlib.import_module("dora_agv").run_node
        node(options.dora_node, MODES[options.name], options.seconds, options.out)
        return 0
    options.out.write_text(json.dumps(measure(options)), encoding="utf-8")
    return 0


if __name__ == "__main__":
    # Some packages leave threads behind that keep the interpreter from ending; the samples are on
    # disk by now, so nothing is lost by not waiting for them.
    status = main()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)
