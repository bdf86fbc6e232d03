"""The occupancy grid: what the map knows and what the sensors have seen since."""

from __future__ import annotations

import numpy as np

from agv import layout

CELL_M = 0.04
COLUMNS = round(layout.FLOOR.x_max / CELL_M)
ROWS = round(layout.FLOOR.y_max / CELL_M)

HARD_CLEARANCE_M = 0.42
"""The vehicle's middle may not come closer to anything: half its width and a margin."""
SOFT_CLEARANCE_M = 0.95
"""Closer than this costs extra, so that paths keep to the middle of an aisle."""
SOFT_WEIGHT = 5.0
BLOCKED = np.inf

_HIT, _PASS, _FULL, _OCCUPIED = 2, -1, 6, 3
_KNOWN_MARGIN_M = 0.2


def _static_clearance() -> np.ndarray:
    """Return each cell's distance to walls and racks, (ROWS, COLUMNS) float64 [m]."""
    x = (np.arange(COLUMNS) + 0.5) * CELL_M
    y = ((np.arange(ROWS) + 0.5) * CELL_M)[:, None]
    floor = layout.FLOOR
    clearance: np.ndarray = np.minimum(
        np.minimum(x - floor.x_min, floor.x_max - x), np.minimum(y - floor.y_min, floor.y_max - y)
    )
    for rack in layout.RACKS:
        outside_x = np.maximum(np.maximum(rack.x_min - x, x - rack.x_max), 0.0)
        outside_y = np.maximum(np.maximum(rack.y_min - y, y - rack.y_max), 0.0)
        clearance = np.minimum(clearance, np.hypot(outside_x, outside_y))
    return clearance


def _disc() -> np.ndarray:
    """Return the distances of the cells around an occupied one [m], a square window."""
    reach = int(SOFT_CLEARANCE_M / CELL_M) + 1
    steps = np.arange(-reach, reach + 1) * CELL_M
    # Something in a cell may be at the cell's edge.
    window: np.ndarray = np.maximum(np.hypot(steps, steps[:, None]) - CELL_M / 2, 0.0)
    return window


class EvidenceLayer:
    """Count how often each cell was seen occupied and how often seen free."""

    def __init__(self) -> None:
        """Start without evidence."""
        self._evidence = np.zeros((ROWS, COLUMNS), dtype=np.int8)

    def update(self, hits: np.ndarray, free: np.ndarray) -> None:
        """Add one measurement: points that were hit and points seen to be free, (n, 2) [m]."""
        passed = _cells(free)
        hit = _cells(hits)
        passed &= ~hit
        evidence = self._evidence
        evidence[passed] += _PASS
        evidence[hit] += _HIT
        np.clip(evidence, 0, _FULL, out=evidence)

    @property
    def occupied(self) -> np.ndarray:
        """Return the cells that are occupied, (ROWS, COLUMNS) bool."""
        return self._evidence >= _OCCUPIED


def _cells(points: np.ndarray) -> np.ndarray:
    """Return the cells that contain a point, (ROWS, COLUMNS) bool."""
    mask = np.zeros((ROWS, COLUMNS), dtype=bool)
    columns, rows = np.floor(points / CELL_M).astype(int).T
    inside = (columns >= 0) & (columns < COLUMNS) & (rows >= 0) & (rows < ROWS)
    mask[rows[inside], columns[inside]] = True
    return mask


class OccupancyGrid:
    """Merge the static map with what LiDARs and camera see.

    The two kinds of sensor have a layer each: a LiDAR that looks over a low carton must not
    erase what the camera knows about it.
    """

    def __init__(self) -> None:
        """Start from the static map."""
        self.lidar = EvidenceLayer()
        self.camera = EvidenceLayer()
        self._static_clearance = _static_clearance()
        self._unknown = self._static_clearance > _KNOWN_MARGIN_M
        self._disc = _disc()

    def add_scan(self, origin: tuple[float, float], hits: np.ndarray) -> None:
        """Add a scan: the cells along each beam are free, the cell at its end is not."""
        start = np.asarray(origin)
        reach = np.hypot(*(hits - start).T)
        along = np.arange(CELL_M, reach.max(initial=0.0), CELL_M)[:, None]
        # A beam says nothing about the last cell before its end.
        short_of_end = along < reach - 1.5 * CELL_M
        fraction = along / reach
        x = start[0] + fraction * (hits[:, 0] - start[0])
        y = start[1] + fraction * (hits[:, 1] - start[1])
        self.lidar.update(hits, np.column_stack((x[short_of_end], y[short_of_end])))

    def seen(self) -> np.ndarray:
        """Return the occupied cells that are not on the static map, (ROWS, COLUMNS) bool."""
        found: np.ndarray = (self.lidar.occupied | self.camera.occupied) & self._unknown
        return found

    def weights(self) -> np.ndarray:
        """Return the price of crossing each cell, at least 1, (ROWS, COLUMNS) float64."""
        clearance = self._static_clearance.copy()
        reach = len(self._disc) // 2
        for row, column in np.argwhere(self.seen()):
            top, left = max(row - reach, 0), max(column - reach, 0)
            window = clearance[top : row + reach + 1, left : column + reach + 1]
            disc = self._disc[top - row + reach :, left - column + reach :]
            np.minimum(window, disc[: window.shape[0], : window.shape[1]], out=window)
        narrow = np.clip(
            (SOFT_CLEARANCE_M - clearance) / (SOFT_CLEARANCE_M - HARD_CLEARANCE_M), 0.0, 1.0
        )
        return np.where(clearance < HARD_CLEARANCE_M, BLOCKED, 1.0 + SOFT_WEIGHT * narrow**2)
