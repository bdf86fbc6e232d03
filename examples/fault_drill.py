"""Fault drill: nodes of every class freeze, raise and overrun on command. What happens then?

    python examples/fault_drill.py                                # all drills, about 12 s
    python examples/fault_drill.py --class rt --fault freeze      # some of them
    python examples/fault_drill.py --interactive                  # "freeze motor", "clear", ...
    python examples/fault_drill.py --plot fault_drill.png         # and a picture

A robot of seven nodes runs with a watchdog of 150 ms. One node after the other freezes (its tick
does not return), raises and overruns (its tick takes longer than its budget), each with the
policies that there are for it. The drill watches the way any program can: by the log, the nodes'
safe-state hooks, `get_all_nodes()`. It prints what happened and when, beside what should have
happened, and the exit code is 0 if all of it did. How late something came is shown, and
does not count: that depends on the machine.

    order  node      execution class  released       --class
        0  buttons   Rt               at 20 Hz       -
       10  estop     Event            by 'bumper'    urgent, on a thread of its own
       20  motor     Rt               at 50 Hz       rt
       40  gripper   Event            by 'grip'      event, on the event loop
       50  planner   Compute          at 20 Hz       compute
       60  camera    BestEffort       at 30 Hz       best_effort, on the event loop
      200  cloud     AsyncIo          at 20 Hz       async

The first drill that it prints; a message names the line that the frozen tick is in:

            time  expected            node     event
          0.0 ms                      motor    fault    its tick does not return
        151.2 ms  150 ms              motor    WARNING  warning: its tick has been running for ...
        301.2 ms  300 ms              motor    ERROR    unhealthy: its tick has been running for ...
        451.1 ms  450 ms              motor    hook     enter_safe_state() is called
        451.4 ms  450 ms              motor    ERROR    isolated: its tick has been running for ...
        451.5 ms                               command  the device answers at last
        451.6 ms  +0 ms               motor    WARNING  its frozen tick has ended; ...
        451.7 ms                      motor    WARNING  exceeded its deadline of 19.00 ms by ...
        555.0 ms                               command  clear_safe_state()
        555.1 ms                               WARNING  safe state cleared
        560.0 ms  +next release       motor    tick     ticks again
                  held: yes, nobody else blamed: yes, cleared: yes

From the table at the end, which has a column for each class:

                                expected            rt           best_effort  event
    freeze as a critical node
      safe state entered        75 ms                75.9         76.6         76.1
      every hook called         75 ms + hooks        77.1        126.7        126.9
      in shutdown order         yes                 yes          yes          yes
      cannot be cleared yet     yes                 yes          yes          yes
"""

from __future__ import annotations

import argparse
import json
import logging
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from drill import report
from drill.bench import Bench, Record, RunEndedError
from drill.console import HELP, Console
from drill.drills import DRILLS
from drill.observer import Observer
from drill.robot import PARTS, Robot


def run_drills(bench: Bench, kinds: list[str], faults: list[str]) -> None:
    """Run drills one after another, then stop the robot."""
    try:
        for kind in kinds:
            for fault in faults:
                for drill in DRILLS[fault]:
                    drill(bench, kind)
    finally:
        bench.robot.scheduler.stop("the drills are over")


def run_robot(robot: Robot, beside: Callable[[], None]) -> None:
    """Run the robot here, and on a thread what goes on beside it and stops it in the end."""
    with ThreadPoolExecutor(1, thread_name_prefix="drill") as pool:
        conduct = pool.submit(beside)
        robot.scheduler.run()
        conduct.result()


def draw(out: Path, observer: Observer, records: list[Record]) -> None:
    """Write the picture, if there is something to draw it with."""
    try:
        from drill import picture
    except ImportError as error:
        print(f"no picture: {error}", file=sys.stderr)
        return
    picture.draw(out, observer, records)
    print(f"picture: {out}", file=sys.stderr)


def parser() -> argparse.ArgumentParser:
    """Return what the command line understands."""
    result = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    add = result.add_argument
    add("--class", dest="kinds", action="append", choices=PARTS, help="drill this class only")
    add("--fault", dest="faults", action="append", choices=DRILLS, help="drill this fault only")
    add("--interactive", action="store_true", help="take commands from the standard input")
    add("--json", action="store_true", help="print the result as JSON, and nothing else")
    add("--plot", type=Path, metavar="PNG", help="draw what happened")
    return result


def main(argv: list[str] | None = None) -> int:
    """Run the example from the command line; return its exit code."""
    command_line = parser()
    args = command_line.parse_args(argv)
    if args.interactive and (args.json or args.kinds or args.faults):
        command_line.error("--interactive takes its faults from the standard input")

    observer = Observer()
    log = logging.getLogger("horus")
    log.addHandler(observer)
    log.setLevel(logging.INFO)
    robot = Robot(observer)
    records: list[Record] = []
    passed = True

    def show(record: Record) -> None:
        records.append(record)
        if not args.json:
            print(report.timeline(record), flush=True)

    if args.interactive:
        console = Console(robot, observer)
        print(f"{report.robot(robot.scheduler.get_all_nodes())}\n\n{HELP}\n", flush=True)
        run_robot(robot, console.converse)
    else:
        if not args.json:
            print(report.robot(robot.scheduler.get_all_nodes()))
        bench = Bench(robot, observer, show)
        kinds, faults = args.kinds or list(PARTS), args.faults or list(DRILLS)
        try:
            run_robot(robot, lambda: run_drills(bench, kinds, faults))
        except RunEndedError:
            print(f"not complete: {robot.scheduler.stop_reason}", file=sys.stderr)
            passed = False
        if args.json:
            print(json.dumps(report.as_json(records), indent=2))
        else:
            print(f"\n{report.summary(records)}\n\n{report.verdict(records)}")
    if args.plot is not None:
        draw(args.plot, observer, records)
    return 0 if passed and all(record.passed for record in records) else 1


if __name__ == "__main__":
    sys.exit(main())
