"""The commands of `python -m horus`: list, describe, read, recover and compare recordings."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import msgspec

from horus.errors import RecordingError
from horus.recording import diff, recovery, sessions
from horus.recording.scribe import EXACT
from horus.timing import FOREVER_NS
from horus.units import NS_PER_S

_LEVELS = {1: "DEBUG", 2: "INFO", 3: "WARNING", 4: "ERROR", 5: "CRITICAL"}
"""Of foxglove.Log."""


def main(arguments: list[str] | None = None) -> int:
    """Run a command; return its exit code: 0, 1 for what `diff` found, 2 for an error."""
    options = _parser().parse_args(arguments)
    try:
        code: int = options.command(options)
    except RecordingError as exc:
        print(f"horus: {exc}", file=sys.stderr)
        return 2
    except BrokenPipeError:  # the reader has seen enough
        sys.stderr.close()
        return 0
    return code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m horus", description="Recordings of horus: MCAP files."
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def command(name: str, function: Any, what: str) -> argparse.ArgumentParser:
        added = commands.add_parser(name, help=what, description=what)
        added.set_defaults(command=function)
        added.add_argument("--json", action="store_true", help="print JSON, for machines")
        return added

    listing = command("recordings", _list, "List the recorded sessions, the oldest first.")
    listing.add_argument(
        "directory",
        nargs="?",
        type=Path,
        help="where they are; without it, HORUS_HOME/recordings or the user's data directory",
    )
    info = command("info", _info, "Say what is in a recording.")
    info.add_argument("recording", type=Path)
    log = command("log", _log, "Print what was logged and what changed, in the order of time.")
    log.add_argument("recording", type=Path)
    recover = command("recover", _recover, "Salvage recordings whose process has died.")
    recover.add_argument("recordings", nargs="+", type=Path, metavar="recording")
    comparing = command(
        "diff", _diff, "Name the first message in which two recordings differ; exit code 1 if so."
    )
    comparing.add_argument("a", type=Path)
    comparing.add_argument("b", type=Path)
    comparing.add_argument(
        "--topic", action="append", dest="topics", help="compare only this one; may be repeated"
    )
    return parser


def _list(options: argparse.Namespace) -> int:
    found = sessions.sessions(options.directory or sessions.default_directory())
    rows: list[dict[str, Any]] = [
        {
            "name": str(session),
            "state": session.state,
            "bytes": session.path.stat().st_size,
            "path": str(session.path),
        }
        for session in found
    ]
    if options.json:
        _print_json(rows)
    else:
        _print_table(
            ["session", "state", "size", "file"],
            ([row["name"], row["state"], _size(row["bytes"]), row["path"]] for row in rows),
        )
    return 0


def _info(options: argparse.Namespace) -> int:
    counts: dict[tuple[str, str], int] = {}
    nodes: dict[str, dict[str, Any]] = {}
    events: list[dict[str, Any]] = []
    first_ns, last_ns = FOREVER_NS, 0
    with recovery.open_recording(options.recording) as reader:
        for entry in reader.entries():
            first_ns, last_ns = min(first_ns, entry.log_ns), max(last_ns, entry.log_ns)
            channel = entry.channel
            if channel.message_encoding == EXACT:
                key = (channel.topic, channel.metadata.get("publisher", ""))
                counts[key] = counts.get(key, 0) + 1
            elif channel.topic == "horus/nodes":
                node = reader.json_of(entry.data, channel.topic)
                nodes[node["name"]] = node
            elif channel.topic == "horus/events":
                events.append(reader.json_of(entry.data, channel.topic))
        about = reader.about
    duration_s = max(0, last_ns - first_ns) / NS_PER_S
    topics: list[dict[str, Any]] = [
        {"topic": topic, "publisher": publisher, "messages": count}
        for (topic, publisher), count in sorted(counts.items())
    ]
    if options.json:
        content = {"scheduler": about, "duration_s": duration_s, "topics": topics}
        _print_json({**content, "nodes": list(nodes.values()), "events": events})
        return 0
    kind = "virtual time" if about["deterministic"] else "real time"
    print(f"{options.recording}: {about['name']}, {duration_s:.3f} s of {kind}")
    print(f"{about['tick_rate_hz']:g} Hz, horus {about['horus']}, Python {about['python']}\n")
    _print_table(
        ["topic", "sent by", "messages", "a second"],
        (
            [
                row["topic"],
                row["publisher"],
                str(row["messages"]),
                f"{row['messages'] / duration_s:.1f}" if duration_s else "",
            ]
            for row in topics
        ),
    )
    print()
    _print_table(
        ["node", "class", "Hz", "order"],
        (
            [
                node["name"],
                node["execution_class"],
                "" if node["on"] else f"{node['rate_hz']:g}",
                str(node["order"]),
            ]
            for node in nodes.values()
        ),
    )
    for event in events:
        if event["kind"] == "lost":
            print(f"\n{event['text']}")
    return 0


def _log(options: argparse.Namespace) -> int:
    rows: list[dict[str, Any]] = []
    with recovery.open_recording(options.recording) as reader:
        began_ns = reader.about["log_ns"]
        for entry in reader.entries():
            # A flight recorder writes the configuration again and again, the last time here.
            began_ns = min(began_ns, entry.log_ns)
            topic = entry.channel.topic
            if topic == "horus/log":
                said = reader.json_of(entry.data, topic)
                row = {"kind": _LEVELS.get(said["level"], "LOG"), "text": _with_node(said)}
            elif topic == "horus/events":
                change = reader.json_of(entry.data, topic)
                subject = f"{change['node']}: " if change["node"] else ""
                row = {"kind": change["kind"], "text": f"{subject}{change['text']}"}
            else:
                continue
            rows.append({"log_ns": entry.log_ns, **row})
    if options.json:
        _print_json(rows)
        return 0
    for row in rows:
        stamp = f"{(row['log_ns'] - began_ns) / NS_PER_S:10.3f} s  {row['kind']:10}  "
        print(stamp + row["text"].replace("\n", "\n" + " " * len(stamp)))
    return 0


def _with_node(said: dict[str, Any]) -> str:
    """Return a log record's text with the node, which it does not name if it is the node's own."""
    text: str = said["message"]
    node = said["name"].removeprefix("horus.node.")
    own = node != said["name"] and not text.startswith(f"{node}: ")
    return f"{node}: {text}" if own else text


def _recover(options: argparse.Namespace) -> int:
    for path in options.recordings:
        recovery_ = recovery.recover(path)
        if options.json:
            _print_json({**asdict(recovery_), "path": str(path)})
        else:
            print(recovery_)
    return 0


def _diff(options: argparse.Namespace) -> int:
    found = diff.diff(options.a, options.b, topics=options.topics)
    if options.json:
        _print_json(None if found is None else {**asdict(found), "text": str(found)})
    else:
        print("no difference" if found is None else found)
    return 0 if found is None else 1


def _size(count: int) -> str:
    return f"{count / 1e6:.1f} MB" if count >= 1e6 else f"{count / 1e3:.1f} kB"


def _print_json(content: Any) -> None:
    print(msgspec.json.encode(content, enc_hook=repr).decode())


def _print_table(titles: list[str], rows: Iterable[list[str]]) -> None:
    table = [titles, *rows]
    widths = [max(len(row[column]) for row in table) for column in range(len(titles))]
    for row in table:
        cells = (cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        print("  ".join(cells).rstrip())
