"""What a node and a scheduler are configured to be: validated, frozen, in nanoseconds.

The public edge takes seconds and Hz. They are checked and converted here, once;
everything below works on the integers.
"""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, TypeGuard, TypeVar

from horus.errors import ConfigError, ConfigWarning, TopicError
from horus.timing import period_ns
from horus.units import NS_PER_MS, NS_PER_S, NS_PER_US, readable

DEFAULT_RATE_HZ = 30.0
DEFAULT_ORDER = 100
DEFAULT_CAPACITY = 1024
AUTO_BUDGET = 0.80
AUTO_DEADLINE = 0.95
E = TypeVar("E", bound=StrEnum)

_LOWEST_RATE_HZ, _HIGHEST_RATE_HZ = 1e-6, 1e6
_LONGEST_NS = 10**9 * NS_PER_S
_NS_PER_UNIT = {"seconds": NS_PER_S, "milliseconds": NS_PER_MS, "microseconds": NS_PER_US}
_SUSPICIOUS_LIMIT_NS = 60 * NS_PER_S
_NAME = re.compile(r"[A-Za-z0-9_](?:[A-Za-z0-9_.\-]{0,126}[A-Za-z0-9_\-])?")


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


@dataclass(frozen=True, slots=True)
class _Port:
    """A topic that a node declares, with the type and queue it wants."""

    topic: str
    type: type | None = None
    capacity: int = DEFAULT_CAPACITY

    def __post_init__(self) -> None:
        """Refuse bad names, types and capacities.

        Raises:
            TopicError: The topic name is not usable.
            ConfigError: The type is no class or the capacity is no whole number above 0.
        """
        check_topic(self.topic)
        if self.type is not None and not isinstance(self.type, type):
            raise ConfigError("type", self.type, "must be a class, or None to accept anything")
        if not _is_int(self.capacity) or self.capacity < 1:
            raise ConfigError("capacity", self.capacity, "must be a whole number of messages >= 1")


class Pub(_Port):
    """Declares a topic that a node publishes, e.g. `Pub("scan", LaserScan)`."""


class Sub(_Port):
    """Declares a topic that a node receives; `Sub(topic, capacity=1)` keeps the latest only."""


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
    compute_kind = _check_compute(compute)
    _refuse_combinations(compute_kind, on=on, is_async=is_async, rate=rate)
    if not _is_int(order) or order < 0:
        raise ConfigError("order", order, "must be a whole number >= 0; lower runs earlier")
    spec = NodeSpec(
        name=checked_name,
        order=order,
        rate_hz=DEFAULT_RATE_HZ if rate is None else check_rate(rate),
        rate_given=rate is not None,
        budget_ns=optional_duration("budget", budget),
        budget_given=budget is not None,
        deadline_ns=optional_duration("deadline", deadline),
        deadline_given=deadline is not None,
        on_miss=Miss.WARN if on_miss is None else _member(Miss, "on_miss", on_miss),
        failure_policy=None
        if failure_policy is None
        else _member(FailurePolicy, "failure_policy", failure_policy),
        execution_class=_infer(
            compute=compute_kind,
            on=on,
            is_async=is_async,
            timed=any(limit is not None for limit in (rate, budget, deadline)),
        ),
        on=None if on is None else check_topic(on),
        priority=_check_priority(priority),
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
        too_long = spec.rate_given and limit_ns > spec.period_ns
        if too_long or limit_ns > _SUSPICIOUS_LIMIT_NS:
            beyond = (
                f"longer than its period of {readable(spec.period_ns)}"
                if too_long
                else "over a minute"
            )
            warnings.warn(
                f"node {spec.name!r}: {argument} is {readable(limit_ns)}, {beyond}; "
                f"limits are in seconds, write {argument}=300 * us for 300 microseconds",
                ConfigWarning,
                stacklevel=5,
            )


def check_name(argument: str, value: object) -> str:
    """Return a name, refusing one that could not be a file name and a metric label.

    Raises:
        ConfigError: Not a string, empty, too long, or with other characters than
            letters, digits, `_`, `-` and `.`.
    """
    if not isinstance(value, str) or not _NAME.fullmatch(value) or ".." in value:
        raise ConfigError(
            argument,
            value,
            "must be 1 to 128 ASCII letters, digits, '_', '-' or '.', "
            "with no leading, trailing or double dot: names become file and metric names",
        )
    return value


def check_topic(value: Any) -> str:
    """Return a usable topic name; a message class stands for its own name.

    Raises:
        TopicError: The name has path separators, control or other odd characters.
    """
    name = value.__name__ if isinstance(value, type) else value
    if not isinstance(name, str) or not _NAME.fullmatch(name) or ".." in name:
        raise TopicError(
            f"topic {value!r}: must be 1 to 128 ASCII letters, digits, '_', '-' or '.', "
            "e.g. 'front.scan'; path separators and control characters are refused"
        )
    return name


def check_rate(value: object, argument: str = "rate") -> float:
    """Return a rate [Hz] as float.

    Raises:
        ConfigError: Not a number from 1e-6 to 1e6.
    """
    return _check_range(argument, value, "Hz", _LOWEST_RATE_HZ, _HIGHEST_RATE_HZ)


def check_duration(argument: str, value: object, unit: str = "seconds") -> int:
    """Return a duration, given in `unit`, in nanoseconds [ns].

    Raises:
        ConfigError: Not a number above zero and below thirty years.
    """
    scale = _NS_PER_UNIT[unit]
    least = 1 / scale
    return round(_check_range(argument, value, unit, least, _LONGEST_NS / scale) * scale)


def optional_duration(argument: str, value: object) -> int | None:
    """Return a duration [s] in nanoseconds [ns]; None stays None.

    Raises:
        ConfigError: Neither None nor a number above zero and below thirty years.
    """
    return None if value is None else check_duration(argument, value)


def _check_range(argument: str, value: object, unit: str, least: float, most: float) -> float:
    # NaN fails the comparison, and so does what is too large for a float.
    if not _is_number(value) or not least <= value <= most:
        example = f", e.g. {argument}=300 * us" if unit == "seconds" else ""
        raise ConfigError(
            argument, value, f"must be a number of {unit} from {least:g} to {most:g}{example}"
        )
    return float(value)


def check_core(argument: str, value: object) -> int:
    """Return a CPU core index that this machine has.

    Raises:
        ConfigError: Not a whole number, or no such core.
    """
    count = os.cpu_count() or 1
    if not _is_int(value) or value < 0:
        raise ConfigError(argument, value, "must be a core index >= 0")
    if value >= count:
        raise ConfigError(argument, value, f"this machine has {count} cores, 0 to {count - 1}")
    return value


def _check_priority(value: object) -> int | None:
    if value is None:
        return None
    if not _is_int(value) or not 1 <= value <= 99:
        raise ConfigError("priority", value, "must be a SCHED_FIFO priority from 1 to 99")
    return value


def _check_compute(value: object) -> bool:
    if value == "process":
        raise ConfigError(
            "compute",
            value,
            "worker processes are not part of this version; "
            "compute=True runs the node on a thread of its own",
        )
    if value == "thread":
        return True
    if not isinstance(value, bool):
        raise ConfigError("compute", value, "must be True, False or 'thread'")
    return value


def _member(kind: type[E], argument: str, value: object) -> E:
    try:
        return kind(str(value))
    except ValueError:
        names = ", ".join(repr(member.value) for member in kind)
        raise ConfigError(argument, value, f"must be one of {names}") from None


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_int(value: object) -> TypeGuard[int]:
    return isinstance(value, int) and not isinstance(value, bool)


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
    cores: tuple[int, ...] | None
    max_deadline_misses: int | None
    verbose: bool
    telemetry: str | None
    loop: str
    shutdown_timeout_ns: int
    seed: int


def make_scheduler_spec(
    *,
    tick_rate: object,
    rt: object,
    deterministic: object,
    blackbox_mb: object,
    watchdog_ms: object,
    recording: object,
    name: object,
    cores: object,
    max_deadline_misses: object,
    verbose: object,
    telemetry: object,
    loop: object,
    shutdown_timeout: object,
    seed: object,
) -> SchedulerSpec:
    """Validate a scheduler's arguments.

    Raises:
        ConfigError: An argument has a wrong type or value.
    """
    if loop not in ("uvloop", "asyncio"):
        raise ConfigError("loop", loop, "must be 'uvloop' or 'asyncio'")
    if telemetry is not None and (not isinstance(telemetry, str) or not telemetry):
        raise ConfigError("telemetry", telemetry, "must be an endpoint URL")
    return SchedulerSpec(
        name="horus" if name is None else check_name("name", name),
        tick_rate_hz=check_rate(tick_rate, "tick_rate"),
        rt=_check_flag("rt", rt),
        deterministic=_check_flag("deterministic", deterministic),
        blackbox_mb=_check_count("blackbox_mb", blackbox_mb),
        watchdog_ns=_check_count("watchdog_ms", watchdog_ms) * NS_PER_MS,
        recording=_check_flag("recording", recording),
        cores=_check_cores(cores),
        max_deadline_misses=None
        if max_deadline_misses is None
        else _check_count("max_deadline_misses", max_deadline_misses, least=1),
        verbose=_check_flag("verbose", verbose),
        telemetry=telemetry,
        loop=loop,
        shutdown_timeout_ns=check_duration("shutdown_timeout", shutdown_timeout),
        seed=_check_count("seed", seed),
    )


def _check_flag(argument: str, value: object) -> bool:
    if not isinstance(value, bool):
        raise ConfigError(argument, value, "must be True or False")
    return value


def _check_count(argument: str, value: object, least: int = 0) -> int:
    if not _is_int(value) or value < least:
        raise ConfigError(argument, value, f"must be a whole number >= {least}")
    return value


def _check_cores(value: object) -> tuple[int, ...] | None:
    if value is None:
        return None
    if isinstance(value, str) or not isinstance(value, Iterable):
        raise ConfigError("cores", value, "must be a list of core indices, e.g. [0, 1]")
    cores = tuple(check_core("cores", core) for core in value)
    if not cores:
        raise ConfigError("cores", value, "must name at least one core, or be None")
    return cores
