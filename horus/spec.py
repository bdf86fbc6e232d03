"""What a node and a scheduler are configured to be: validated, frozen, in nanoseconds.

The public edge takes seconds and Hz. They are checked and converted here, once;
everything below works on the integers.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path

from horus.endpoint import Endpoint, parse_endpoint
from horus.errors import ConfigError, ConfigWarning, warn_user
from horus.timing import period_ns
from horus.units import NS_PER_MS, NS_PER_S, NS_PER_US, readable
from horus.validation import (
    check_compute,
    check_core,
    check_cores,
    check_count,
    check_duration,
    check_flag,
    check_name,
    check_priority,
    check_rate,
    check_topic,
    is_int,
    is_number,
    member,
    optional_duration,
)

DEFAULT_RATE_HZ = 30.0
AUTO_BUDGET = 0.80
AUTO_DEADLINE = 0.95
DEFAULT_SPIN_US, LONGEST_SPIN_US = 200, 1000
_SUSPICIOUS_LIMIT_NS = 60 * NS_PER_S


class ExecutionClass(StrEnum):
    """Where a node runs; inferred from its configuration, never set."""

    BEST_EFFORT = "BestEffort"
    """Sequentially in order on the event loop."""
    EVENT = "Event"
    """Once per message of its trigger topic."""
    ASYNC_IO = "AsyncIo"
    """A coroutine on the event loop."""
    RT = "Rt"
    """A dedicated thread on the absolute release grid."""
    COMPUTE = "Compute"
    """A worker thread of the compute pool, for CPU-heavy work."""


class Miss(StrEnum):
    """What happens when a tick exceeds its budget or its deadline."""

    WARN = "warn"
    """Log a warning and continue."""
    SKIP = "skip"
    """Drop exactly the next release."""
    SAFE_MODE = "safe_mode"
    """Call the node's safe-state hook, once per episode."""
    STOP = "stop"
    """Stop the scheduler in order."""


class FailurePolicy(StrEnum):
    """What happens when a tick raises."""

    FATAL = "fatal"
    """Stop the scheduler in order; `run()` raises `NodeError`."""
    RESTART = "restart"
    """Run `init()` again, with exponential back-off, then resume."""
    SKIP = "skip"
    """Log a warning and try again at the next release."""
    IGNORE = "ignore"
    """Log the error and continue."""


class NodeState(StrEnum):
    """Where a node is in its life."""

    UNINITIALIZED = "uninitialized"
    """Added; `init()` has not run."""
    RUNNING = "running"
    """Initialised and ticking when released."""
    RESTARTING = "restarting"
    """A tick failed under `restart`; `init()` runs again after the back-off."""
    SAFE_STATE = "safe_state"
    """Held: it does not tick until `clear_safe_state()`."""
    ERROR = "error"
    """`init()` failed; the node is excluded from ticking."""
    STOPPING = "stopping"
    """`shutdown()` has been called for."""
    STOPPED = "stopped"
    """`shutdown()` has run."""


class Health(StrEnum):
    """What supervision thinks of a node."""

    HEALTHY = "healthy"
    """Its ticks finish."""
    WARNING = "warning"
    """A tick has lasted longer than the watchdog timeout."""
    UNHEALTHY = "unhealthy"
    """Longer than twice the timeout; its releases are skipped."""
    ISOLATED = "isolated"
    """Longer than three times the timeout; it is out of the schedule."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeSpec:
    """A node's validated configuration; see `Node` for the meaning of each argument."""

    name: str
    order: int
    rate_hz: float
    rate_given: bool
    budget_ns: int | None
    budget_given: bool
    deadline_ns: int | None
    deadline_given: bool
    on_miss: Miss
    failure_policy: FailurePolicy | None
    execution_class: ExecutionClass
    process: bool
    """Whether a compute node has a process of its own."""
    on: str | None
    priority: int | None
    core: int | None
    watchdog_ns: int | None

    @property
    def period_ns(self) -> int:
        """The period [ns]."""
        return period_ns(self.rate_hz)

    def with_rate(self, rate_hz: object) -> NodeSpec:
        """Return this spec at another rate, its automatic limits derived anew."""
        return _derive_limits(replace(self, rate_hz=check_rate(rate_hz)))

    def with_budget_ns(self, budget_ns: int) -> NodeSpec:
        """Return this spec with an explicit budget [ns]."""
        return _derive_limits(replace(self, budget_ns=budget_ns, budget_given=True))


def make_node_spec(
    *,
    name: object,
    is_async: bool,
    rate: object,
    order: object,
    budget: object,
    deadline: object,
    on_miss: object,
    failure_policy: object,
    compute: object,
    on: object,
    priority: object,
    core: object,
    watchdog: object,
) -> NodeSpec:
    """Validate a node's arguments and infer its execution class.

    Raises:
        ConfigError: An argument has a wrong type or value, or two exclude each other.
        TopicError: `on` is not a usable topic name.
    """
    checked_name = check_name("name", name)
    compute_kind, process = check_compute(compute)
    _refuse_combinations(compute_kind, on=on, is_async=is_async, rate=rate)
    if not is_int(order) or order < 0:
        raise ConfigError("order", order, "must be a whole number >= 0; lower runs earlier")
    spec = NodeSpec(
        name=checked_name,
        order=int(order),
        rate_hz=DEFAULT_RATE_HZ if rate is None else check_rate(rate),
        rate_given=rate is not None,
        budget_ns=optional_duration("budget", budget),
        budget_given=budget is not None,
        deadline_ns=optional_duration("deadline", deadline),
        deadline_given=deadline is not None,
        on_miss=Miss.WARN if on_miss is None else member(Miss, "on_miss", on_miss),
        failure_policy=None
        if failure_policy is None
        else member(FailurePolicy, "failure_policy", failure_policy),
        execution_class=_infer(
            compute=compute_kind,
            on=on,
            is_async=is_async,
            timed=any(limit is not None for limit in (rate, budget, deadline)),
        ),
        on=None if on is None else check_topic(on),
        process=process,
        priority=check_priority(priority),
        core=None if core is None else check_core("core", core),
        watchdog_ns=optional_duration("watchdog", watchdog),
    )
    _warn_about_units(spec)
    return _derive_limits(spec)


def _infer(*, compute: bool, on: object, is_async: bool, timed: bool) -> ExecutionClass:
    if compute:
        return ExecutionClass.COMPUTE
    if on is not None:
        return ExecutionClass.EVENT
    if is_async:
        return ExecutionClass.ASYNC_IO
    return ExecutionClass.RT if timed else ExecutionClass.BEST_EFFORT


def _refuse_combinations(compute: bool, *, on: object, is_async: bool, rate: object) -> None:
    if compute and on is not None:
        raise ConfigError(
            "on", on, "a compute node is released by its rate; drop compute= or drop on="
        )
    if compute and is_async:
        raise ConfigError(
            "compute", compute, "an async tick runs on the event loop; use a plain def tick"
        )
    if on is not None and rate is not None:
        raise ConfigError(
            "rate", rate, "an event node is released by messages of its topic, not by a rate"
        )


def _derive_limits(spec: NodeSpec) -> NodeSpec:
    """Fill in the automatic limits: 80 % and 95 % of the period, for nodes that are timed."""
    timed = spec.rate_given or spec.budget_given or spec.deadline_given
    if not timed or spec.execution_class is ExecutionClass.EVENT:
        return spec
    budget_ns, deadline_ns = spec.budget_ns, spec.deadline_ns
    if not spec.deadline_given:
        # A budget the author wrote may exceed 95 % of the period: the deadline
        # then follows it, or each tick within budget would be a miss.
        auto = int(spec.period_ns * AUTO_DEADLINE)
        deadline_ns = max(auto, budget_ns) if spec.budget_given and budget_ns else auto
    if not spec.budget_given:
        auto = int(spec.period_ns * AUTO_BUDGET)
        budget_ns = min(auto, deadline_ns) if spec.deadline_given and deadline_ns else auto
    return replace(spec, budget_ns=budget_ns, deadline_ns=deadline_ns)


def _warn_about_units(spec: NodeSpec) -> None:
    for argument, limit_ns in (("budget", spec.budget_ns), ("deadline", spec.deadline_ns)):
        if limit_ns is None:
            continue
        too_long = spec.rate_given and limit_ns > spec.period_ns + 1
        if too_long or limit_ns > _SUSPICIOUS_LIMIT_NS:
            beyond = (
                f"longer than its period of {readable(spec.period_ns)}"
                if too_long
                else "over a minute"
            )
            warn_user(
                f"node {spec.name!r}: {argument} is {readable(limit_ns)}, {beyond}; "
                f"limits are in seconds, write {argument}=300 * us for 300 microseconds",
                ConfigWarning,
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class SchedulerSpec:
    """A scheduler's validated configuration; see `Scheduler` for each argument."""

    name: str
    tick_rate_hz: float
    rt: bool
    deterministic: bool
    blackbox_mb: int
    watchdog_ns: int
    recording: bool
    recording_directory: Path | None
    """Where recordings go; None for the default."""
    recording_blocks: bool
    """Whether BestEffort nodes wait for a recording that does not keep up."""
    cores: tuple[int, ...] | None
    max_deadline_misses: int | None
    verbose: bool
    telemetry: Endpoint | None
    loop: str
    shutdown_timeout_ns: int
    spin_ns: int
    seed: int


def make_scheduler_spec(
    *,
    tick_rate: object,
    rt: object,
    deterministic: object,
    blackbox_mb: object,
    watchdog_ms: object,
    recording: object,
    recording_backpressure: object,
    name: object,
    cores: object,
    max_deadline_misses: object,
    verbose: object,
    telemetry: object,
    loop: object,
    shutdown_timeout: object,
    spin_us: object,
    seed: object,
) -> SchedulerSpec:
    """Validate a scheduler's arguments.

    Raises:
        ConfigError: An argument has a wrong type or value.
    """
    if loop not in ("uvloop", "asyncio"):
        raise ConfigError("loop", loop, "must be 'uvloop' or 'asyncio'")
    if recording_backpressure not in ("drop", "block"):
        raise ConfigError(
            "recording_backpressure", recording_backpressure, "must be 'drop' or 'block'"
        )
    directory = _directory(recording)
    return SchedulerSpec(
        name="horus" if name is None else check_name("name", name),
        tick_rate_hz=check_rate(tick_rate, "tick_rate"),
        rt=check_flag("rt", rt),
        deterministic=check_flag("deterministic", deterministic),
        blackbox_mb=check_count("blackbox_mb", blackbox_mb),
        watchdog_ns=check_count("watchdog_ms", watchdog_ms) * NS_PER_MS,
        recording=bool(recording),
        recording_directory=directory,
        recording_blocks=recording_backpressure == "block",
        cores=check_cores(cores),
        max_deadline_misses=None
        if max_deadline_misses is None
        else check_count("max_deadline_misses", max_deadline_misses, least=1),
        verbose=check_flag("verbose", verbose),
        telemetry=parse_endpoint(telemetry),
        loop=loop,
        shutdown_timeout_ns=check_duration("shutdown_timeout", shutdown_timeout),
        spin_ns=_spin_ns(spin_us, rt),
        seed=check_count("seed", seed),
    )


def _directory(recording: object) -> Path | None:
    """Return the directory that `recording=` names; None if it is True or False."""
    if isinstance(recording, bool):
        return None
    text = os.fspath(recording) if isinstance(recording, str | os.PathLike) else None
    if not isinstance(text, str) or not text or "\0" in text:
        raise ConfigError("recording", recording, "must be True, False or a directory")
    return Path(text).expanduser()


def _spin_ns(spin_us: object, rt: object) -> int:
    if spin_us is None:
        return DEFAULT_SPIN_US * NS_PER_US if rt else 0
    if not is_number(spin_us) or not 0 <= spin_us <= LONGEST_SPIN_US:
        raise ConfigError(
            "spin_us", spin_us, f"must be a number of microseconds from 0 to {LONGEST_SPIN_US}"
        )
    return round(spin_us * NS_PER_US)
