"""Map a real building from 3,873 recorded laser scans.

The scans were taken by a robot driving two hours and 1.9 km through the corridors around
Killian Court. The log ships inside the package `rtb-data`, which comes with
`pip install "horus-scheduler[examples]"`, and is read from there. Five nodes of four classes:

    player    Rt, 100 Hz     publishes every scan at its recorded time divided by --speed
    filter    Event          removes beams without an echo and lone mixed-pixel echoes
    localiser Event          dead-reckons the odometry and chooses the pose of the scan
    mapper    Compute, 10 Hz casts every waiting scan into a log-odds grid, off the event loop
    progress  BestEffort     prints a line for every tenth of the log

No scan may be lost, however fast the log is played: a subscription holds as many scans as the
log has, so that a slow mapper falls behind but never drops. The map depends on the order of the
scans alone, so every speed and the deterministic mode give the same map, bit for bit.

Where the poses come from: `--poses graph` (default) takes the pose stored with each scan, which the
log's authors relaxed over 1,115 loop closures. `--poses odometry` integrates only the motions from
scan to scan; the map then shows how far dead reckoning strays, because nothing here closes loops.

    python examples/real_lidar_mapping.py --speed 100        # real time, 100 times faster
    python examples/real_lidar_mapping.py --deterministic    # virtual time, as fast as possible

Prints:
    log      ... scans, ... beams each, recorded over ... s
    mapped    10 % ... scans, ... s of the drive
    ...
    mapped   100 % ... scans, ... s of the drive
    scans    ... published, ... mapped, 0 lost, 0 out of order
    ...
    map      ... x ... m at 0.10 m a cell, ... m2 free, ... wall cells
    sha256   ...
    ...
"""

from __future__ import annotations

import argparse
import hashlib
import io
import struct
import sys
import time
import zipfile
import zlib
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import horus
from horus import Node, Scheduler, Sub

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

PACKAGE, LOG_ARCHIVE, LOG_NAME = "rtbdata", "data/killian.g2o.zip", "killian.g2o"
N_BEAMS = 180
PLAYER_RATE_HZ = 100
MAPPER_RATE_HZ = 10
DRAIN_TIME_S = 30.0  # how long the run may outlast the log before it counts as hung


# --- the log ---------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class LaserLog:
    """Hold the scans of one drive.

    Attributes:
        stamp_s: Recorded times since the first scan, (n,) [s].
        ranges_m: Measured distances, (n, 180) [m]; values past `max_range_m` mean "no echo".
        poses: Relaxed poses x, y, heading, (n, 3) [m, m, rad].
        motions: Motion since the scan before, seen from there, (n, 3) [m, m, rad].
        bearings_rad: Directions of the beams from the robot's heading, (180,) [rad].
        max_range_m: Range of the sensor [m].
    """

    stamp_s: Floats
    ranges_m: Floats
    poses: Floats
    motions: Floats
    bearings_rad: Floats
    max_range_m: float

    def __len__(self) -> int:
        """Return the number of scans."""
        return len(self.stamp_s)


def open_log() -> Iterable[str]:
    """Return the lines of the log inside the installed package."""
    try:
        archive = resources.files(PACKAGE).joinpath(LOG_ARCHIVE).read_bytes()
    except ModuleNotFoundError:
        sys.exit('This example needs its data: pip install "horus-scheduler[examples]"')
    with zipfile.ZipFile(io.BytesIO(archive)) as zipped:
        return zipped.read(LOG_NAME).decode("ascii").splitlines()


def parse_log(lines: Iterable[str], n_scans: int | None = None) -> LaserLog:
    """Parse a pose graph whose vertices carry laser scans.

    A ROBOTLASER1 line is: type, start angle, field of view, angular step, maximum range,
    accuracy, remission mode, number of beams, the ranges, number of remissions (0), laser pose,
    robot pose, five motion fields, time, host, time. An EDGE_SE2 line is: from, to, relative
    pose x, y, heading, six numbers of the information matrix; the edges that lead from a vertex
    to the next one are the odometry.

    Args:
        lines: The lines of the file.
        n_scans: Keep only that many scans; None keeps all.
    """
    scans: list[list[float]] = []
    motions: dict[int, list[float]] = {}
    for line in lines:
        kind, _, rest = line.partition(" ")
        if kind == "ROBOTLASER1" and (n_scans is None or len(scans) < n_scans):
            fields = rest.split()
            del fields[-2]  # the host's name, the only field that is not a number
            scans.append([float(field) for field in fields])
        elif kind == "EDGE_SE2":
            from_id, to_id, *edge = rest.split()
            if int(to_id) == int(from_id) + 1:
                motions[int(to_id)] = [float(field) for field in edge[:3]]
    table = np.array(scans)
    start_rad, step_rad, max_range_m = table[0, 1], table[0, 3], table[0, 4]
    pose_at = 8 + N_BEAMS + 1 + 3
    stamp_s = table[:, -2]
    return LaserLog(
        stamp_s=stamp_s - stamp_s[0],
        ranges_m=table[:, 8 : 8 + N_BEAMS],
        poses=table[:, pose_at : pose_at + 3],
        motions=np.array([[0.0, 0.0, 0.0]] + [motions[i] for i in range(1, len(table))]),
        bearings_rad=start_rad + step_rad * np.arange(N_BEAMS),
        max_range_m=float(max_range_m),
    )


# --- geometry --------------------------------------------------------------------------------


def compose(pose: Sequence[float], motion: Sequence[float]) -> tuple[float, float, float]:
    """Return the pose reached by a motion given in the frame of `pose`."""
    x_m, y_m, heading_rad = pose
    forward_m, left_m, turn_rad = motion
    cos, sin = np.cos(heading_rad), np.sin(heading_rad)
    return (
        float(x_m + cos * forward_m - sin * left_m),
        float(y_m + sin * forward_m + cos * left_m),
        float(heading_rad + turn_rad),
    )


def remove_phantoms(ranges_m: Floats, *, limit_m: float, jump_m: float) -> Floats:
    """Return the ranges with beams that hit nothing solid set to NaN.

    A beam that grazes an edge averages the near and the far surface and reports a point in mid
    air. Such a range stands out from both of its neighbours to the same side, whereas along a
    wall, however steeply it is seen, ranges rise or fall monotonically.

    Args:
        ranges_m: One scan, (n_beams,) [m].
        limit_m: Ranges from here on are "no echo" [m].
        jump_m: How far a phantom differs from both neighbours at least [m].
    """
    solid = ranges_m < limit_m
    to_left, to_right = ranges_m[1:-1] - ranges_m[:-2], ranges_m[1:-1] - ranges_m[2:]
    lone = (to_left * to_right > 0) & (np.minimum(abs(to_left), abs(to_right)) > jump_m)
    solid[1:-1] &= ~lone
    return np.where(solid, ranges_m, np.nan)


class OccupancyGrid:
    """A log-odds occupancy grid that grows with the world.

    Cells are addressed by world coordinates divided by the cell size, and storage grows in
    blocks aligned to that raster: the content is the same whatever the order of growth.
    """

    BLOCK = 256  # cells
    HIT, PASS, CLAMP = 0.9, -0.4, 6.0  # log odds

    def __init__(self, cell_m: float) -> None:
        """Start empty, with square cells [m]."""
        self.cell_m = cell_m
        self._low = np.zeros(2, np.intp)  # world cell (column, row) of the array's first element
        self.log_odds = np.zeros((0, 0), np.float32)  # rows are y, columns are x

    def cast(self, pose: Sequence[float], ranges_m: Floats, bearings_rad: Floats) -> None:
        """Enter one scan: every beam clears the cells it passes and marks the one it hits."""
        x_m, y_m, heading_rad = pose
        echo = np.isfinite(ranges_m)
        ranges_m, angle_rad = ranges_m[echo], heading_rad + bearings_rad[echo]
        origin_m = np.array([[x_m], [y_m]])
        direction = np.stack([np.cos(angle_rad), np.sin(angle_rad)])
        hits = self._cells(origin_m + ranges_m * direction)
        self._grow(np.concatenate([hits, self._cells(origin_m)], axis=1))
        # One sample per cell along each beam; the last cell before the echo stays untouched,
        # so that range noise does not wear walls away.
        n_samples = np.maximum(ranges_m / self.cell_m - 1, 0).astype(np.intp)
        first = np.cumsum(n_samples) - n_samples
        step = np.arange(n_samples.sum()) - np.repeat(first, n_samples)
        reach_m = (step + 0.5) * self.cell_m
        passed = self._cells(origin_m + reach_m * np.repeat(direction, n_samples, axis=1))
        flat = self.log_odds.reshape(-1)
        hit_at, pass_at = self._flat(hits), self._flat(passed)
        before = flat[hit_at]
        # Plain (unbuffered) index assignment counts a cell once per scan, however many of the
        # scan's beams cross it: beams fan out, and near cells would saturate otherwise.
        flat[pass_at] = np.maximum(flat[pass_at] + self.PASS, -self.CLAMP)
        flat[hit_at] = np.minimum(before + self.HIT, self.CLAMP)

    def _cells(self, points_m: Floats) -> NDArray[np.intp]:
        """Return the world cells, (2, n) column and row, of points, (2, n) x and y."""
        return np.floor(points_m / self.cell_m).astype(np.intp)

    def _flat(self, cells: NDArray[np.intp]) -> NDArray[np.intp]:
        """Return positions in the flattened array."""
        column, row = cells - self._low[:, None]
        position: NDArray[np.intp] = row * self.log_odds.shape[1] + column
        return position

    def _grow(self, cells: NDArray[np.intp]) -> None:
        """Make room for every cell within the box around `cells`."""
        size = np.array(self.log_odds.shape[::-1])
        low, high = cells.min(axis=1), cells.max(axis=1) + 1
        if (low >= self._low).all() and (high <= self._low + size).all():
            return
        low = low // self.BLOCK * self.BLOCK
        high = -(-high // self.BLOCK) * self.BLOCK
        if self.log_odds.size:
            low, high = np.minimum(low, self._low), np.maximum(high, self._low + size)
        grown = np.zeros((high - low)[::-1], np.float32)
        column, row = self._low - low
        if self.log_odds.size:
            grown[row : row + size[1], column : column + size[0]] = self.log_odds
        self.log_odds, self._low = grown, low

    def digest(self) -> str:
        """Return the SHA-256 of the grid's position and content."""
        header = struct.pack("<4q", *self._low, *self.log_odds.shape)
        return hashlib.sha256(header + self.log_odds.tobytes()).hexdigest()

    def known_box(self) -> tuple[slice, slice]:
        """Return the rows and columns that hold everything seen, with a margin."""
        seen = self.log_odds != 0
        rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
        margin = round(2.0 / self.cell_m)
        return (
            slice(max(rows[0] - margin, 0), rows[-1] + margin),
            slice(max(columns[0] - margin, 0), columns[-1] + margin),
        )

    def draw(self, path_m: Floats) -> NDArray[np.uint8]:
        """Return a picture, north up: walls black, free white, the driven path blue.

        Args:
            path_m: Positions of the robot, (n, 2) [m].
        """
        certainty = np.tanh(self.log_odds / 2)  # -1 free, 0 unknown, 1 wall
        grey = 205 - np.where(certainty > 0, 205, 50) * certainty
        picture = np.repeat(grey.astype(np.uint8)[:, :, None], 3, axis=2)
        scan = np.arange(len(path_m))
        between = np.linspace(0, len(path_m) - 1, 10 * len(path_m))
        dense_m = np.stack([np.interp(between, scan, along) for along in path_m.T])
        column, row = self._cells(dense_m) - self._low[:, None]
        for right, up in ((0, 0), (1, 0), (0, 1), (1, 1)):
            at = np.minimum(row + up, len(grey) - 1), np.minimum(column + right, grey.shape[1] - 1)
            picture[at] = (40, 110, 220)
        return picture[self.known_box()][::-1]


def encode_png(rgb: NDArray[np.uint8]) -> bytes:
    """Return an image, (height, width, 3), as a PNG file."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        checksum = struct.pack(">I", zlib.crc32(kind + data))
        return struct.pack(">I", len(data)) + kind + data + checksum

    height, width, _ = rgb.shape
    rows = np.concatenate([np.zeros((height, 1), np.uint8), rgb.reshape(height, -1)], axis=1)
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows.tobytes(), 6))
    return b"\x89PNG\r\n\x1a\n" + body + chunk(b"IEND", b"")


# --- the nodes -------------------------------------------------------------------------------


class Player(Node):
    """Publish the scans of a log at their recorded times, played at a chosen speed."""

    def __init__(self, drive: LaserLog, speed: float) -> None:
        """Play `drive`, `speed` times as fast as it was recorded."""
        super().__init__("player", rate=PLAYER_RATE_HZ, order=0, pubs="scan.raw")
        self.drive = drive
        self.due_s = drive.stamp_s / speed
        self.published = 0
        self.lateness_s = np.zeros(len(drive))

    def tick(self) -> None:
        """Publish everything that is due: at high speed that is several scans a tick."""
        elapsed_s = horus.elapsed()
        for seq in range(self.published, int(np.searchsorted(self.due_s, elapsed_s, "right"))):
            self.send("scan.raw", {
                "seq": seq,
                "stamp_s": float(self.drive.stamp_s[seq]),
                "ranges_m": self.drive.ranges_m[seq],
                "motion": tuple(self.drive.motions[seq].tolist()),
                "pose": tuple(self.drive.poses[seq].tolist()),
            })  # fmt: skip
            self.lateness_s[seq] = elapsed_s - self.due_s[seq]
            self.published = seq + 1


class BeamFilter(Node):
    """Remove the beams of a scan that hit nothing solid."""

    USABLE_RANGE_M = 30.0  # beyond, beams are more than half a metre apart
    PHANTOM_JUMP_M = 0.5

    def __init__(self, capacity: int) -> None:
        """Hold up to `capacity` scans that wait."""
        source = Sub("scan.raw", capacity=capacity)
        super().__init__("filter", on="scan.raw", order=10, subs=source, pubs="scan.clean")
        self.removed = 0

    def tick(self) -> None:
        """Clean one scan."""
        scan = self.recv("scan.raw")
        ranges_m = remove_phantoms(
            scan["ranges_m"], limit_m=self.USABLE_RANGE_M, jump_m=self.PHANTOM_JUMP_M
        )
        self.removed += int(np.isnan(ranges_m).sum())
        self.send("scan.clean", scan | {"ranges_m": ranges_m})


class Localiser(Node):
    """Give each scan the pose that it is mapped from, and measure how far odometry strays."""

    def __init__(self, capacity: int, *, dead_reckoning: bool) -> None:
        """Hold up to `capacity` scans that wait; publish dead-reckoned poses if asked to."""
        source = Sub("scan.clean", capacity=capacity)
        super().__init__("localiser", on="scan.clean", order=20, subs=source, pubs="scan.posed")
        self.dead_reckoning = dead_reckoning
        self.reckoned: tuple[float, float, float] | None = None
        self.max_drift_m = 0.0

    def tick(self) -> None:
        """Advance the dead-reckoned pose by one motion and publish the chosen pose."""
        scan = self.recv("scan.clean")
        pose = scan["pose"]
        self.reckoned = compose(self.reckoned, scan["motion"]) if self.reckoned else pose
        drift_m = float(np.hypot(self.reckoned[0] - pose[0], self.reckoned[1] - pose[1]))
        self.max_drift_m = max(self.max_drift_m, drift_m)
        self.send("scan.posed", {
            "seq": scan["seq"],
            "stamp_s": scan["stamp_s"],
            "ranges_m": scan["ranges_m"],
            "pose": self.reckoned if self.dead_reckoning else pose,
        })  # fmt: skip


class Mapper(Node):
    """Cast scans into the occupancy grid, on the thread pool: the one node that costs CPU time."""

    def __init__(self, drive: LaserLog, cell_m: float) -> None:
        """Map the whole of `drive` into cells of that size [m]."""
        source = Sub("scan.posed", capacity=len(drive))
        super().__init__(
            "mapper", rate=MAPPER_RATE_HZ, compute=True, order=30, subs=source, pubs="map.status"
        )
        self.grid = OccupancyGrid(cell_m)
        self.n_scans = len(drive)
        self.bearings_rad = drive.bearings_rad
        self.path_m: list[tuple[float, float]] = []
        self.out_of_order = 0
        self.next_seq = 0

    def tick(self) -> None:
        """Map every scan that has arrived since the last tick; end the run after the last one."""
        self.map_waiting()
        if self.next_seq == self.n_scans:
            self.request_stop("the log is mapped")

    def shutdown(self) -> None:
        """Map what still waits when the run is interrupted."""
        self.map_waiting()

    def map_waiting(self) -> None:
        """Cast every scan that waits into the grid."""
        scans = self.recv_all("scan.posed")
        for scan in scans:
            self.grid.cast(scan["pose"], scan["ranges_m"], self.bearings_rad)
            self.path_m.append(scan["pose"][:2])
            self.out_of_order += scan["seq"] != self.next_seq
            self.next_seq = scan["seq"] + 1
        if scans:
            last = scans[-1]
            self.send("map.status", {"scans": len(self.path_m), "stamp_s": last["stamp_s"]})


class Progress(Node):
    """Print a line for every tenth of the log."""

    def __init__(self, n_scans: int) -> None:
        """Expect that many scans."""
        super().__init__("progress", subs="map.status")
        self.n_scans = n_scans
        self.tenths = 0

    def tick(self) -> None:
        """Report the newest status when it completes another tenth."""
        for status in self.recv_all("map.status"):
            self.report(status)

    def shutdown(self) -> None:
        """Report what the mapper said after the last tick."""
        self.tick()

    def report(self, status: dict[str, Any]) -> None:
        """Print one line for the highest tenth completed since the last one."""
        tenths = status["scans"] * 10 // self.n_scans
        if tenths > self.tenths:
            self.tenths = tenths
            print(
                f"mapped   {tenths * 10:3d} %  {status['scans']:5d} scans, "
                f"{status['stamp_s']:6.0f} s of the drive",
                flush=True,
            )


# --- the program -----------------------------------------------------------------------------


def parse_arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    """Return the command line's options."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--speed", type=float, default=100.0, help="times real time (%(default)s)")
    parser.add_argument("--deterministic", action="store_true", help="virtual time, full speed")
    parser.add_argument("--scans", type=int, help="stop after that many scans")
    parser.add_argument("--poses", choices=("graph", "odometry"), default="graph")
    parser.add_argument("--cell", type=float, default=0.1, help="size of a cell [m] (%(default)s)")
    parser.add_argument("--out", type=Path, default=Path("map.png"), help="picture (%(default)s)")
    options = parser.parse_args(argv)
    for name in ("speed", "scans", "cell"):
        value = getattr(options, name)
        if value is not None and not (value > 0 and np.isfinite(value)):
            parser.error(f"--{name} must be a positive number, not {value}")
    return options


def main(argv: Sequence[str] | None = None) -> int:
    """Play the log through the nodes and write the map."""
    options = parse_arguments(argv)
    drive = parse_log(open_log(), options.scans)
    lasted_s = drive.stamp_s[-1]
    print(f"log      {len(drive)} scans, {N_BEAMS} beams each, recorded over {lasted_s:.0f} s")

    player = Player(drive, options.speed)
    beam_filter = BeamFilter(capacity=len(drive))
    localiser = Localiser(capacity=len(drive), dead_reckoning=options.poses == "odometry")
    mapper = Mapper(drive, options.cell)

    started_s = time.perf_counter()
    with Scheduler(tick_rate=PLAYER_RATE_HZ, deterministic=options.deterministic) as sched:
        sched.add(player).add(beam_filter).add(localiser).add(mapper).add(Progress(len(drive)))
        sched.run(duration=float(player.due_s[-1]) + DRAIN_TIME_S)
        report = sched.timing_report()
    took_s = time.perf_counter() - started_s

    mapped = len(mapper.path_m)
    if not mapped:
        print("no scan was mapped")
        return 1
    lost = player.published - mapped
    late_ms = np.percentile(player.lateness_s[: player.published], 99) * 1e3
    known = mapper.grid.log_odds[mapper.grid.known_box()]
    height_m, width_m = np.multiply(known.shape, options.cell)
    options.out.write_bytes(encode_png(mapper.grid.draw(np.array(mapper.path_m))))

    if mapped < len(drive):
        print(f"stopped  before the end of the log: {sched.stop_reason}")
    print(
        f"scans    {player.published} published, {mapped} mapped, {lost} lost, "
        f"{mapper.out_of_order} out of order\n"
        f"player   99 % of the scans left at most {late_ms:.1f} ms after their recorded time\n"
        f"filter   {beam_filter.removed} of {mapped * N_BEAMS} beams removed\n"
        f"odometry strays up to {localiser.max_drift_m:.1f} m from the relaxed poses\n"
        f"map      {width_m:.0f} x {height_m:.0f} m at {options.cell:.2f} m a cell, "
        f"{(known < 0).sum() * options.cell**2:.0f} m2 free, {(known > 0).sum()} wall cells\n"
        f"sha256   {mapper.grid.digest()}\n"
        f"took     {took_s:.2f} s, {mapped / took_s:.0f} scans/s\n"
        f"wrote    {options.out}\n"
    )
    print(report)
    return 0 if mapped == len(drive) and not lost and not mapper.out_of_order else 1


if __name__ == "__main__":
    sys.exit(main())
