"""A drone flight controller: a quadrotor flies a square, in real time or in virtual time.

    python examples/drone_flight_controller.py                   # real time, about 21 s
    python examples/drone_flight_controller.py --deterministic   # the same flight every time
    python examples/drone_flight_controller.py --strict          # ends at the first late ESC tick
    python examples/drone_flight_controller.py --deterministic --duration 8    # ends in the air

With `--esc-on-miss stop --esc-deadline-us 15000 --stall-at 8`, one late ESC tick in the air ends
the run, and the ESC brings the drone down on its own.

The drone calibrates its gyroscope, takes off, flies round a square of 4 m in a breeze with a gust,
lands and stops its motors. It knows its attitude and position only from noisy sensors. However a
run ends, the ESC brings the drone down and stops the motors before the sensors disconnect. The
exit code is 0 when the whole square was flown well, and `drone.png` shows it.

    order  node      rate     what it does
        0  imu       400 Hz   gyroscope, accelerometer, magnetometer; complementary filter
        5  gps        10 Hz   position and velocity
       10  attitude  400 Hz   inner loop: attitude and rates to motor commands
       15  pilot      10 Hz   hands out the waypoints, ends the run after the landing
       20  position   50 Hz   outer loop: dead reckoning, GPS, PID on a smooth reference
       30  esc       400 Hz   drives the motors, hard deadline; steps the physics
      100  logger     10 Hz   logs, prints a line a second

The end of what it prints with `--deterministic` (in real time the numbers vary a little):

    square flown          True (corners missed by 0.018, 0.019, 0.019, 0.037 m)
    tracking error        RMS 0.030 m, max 0.054 m
    on the square         RMS 0.030 m, max 0.049 m
    greatest tilt         18.4 degrees
    landed                True (off by 0.023 m)
    touchdown             0.485 m/s
    thrust at the end     0.000 N
    shutdown order        esc -> gps -> imu
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import horus
from drone import control, failsafe, flight_log
from drone.course import Follower
from drone.devices import GpsNode, ImuNode
from drone.estimation import Navigator
from drone.failsafe import Descent
from drone.flight_log import FlightLog
from drone.geometry import difference
from drone.guidance import Logger, Pilot
from drone.messages import NEWEST_GPS, NEWEST_IMU, Imu, Navigation
from drone.world import MAX_ADVANCE_S, World
from horus import Miss, Node, Scheduler, Sub, ms, us

if TYPE_CHECKING:
    from drone.control import Setpoint, Thrusts
    from drone.course import Waypoint
    from drone.sensors import GpsFix

STALE_S = 100 * ms
"""Motor commands older than this are not flown on, whatever the scheduler's policies."""
STALL_S = 20 * ms


@dataclass(frozen=True, slots=True, kw_only=True)
class Policies:
    """How hard the flight controller is on itself: arguments of three nodes and the scheduler."""

    imu: dict[str, Any]
    attitude: dict[str, Any]
    esc: dict[str, Any]
    scheduler: dict[str, Any]


class AttitudeControl(Node):
    """The inner loop: hold the attitude that the outer loop asks for."""

    def __init__(self, **limits: Any) -> None:
        """Control within limits, see `policies`."""
        super().__init__(
            "attitude",
            rate=400,
            order=10,
            on_miss="safe_mode",
            subs=[NEWEST_IMU, Sub("setpoint", capacity=1)],
            pubs=["motor_cmd"],
            **limits,
        )
        self._stabiliser = control.Stabiliser()
        self._setpoint = control.DISARMED
        self.safe_states = 0

    def tick(self) -> None:
        """Turn the newest attitude into motor commands."""
        setpoint: Setpoint | None = self.recv("setpoint")
        if setpoint is not None:
            self._setpoint = setpoint
        imu: Imu | None = self.recv("imu")
        if imu is not None:
            dt_s = min(horus.dt(), MAX_ADVANCE_S)
            angles, rates = imu.angles_rad, imu.rates_radps
            self.send("motor_cmd", self._stabiliser.thrusts(angles, rates, self._setpoint, dt_s))

    def enter_safe_state(self) -> None:
        """Fly level until the next setpoint; called after a late tick."""
        self._setpoint = self._setpoint.level()
        self.safe_states += 1


class PositionControl(Node):
    """The outer loop: know where the drone is, and steer it along its course."""

    def __init__(self, log: FlightLog) -> None:
        """Note the reference in a log."""
        super().__init__(
            "position",
            rate=50,
            order=20,
            subs=[NEWEST_GPS, NEWEST_IMU, Sub("waypoint", capacity=1)],
            pubs=["setpoint", "nav"],
        )
        self._log = log
        self._navigator = Navigator()
        self._follower = Follower()
        self._controller = control.PositionController()
        self._imu: Imu | None = None

    def tick(self) -> None:
        """Navigate, follow the course, ask for an attitude and report."""
        dt_s = self._navigate()
        if self._imu is None or dt_s <= 0.0:
            return
        navigator, follower = self._navigator, self._follower
        waypoint: Waypoint | None = self.recv("waypoint")
        if waypoint is not None:
            follower.take(waypoint)
        reference = follower.advance(dt_s)
        position_m, velocity_mps = navigator.position_m, navigator.velocity_mps
        error_m = follower.error_m(reference, position_m)
        arrived = follower.arrived(error_m, velocity_mps[2], dt_s)
        setpoint = control.DISARMED
        if follower.flying:
            wanted = self._controller.acceleration(reference, position_m, velocity_mps, dt_s)
            setpoint = control.attitude_for(wanted, yaw_rad=0.0)
            self._log.add_reference(self._imu.time_s, follower.name, reference.position_m)
        self.send("setpoint", setpoint)
        self.send(
            "nav",
            Navigation(
                leg=follower.name,
                arrived=arrived,
                position_m=position_m,
                velocity_mps=velocity_mps,
                drift_mps2=navigator.drift_mps2,
                error_m=error_m,
            ),
        )

    def _navigate(self) -> float:
        """Go on by what the IMU felt since the last tick; return how long that was [s].

        By the IMU's clock: when it has nothing new, there is nothing to decide either.
        """
        imu: Imu | None = self.recv("imu")
        dt_s = 0.0
        if imu is not None and imu.calibrated:
            if self._imu is not None:
                dt_s = imu.time_s - self._imu.time_s
                gained = difference(imu.gained_mps, self._imu.gained_mps)
                self._navigator.predict(gained, dt_s)
            self._imu = imu
        fix: GpsFix | None = self.recv("gps")
        if fix is not None:
            self._navigator.correct(fix)
        return dt_s


class Esc(Node):
    """Drive the motors at 400 Hz; as the hardware, step the physics.

    The one thread that may touch the world's state is this node's.
    """

    def __init__(self, world: World, log: FlightLog, stall_at_s: float, **limits: Any) -> None:
        """Own a world.

        Args:
            world: the drone.
            log: where to note what happens.
            stall_at_s: when one tick is to take `STALL_S` longer than it should [s].
            limits: budget, deadline and what a miss leads to, see `Policies`.
        """
        newest_command = Sub("motor_cmd", capacity=1)
        super().__init__("esc", rate=400, order=30, subs=[newest_command], **limits)
        self._world, self._log = world, log
        self._thrusts: Thrusts = control.OFF
        self._age_s = 0.0
        self._descent: Descent | None = None
        self._stall_at_s = stall_at_s

    def tick(self) -> None:
        """Pass the newest motor commands on, unless they are stale."""
        # A skipped release makes dt longer, and the drone flies further: it keeps its true
        # speed. In deterministic mode dt is two timesteps, so one tick is two physics steps.
        dt_s = min(horus.dt(), MAX_ADVANCE_S)
        thrusts: Thrusts | None = self.recv("motor_cmd")
        self._age_s = self._age_s + dt_s if thrusts is None else 0.0
        if self._age_s > STALE_S:
            self._descend(f"no motor command for {self._age_s * 1e3:.0f} ms")
        if self._descent is not None:
            self._thrusts = self._descent.thrusts(self._world.snapshot, dt_s)
            if self._descent.down:
                self.request_stop("brought down by the ESC")
        elif thrusts is not None:
            self._thrusts = thrusts
        self._world.advance(dt_s, self._thrusts)
        if horus.elapsed() >= self._stall_at_s:
            self._stall_at_s = math.inf
            self._log.add(self.name, flight_log.STALLED, f"for {STALL_S * 1e3:.0f} ms, as asked")
            time.sleep(STALL_S)

    def enter_safe_state(self) -> None:
        """Come down; called by the scheduler when it must."""
        self._descend("safe state")

    def shutdown(self) -> None:
        """Stop the motors, on the ground, however the run ended.

        Nobody else ticks any more: from the air, the board flies the drone down on its own.
        """
        self._descend("the run ended in the air")
        failsafe.stop_motors(self._world, self._descent)
        self._log.add(self.name, flight_log.MOTORS_OFF)

    def _descend(self, reason: str) -> None:
        if self._descent is None and self._thrusts != control.OFF:
            self._descent = Descent()
            height_m = self._world.snapshot.position_m[2]
            self._log.add(self.name, flight_log.FAILSAFE, f"{reason}, {height_m:.2f} m up")


def policies(args: argparse.Namespace) -> Policies:
    """Return how hard the controller shall be on itself.

    A drone must not fly with stale motor commands, and a flight computer with a real-time kernel
    and cores of its own ends the flight at the first ESC tick that takes 200 us, and after ten
    late ticks of anybody: that is `--strict`. On an ordinary kernel any thread can be some
    milliseconds late at any time, and the drone would never leave the ground. There, late ticks
    are counted and warned of; the attitude loop flies level after one; and what must not happen,
    flying on commands that are really old, is left to the ESC's own clock (`STALE_S`).
    """
    attitude: dict[str, Any] = {}
    esc: dict[str, Any] = {"on_miss": args.esc_on_miss or ("stop" if args.strict else "warn")}
    if args.strict:
        attitude |= {"budget": 200 * us, "deadline": 500 * us}
        esc |= {"budget": 100 * us, "deadline": 200 * us}
    if args.esc_deadline_us is not None:
        esc |= {"deadline": args.esc_deadline_us * us, "budget": args.esc_deadline_us * us}
    scheduler: dict[str, Any] = {
        "watchdog_ms": args.watchdog_ms,
        "blackbox_mb": args.blackbox_mb,
        "max_deadline_misses": args.max_deadline_misses or (10 if args.strict else None),
    }
    imu: dict[str, Any] = {}
    if args.rt:
        # Hints for a machine with two cores to spare: sensing on one, control on the other.
        scheduler |= {"rt": True, "cores": [0, 1]}
        imu["core"], attitude["core"], esc["core"] = 0, 1, 1
    return Policies(imu=imu, attitude=attitude, esc=esc, scheduler=scheduler)


@dataclass(frozen=True, slots=True, kw_only=True)
class Flight:
    """Everything a flight leaves behind."""

    world: World
    log: FlightLog
    outcome: flight_log.Outcome
    timing: str
    attitude_safe_states: int
    stop_reason: str | None


def fly(
    chosen: Policies,
    *,
    deterministic: bool,
    duration_s: float,
    seed: int = 1,
    stall_at_s: float = math.inf,
) -> Flight:
    """Build the drone, run it until it has landed, and judge what happened."""
    world = World()
    log = FlightLog(clock=lambda: world.snapshot.time_s)
    attitude = AttitudeControl(**chosen.attitude)
    nodes = (
        ImuNode(world, log, seed, **chosen.imu),
        GpsNode(world, log, seed),
        attitude,
        Pilot(log),
        PositionControl(log),
        Esc(world, log, stall_at_s, **chosen.esc),
        Logger(),
    )
    with Scheduler(
        tick_rate=400, deterministic=deterministic, name="drone", **chosen.scheduler
    ) as sched:
        for node in nodes:
            sched.add(node)
        sched.run(duration=duration_s)
        timing, stop_reason = str(sched.timing_report()), sched.stop_reason
    return Flight(
        world=world,
        log=log,
        outcome=flight_log.judge(log, world.record),
        timing=timing,
        attitude_safe_states=attitude.safe_states,
        stop_reason=stop_reason,
    )


def parser() -> argparse.ArgumentParser:
    """Return what the command line understands."""
    result = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    add = result.add_argument
    add("--deterministic", action="store_true", help="fly in virtual time")
    add("--duration", type=float, default=60.0, help="at most this long [s]")
    add("--seed", type=int, default=1, help="of the sensors' noise")
    add("--out", type=Path, default=Path("drone.png"), help="where the picture goes")
    add("--strict", action="store_true", help="stop at the first missed ESC deadline of 200 us")
    add("--rt", action="store_true", help="real-time scheduling, pinned to cores 0 and 1")
    add("--esc-on-miss", choices=[miss.value for miss in Miss], help="for a late ESC tick")
    add("--esc-deadline-us", type=float, help="from release to end of an ESC tick")
    add("--max-deadline-misses", type=int, help="stop after so many, of all nodes together")
    add("--watchdog-ms", type=int, default=100, help="detect ticks that do not end; 0 for never")
    add("--blackbox-mb", type=int, default=0, help="size of the flight recorder")
    add("--stall-at", type=float, default=math.inf, help="delay one ESC tick at this time [s]")
    return result


def main(argv: list[str] | None = None) -> int:
    """Run the example from the command line; return its exit code."""
    command_line = parser()
    args = command_line.parse_args(argv)
    if args.deterministic and args.stall_at < math.inf:
        command_line.error("--stall-at needs real time: in virtual time no tick is ever late")
    flight = fly(
        policies(args),
        deterministic=args.deterministic,
        duration_s=args.duration,
        seed=args.seed,
        stall_at_s=args.stall_at,
    )
    print(f"\n{flight.timing}\n\n{flight_log.report(flight.log, flight.outcome)}")
    print(f"late attitude ticks   flown level after {flight.attitude_safe_states}")
    print(f"stopped               {flight.stop_reason}")

    # Imported late: drawing has no place in the memory of a flying drone.
    from drone import picture

    picture.draw(args.out, flight.world, flight.log, flight.outcome)
    print(f"picture               {args.out}")
    return 1 if flight.outcome.failures else 0


if __name__ == "__main__":
    sys.exit(main())
