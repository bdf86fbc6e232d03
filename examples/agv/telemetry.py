"""The nodes that report: the battery watcher and the uploader to the fleet server."""

from __future__ import annotations

from typing import TYPE_CHECKING

import horus
from agv.fleet import FleetClient
from agv.messages import NEWEST_ODOM
from horus import Node, Sub

if TYPE_CHECKING:
    from agv.messages import Odometry
    from agv.mission import MissionLog


class BatteryWatcher(Node):
    """Count the charge, and print how the mission goes."""

    CAPACITY_J = 24.0 * 40.0 * 3600.0
    ELECTRONICS_W = 65.0

    def __init__(self) -> None:
        """Start with a charge of 80 %."""
        super().__init__("battery", order=100, subs=[NEWEST_ODOM], pubs=["battery"])
        self._used_j = 0.2 * self.CAPACITY_J
        self._next_line_s = 0.0

    def tick(self) -> None:
        """Integrate the power; once a second, report and print."""
        odom: Odometry | None = self.latest("odom")
        if odom is None:
            return
        power_w = self.ELECTRONICS_W + odom.power_w / 0.85
        self._used_j += power_w * horus.dt()
        if horus.elapsed() < self._next_line_s:
            return
        self._next_line_s += 1.0
        charge = 1.0 - self._used_j / self.CAPACITY_J
        voltage = 22.4 + 3.2 * charge - 0.0008 * power_w
        if voltage < 22.0:
            self.log_warning(f"Low battery: {voltage:.1f} V")
        self.send("battery", {"voltage": voltage, "charge": charge, "power_w": power_w})
        pose = odom.pose
        print(
            f"{horus.elapsed():6.2f} s  x {pose.x_m:5.2f}  y {pose.y_m:5.2f} m  "
            f"{abs(pose.speed_mps):5.2f} m/s  {odom.state:<8} {voltage:5.2f} V {power_w:4.0f} W",
            flush=True,
        )


class FleetUploader(Node):
    """Report to the fleet server over HTTP; the network may fail, the vehicle drives on."""

    def __init__(self, url: str, log: MissionLog) -> None:
        """Report to a URL; count deliveries in a log."""
        super().__init__(
            "fleet",
            rate=1,
            order=200,
            failure_policy="skip",
            subs=[Sub("battery", capacity=1), NEWEST_ODOM],
        )
        self._client, self._log = FleetClient(url), log

    async def tick(self) -> None:
        """Send the newest state."""
        odom: Odometry | None = self.latest("odom")
        if odom is not None:
            report = {"x": odom.pose.x_m, "y": odom.pose.y_m, "state": odom.state}
            report["battery"] = self.latest("battery")
            self._log.delivered = await self._client.report(report)

    async def shutdown(self) -> None:
        """Say goodbye and close the connection."""
        try:
            self._log.delivered = await self._client.report({"state": "shutdown"})
        finally:
            await self._client.close()
