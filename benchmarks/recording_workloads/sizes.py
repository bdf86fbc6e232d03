"""How much of each workload to run, which does not change what is run."""

from __future__ import annotations

from dataclasses import dataclass

Series = dict[str, list[float]]
"""Raw samples of one child run, by series name; the unit is the suffix of the name."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Size:
    """How much of each workload to run, beside what takes the seconds that are asked for."""

    pairs: int
    """How often a run without and one with recording are measured."""
    blocks: int
    """How often the costs of each variant are measured."""
    bursts: int
    """Bursts of a block."""
    writes: int
    """How often a file is written as fast as possible."""
    write_messages: int
    replay_messages: int
    recover_mb: float
    telemetry_cycles: int
    """How often the CPU time without and with telemetry is measured."""
    telemetry_settle_s: float
    """Time after the start until the window opens [s]: libraries are loaded, a snapshot is sent."""
    telemetry_window_s: float
    aged_ticks: int
    """What the counters have seen of a program that has run for long."""


FULL = Size(
    pairs=4,
    blocks=10,
    bursts=10,
    writes=5,
    write_messages=60_000,
    replay_messages=200_000,
    recover_mb=100.0,
    telemetry_cycles=3,
    telemetry_settle_s=1.5,
    telemetry_window_s=4.0,
    aged_ticks=9_000,
)
QUICK = Size(
    pairs=1,
    blocks=1,
    bursts=3,
    writes=1,
    write_messages=5_000,
    replay_messages=10_000,
    recover_mb=2.0,
    telemetry_cycles=1,
    telemetry_settle_s=0.5,
    telemetry_window_s=0.5,
    aged_ticks=1_000,
)
