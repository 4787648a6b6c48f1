"""Yardstick: nearest-neighbour distances, the plainest change detector there is.

Points of either cloud farther than 0.5 m from the other are changes ([11][12] of the paper work in this manner). It
knows nothing of visibility: what was not seen is taken for gone, within the same 80 m window as the voters use.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from mapvote.core.grid import CELL_SIZE, Grid
from mapvote.core.point_map import PointMap
from mapvote.core.reference import reference_window
from mapvote.core.types import F64, NO_VOTE, U8, Bool, CellState
from mapvote.core.voxels import voxel_downsample

DISTANCE_M = 0.5
_MERGE_EVERY = 16


def heights_above_ground(point_map: PointMap, points: F64) -> F64:
    """(n,) metres above the map's ground of points (n, 3); above the nearest known ground where it is unknown."""
    lattice = point_map.lattice
    rows, cols = lattice.cells_of(points) if len(points) else (np.zeros(1, np.int64), np.zeros(1, np.int64))
    row, col = int(rows.min()), int(cols.min())
    window = Grid(lattice, row, col, int(rows.max()) - row + 1, int(cols.max()) - col + 1)
    reference = reference_window(point_map, window)
    filled = np.where(np.isnan(reference.ground_z), reference.base * CELL_SIZE, reference.ground_z)
    return points[:, 2] - filled[rows - row, cols - col] if len(points) else np.zeros(0)


class NearestNeighbour:
    """One vehicle's detector: push every scan, then ask for its states. One cloud of 0.3 m voxels is kept."""

    def __init__(self, obstacles_map: F64, grid: Grid, window_m: float = 80.0) -> None:
        """``obstacles_map`` (n, 3): the old map's points above ground; states are given over ``grid``."""
        self._map = obstacles_map
        self._grid = grid
        self._half = 0.5 * window_m
        self._seen = np.zeros(grid.shape, dtype=np.bool_)
        self._clouds = [np.zeros((0, 3))]

    def push(self, points_map: F64, origin_map: F64, obstacle: Bool, moving: Bool) -> None:
        """One scan: points (n, 3) and sensor (3,) in map metres; which are above ground, which belong to movers."""
        near = np.abs(points_map[:, :2] - origin_map[:2]).max(axis=1) <= self._half
        self._clouds.append(points_map[near & obstacle & ~moving])
        if len(self._clouds) > _MERGE_EVERY:
            self._clouds = [self._cloud()]
        x, y = self._grid.centres()
        rows, cols = np.abs(y - origin_map[1]) <= self._half, np.abs(x - origin_map[0]) <= self._half
        self._seen[np.ix_(rows, cols)] = True

    def _cloud(self) -> F64:
        cloud = np.concatenate(self._clouds)
        lattice = self._grid.lattice
        return cloud[voxel_downsample(cloud, CELL_SIZE, lattice.x0, lattice.y0)]

    @property
    def memory_bytes(self) -> int:
        """Held between scans."""
        return int(sum(cloud.nbytes for cloud in self._clouds) + self._seen.nbytes)

    def states(self) -> U8:
        """(rows, cols) CellState: changed where more than half of the cell's map points, or any new point, are far."""
        cloud = self._cloud()
        map_far, map_all = self._far_and_all(self._map, cloud)
        new_far, new_all = self._far_and_all(cloud, self._map)
        states = np.full(self._grid.shape, CellState.UNCHANGED_EMPTY, dtype=np.uint8)
        states[(map_all > 0) | (new_all > 0)] = CellState.UNCHANGED_OCCUPIED
        states[new_far > 0] = CellState.CHANGED_OCCUPIED
        states[2 * map_far > map_all] = CellState.CHANGED_EMPTY
        states[~self._seen] = NO_VOTE
        return states

    def _far_and_all(self, points: F64, other: F64) -> tuple[np.ndarray, np.ndarray]:
        """Per cell, how many ``points`` are farther than DISTANCE_M from ``other``, and how many there are."""
        far = np.ones(len(points), dtype=np.bool_)
        if len(points) and len(other):
            far = np.isinf(cKDTree(other).query(points, distance_upper_bound=DISTANCE_M)[0])
        rows, cols, inside = self._grid.indices_of(points)
        cell = rows * self._grid.cols + cols
        size = self._grid.rows * self._grid.cols
        counts = [
            np.bincount(cell[chosen], minlength=size).reshape(self._grid.shape) for chosen in (inside & far, inside)
        ]
        return counts[0], counts[1]
