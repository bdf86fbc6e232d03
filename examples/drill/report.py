"""What the drills print: a timeline each and a table of all, or JSON."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable
from typing import Any

from drill.bench import Check, Record
from drill.observer import SYSTEM, Event
from drill.robot import PARTS
from horus import ms

_WIDTH = 112


def robot(nodes: Iterable[dict[str, Any]]) -> str:
    """Return a table of the robot's nodes."""
    kinds = {part.name: kind for kind, part in PARTS.items()}
    lines = ["order  node      execution class  released       --class"]
    for one in nodes:
        kind = kinds.get(one["name"])
        topic = PARTS[kind].arguments.get("on") if kind else None
        released = f"by {topic!r}" if topic else f"at {one['rate']:g} Hz"
        lines.append(
            f"{one['order']:5}  {one['name']:8}  {one['execution_class']:15}  {released:13}  "
            + (kind or "-")
        )
    return "\n".join(lines)


def timeline(record: Record) -> str:
    """Return what happened in a drill, line by line, beside what was expected."""
    title = f"\n{record.fault} {record.machine} {record.variant}  [{record.kind}]"
    lines = [title, f"{'time':>12}  {'expected':20}node     event"]
    expected = {id(check.event): check.expected for check in record.checks if check.event}
    lines += [
        line(event, event.at_s - record.struck_s, expected.get(id(event), ""))
        for event in record.events
    ]
    confirmed = [check for check in record.checks if check.due_s is None]
    if confirmed:
        words = ", ".join(f"{check.what}: {_yes(check)}" for check in confirmed)
        lines.append(f"{'':14}{words}")
    for check in record.checks:
        if check.due_s is not None and not check.passed:
            when = "never happened" if check.event is None else "came too early"
            lines.append(f"{'FAILED':>12}  {check.what} {when}, expected: {check.expected}")
    return "\n".join(lines)


def line(event: Event, after_s: float, expected: str = "") -> str:
    """Return an event as a line of a timeline, wrapped."""
    node = "" if event.node == SYSTEM else event.node
    head = f"{after_s / ms:9.1f} ms  {expected:20}{node:8} {event.kind:<8} "
    where = f"; in {event.place}" if event.place else ""
    return "\n".join(
        textwrap.wrap(
            event.text + where,
            _WIDTH,
            initial_indent=head,
            subsequent_indent=" " * len(head),
            break_on_hyphens=False,
        )
    )


def summary(records: list[Record]) -> str:
    """Return a table: a row for everything that should happen, a column for each class."""
    kinds = list(dict.fromkeys(record.kind for record in records))
    sections: dict[str, dict[tuple[str, str], dict[str, Check]]] = {}
    for record in records:
        rows = sections.setdefault(f"{record.fault} {record.variant}", {})
        for check in record.checks:
            rows.setdefault((check.what, check.expected), {})[record.kind] = check
    lines = [f"{'':28}{'expected':20}{''.join(f'{kind:<13}' for kind in kinds)}".rstrip()]
    for section, rows in sections.items():
        lines.append(section)
        for (what, expected), checks in rows.items():
            cells = "".join(f"{_cell(checks.get(kind)):<13}" for kind in kinds)
            lines.append(f"  {what:26}{expected:20}{cells}".rstrip())
    return "\n".join(lines)


def verdict(records: list[Record]) -> str:
    """Return how many things happened that should, and which did not."""
    checks = [check for record in records for check in record.checks]
    lines = ["times in ms since the fault; with + since the command before"]
    if any(check.late for check in checks):
        lines.append("*  more than 10 % + 5 ms late: the machine was busy")
    lines += [
        f"FAILED  {record.fault} {record.machine} {record.variant}: {check.what}"
        for record in records
        for check in record.checks
        if not check.passed
    ]
    passed = sum(check.passed for check in checks)
    lines.append(f"{passed} of {len(checks)} things happened that should")
    return "\n".join(lines)


def as_json(records: list[Record]) -> dict[str, Any]:
    """Return everything as numbers and words; times in milliseconds."""
    return {
        "passed": all(record.passed for record in records),
        "drills": [
            {
                "class": record.kind,
                "node": record.machine,
                "fault": record.fault,
                "variant": record.variant,
                "passed": record.passed,
                "checks": [
                    {
                        "what": check.what,
                        "expected": check.expected,
                        "expected_ms": _ms(check.due_s),
                        "observed_ms": _ms(check.observed_s),
                        "passed": check.passed,
                        "late": check.late,
                    }
                    for check in record.checks
                ],
                "events": [
                    {
                        "at_ms": _ms(event.at_s - record.struck_s),
                        "node": event.node,
                        "kind": event.kind,
                        "text": event.text,
                        "place": event.place,
                    }
                    for event in record.events
                ],
            }
            for record in records
        ],
    }


def _cell(check: Check | None) -> str:
    if check is None:
        return "-"
    if check.due_s is None:
        return _yes(check)
    if check.observed_s is None:
        return "NEVER"
    mark = "" if check.passed else " EARLY"
    return f"{check.observed_s / ms:5.1f}{mark or ' *' * check.late}"


def _yes(check: Check) -> str:
    return "yes" if check.passed else "NO"


def _ms(seconds: float | None) -> float | None:
    return None if seconds is None else round(seconds / ms, 3)
