"""Record a vehicle, change its controller, and replay the recorded sensors through the new one.

    python examples/record_and_replay.py

The warehouse AGV drives for eight seconds in virtual time, and everything its nodes send is
recorded. Then its motor controller runs again, alone, on what the safety monitor and the planner
had said in the recording: first as it was, which gives the same odometry to the last bit, and then
with a drive that accelerates more gently. `replay.png` shows both speeds.

Prints, after the progress of the drive:

    recorded      1929 messages on 9 topics
    the same      no difference
    gentler       tick 110, topic 'odom', message 12 of 'motor', .pose.x_m: 1.30001... != 1.30000...
    at 1.5 m/s    after 1.36 s as recorded, 2.62 s with the new drive
"""

from __future__ import annotations

import argparse
import math
import tempfile
from pathlib import Path

from warehouse_agv import MotorController, drive_mission

import horus
from agv.drive import ACCELERATION_MPS2, Drive
from agv.mission import MissionLog
from agv.world import World
from horus import Scheduler

RECORDED_S = 8.0
FAST_MPS = 1.5


def replay(recording: Path, acceleration_mps2: float, directory: Path) -> Path:
    """Replay a recording around a live motor controller; return the recording of that."""
    world = World()
    motor = MotorController(
        world, MissionLog(clock=lambda: world.snapshot.time_s), Drive(acceleration_mps2)
    )
    sched = Scheduler.replay_from(recording, recording=directory)
    sched.add(motor)  # takes the place of the recorded one; the others are played
    sched.set_replay_speed(math.inf)
    sched.run()
    (path,) = sched.stop_recording()
    return path


def speeds(recording: Path) -> list[tuple[float, float]]:
    """Return the time [s] and speed [m/s] of each odometry message."""
    with horus.open_recording(recording) as reader:
        poses = [recorded.message().pose for recorded in reader.messages(["odom"])]
    return [(pose.time_s, pose.speed_mps) for pose in poses]


def main() -> None:
    """Run the example from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("replay.png"), help="the picture")
    out: Path = parser.parse_args().out
    with tempfile.TemporaryDirectory() as name:
        directory = Path(name)
        run = drive_mission(
            deterministic=True, duration_s=RECORDED_S, recording=directory / "recorded"
        )
        (recorded,) = run.recordings
        with horus.open_recording(recorded) as reader:
            topics = [message.topic for message in reader.messages()]
        print(f"recorded      {len(topics)} messages on {len(set(topics))} topics")

        same = replay(recorded, ACCELERATION_MPS2, directory / "same")
        print(f"the same      {horus.diff(recorded, same) or 'no difference'}")
        gentle = replay(recorded, ACCELERATION_MPS2 / 2, directory / "gentle")
        print(f"gentler       {horus.diff(recorded, gentle)}")
        tracks = {"recorded": speeds(recorded), "replayed, half the acceleration": speeds(gentle)}
    before, after = [
        next(time for time, speed in track if speed >= FAST_MPS) for track in tracks.values()
    ]
    print(
        f"at {FAST_MPS} m/s    after {before:.2f} s as recorded, {after:.2f} s with the new drive"
    )
    draw(out, tracks)
    print(f"picture       {out}")


def draw(out: Path, tracks: dict[str, list[tuple[float, float]]]) -> None:
    """Draw speeds over time."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(9, 3.5), constrained_layout=True)
    for (label, track), colour in zip(tracks.items(), ("#7b8a97", "#d1343b"), strict=True):
        axes.plot(*zip(*track, strict=True), label=label, color=colour)
    axes.set(xlabel="time [s]", ylabel="speed [m/s]", title="One recording, two motor controllers")
    axes.legend(frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(out, dpi=110)


if __name__ == "__main__":
    main()
