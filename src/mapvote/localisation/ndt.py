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

from mapvote.core.types import F32, F64, I64, Drive, Registration, check_array
from mapvote.core.voxels import thin
from mapvote.localisation.ndt_solver import Certainty, Target, align, likelihoods, near_in, room_for, room_to_work
from mapvote.localisation.ndt_voxels import Voxels, Window, enter_points, join_voxels, refresh, reindex


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
"""How far the window reaches to the sides, below and above its centre: as far as a scan has enough points."""
CENTRAL_M = 24.0
"""A vehicle this far from the window's centre still has 72 m of map to all sides."""
SETTLED = 0.05, 0.01
"""A step shorter than this share of a level's floor has converged: on the way, and at the finest level."""
MIN_POINTS = 3
"""A voxel with fewer points has no distribution: two make a line."""
COVARIANCE_SCALE = 5.0
"""What neighbouring residuals have in common, calibrated so that normalised squared errors average 6."""
MAP_SIGMA_M, MAP_SIGMA_RAD = 0.01, float(np.radians(0.03))
"""What the map itself is off by around a scan, which no residual shows."""
_ENOUGH = 20_000
"""Points that are thinned at least: of a dense scan every third, fifth .. is used. Odd, so that no beam is left
out where points are stored firing by firing."""


class NdtGrid:
    """One level of the map: voxels of one size. All are kept; those inside the window can be found."""

    def __init__(self, level: Level, half: float) -> None:
        size = level.voxel_m
        shape = (round(2 * half / size), round(2 * half / size), round((BELOW_M + ABOVE_M) / size))
        self.level = level
        self.reach = np.array([half, half, BELOW_M])
        self.window = Window(np.empty(shape, dtype=np.int32), np.zeros(3, dtype=np.int64), size)  # recentred next
        self.near = near_in(self.window)
        self.n = 0
        self._voxels, self._stale = room_for_voxels(1024), list[I64]()

    @property
    def voxels(self) -> Voxels:
        """With the distributions of all entered points, computed when they are read: of a map that grows the
        coarse levels hardly ever are."""
        for rows in self._stale:
            refreshed(self._voxels, rows, self.level)
        self._stale.clear()
        return self._voxels

    def clear(self) -> None:
        """Forget all voxels; their memory stays."""
        self.n = 0
        self._stale.clear()

    def recentre(self, centre: F64) -> None:
        """Move the window; what was entered before and lies inside is found again."""
        self.window.lowest[:] = np.round((centre - self.reach) / self.level.voxel_m).astype(np.int64)
        self.window.rows.fill(-1)
        reindex(self.window, self._voxels.place, self.n)

    def enter(self, points_map: F64) -> None:
        """Enter points (n, 3) in map metres; those outside the window are left out."""
        self._voxels, self.n, touched = entered(points_map, self.window, self._voxels, self.n)
        self._stale += touched

    def join(self, others: Sequence[Voxels]) -> None:
        """Add voxels of this level, of points that were not entered; those outside the window are left out."""
        room = self.n + sum(len(more.place) for more in others)
        if room > len(self._voxels.place):
            more = room_for_voxels(room - self.n)
            self._voxels = Voxels(*(np.concatenate([a[: self.n], b]) for a, b in zip(self._voxels, more, strict=True)))
        for part in others:
            shared = np.empty(len(part.place), dtype=np.int64)
            self.n, n_shared = join_voxels(part, self.window, self._voxels, self.n, shared)
            refreshed(self._voxels, shared[:n_shared], self.level)


def refreshed(voxels: Voxels, rows: I64, level: Level) -> None:
    """The distributions of ``rows`` (m,), in place, from their sums."""
    scratch = np.empty((2, 3, 3))
    refresh(voxels, rows, level.voxel_m, level.floor_m, MIN_POINTS, scratch[0], scratch[1])


def entered(points_map: F64, window: Window, voxels: Voxels, n: int) -> tuple[Voxels, int, list[I64]]:
    """(voxels with points (n, 3) in map metres entered into their sums, how many there are, the rows to refresh): with
    more room where they need it."""
    left, stale = points_map, []
    while len(left):
        if n == len(voxels.place):
            voxels = Voxels(*(np.concatenate([a, np.zeros_like(a)]) for a in voxels))
        touched = np.empty(len(left), dtype=np.int64)
        n, looked_at, n_touched = enter_points(left, window, voxels, n, touched)
        stale.append(touched[:n_touched].copy())
        left = left[looked_at:]
    return voxels, n, stale


def room_for_voxels(n: int) -> Voxels:
    """Room for n voxels."""
    return Voxels(np.zeros((n, 3), dtype=np.int64), np.zeros((n, 11)), np.zeros((n, 9)))


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

    def begin_anew(self, centre: F64) -> None:
        """Forget all voxels and put the middle at ``centre`` (3,), in the same memory: to ask for as much again, 15 MB,
        takes longer than to fill it."""
        for grid in self.levels:
            grid.clear()
        self.recentre(centre)

    def is_central(self, position: F64) -> bool:
        """Whether ``position`` (3,) is near enough to the middle for the window to hold what a scan reaches."""
        return bool(np.abs(np.asarray(position) - self.centre).max() <= CENTRAL_M)

    def around(self, position: F64) -> NdtMap:
        """Itself, with a window that holds what a scan from ``position`` (3,) reaches."""
        if not self.is_central(position):
            self.recentre(position)
        return self

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


def thin_for_levels(points_lidar: NDArray[np.floating]) -> list[F32]:
    """The scan as each level wants it, (3, m): one point per voxel of the level's ``points_m``."""
    source = np.ascontiguousarray(points_lidar, dtype=np.float32)
    chosen = thinned(source)
    return [in_rows(source[chosen[level.points_m]]) for level in LEVELS]


def in_rows(points_lidar: NDArray[np.floating]) -> F32:
    """(3, n) of points (n, 3): rows of x, y and z, as the kernels want them."""
    return np.ascontiguousarray(points_lidar.T, dtype=np.float32)


def thinned(points_lidar: F32) -> dict[float, I64]:
    """By size, metres: indices, ascending, of one of (n, 3) points per voxel of each size that the levels want."""
    sizes = sorted({level.points_m for level in LEVELS})
    few = thin(points_lidar, sizes[0], every=max(1, (len(points_lidar) // _ENOUGH - 1) | 1))
    chosen = {sizes[0]: few}
    for size in sizes[1:]:
        few = few[thin(points_lidar.take(few, axis=0), size)]
        chosen[size] = few
    return chosen


def refine(
    ndt_map: NdtMap,
    clouds: list[F32],
    T_map_lidar_guess: F64,
    prior: PosePrior | None = None,
    first_level: int = 0,
    settled: tuple[float, float] = SETTLED,
) -> Registration:
    """The pose in the map of a de-skewed scan, thinned by :func:`thin_for_levels`, from a guess.

    ``prior`` enters as a factor at the finest level; ``settled``: see SETTLED. Never raises for bad overlap: the inlier
    share and the score are low instead, and the caller abstains.
    """
    T = np.array(T_map_lidar_guess, dtype=np.float64)
    iterations, covariance, work = 0, np.empty((6, 6)), room_to_work()
    last = len(ndt_map.levels) - 1
    for i in range(first_level, last + 1):
        grid = ndt_map.levels[i]
        tolerance = max(0.001, settled[i == last] * grid.level.floor_m)
        where = Target(grid.window, grid.near, grid.voxels.cells, grid.level.iterations, tolerance)
        known = _known(prior if i == last else None)
        pairs = room_for(clouds[i].shape[1])
        score, inlier_share, more, converged = align(clouds[i], T, where, known, pairs, work, covariance)
        iterations += more
    return Registration(T, covariance, score, inlier_share, iterations, converged)


def _known(prior: PosePrior | None) -> Certainty:
    variance = np.array([MAP_SIGMA_M**2] * 3 + [MAP_SIGMA_RAD**2] * 3)
    if prior is None:
        return Certainty(COVARIANCE_SCALE, variance, np.eye(4), np.zeros((6, 6)))
    return Certainty(COVARIANCE_SCALE, variance, np.ascontiguousarray(prior.T_map_lidar), prior.information)


def best_of(
    ndt_map: NdtMap, clouds: list[F32], guesses: Sequence[F64], most: int, prior: PosePrior | None = None,
    points: int = 1 << 30,
) -> Registration:  # fmt: skip
    """The ``most`` likeliest of guessed poses (4, 4), see :func:`likeliest`, refined: the one with the best score."""
    chosen = likeliest(ndt_map, clouds[0], guesses, most, points)
    return max((refine(ndt_map, clouds, guess, prior) for guess in chosen), key=lambda found: found.score)


def fitness(ndt_map: NdtMap, clouds: list[F32], T_map_lidar: F64, level: int = 0) -> float:
    """Mean likelihood of the scan at a pose, in [0, 1], at one level: to rank guesses before any is refined."""
    return float(fitnesses(ndt_map, clouds[level], T_map_lidar[None], level)[0])


def likeliest(ndt_map: NdtMap, cloud: F32, guesses: Sequence[F64], most: int, points: int = 1 << 30) -> list[F64]:
    """The ``most`` of guessed poses (4, 4) at which a cloud (3, n) fits the coarsest level best, best first, by some
    ``points`` of it."""
    few = np.ascontiguousarray(cloud[:, :: max(1, cloud.shape[1] // points)])
    fits = fitnesses(ndt_map, few, np.array(guesses))
    return [guesses[k] for k in np.argsort(-fits, kind="stable")[:most]]


def fitnesses(ndt_map: NdtMap, cloud: F32, T_map_lidar: F64, level: int = 0) -> F64:
    """(m,) :func:`fitness` of a cloud (3, n) at many poses (m, 4, 4)."""
    grid = ndt_map.levels[level]
    out = np.empty(len(T_map_lidar))
    likelihoods(cloud, np.ascontiguousarray(T_map_lidar), grid.window, grid.near, grid.voxels.cells, out)
    return out
