"""Drive a warehouse AGV whose planner burns 40 ms in ten ticks a second: does the motor keep 1 kHz?

The seven nodes of the contract's example, run by this package and by what else there is, in turn;
then how fast this package hands on the baton, stops in an emergency and notices a frozen node.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmarks import agv_report, cyclictest, harness, peers
from benchmarks.agv_report import CYCLICTEST
from benchmarks.agv_workloads.scenario import MARGIN_S, MODES, REACTIONS, SOAK, WARMUP_S
from benchmarks.harness import OURS, ChildRun, Contender

CHILDREN = Path(__file__).resolve().with_name("agv_workloads")
WORKLOADS = (*MODES, *REACTIONS)
START_AND_END_S = 90.0
"""How long a child may take beyond what it measures [s]."""
THREADS, UVLOOP = "plain threads", "asyncio on uvloop"

NOTES = (
    "Latencies are from a tick's release to its first statement; - where the contender does not "
    "tell the release. Early ones are negative. Counts are per 5 s.",
    "An order violation is a motor tick with no safety tick completed since the motor tick before; "
    "dora-rs offers no order, its nodes are processes, the planner in every mode.",
    "Only this package moves a single node to a process of its own.",
)

OVER_ROUNDS = (
    "Figures are medians over {} rounds (lowest-highest round). Of maxima, longest gaps, order "
    "violations and worst reactions, the worst round counts."
)


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    """Parse the options of this benchmark."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks agv", description=__doc__)
    parser.add_argument(
        "--peers",
        action="store_true",
        help=f"measure {peers.HORUS_ROBOTICS.requirement} and {peers.DORA.requirement}, in "
        "environments made in .bench/, plain threads, and asyncio tasks on uvloop, too",
    )
    count = harness.at_least_one
    parser.add_argument(
        "--seconds",
        type=harness.positive,
        default=5.0,
        metavar="N",
        help="length of a run, default 5",
    )
    parser.add_argument("--rounds", type=count, default=3, metavar="N", help="default 3")
    parser.add_argument(
        "--calm",
        type=float,
        default=100.0,
        metavar="PERCENT",
        help="repeat runs during which other processes used more than this of all CPUs",
    )
    _add_outputs(parser)
    parser.add_argument(
        "--only",
        nargs="+",
        choices=WORKLOADS,
        default=WORKLOADS,
        metavar="WORKLOAD",
        help=f"run only these: {', '.join(WORKLOADS)}",
    )
    parser.add_argument(
        "--soak",
        type=harness.positive,
        metavar="MINUTES",
        help="instead of everything else, run a healthy schedule under a watchdog for so long",
    )
    return parser.parse_args(argv)


def _add_outputs(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--markdown", action="store_true", help="print the tables as Markdown")
    parser.add_argument(
        "--json", type=harness.output_file, metavar="FILE", help="write all raw samples"
    )
    parser.add_argument(
        "--plot",
        type=harness.output_file,
        metavar="FILE",
        help="draw the latency histograms, e.g. agv.bench.png",
    )


def our_contender(seconds: float) -> Contender:
    """Return this package as it is in the checkout, run for ``seconds`` [s]."""
    return Contender(
        label=OURS,
        python=Path(sys.executable),
        import_root=harness.REPOSITORY,
        script=CHILDREN,
        arguments=("--contender", "horus", "--seconds", str(seconds)),
        timeout_s=WARMUP_S + seconds + MARGIN_S + START_AND_END_S,
    )


def takes_part(label: str, mode: str) -> bool:
    """Return whether a contender drives in this mode.

    Where else than in a thread the planner can run is this package's matter, for which cyclictest
    tells what the machine allows.
    """
    return label in (OURS, CYCLICTEST) or MODES[mode].compute is True


def other_contender(label: str, python: Path, key: str, seconds: float) -> Contender:
    """Return one that drives the AGV and nothing else; ``key`` is the children's name for it."""
    return Contender(
        label=label,
        python=python,
        script=CHILDREN,
        arguments=("--contender", key, "--seconds", str(seconds)),
        timeout_s=WARMUP_S + seconds + MARGIN_S + START_AND_END_S,
        workloads=tuple(mode for mode in MODES if takes_part(label, mode)),
    )


def find_contenders(seconds: float, *, with_peers: bool) -> tuple[list[Contender], dict[str, str]]:
    """Return who can be run, and who cannot with the reason, in the order of the tables."""
    found = [our_contender(seconds)]
    missing: dict[str, str] = {}
    if with_peers:
        for peer, key in ((peers.HORUS_ROBOTICS, "horus"), (peers.DORA, "dora")):
            try:
                found.append(other_contender(peer.label, peer.interpreter(), key, seconds))
            except peers.PeerError as error:
                missing[peer.label] = str(error)
        here = Path(sys.executable)
        found.append(other_contender(THREADS, here, "threads", seconds))
        found.append(other_contender(UVLOOP, here, "uvloop", seconds))
    if cyclictest.find() is None:
        missing[CYCLICTEST] = cyclictest.NOT_INSTALLED
    else:
        found.append(
            Contender(
                label=CYCLICTEST,
                python=Path(sys.executable),
                script=Path(cyclictest.__file__),
                arguments=("--seconds", str(seconds)),
                timeout_s=seconds + START_AND_END_S,
                workloads=tuple(MODES),
            )
        )
    return found, missing


def report(
    runs: Sequence[ChildRun],
    missing: Mapping[str, str],
    facts: Mapping[str, str],
    *,
    markdown: bool,
) -> str:
    """Return the printed result: facts, a table per mode, reactions, targets, how to read it."""
    render = harness.render_markdown if markdown else harness.render_text
    ran = {run.workload for run in runs}
    sections = [("  \n" if markdown else "\n").join(head_lines(runs, facts))]
    for mode in MODES:
        if mode in ran:
            labels = dict.fromkeys(run.contender for run in runs if run.workload == mode)
            absent = [label for label in missing if takes_part(label, mode)]
            rows = agv_report.agv_rows(runs, mode, [*labels, *absent])
            sections.append(render(rows))
    if not ran.isdisjoint(MODES):
        sections.append("\n".join(NOTES))
    measures = [each for each in agv_report.REACTION_MEASURES if each.workload in ran]
    if measures:
        # Their targets are in the next table.
        _, *rows = (row[:3] for row in harness.table_rows(runs, measures, [OURS]))
        sections.append(render([("reaction", "unit", OURS), *rows]))
    sections.append(render(agv_report.target_rows(runs)))
    rounds = max((run.round for run in runs), default=0)
    ending = [OVER_ROUNDS.format(rounds)] if rounds > 1 else []
    ending += [f"{label}: {why}" for label, why in missing.items()]
    sections.append("\n".join([*ending, *harness.failures(runs)]))
    return "\n\n".join(sections)


def head_lines(runs: Sequence[ChildRun], facts: Mapping[str, str]) -> list[str]:
    """Return facts about machine and contenders, and what the system refused them."""
    key = "refused by the system"
    refused = {run.contender: run.package[key] for run in runs if key in run.package}
    return [
        *harness.describe(runs, facts),
        *(f"{key} to {label}: {what}" for label, what in refused.items()),
    ]


def document(
    runs: Sequence[ChildRun], missing: Mapping[str, str], facts: Mapping[str, str], seconds: float
) -> dict[str, Any]:
    """Return everything as JSON takes it: facts, targets, and each run raw and reduced."""
    entries = []
    for run in runs:
        entry = asdict(run)
        if run.workload in MODES and run.error is None:
            entry["figures"] = asdict(agv_report.motor_figures(run.series))
        entries.append(entry)
    targets = []
    for verdict in agv_report.verdicts(runs):
        figure = asdict(verdict.figure)
        # JSON has no word for a figure that was not measured, but null.
        figure = {key: value if math.isfinite(value) else None for key, value in figure.items()}
        targets.append({**asdict(verdict), "figure": figure, "met": verdict.met})
    return {
        "facts": facts,
        "seconds": seconds,
        "missing": missing,
        "targets": targets,
        "runs": entries,
    }


def soak(options: argparse.Namespace, facts: Mapping[str, str]) -> int:
    """Run the soak, print its table, and return 0 if it ran and nothing was reported frozen."""
    seconds = 60.0 * options.soak
    _progress(f"soak  {options.soak:g} min")
    run = harness.run_child(our_contender(seconds), SOAK, round_number=1, quick=False)
    measures = agv_report.soak_measures(list(run.series), seconds)
    rows = harness.table_rows([run], measures, [OURS])
    table = harness.render_markdown(rows) if options.markdown else harness.render_text(rows)
    print("\n".join([*harness.describe([run], facts), "", table, *harness.failures([run])]))
    if options.json is not None:
        whole = {"facts": facts, "seconds": seconds, "runs": [asdict(run)]}
        options.json.write_text(json.dumps(whole), encoding="utf-8")
    return 0 if run.error is None and run.series["watchdog_expirations"][0] == 0 else 1


def _progress(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark and return 0 if every workload of this package delivered samples."""
    options = parse(argv)
    if options.plot is not None and importlib.util.find_spec("matplotlib") is None:
        _progress("without --plot: matplotlib is not installed (pip install -e '.[examples]')")
        options.plot = None
    facts = harness.machine_facts()
    if options.soak is not None:
        return soak(options, facts)
    contenders, missing = find_contenders(options.seconds, with_peers=options.peers)
    for label, why in missing.items():
        _progress(f"without {label}: {why}")
    runs = harness.run_rounds(
        contenders,
        options.only,
        rounds=options.rounds,
        quick=False,
        max_other_load_percent=options.calm,
        progress=_progress,
    )
    print(report(runs, missing, facts, markdown=options.markdown))
    if options.json is not None:
        whole = document(runs, missing, facts, options.seconds)
        options.json.write_text(json.dumps(whole), encoding="utf-8")
    if options.plot is not None:
        from benchmarks.agv_plot import draw

        draw(runs, options.plot)
    return 1 if any(run.error for run in runs if run.contender == OURS) else 0
