"""A benchmark whose result is one table: a line per measure, a column per contender."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Protocol

from benchmarks import harness, peers
from benchmarks.harness import OURS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from benchmarks.harness import ChildRun, Contender, Measure


RUNS_IN_A_WORKLOAD = 5
"""How often a workload may run for ``--seconds``, before it is given up."""
QUICK_S = 1.0
"""What stands in for ``--seconds`` with ``--quick`` [s]."""


class FindContenders(Protocol):
    """Finds out who can be measured."""

    def __call__(self, *, with_peers: bool) -> list[Contender]:
        """Return this package, first, and the others.

        Raises:
            PeerError: One cannot be had.
        """


def lasting(contender: Contender, seconds: float) -> Contender:
    """Return a contender whose children are told how long to run [s]."""
    return replace(
        contender,
        arguments=(*contender.arguments, "--seconds", f"{seconds:g}"),
        timeout_s=contender.timeout_s + RUNS_IN_A_WORKLOAD * seconds,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class TableBenchmark:
    """What is measured of whom, with the command that does it."""

    name: str
    description: str | None
    measures: Sequence[Measure]
    contenders: FindContenders
    peers_help: str
    reading: str
    """How to read the table: which way is better."""
    rounds: int = 5
    """How many rounds unless ``--rounds`` says otherwise."""
    seconds: float | None = None
    """How long a run lasts unless ``--seconds`` says otherwise [s]; None if nobody can choose."""

    @property
    def workloads(self) -> tuple[str, ...]:
        """Return what the measures are taken from."""
        return tuple(dict.fromkeys(measure.workload for measure in self.measures))

    def parse(self, argv: Sequence[str] | None) -> argparse.Namespace:
        """Parse the options."""
        parser = argparse.ArgumentParser(
            prog=f"python -m benchmarks {self.name}", description=self.description
        )
        parser.add_argument("--peers", action="store_true", help=self.peers_help)
        parser.add_argument(
            "--json", type=harness.output_file, metavar="FILE", help="write all raw samples"
        )
        parser.add_argument(
            "--quick", action="store_true", help="one short round: smoke, not figures"
        )
        parser.add_argument(
            "--rounds",
            type=harness.at_least_one,
            metavar="N",
            help=f"default {self.rounds}; 1 with --quick",
        )
        if self.seconds is not None:
            parser.add_argument(
                "--seconds",
                type=harness.positive,
                metavar="N",
                help=f"length of a run, default {self.seconds:g}; {QUICK_S:g} with --quick",
            )
        parser.add_argument(
            "--calm",
            type=float,
            default=100.0,
            metavar="PERCENT",
            help="repeat runs during which other processes used more than this of all CPUs",
        )
        parser.add_argument("--markdown", action="store_true", help="print the table as Markdown")
        parser.add_argument(
            "--only",
            nargs="+",
            choices=self.workloads,
            default=self.workloads,
            metavar="WORKLOAD",
            help=f"run only these: {', '.join(self.workloads)}",
        )
        options = parser.parse_args(argv)
        if options.rounds is None:
            options.rounds = 1 if options.quick else self.rounds
        if self.seconds is not None and options.seconds is None:
            options.seconds = QUICK_S if options.quick else self.seconds
        return options

    def report(
        self,
        runs: Sequence[ChildRun],
        contenders: Sequence[str],
        facts: Mapping[str, str],
        *,
        only: Sequence[str],
        markdown: bool,
    ) -> str:
        """Return the printed result: facts, table, and how to read it."""
        measures = [measure for measure in self.measures if measure.workload in only]
        rows = harness.table_rows(runs, measures, contenders)
        table = harness.render_markdown(rows) if markdown else harness.render_text(rows)
        lines = harness.describe(runs, facts)
        rounds = max((run.round for run in runs), default=0)
        notes = f"Figures are medians over {rounds} round{'s' if rounds != 1 else ''}"
        notes += " (lowest-highest round)." if rounds > 1 else "."
        if len(contenders) > 1:
            notes += " ratio = this package / peer."
        notes = "\n".join([f"{notes} {self.reading}", *harness.failures(runs)])
        head = "  \n".join(lines) if markdown else "\n".join(lines)
        return f"{head}\n\n{table}\n\n{notes}"

    def main(self, argv: Sequence[str] | None = None) -> int:
        """Run the benchmark and return 0 if every workload of this package delivered samples."""
        options = self.parse(argv)
        facts = harness.machine_facts()
        try:
            contenders = self.contenders(with_peers=options.peers)
        except peers.PeerError as error:
            print(error, file=sys.stderr)
            return 2
        if self.seconds is not None:
            contenders = [lasting(contender, options.seconds) for contender in contenders]
        runs = harness.run_rounds(
            contenders,
            options.only,
            rounds=options.rounds,
            quick=options.quick,
            max_other_load_percent=options.calm,
            progress=lambda line: print(line, file=sys.stderr, flush=True),
        )
        labels = [contender.label for contender in contenders]
        print(self.report(runs, labels, facts, only=options.only, markdown=options.markdown))
        if options.json is not None:
            document = {
                "facts": facts,
                "quick": options.quick,
                "runs": [asdict(run) for run in runs],
            }
            options.json.write_text(json.dumps(document, indent=1), encoding="utf-8")
        return 1 if any(run.error for run in runs if run.contender == OURS) else 0
