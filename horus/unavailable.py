"""What the contract names and this version does not have: said plainly, never pretended."""

from __future__ import annotations

from typing import NoReturn

from horus.errors import StateError, UnavailableWarning, warn_user
from horus.spec import NodeSpec, SchedulerSpec


def warn_of_scheduler(spec: SchedulerSpec) -> None:
    """Warn of the arguments of a scheduler that have no effect."""
    for asked, argument, consequence in (
        (spec.rt, "rt=True", "nodes run with ordinary priority; see degradations()"),
        (spec.cores, "cores=", "threads may run on any core"),
        (spec.watchdog_ns, "watchdog_ms=", "frozen nodes are not detected"),
        (spec.blackbox_mb, "blackbox_mb=", "there is no flight recorder"),
        (spec.recording, "recording=True", "nothing is recorded"),
        (spec.telemetry, "telemetry=", "no metrics are sent"),
    ):
        if asked:
            warn(argument, consequence)


def warn_of_node(spec: NodeSpec) -> None:
    """Warn of the arguments of a node that have no effect."""
    for asked, argument, consequence in (
        (spec.watchdog_ns, "watchdog=", "a frozen tick is not detected"),
        (spec.priority, "priority=", "its thread has ordinary priority"),
        (spec.core is not None, "core=", "its thread may run on any core"),
    ):
        if asked:
            warn(f"{argument} of node {spec.name!r}", consequence)


def warn(feature: str, consequence: str) -> None:
    """Warn that a feature has no effect."""
    warn_user(f"{feature} is not part of this version: {consequence}", UnavailableWarning)


def refuse_recording(what: str) -> NoReturn:
    """Raise because nothing is ever recorded.

    Raises:
        StateError: Always.
    """
    raise StateError(f"recording is not part of this version; there is no {what}")


def degradations(spec: SchedulerSpec, nodes: list[NodeSpec]) -> list[str]:
    """Return what was requested and could not be had, in readable sentences."""
    missing = []
    if spec.rt:
        missing.append("SCHED_FIFO is not part of this version - using SCHED_OTHER")
        missing.append("mlockall is not part of this version - memory pages may be swapped")
    if spec.cores is not None:
        missing.append("cores= is not part of this version - threads may run on any core")
    for node in nodes:
        if node.core is not None:
            missing.append(f"node {node.name!r} is not pinned to core {node.core}")
        if node.priority is not None:
            missing.append(f"node {node.name!r} does not have priority {node.priority}")
    return missing
