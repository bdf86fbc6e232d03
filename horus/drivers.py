"""Who can drive the nodes of a session: a runtime, a stepper, a simulation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from horus.live import LiveNode
from horus.loop.bridge import Bridge
from horus.loop.executor import Home
from horus.loop.runtime import Runtime
from horus.loop.simulation import Simulation
from horus.loop.stepping import Stepper


@dataclass(slots=True)
class Drivers:
    """Those there are; None for one that was not needed yet.

    Thread: written by those who drive the nodes, read by any.
    """

    runtime: Runtime | None = None
    stepper: Stepper | None = None
    """Also a simulation, which is a stepper in virtual time."""
    stepping: bool = False
    """Whether a step is taken; a runtime stands still meanwhile."""

    @property
    def simulation(self) -> Simulation | None:
        """The stepper, if it simulates."""
        stepper = self.stepper
        return stepper if isinstance(stepper, Simulation) else None

    def members(self) -> Sequence[tuple[LiveNode, Home]]:
        """Return the nodes that are run, each with its home."""
        runtime, stepper = self.runtime, self.stepper
        if runtime is not None and not self.stepping:
            return runtime.members()
        return () if stepper is None else stepper.members()

    def bridge(self) -> Bridge | None:
        """Return the way into the event loop; None without a runtime."""
        runtime = self.runtime
        return None if runtime is None else runtime.bridge
