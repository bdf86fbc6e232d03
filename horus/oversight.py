"""What looks after a session, whoever drives its nodes: supervision, safe state, process."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence

from horus.clock import Timeline
from horus.drivers import Drivers
from horus.live import LiveNode
from horus.loop.ending import WayOut
from horus.loop.fault_log import FaultLog
from horus.loop.hooks import HookCaller
from horus.loop.inspector import Inspector
from horus.loop.notify import Notifier, find_notifier
from horus.loop.realtime import RealTime
from horus.loop.safety import Safety
from horus.loop.signals import LastAct, SignalOwner
from horus.loop.stacks import in_callback
from horus.loop.supervisor import Supervisor
from horus.loop.watchdog import Watchdog
from horus.registry import Registry
from horus.spec import NodeState, SchedulerSpec
from horus.units import to_s

_LAST_ACTS_S = 0.5
"""How much longer than its parts a last act may take [s]."""


class Oversight:
    """Owns what keeps a robot safe and its people informed while somebody drives the nodes.

    - the supervisor, with a watchdog; in virtual time an inspector of the simulation's
    - the safe state and those who call the hooks
    - for a run that owns the process: signals, the service manager, the last acts before
      a forced end

    Thread: any; those who drive the nodes call `supervisor`, `close` and `owning_process`.
    """

    def __init__(
        self,
        spec: SchedulerSpec,
        timeline: Timeline,
        registry: Registry,
        drivers: Drivers,
        safe_state_entered: Callable[[str], None],
    ) -> None:
        """Look after the nodes of `registry`, which `drivers` drive; nothing happens yet."""
        self._spec = spec
        self._timeline = timeline
        self._registry = registry
        self._drivers = drivers
        self.real_time = RealTime(spec)
        self.safety = Safety(self._call_hooks, safe_state_entered)
        self.fault_log = FaultLog(spec.name)
        self._hooks = HookCaller(self.real_time, drivers.bridge, self.report)
        self._watched = spec.watchdog_ns > 0
        self._supervisor: Supervisor | None = None
        self._signals: SignalOwner | None = None
        self._notifier: Notifier | None = None

    # -- supervision -------------------------------------------------------------------

    def supervisor(self) -> Supervisor:
        """Return the supervisor of this session, which still has to be started."""
        if self._supervisor is None:
            self._supervisor = Supervisor(
                self._spec,
                self._timeline,
                self.real_time,
                self.safety,
                self._drivers.members,
                self.fault_log,
            )
        return self._supervisor

    def inspector(self) -> Inspector:
        """Return what a simulation acts through instead, on its own thread."""
        watchdog = Watchdog(self._spec.watchdog_ns, self._drivers.members)
        return Inspector(watchdog, self.safety, self._timeline.now_ns, self.report)

    def begin_steps(self) -> None:
        """Watch over steps, which nobody supervises without a watchdog."""
        if self._watched and not self._spec.deterministic:
            self.supervisor().start()

    def watch(self, live: LiveNode) -> None:
        """Take note of a node's watchdog timeout, which is new or has changed."""
        if live.spec.watchdog_ns or live.critical_ns:
            self._watched = True
            self.look_again()

    def look_again(self) -> None:
        """Take note that nodes have come, or that a timeout has changed."""
        if self._supervisor is not None:
            self._supervisor.look_again()
        simulation = self._drivers.simulation
        if simulation is not None:
            simulation.look_again()

    def critical_late(self, live: LiveNode, lasted_ns: int) -> None:
        """See to it that a critical node's late end has consequences; see `Control`."""
        times_cleared = self.safety.times_cleared
        acting = self._drivers.simulation or self._supervisor
        if acting is not None:
            acting.critical_late(live, lasted_ns, times_cleared)

    def report(self, write: Callable[[], None]) -> None:
        """Log something, where that may take as long as it likes."""
        supervisor = self._supervisor
        if supervisor is None:
            write()
        else:
            supervisor.report(write)

    def close(self) -> None:
        """Supervise no more: the session closes."""
        if self._supervisor is not None:
            self._supervisor.close()
            self._supervisor = None

    # -- the safe state ----------------------------------------------------------------

    def clear_safe_state(self) -> list[str]:
        """Let the nodes tick again that are held; return the names of those that cannot yet.

        Raises:
            StateError: A critical node is still frozen.
        """
        return self.safety.clear(self._registry.in_order)

    def _call_hooks(self, lives: Sequence[LiveNode]) -> None:
        simulation = self._drivers.simulation
        if simulation is not None:
            simulation.call_hooks(lives)
        else:
            self._hooks.start(lives)

    # -- the process -------------------------------------------------------------------

    @contextlib.contextmanager
    def owning_process(
        self, request_stop: Callable[[str], None], dump: Callable[[str], None]
    ) -> Iterator[None]:
        """Own the signals and tell the service manager in the block.

        Args:
            request_stop: Ends the run in order, for a reason.
            dump: Writes the flight recorder, for a reason; returns at once.
        """
        make_safe = LastAct(
            self._make_safe,
            lambda: _LAST_ACTS_S + self._hooks.limit_s(len(self._registry.in_order)),
        )
        shut_down = LastAct(
            self._shut_down,
            lambda: _LAST_ACTS_S + len(self._registry.in_order) * self._shutdown_timeout_s,
        )
        signals = self._signals = SignalOwner(
            request_stop,
            make_safe,
            shut_down,
            in_callback,
            dump if self._spec.blackbox_mb else None,
        )
        with signals.owning():
            self._notifier = find_notifier()
            try:
                yield
            finally:
                self._signals = None
                if self._notifier is not None:
                    self._notifier.close()
                    self._notifier = None

    @property
    def way_out(self) -> WayOut | None:
        """What can be done about a callback that blocks the main thread, if anything."""
        signals = self._signals
        return signals if signals is not None and signals.owns else None

    def tell_manager(self, state: str) -> None:
        """Tell the service manager a state such as `READY=1`, if there is one."""
        notifier = self._notifier
        if notifier is not None:
            notifier.send(state)

    def keep_manager_informed(self) -> None:
        """Send the service manager signs of life, if it wants them, until the session closes."""
        notifier = self._notifier
        if notifier is not None and notifier.watchdog_s is not None:
            self.supervisor().notify(notifier)

    @property
    def _shutdown_timeout_s(self) -> float:
        return to_s(self._spec.shutdown_timeout_ns)

    def _make_safe(self) -> None:
        """Call the safe-state hooks, before the process is forced to end."""
        alive = (NodeState.RUNNING, NodeState.RESTARTING, NodeState.STOPPING)
        self._hooks.call(
            live
            for live in reversed(self._registry.in_order)
            if live.state in alive and live.standing.hold() and live.standing.claim_hook()
        )

    def _shut_down(self) -> None:
        """Call what is owed of `shutdown()`, before the process is forced to end."""
        runtime = self._drivers.runtime
        if runtime is not None:
            runtime.shut_down_without_loop()
