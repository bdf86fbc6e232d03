"""The sensor nodes: the IMU with its filter, and the GPS receiver."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from drone import sensors
from drone.estimation import AttitudeFilter
from drone.flight_log import DISCONNECTED, FlightLog
from drone.geometry import NOTHING, moved, roll_pitch_yaw
from drone.messages import NEWEST_NAV, Imu, Navigation
from horus import Node

if TYPE_CHECKING:
    from drone.geometry import Vector
    from drone.world import World


class ImuNode(Node):
    """Read the IMU at 400 Hz and fuse what it says into an attitude."""

    def __init__(self, world: World, log: FlightLog, seed: int, **hints: Any) -> None:
        """Read the state of a world; note the disconnection in a log."""
        super().__init__("imu", rate=400, order=0, subs=[NEWEST_NAV], pubs=["imu"], **hints)
        self._world, self._log, self._seed = world, log, seed
        self._device: sensors.Imu | None = None
        self._filter = AttitudeFilter()
        self._time_s = 0.0
        self._gained: Vector = NOTHING

    def init(self) -> None:
        """Connect to the device."""
        self._device = sensors.Imu(self._seed)

    def tick(self) -> None:
        """Take one measurement."""
        if self._device is None:
            return
        fusion, raw = self._filter, self._device.read(self._world.snapshot)
        # Integrated is over the device's own clock: a thread that is late, or early again, would
        # otherwise turn its jitter into attitude.
        dt_s, self._time_s = raw.time_s - self._time_s, raw.time_s
        if dt_s <= 0.0:
            return
        nav: Navigation | None = self.latest("nav")
        rates = fusion.update(raw, dt_s, NOTHING if nav is None else nav.drift_mps2)
        if fusion.calibrated:
            self._gained = moved(self._gained, dt_s, fusion.acceleration_mps2(raw))
        self.send(
            "imu",
            Imu(
                time_s=raw.time_s,
                angles_rad=roll_pitch_yaw(fusion.attitude),
                rates_radps=rates,
                gained_mps=self._gained,
                calibrated=fusion.calibrated,
            ),
        )

    def shutdown(self) -> None:
        """Disconnect from the device."""
        self._device = None
        self._log.add(self.name, DISCONNECTED)


class GpsNode(Node):
    """Read the GPS receiver at 10 Hz."""

    def __init__(self, world: World, log: FlightLog, seed: int) -> None:
        """Read the state of a world; note the disconnection in a log."""
        super().__init__("gps", rate=10, order=5, pubs=["gps"])
        self._world, self._log, self._seed = world, log, seed
        self._device: sensors.Gps | None = None

    def init(self) -> None:
        """Connect to the device."""
        self._device = sensors.Gps(self._seed)

    def tick(self) -> None:
        """Take one fix."""
        if self._device is not None:
            self.send("gps", self._device.read(self._world.snapshot))

    def shutdown(self) -> None:
        """Disconnect from the device."""
        self._device = None
        self._log.add(self.name, DISCONNECTED)
