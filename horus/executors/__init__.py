"""Where nodes run: one executor per execution class."""

from __future__ import annotations

from horus.executors.async_io import AsyncIoExecutor
from horus.executors.best_effort import BestEffortExecutor
from horus.executors.compute import ComputeExecutor
from horus.executors.event import EventExecutor
from horus.executors.rt import RtExecutor
from horus.loop.bridge import Bridge
from horus.loop.cycle import Cycle
from horus.loop.executor import Executor
from horus.loop.realtime import RealTime
from horus.spec import ExecutionClass


def make_executors(
    bridge: Bridge, cycle: Cycle, real_time: RealTime
) -> dict[ExecutionClass, Executor]:
    """Return the executors of one run."""
    return {
        ExecutionClass.BEST_EFFORT: BestEffortExecutor(bridge, cycle),
        ExecutionClass.EVENT: EventExecutor(bridge, cycle, real_time),
        ExecutionClass.ASYNC_IO: AsyncIoExecutor(bridge, cycle),
        ExecutionClass.RT: RtExecutor(bridge, cycle, real_time),
        ExecutionClass.COMPUTE: ComputeExecutor(bridge, cycle, real_time),
    }
