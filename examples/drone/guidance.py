"""The nodes around the controllers: the pilot that hands out waypoints, and the logger."""

from __future__ import annotations

import math

import horus
from drone.course import COURSE, STANDING
from drone.flight_log import FLOWN, FlightLog
from drone.messages import NEWEST_IMU, NEWEST_NAV, Imu, Navigation
from horus import Node, Sub

ROTORS_STAND_AFTER_S = 0.5


class Pilot(Node):
    """Hand out the waypoints of the course, and end the flight when it has landed."""

    def __init__(self, log: FlightLog) -> None:
        """Note the legs in a log."""
        # Every report counts for the errors of a leg, so this queue is not of the newest alone.
        super().__init__(
            "pilot", rate=10, order=15, subs=[Sub("nav", capacity=64)], pubs=["waypoint"]
        )
        self._log = log
        self._course = iter(COURSE)
        self._leg = STANDING
        self._errors_m: list[float] = []
        self._landed_s: float | None = None

    def tick(self) -> None:
        """Follow the progress; send the next waypoint when the last one is reached."""
        reports: list[Navigation] = self.recv_all("nav")
        for nav in reports:
            # Reports from before a new waypoint was taken up are about another leg.
            if self._landed_s is None and nav.leg == self._leg:
                self._errors_m.append(nav.error_m)
                if nav.arrived:
                    self._arrived()
        if self._landed_s is not None and horus.elapsed() >= self._landed_s + ROTORS_STAND_AFTER_S:
            self.request_stop("landed")

    def _arrived(self) -> None:
        if self._leg != STANDING:
            rms_m = math.sqrt(sum(e * e for e in self._errors_m) / len(self._errors_m))
            text = f"{self._leg}, off by RMS {rms_m:.3f} m, max {max(self._errors_m):.3f} m"
            self._log.add(self.name, FLOWN, text)
            print(f"{horus.elapsed():6.2f} s  flown {text}", flush=True)
        self._errors_m.clear()
        waypoint = next(self._course, None)
        if waypoint is None:
            self._landed_s = horus.elapsed()
        else:
            self._leg = waypoint.name
            self.send("waypoint", waypoint)


class Logger(Node):
    """Log at 10 Hz, as to an SD card, and print a line once a second."""

    def __init__(self) -> None:
        """Print the first line at once."""
        super().__init__("logger", rate=10, order=100, subs=[NEWEST_IMU, NEWEST_NAV], pubs=["log"])
        self._next_line_s = 0.0

    def tick(self) -> None:
        """Log the newest state."""
        imu: Imu | None = self.latest("imu")
        nav: Navigation | None = self.latest("nav")
        if imu is None or nav is None:
            return
        self.send("log", {"t": horus.now(), "tick": horus.tick(), "imu": imu, "nav": nav})
        if horus.elapsed() < self._next_line_s:
            return
        self._next_line_s += 1.0
        (x, y, z), tilt_rad = nav.position_m, math.hypot(*imu.angles_rad[:2])
        print(
            f"{horus.elapsed():6.2f} s  {nav.leg:<8}  x {x:5.2f}  y {y:5.2f}  z {z:5.2f} m  "
            f"{math.hypot(*nav.velocity_mps):5.2f} m/s  tilt {math.degrees(tilt_rad):4.1f} deg  "
            f"error {nav.error_m:.3f} m",
            flush=True,
        )
