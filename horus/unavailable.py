"""What the contract names and this version does not have: said plainly, never pretended."""

from __future__ import annotations

from horus.errors import UnavailableWarning, warn_user
from horus.spec import SchedulerSpec


def warn_of_scheduler(spec: SchedulerSpec) -> None:
    """Warn of the arguments of a scheduler that have no effect."""
    for asked, argument, consequence in ((spec.telemetry, "telemetry=", "no metrics are sent"),):
        if asked:
            warn(argument, consequence)


def warn(feature: str, consequence: str) -> None:
    """Warn that a feature has no effect."""
    warn_user(f"{feature} is not part of this version: {consequence}", UnavailableWarning)
