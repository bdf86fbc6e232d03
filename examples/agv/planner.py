"""A* on the occupancy grid, and what turns its steps into a path that can be driven.

The search is deliberately plain Python: it is the CPU-heavy work that a robot program must keep
away from its motor loop.
"""

from __future__ import annotations

import heapq
import math
from itertools import pairwise

import numpy as np

from agv.grid import BLOCKED, CELL_M, COLUMNS, ROWS

CRUISE_MPS = 1.6
COMFORT_MPS2 = 1.1
LATERAL_MPS2 = 0.9
SMOOTHING_ROUNDS = 360
BEND_WINDOW_M = 0.5

_DIAGONAL = math.sqrt(2.0)
# The grid is searched as one flat list with a blocked border: no index is ever out of range.
_STRIDE = COLUMNS + 2
_MOVES = tuple(
    (row * _STRIDE + column, math.hypot(row, column))
    for row in (-1, 0, 1)
    for column in (-1, 0, 1)
    if row or column
)


def _index(x_m: float, y_m: float) -> int:
    column = min(max(int(x_m / CELL_M), 0), COLUMNS - 1)
    row = min(max(int(y_m / CELL_M), 0), ROWS - 1)
    return (row + 1) * _STRIDE + column + 1


def _center(index: int) -> tuple[float, float]:
    row, column = divmod(index, _STRIDE)
    return (column - 0.5) * CELL_M, (row - 0.5) * CELL_M


def _nearest_open(weights: list[float], start: int) -> int | None:
    """Return the open cell nearest to one that may itself be blocked, by breadth-first search."""
    frontier, known = [start], {start}
    while frontier:
        for index in frontier:
            if weights[index] < BLOCKED:
                return index
        reached = {index + move for index in frontier for move, _ in _MOVES}
        frontier = sorted(i for i in reached - known if 0 <= i < len(weights))
        known |= reached
    return None


def a_star(weights: list[float], start: int, goal: int) -> list[int]:
    """Return the cheapest chain of cells from start to goal, empty when there is none.

    A step costs its length times the mean weight of its two cells; as no weight is below 1, the
    octile distance never overestimates.
    """
    goal_row, goal_column = divmod(goal, _STRIDE)
    cost = {start: 0.0}
    came_from: dict[int, int] = {}
    closed: set[int] = set()
    queue = [(0.0, start)]
    while queue:
        _, here = heapq.heappop(queue)
        if here == goal:
            chain = [here]
            while here != start:
                here = came_from[here]
                chain.append(here)
            return chain[::-1]
        if here in closed:
            continue
        closed.add(here)
        cost_here, weight_here = cost[here], weights[here]
        for move, length in _MOVES:
            there = here + move
            weight = weights[there]
            if weight == BLOCKED or there in closed:
                continue
            candidate = cost_here + length * 0.5 * (weight_here + weight)
            if candidate < cost.get(there, BLOCKED):
                cost[there] = candidate
                came_from[there] = here
                row, column = divmod(there, _STRIDE)
                d_row, d_column = abs(row - goal_row), abs(column - goal_column)
                straight, diagonal = abs(d_row - d_column), min(d_row, d_column)
                heapq.heappush(queue, (candidate + straight + _DIAGONAL * diagonal, there))
    return []


def _smooth(points: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Relax a chain of cell centres into a curve that keeps out of blocked cells."""
    points = points.copy()
    for _ in range(SMOOTHING_ROUNDS):
        moved = 0.5 * points[1:-1] + 0.25 * (points[:-2] + points[2:])
        columns, rows = (moved / CELL_M).astype(int).T
        open_cell = weights[rows, columns] < BLOCKED
        points[1:-1][open_cell] = moved[open_cell]
    return points


def _speeds(points: np.ndarray) -> np.ndarray:
    """Return the speed allowed at each point, (n,) float64 [m/s]: slow in bends, 0 at the end."""
    steps = np.diff(points, axis=0)
    lengths = np.hypot(*steps.T)
    turns = np.abs(np.diff(np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))))
    # Averaged over half a metre: the single steps of the grid are not bends.
    window = np.ones(round(BEND_WINDOW_M / CELL_M))
    allowed = np.full(len(points), CRUISE_MPS)
    if len(turns):
        bend = np.convolve(turns, window)[len(window) // 2 :][: len(turns)] / BEND_WINDOW_M
        allowed[1:-1] = np.minimum(CRUISE_MPS, np.sqrt(LATERAL_MPS2 / np.maximum(bend, 1e-3)))
    speeds = [0.0]
    for speed, length in zip(allowed[-2::-1].tolist(), lengths[::-1].tolist(), strict=True):
        speeds.append(min(speed, math.sqrt(speeds[-1] ** 2 + 2 * COMFORT_MPS2 * length)))
    return np.array(speeds[::-1])


def plan(weights: np.ndarray, start: tuple[float, float], goal: tuple[float, float]) -> np.ndarray:
    """Plan a path from where the vehicle is to its goal.

    Args:
        weights: the price of each cell, (ROWS, COLUMNS) float64.
        start: where the vehicle's middle is [m].
        goal: where it is to go [m].

    Returns:
        The path, (n, 3) float64: x [m], y [m] and allowed speed [m/s];
        no rows when there is no way.
    """
    bordered = np.pad(weights, 1, constant_values=BLOCKED).ravel().tolist()
    first = _nearest_open(bordered, _index(*start))
    last = _index(*goal)
    chain = a_star(bordered, first, last) if first is not None else []
    if not chain:
        return np.empty((0, 3))
    points = np.array([start, *(_center(index) for index in chain[1:-1]), goal])
    points = _smooth(points, weights)
    return np.column_stack((points, _speeds(points)))


def length_m(path: np.ndarray) -> float:
    """Return the length of a path [m]."""
    return sum(math.dist(a, b) for a, b in pairwise(path[:, :2].tolist()))
