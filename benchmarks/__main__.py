"""Dispatch ``python -m benchmarks <name> ...`` to the module of that name."""

from __future__ import annotations

import argparse
import importlib
import signal
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

BENCHMARKS = {
    "micro": "topics, scheduler overhead, event latency, CPU load and import time",
    "agv": "the warehouse AGV: does the motor keep its 1 kHz beside a busy planner?",
    "recording": "recording, replay, recovery and telemetry: what is lost, what it costs",
    "service": "off the interpreter, inside your service: worker processes and embedding",
}
"""Benchmark name (a module of this package with ``main(argv) -> int``) to its one-line summary."""


def parse(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Split the command line into the benchmark's name and the arguments meant for it."""
    summaries = "\n".join(f"  {name:<9} {summary}" for name, summary in BENCHMARKS.items())
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks",
        description=f"Run one benchmark.\n\nbenchmarks:\n{summaries}",
        epilog="python -m benchmarks <name> --help lists the options of one benchmark",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("name", choices=BENCHMARKS, metavar="name", help="which benchmark to run")
    parser.add_argument("args", nargs=argparse.REMAINDER, help="options of that benchmark")
    return parser.parse_args(argv)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark named on the command line and return its exit status."""
    options = parse(argv)
    # Imported only when chosen: a benchmark may need packages that the others do without.
    module = importlib.import_module(f"benchmarks.{options.name}")
    try:
        status: int = module.main(options.args)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    return status


if __name__ == "__main__":
    # Like Ctrl-C, and unlike the default, this takes the children along.
    signal.signal(signal.SIGTERM, lambda number, _frame: sys.exit(128 + number))
    sys.exit(main())
