"""VGICP of small_gicp as a matcher: distributions of the map's voxels against distributions of the scan's points.

Koide et al., Voxelized GICP for Fast and Accurate 3D Point Cloud Registration, ICRA 2021. small_gicp registers; what
localisation asks besides (the likelihood of places, what the map leads to expect) is answered here from its voxels.
Needs the extra ``vgicp``. docs/measurements/localisation.md has its figures beside NDT's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mapvote.core.extras import require
from mapvote.core.geometry import exp, log
from mapvote.core.grid import window_around
from mapvote.core.point_map import PointMap
from mapvote.core.record import record
from mapvote.core.types import F32, F64, I64, Bool, PosePrior, Registration
from mapvote.matching.matcher import CONVERGENCE


@record(votes=True)
@dataclass(frozen=True, slots=True)
class Vgicp:
    """Numbers of the matcher ``vgicp``."""

    coarse_m: float = 3.0
    """Side of the map's voxels where a guess may be metres off."""
    fine_m: float = 1.0
    """Side of the map's voxels at last."""
    neighbours: int = 10
    """Points that give a point of the map or of the scan its covariance."""
    map_spacing_m: float = 0.25
    """The map is thinned to one point per voxel of this side before its covariances are estimated."""
    reach_voxels: float = 3.0
    """A scan's point is paired with a voxel no farther away than this many sides of it."""
    half_window_m: float = 96.0
    """The map is laid out this far to all sides of the vehicle."""
    central_m: float = 24.0
    """The map is laid out anew once the vehicle is this far from the middle."""
    floor_share: float = 0.1
    """Standard deviation added to every voxel where likelihoods are asked for, isotropic, as a share of its side."""
    iterations: int = 20
    """Most steps of a registration at one side."""
    inlier_e: float = 7.81
    """Squared Mahalanobis distance of an inlier: 95 % of chi-square with 3 degrees of freedom."""
    covariance_scale: float = 5.0
    """Factor on the inverse Hessian: neighbouring residuals share most of their error."""
    map_sigma_m: float = 0.01
    """Standard deviation of the map itself, which no residual shows."""


VGICP = Vgicp()


class _Voxels:
    """small_gicp's voxels of one side, and their distributions where they can be looked up."""

    def __init__(self, cloud: Any, side_m: float, numbers: Vgicp) -> None:
        """``cloud``: small_gicp's, with covariances."""
        self.side_m = side_m
        self.reach_m = numbers.reach_voxels * side_m
        self.voxels = _library().GaussianVoxelMap(side_m)
        self.voxels.insert(cloud)
        means = np.asarray(self.voxels.voxel_points())[:, :3]
        covariances = np.asarray(self.voxels.voxel_covs()).reshape(-1, 4, 4)[:, :3, :3]
        keys = self._keys(means)
        order = np.argsort(keys)
        self._sorted_keys = keys[order]
        self._means = means[order]
        self.covariances = covariances[order]
        floor_m = numbers.floor_share * side_m
        self.precisions = np.linalg.inv(self.covariances + floor_m**2 * np.eye(3))

    def rows_of(self, points: F64) -> tuple[I64, Bool]:
        """(n,) row of the voxel of each point (n, 3) about the centre, and whether it has one."""
        keys = self._keys(points)
        row = np.minimum(np.searchsorted(self._sorted_keys, keys), len(self._sorted_keys) - 1)
        return row, np.asarray(self._sorted_keys[row] == keys)

    def squared_distances(self, points: F64) -> F64:
        """(n,) squared Mahalanobis distances of points (n, 3) about the centre from their voxels; inf outside."""
        row, there = self.rows_of(points)
        u = points - self._means[row]
        e = np.einsum("ni,nij,nj->n", u, self.precisions[row], u)
        return np.where(there, e, np.inf).astype(np.float64)

    def _keys(self, points: F64) -> I64:
        """One number per voxel."""
        index = np.floor(points / self.side_m).astype(np.int64) + (1 << 20)
        return np.asarray((index[:, 0] << 42) | (index[:, 1] << 21) | index[:, 2])


class VgicpMap:
    """A part of the map as small_gicp's voxels. See :class:`mapvote.matching.matcher.LocalMatcher`."""

    def __init__(self, points_map: F64, centre: F64, numbers: Vgicp = VGICP) -> None:
        """``points_map`` (n, 3) metres; the voxels lie about ``centre`` (3,), where float32 suffices."""
        self.numbers = numbers
        self.centre = centre
        local = np.ascontiguousarray(points_map - centre)
        cloud, _ = _library().preprocess_points(local, numbers.map_spacing_m, numbers.neighbours, 1)
        self._coarse = _Voxels(cloud, numbers.coarse_m, numbers)
        self._fine = _Voxels(cloud, numbers.fine_m, numbers)

    def refine(
        self,
        clouds: Sequence[F32],
        T_map_lidar_guess: F64,
        prior: PosePrior | None = None,
        first_level: int = 0,
        settled: tuple[float, float] = CONVERGENCE.settled,
    ) -> Registration:
        """See :class:`mapvote.matching.matcher.LocalMatcher`. The finest cloud alone is used; ``prior`` is weighed
        against the scan by their information afterwards."""
        points = np.ascontiguousarray(clouds[-1].T, dtype=np.float64)
        T = np.array(T_map_lidar_guess, dtype=np.float64)
        if len(points) <= self.numbers.neighbours:
            return Registration(T, np.eye(6), 0.0, 0.0, 0, False)
        T[:3, 3] -= self.centre
        # A point's covariance is of its neighbours in the scan: once for both sides.
        small_gicp = _library()
        source = small_gicp.PointCloud(points)
        small_gicp.estimate_covariances(source, small_gicp.KdTree(source), self.numbers.neighbours, 1)
        for level in [self._coarse, self._fine] if first_level == 0 else [self._fine]:
            reach_m = level.reach_m
            most = self.numbers.iterations
            result = small_gicp.align(level.voxels, source, T, max_correspondence_distance=reach_m, max_iterations=most)
            T = np.array(result.T_target_source)
        T[:3, 3] += self.centre
        covariance = self._covariance(np.asarray(result.H), T[:3, :3])
        if prior is not None:
            T, covariance = _weighed(T, covariance, prior)
        e = self._fine.squared_distances(points @ T[:3, :3].T + T[:3, 3] - self.centre)
        score = float(np.exp(-0.5 * e).mean())
        inlier_share = float((e < self.numbers.inlier_e).mean())
        return Registration(T, covariance, score, inlier_share, result.iterations, result.converged)

    def likelihood(self, cloud: F32, T_map_lidar: F64, level: int = 0) -> F64:
        """See :class:`mapvote.matching.matcher.LocalMatcher`. Level 0 is the coarse side, all others the fine one."""
        points = cloud.T.astype(np.float64)
        if not len(points):
            return np.zeros(len(T_map_lidar))
        voxels = self._coarse if level == 0 else self._fine
        placed = np.einsum("mij,nj->mni", T_map_lidar[:, :3, :3], points) + T_map_lidar[:, None, :3, 3]
        e = voxels.squared_distances((placed - self.centre).reshape(-1, 3))
        return np.asarray(np.exp(-0.5 * e).reshape(len(T_map_lidar), -1).mean(axis=1))

    def expected(self, points_map: F64, noise_m: float) -> tuple[F64, Bool]:
        """See :class:`mapvote.matching.matcher.LocalMatcher`. E exp(-u'Cu / 2) = det(I + S C)^-1/2, u ~ N(0, S)."""
        local = points_map - self.centre
        row, there = self._fine.rows_of(local)
        row = row[there]
        S = self._fine.covariances[row] + noise_m**2 * np.eye(3)
        determinant = np.linalg.det(np.eye(3) + S @ self._fine.precisions[row])
        near = np.zeros(len(points_map), dtype=np.bool_)
        steps = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)])
        for step in steps * self.numbers.coarse_m:
            near |= self._coarse.rows_of(local + step)[1]
        return np.asarray(1.0 / np.sqrt(np.maximum(determinant, 1.0)), dtype=np.float64), near

    def _covariance(self, H: F64, R: F64) -> F64:
        """(6, 6) of the error (rho, phi) in map axes; H is of (phi, rho) in the lidar's axes."""
        curvature = H + 1e-6 * max(float(np.trace(H)), 1.0) * np.eye(6)
        own = self.numbers.covariance_scale * np.linalg.inv(curvature)
        to_map = np.zeros((6, 6))
        to_map[:3, 3:] = R
        to_map[3:, :3] = R
        of_map = np.diag([self.numbers.map_sigma_m**2] * 3 + [0.0] * 3)
        return np.asarray(to_map @ own @ to_map.T + of_map)


def _weighed(T: F64, covariance: F64, prior: PosePrior) -> tuple[F64, F64]:
    """A pose and its covariance, joined with a prior by their information."""
    turn = log(prior.T_map_lidar @ np.linalg.inv(T))[3:]
    away = np.concatenate([prior.T_map_lidar[:3, 3] - T[:3, 3], turn])
    information = np.linalg.inv(covariance)
    joined = np.asarray(np.linalg.inv(information + prior.information), dtype=np.float64)
    step = joined @ (prior.information @ away)
    moved = T.copy()
    moved[:3, :3] = exp(np.concatenate([np.zeros(3), step[3:]]))[:3, :3] @ T[:3, :3]
    moved[:3, 3] += step[:3]
    return moved, joined


def _library() -> Any:
    """small_gicp; MapvoteError naming the extra if it is missing. The record above is read without it."""
    return require("small_gicp", "vgicp", "ndt.matcher = vgicp")


class VgicpWindow:
    """See :class:`mapvote.matching.matcher.MapAround`: laid out anew when the vehicle leaves its middle."""

    def __init__(self, point_map: PointMap, numbers: Vgicp = VGICP) -> None:
        _library()
        self.point_map = point_map
        self.numbers = numbers
        self._laid_out: VgicpMap | None = None

    def __call__(self, position: F64) -> VgicpMap:
        """The part around a position (3,), map metres."""
        laid_out = self._laid_out
        if laid_out is None or np.abs(position - laid_out.centre).max() > self.numbers.central_m:
            laid_out = VgicpMap(self._points_around(position), np.array(position, dtype=np.float64), self.numbers)
            self._laid_out = laid_out
        return laid_out

    def prepare(self, position: F64) -> None:
        """Nothing is made ahead."""

    def go_on_in(self, point_map: PointMap) -> None:
        """The map is another version from here on."""
        self.point_map = point_map
        self._laid_out = None

    def _points_around(self, position: F64) -> F64:
        half_m = self.numbers.half_window_m
        window = window_around(self.point_map.lattice, float(position[0]), float(position[1]), 2 * half_m)
        tiles = [self.point_map.tiles[index] for index in window.tiles() if index in self.point_map.tiles]
        points = np.concatenate([np.zeros((0, 3)), *[tile.points_map for tile in tiles]])
        near = np.abs(points[:, :2] - position[:2]).max(axis=1) <= half_m
        return np.asarray(points[near])
