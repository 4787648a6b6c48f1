"""What people use today for the three stages of a scan, each called as its documentation advises, on one thread.

small_gicp's VGICP localises, dufomap finds what moves, Open3D's cloud-to-cloud distances find what changed. They get
what favours them: points already de-skewed with the true motion, targets and clouds made outside the clock.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
import open3d as o3d
import small_gicp
from dufomap import dufomap

from mapvote.core.geometry import inverse, transform
from mapvote.core.grid import Grid
from mapvote.core.types import F32, F64, NO_VOTE, U8, Bool, CellState

VOXEL_M = 0.2
"""dufomap: at its usual 0.1 m a 32-beam scan hardly ever makes a voxel void."""
FAR_M = 0.5
"""A point farther than this from the other cloud is a change (evaluation/baselines.py)."""
LOST_M = 1.0
MIN_POINTS = 5
"""Far points that make a cell changed-occupied: n_min of the paper."""
Clock = Callable[[str, Callable[[], Any]], Any]
"""Runs something and adds its CPU time to a stage."""


class Vgicp:
    """Tracks with a perfect odometry: 0.5 m down-sampling, covariances of 10 neighbours, 1 m voxels.

    Each guess is its last pose moved on by the true motion since. By constant velocity it was lost on 20 of 70 scans of
    ``street`` 2: where a street tells little along itself it slides by centimetres, and its own guesses make metres of
    them. It begins at the true pose, and anew from it where it is more than LOST_M off.
    """

    def __init__(self, map_points: F64, T_true: F64) -> None:
        self.middle = map_points.mean(axis=0)  # its voxels hold float32 offsets
        cloud, _ = small_gicp.preprocess_points(
            map_points - self.middle, downsampling_resolution=0.3, num_neighbors=10, num_threads=1
        )
        self.target = small_gicp.GaussianVoxelMap(1.0)
        self.target.insert(cloud)
        self.T_true, self.lost = T_true, 0
        self.poses: list[F64] = []

    def __call__(self, points: F32, clock: Clock) -> F64:
        i = len(self.poses)
        guess = self.T_true[i].copy() if i < 1 else self.poses[-1] @ inverse(self.T_true[i - 1]) @ self.T_true[i]
        guess[:3, 3] -= self.middle
        cloud = points.astype(np.float64)
        T = clock("localise", lambda: self._align(cloud, guess)).copy()
        T[:3, 3] += self.middle
        if not np.linalg.norm((T - self.T_true[i])[:3, 3]) < LOST_M:
            T, self.lost = self.T_true[i], self.lost + 1
        self.poses.append(T)
        return T

    def _align(self, cloud: F64, guess: F64) -> F64:
        source, _ = small_gicp.preprocess_points(cloud, downsampling_resolution=0.5, num_neighbors=10, num_threads=1)
        return np.asarray(
            small_gicp.align(self.target, source, guess, num_threads=1, max_iterations=30).T_target_source
        )


class Dufomap:
    """Decides a scan as late as we do: ten scans later. ``masks`` holds what moves by scan."""

    def __init__(self, look_ahead: int) -> None:
        self.dufo = dufomap(VOXEL_M, VOXEL_M, 1, num_threads=1)
        self.look_ahead = look_ahead
        self.waiting: deque[tuple[F32, F64]] = deque()
        self.masks: list[Bool] = []

    def __call__(self, points: F32, T_map_lidar: F64, clock: Clock) -> None:
        self.waiting.append((points, T_map_lidar))
        clock("moving", lambda: self.dufo.run(points, T_map_lidar, True))
        if len(self.waiting) > self.look_ahead:
            scan = self.waiting.popleft()
            self.masks.append(clock("moving", lambda: self.dufo.segment(*scan, True)).astype(bool))

    def finish(self) -> None:
        """What still waits, outside the clock."""
        self.masks += [self.dufo.segment(*scan, True).astype(bool) for scan in self.waiting]


class CloudToCloud:
    """Distances both ways between a scan and the map around it; over the drive, cells that changed.

    ``obstacles_map`` (n, 3) are the map's points above ground; the ground is compared by neither side.
    """

    def __init__(self, obstacles_map: F64, grid: Grid, half_m: float) -> None:
        self.map, self.grid, self.half_m = obstacles_map, grid, half_m
        self.nearest = np.full(len(obstacles_map), np.inf)
        self.new: list[F64] = []

    def __call__(self, points: F32, T_map_lidar: F64, clock: Clock) -> None:
        scan, here = transform(T_map_lidar, points), T_map_lidar[:2, 3]
        scan = scan[np.abs(scan[:, :2] - here).max(axis=1) < self.half_m]
        near = np.flatnonzero(np.abs(self.map[:, :2] - here).max(axis=1) < self.half_m)
        of_scan, of_map = _cloud(scan), _cloud(self.map[near])
        to_map, to_scan = clock(
            "see + vote",
            lambda: (of_scan.compute_point_cloud_distance(of_map), of_map.compute_point_cloud_distance(of_scan)),
        )
        self.nearest[near] = np.minimum(self.nearest[near], np.asarray(to_scan))
        self.new.append(scan[np.asarray(to_map) > FAR_M])

    def states(self, is_obstacle: Callable[[F64], Bool]) -> U8:
        """(rows, cols): changed-empty where over half of the map's points stayed far, changed-occupied where enough
        of the scans' points above ground did."""
        new = np.concatenate(self.new)
        new = new[is_obstacle(new)]
        seen = np.isfinite(self.nearest)
        all_, far = self._count(self.map[seen]), self._count(self.map[self.nearest > FAR_M])
        states = np.full(self.grid.shape, NO_VOTE, dtype=np.uint8)
        states[self._count(new) >= MIN_POINTS] = CellState.CHANGED_OCCUPIED
        states[2 * far > all_] = CellState.CHANGED_EMPTY
        return states

    def _count(self, points: F64) -> np.ndarray[Any, Any]:
        rows, cols, inside = self.grid.indices_of(points)
        flat = rows[inside] * self.grid.cols + cols[inside]
        return np.bincount(flat, minlength=self.grid.rows * self.grid.cols).reshape(self.grid.shape)


def _cloud(points: F64) -> o3d.geometry.PointCloud:
    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
