"""NDT: a map of Gaussians, and the pose at which a scan fits it best (paper II).

Magnusson, The Three-Dimensional Normal-Distributions Transform, 2009, with three changes: every voxel's
distribution is widened by an isotropic floor instead of an eigenvalue clamp; Gauss-Newton steps on the
reweighted form replace full Newton, which diverges from 0.4 m; voxels are found through a dense index over
a bounded window. A point is compared with its own voxel and the six beside it (DIRECT7).

Pose errors are (6,) vectors (rho, phi) in map axes about the sensor: t' = t + rho, R' = exp(phi) R.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapvote.core.geometry import exp, log
from mapvote.core.types import F64, Drive, Registration, check_array
from mapvote.core.voxels import thin
from mapvote.localisation.ndt_kernels import normal_equations
from mapvote.localisation.ndt_voxels import Voxels, Window, enter_points, reindex


@dataclass(frozen=True, slots=True)
class Level:
    """One step of the coarse-to-fine search."""

    voxel_m: float
    """Side of the NDT voxels."""
    floor_m: float
    """Standard deviation added to every voxel's distribution, isotropic."""
    points_m: float
    """The scan is thinned to one point per voxel of this side."""
    iterations: int
    """Most Gauss-Newton steps at this level."""


LEVELS = Level(3.0, 0.5, 1.0, 15), Level(2.0, 0.25, 1.0, 15), Level(1.0, 0.1, 0.7, 15)
"""Coarse to fine: voxels of the paper's 0.3 m have no basin, and denser scans gave no better median."""
HALF_WINDOW_M, BELOW_M, ABOVE_M = 96.0, 24.0, 40.0
"""How far the window reaches to the sides, below and above its centre: as far as a scan has points to speak of."""
CENTRAL_M = 24.0
"""A vehicle this far from the window's centre still has 72 m of map to all sides."""
MIN_POINTS = 3
"""A voxel with fewer points has no distribution: two make a line."""
COVARIANCE_SCALE = 5.0
"""What neighbouring residuals have in common, calibrated so that normalised squared errors average 6."""
MAP_SIGMA_M, MAP_SIGMA_RAD = 0.01, float(np.radians(0.03))
"""What the map itself is off by around a scan, which no residual shows."""
_LEVER_M = 20.0
"""Distance at which a rotation is weighed against a shift, where one tolerance must serve both."""


class NdtGrid:
    """One level of the map: voxels of one size. All are kept; those inside the window can be found."""

    def __init__(self, level: Level, half: float) -> None:
        size = level.voxel_m
        shape = (round(2 * half / size), round(2 * half / size), round((BELOW_M + ABOVE_M) / size))
        self.level = level
        self.reach = np.array([half, half, BELOW_M])
        self.window = Window(np.full(shape, -1, dtype=np.int32), np.zeros(3, dtype=np.int64), size)
        self.voxels = Voxels(np.zeros((1024, 3), dtype=np.int64), np.zeros((1024, 11)), np.zeros((1024, 9)))
        self.n = 0

    def recentre(self, centre: F64) -> None:
        """Move the window; what was entered before and lies inside is found again."""
        self.window.lowest[:] = np.round((centre - self.reach) / self.level.voxel_m).astype(np.int64)
        reindex(self.window, self.voxels.place, self.n)

    def enter(self, points_map: F64) -> None:
        """Enter points (n, 3) in map metres; those outside the window are left out."""
        left = points_map
        while len(left):
            if self.n == len(self.voxels.place):
                self.voxels = Voxels(*(np.concatenate([a, np.zeros_like(a)]) for a in self.voxels))
            self.n, looked_at = enter_points(left, self.window, self.voxels, self.n, self.level.floor_m, MIN_POINTS)
            left = left[looked_at:]


class NdtMap:
    """All levels over one bounded window around ``centre`` (map metres), coarse to fine. Grows by :meth:`enter`."""

    def __init__(self, centre: F64, levels: Sequence[Level] = LEVELS, half_window_m: float = HALF_WINDOW_M) -> None:
        self.levels = [NdtGrid(level, half_window_m) for level in levels]
        self.recentre(centre)

    def recentre(self, centre: F64) -> None:
        """Put the middle of the window at ``centre`` (3,)."""
        self.centre = np.asarray(centre, dtype=np.float64).copy()
        for grid in self.levels:
            grid.recentre(self.centre)

    def is_central(self, position: F64) -> bool:
        """Whether ``position`` (3,) is near enough to the middle for the window to hold what a scan reaches."""
        return bool(np.abs(np.asarray(position) - self.centre).max() <= CENTRAL_M)

    def enter(self, points_map: NDArray[np.floating]) -> None:
        """Enter points (n, 3) in map metres into every level."""
        points = np.ascontiguousarray(points_map, dtype=np.float64)
        for grid in self.levels:
            grid.enter(points)


@dataclass(frozen=True, slots=True)
class PosePrior:
    """What is believed of a pose before looking: independent errors of position and rotation."""

    T_map_lidar: F64
    sigma_m: float
    sigma_rad: float

    def __post_init__(self) -> None:
        check_array(self.T_map_lidar, "T_map_lidar of the prior", (4, 4), np.float64)

    @classmethod
    def of(cls, drive: Drive, i: int) -> PosePrior | None:
        """What ``drive`` brings for its scan ``i``, if anything."""
        if drive.T_map_lidar_prior is None:
            return None
        return cls(drive.T_map_lidar_prior[i], drive.prior_sigma_m, float(np.radians(drive.prior_sigma_deg)))

    @property
    def information(self) -> F64:
        """(6, 6) inverse covariance."""
        return np.diag([self.sigma_m**-2] * 3 + [self.sigma_rad**-2] * 3)


def build_ndt(points_map: NDArray[np.floating], centre: F64 | None = None) -> NdtMap:
    """The NDT map of points (n, 3) in map metres, its window around ``centre`` (default: the middle of the points)."""
    if centre is None:
        centre = 0.5 * (points_map.min(axis=0) + points_map.max(axis=0)).astype(np.float64)
    ndt_map = NdtMap(centre)
    ndt_map.enter(points_map)
    return ndt_map


def thin_for_levels(points_lidar: NDArray[np.floating]) -> list[F64]:
    """The scan as each level wants it: one point per voxel of the level's ``points_m``. Finest first thinned once."""
    clouds: dict[float, F64] = {}
    source = np.ascontiguousarray(points_lidar, dtype=np.float32)
    for size in sorted({level.points_m for level in LEVELS}):
        source = source[thin(source, size)]
        clouds[size] = source.astype(np.float64)
    return [clouds[level.points_m] for level in LEVELS]


def register(
    ndt_map: NdtMap,
    points_lidar: NDArray[np.floating],
    T_map_lidar_guess: F64,
    *,
    prior: PosePrior | None = None,
    first_level: int = 0,
) -> Registration:
    """The pose of a de-skewed scan (n, 3) in the map, from a guess; ``prior`` enters as a factor at the finest level.

    Never raises for bad overlap: the inlier share and the score are low instead, and the caller abstains.
    """
    return refine(ndt_map, thin_for_levels(points_lidar), T_map_lidar_guess, prior, first_level)


def refine(
    ndt_map: NdtMap, clouds: list[F64], T_map_lidar_guess: F64, prior: PosePrior | None = None, first_level: int = 0
) -> Registration:
    """:func:`register` for a scan already thinned by :func:`thin_for_levels`."""
    T = T_map_lidar_guess.copy()
    iterations = 0
    last = len(ndt_map.levels) - 1
    for i in range(first_level, last + 1):
        grid = ndt_map.levels[i]
        tolerance = (0.01 if i == last else 0.05) * grid.level.floor_m
        converged = False
        for _ in range(grid.level.iterations):
            iterations += 1
            H, g, M, score, inlier_share = _equations(grid, clouds[i], T)
            covariance, step = _solve(H, g, M)
            if prior is not None and i == last:
                covariance, step = _fuse(covariance, step, prior, T)
            T = _moved(T, _clamped(step, 0.5 * grid.level.voxel_m))
            if np.linalg.norm(step[:3]) < tolerance and np.linalg.norm(step[3:]) * _LEVER_M < tolerance:
                converged = True
                break
    return Registration(T, covariance, score, inlier_share, iterations, converged)


def fitness(ndt_map: NdtMap, clouds: list[F64], T_map_lidar: F64, level: int = 0) -> float:
    """Mean likelihood of the scan at a pose, in [0, 1], at one level: to rank guesses before any is refined."""
    return _equations(ndt_map.levels[level], clouds[level], T_map_lidar)[3]


def _equations(grid: NdtGrid, points: F64, T: F64) -> tuple[F64, F64, F64, float, float]:
    R, t = np.ascontiguousarray(T[:3, :3]), T[:3, 3].copy()
    return normal_equations(points, R, t, grid.window, grid.voxels.cells)


def _solve(H: F64, g: F64, M: F64) -> tuple[F64, F64]:
    """Covariance and step of the NDT alone.

    The covariance is the robust ("sandwich") estimate H^-1 M H^-1, M being the scatter of the points' own
    gradients, times COVARIANCE_SCALE for what neighbouring points have in common, plus what the map itself is
    off by. A direction that nothing fixes gets a small curvature, hence a large variance and no step, instead of a
    singular matrix.
    """
    floor = 1e-6 * max(float(np.trace(H)), 1.0) * np.eye(6)
    H_inv = _inverse(H + floor)
    map_variance = np.diag([MAP_SIGMA_M**2] * 3 + [MAP_SIGMA_RAD**2] * 3)
    return COVARIANCE_SCALE * (H_inv @ (M + floor) @ H_inv) + map_variance, -H_inv @ g


def _fuse(covariance: F64, step: F64, prior: PosePrior, T: F64) -> tuple[F64, F64]:
    """The NDT's step and the step to the prior, weighed by their information."""
    information = _inverse(covariance)
    to_prior = np.concatenate([prior.T_map_lidar[:3, 3] - T[:3, 3], _rotation_step(prior.T_map_lidar, T)])
    fused = _inverse(information + prior.information)
    return fused, fused @ (information @ step + prior.information @ to_prior)


def _inverse(matrix: F64) -> F64:
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)


def _rotation_step(T_to: F64, T_from: F64) -> F64:
    """phi with R_to = exp(phi) R_from."""
    difference = np.eye(4)
    difference[:3, :3] = T_to[:3, :3] @ T_from[:3, :3].T
    return log(difference)[3:]


def _clamped(step: F64, limit_m: float) -> F64:
    """The step, shortened as a whole if it shifts a point 20 m away by more than ``limit_m``."""
    length = max(float(np.linalg.norm(step[:3])), float(np.linalg.norm(step[3:])) * _LEVER_M)
    return step * min(1.0, limit_m / max(length, 1e-12))


def _moved(T: F64, step: F64) -> F64:
    """T with its sensor shifted by rho and turned by phi, both in map axes."""
    out = T.copy()
    out[:3, :3] = exp(np.concatenate([np.zeros(3), step[3:]]))[:3, :3] @ T[:3, :3]
    out[:3, 3] += step[:3]
    return out
