"""A warehouse AGV: eight nodes around a physics engine, in real time or in virtual time.

    python examples/warehouse_agv.py                   # real time, about 20 s
    python examples/warehouse_agv.py --deterministic   # virtual time, the same run every time

The vehicle sets out for its goal. On the way a pallet falls into its aisle: the safety monitor
sees it on the LiDARs and publishes `emergency.stop`, the motor controller brakes, and the vehicle
stands before it touches anything. The planner finds another way, round a carton that only the
camera can see, and the vehicle arrives. On shutdown the motors halt before the sensors
disconnect. The exit code is 0 when all of that happened, and `agv.png` shows it.

    order  node          class       rate     what it does
        0  safety        Rt          1000 Hz  protective field, emergency.stop
       10  lidar_front   Rt            40 Hz  180 beams by ray casts
       11  lidar_rear    Rt            40 Hz
       20  camera        Rt            10 Hz  32 x 24 depth image, segmented into obstacles
       50  planner       Compute       10 Hz  A* on the occupancy grid, tens of ms of Python
       70  motor         Rt          1000 Hz  pure pursuit, wheel ramps; steps the physics
      100  battery       BestEffort    30 Hz  counts the charge, prints the progress
      200  fleet         AsyncIo        1 Hz  posts reports to a server on loopback

The end of what it prints with `--deterministic` (in real time the numbers vary a little):

    goal reached          True (off by 0.009 m)
    emergency stops       1
    stopping distance     0.357 m
    least clearance       0.463 m to the pallet
    contacts              0 physics steps with any contact
    shutdown order        motor -> camera -> lidar_rear -> lidar_front
    fleet reports         18 delivered
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import horus
from agv import drive, mission, planner, safety, sensors
from agv.devices import CameraNode, LidarNode
from agv.fleet import FleetServer
from agv.grid import OccupancyGrid
from agv.layout import GOAL
from agv.messages import (
    MOUNTS,
    NEWEST_ODOM,
    NEWEST_SCANS,
    ODOM,
    PATH,
    SCAN_TOPICS,
    Obstacles,
    Odometry,
)
from agv.telemetry import BatteryWatcher, FleetUploader
from agv.world import MAX_STEPS_PER_TICK, TIMESTEP_S, World
from horus import Node, Scheduler, Sub, us

if TYPE_CHECKING:
    import numpy as np


class SafetyMonitor(Node):
    """Watch the protective field; stop the vehicle when something is in it."""

    def __init__(self, log: mission.MissionLog) -> None:
        """Watch with both LiDARs; note releases in a log."""
        # A certified controller would say on_miss="stop" and deadline=200 * us, and mean it. On
        # an ordinary kernel, where any thread can be some milliseconds late, that would end the
        # run on the first late tick: this demo warns, and stops the vehicle by SILENCE_S instead.
        super().__init__(
            "safety",
            rate=1000,
            order=0,
            on_miss="warn",
            subs=[*NEWEST_SCANS, NEWEST_ODOM],
            pubs=["emergency.stop", "emergency.clear", "clearance"],
        )
        self._log = log
        self._field = safety.ProtectiveField(MOUNTS)
        self._latch = safety.StopLatch()
        self._speed_mps = 0.0
        self._heard_s = dict.fromkeys(MOUNTS, 0.0)

    def tick(self) -> None:
        """Judge the newest scans; publish changes of the verdict."""
        now_s = horus.elapsed()
        odom: Odometry | None = self.recv("odom")
        if odom is not None:
            self._speed_mps = odom.pose.speed_mps
        fresh = False
        for name, topic in SCAN_TOPICS.items():
            view: sensors.View | None = self.recv(topic)
            if view is not None:
                self._field.update(name, view)
                self._heard_s[name] = now_s
                fresh = True
        verdict = self._field.judge(self._speed_mps)
        if fresh:
            self.send("clearance", verdict.ahead_m)
        reason = verdict.reason
        if now_s - min(self._heard_s.values()) > safety.SILENCE_S:
            reason = "a LiDAR is silent"
        match self._latch.update(now_s, self._speed_mps, reason):
            case "stop":
                self.send("emergency.stop", {"reason": reason, "distance": verdict.ahead_m})
                self.log_warning(f"Emergency stop: {reason}")
            case "clear":
                self.send("emergency.clear", {})
                self._log.add(self.name, mission.RELEASED, "standing and free")


class PathPlanner(Node):
    """Keep the occupancy grid and plan on it, off the control threads."""

    def __init__(self, grid: OccupancyGrid, log: mission.MissionLog) -> None:
        """Keep a grid; note the plans in a log."""
        super().__init__(
            "planner",
            rate=10,
            order=50,
            compute=True,
            subs=[*NEWEST_SCANS, NEWEST_ODOM, Sub("obstacles", capacity=1)],
            pubs=[PATH],
        )
        self._grid, self._log = grid, log
        self._beams = {name: sensors.lidar_directions(mount) for name, mount in MOUNTS.items()}

    def tick(self) -> None:
        """Take in what was seen, then plan from where the vehicle is."""
        for name, topic in SCAN_TOPICS.items():
            view: sensors.View | None = self.recv(topic)
            if view is not None:
                hits = sensors.to_map(view, MOUNTS[name], self._beams[name])
                self._grid.add_scan((view.x_m, view.y_m), hits[:, :2])
        seen: Obstacles | None = self.recv("obstacles")
        if seen is not None:
            self._grid.camera.update(seen.occupied, seen.free)
        odom: Odometry | None = self.latest("odom")
        if odom is not None:
            path = planner.plan(self._grid.weights(), (odom.pose.x_m, odom.pose.y_m), GOAL)
            self.send("path", path)
            if len(path):
                self._log.add_plan(path)


class MotorController(Node):
    """Follow the path and turn the wheels; as the hardware, step the physics.

    The one thread that may touch the world's state is this node's.
    """

    def __init__(
        self, world: World, log: mission.MissionLog, vehicle: drive.Drive | None = None
    ) -> None:
        """Own a world; note what happens in a log; drive another drive than the usual one."""
        # on_miss="safe_mode" would brake at every late tick of an ordinary kernel; see safety.
        super().__init__(
            "motor",
            rate=1000,
            order=70,
            budget=300 * us,
            deadline=900 * us,
            on_miss="warn",
            subs=[
                Sub("path", capacity=1),
                Sub("clearance", capacity=1),
                "emergency.stop",
                "emergency.clear",
            ],
            pubs=[ODOM],
        )
        self._world, self._log = world, log
        self._drive = vehicle or drive.Drive()
        self._ticks = 0
        self._braking = False

    def tick(self) -> None:
        """Obey, steer at 100 Hz, turn the wheels at 1 kHz."""
        world, vehicle = self._world, self._drive
        stop: dict[str, Any] | None = self.recv("emergency.stop")
        if stop is not None:
            vehicle.emergency_stop()
            self._braking = True
            self._note(mission.EMERGENCY_STOP, stop["reason"])
        if self.recv("emergency.clear") is not None:
            vehicle.release()
        path: np.ndarray | None = self.recv("path")
        if path is not None:
            vehicle.follow(path.tolist())
        clearance_m: float | None = self.recv("clearance")
        if clearance_m is not None:
            vehicle.keep_clear(clearance_m)
        if self._ticks % 10 == 0:
            self._steer()
        self._ticks += 1
        # A skipped release makes dt longer, and the wheels turn further: the vehicle keeps its
        # true speed. In deterministic mode dt is one timestep, so one tick is one step.
        dt_s = min(horus.dt(), MAX_STEPS_PER_TICK * TIMESTEP_S)
        world.advance(dt_s, *vehicle.ramp(dt_s))

    def _steer(self) -> None:
        world, vehicle = self._world, self._drive
        pose = world.pose()
        vehicle.steer(pose)
        self.send("odom", Odometry(pose=pose, state=vehicle.state, power_w=world.motor_power_w()))
        standing = abs(pose.speed_mps) < drive.STANDING_MPS
        if self._braking and standing:
            self._braking = False
            clearance_m = world.record.min_clearance_m
            self._note(mission.STANDING, f"{clearance_m:.2f} m from the pallet")
        if vehicle.state is drive.DriveState.ARRIVED and standing:
            self._note(mission.ARRIVED)
            self.request_stop("goal reached")

    def enter_safe_state(self) -> None:
        """Brake; called by the scheduler when it must."""
        self._drive.emergency_stop()

    def shutdown(self) -> None:
        """Brake until the wheels stand, however the run ended."""
        self._drive.emergency_stop()
        steps = 0
        while steps < 2000 and (steps < 50 or abs(self._world.pose().speed_mps) > 1e-3):
            steps += self._world.advance(TIMESTEP_S, *self._drive.ramp(TIMESTEP_S))
        self._note(mission.MOTORS_HALTED, f"{abs(self._world.pose().speed_mps):.4f} m/s")

    def _note(self, what: str, detail: str = "") -> None:
        self._log.add(self.name, what, detail, self._world.pose())


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """Everything a run leaves behind."""

    world: World
    grid: OccupancyGrid
    log: mission.MissionLog
    outcome: mission.Outcome
    timing: str
    stop_reason: str | None
    recordings: list[Path]


def drive_mission(*, deterministic: bool, duration_s: float, recording: bool | Path = False) -> Run:
    """Build the vehicle, run it until it has arrived, and judge what happened."""
    world, grid = World(), OccupancyGrid()
    log = mission.MissionLog(clock=lambda: world.snapshot.time_s)
    options = {"tick_rate": 1000, "watchdog_ms": 500, "name": "warehouse_agv"}
    with (
        FleetServer() as server,
        Scheduler(deterministic=deterministic, recording=recording, **options) as sched,
    ):
        sched.add(SafetyMonitor(log))
        sched.add(LidarNode("front", 10, world, log)).add(LidarNode("rear", 11, world, log))
        sched.add(CameraNode(world, log)).add(PathPlanner(grid, log))
        sched.add(MotorController(world, log))
        sched.add(BatteryWatcher()).add(FleetUploader(server.url, log))
        # If one of these freezes, the whole vehicle enters its safe state.
        sched.add_critical_node("motor", timeout_ms=200)
        sched.add_critical_node("safety", timeout_ms=100)
        sched.run(duration=duration_s)
        timing, stop_reason = str(sched.timing_report()), sched.stop_reason
        recordings = sched.stop_recording()
    return Run(
        world=world,
        grid=grid,
        log=log,
        outcome=mission.judge(log, world.record, world.pose()),
        timing=timing,
        stop_reason=stop_reason,
        recordings=recordings,
    )


def main(argv: list[str] | None = None) -> int:
    """Run the example from the command line; return its exit code."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--deterministic", action="store_true", help="run in virtual time")
    parser.add_argument("--duration", type=float, default=60.0, help="at most this long [s]")
    parser.add_argument("--out", type=Path, default=Path("agv.png"), help="where the picture goes")
    args = parser.parse_args(argv)

    run = drive_mission(deterministic=args.deterministic, duration_s=args.duration)
    print(f"\n{run.timing}\n\n{mission.report(run.log, run.outcome)}")
    print(f"stopped               {run.stop_reason}")

    # Imported late: drawing has no place in the memory of a running vehicle.
    from agv import picture

    picture.draw(args.out, run.world, run.grid, run.log, run.outcome)
    print(f"picture               {args.out}")
    return 1 if run.outcome.failures else 0


if __name__ == "__main__":
    sys.exit(main())
