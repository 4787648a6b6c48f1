"""The map around a vehicle as NDT matches scans with it: all levels over one window, laid out from tiles ahead of need.

This is the matcher ``ndt`` of :mod:`mapvote.matching.matcher`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapvote.core.geometry import corners
from mapvote.core.grid import TILE_CELLS, TileIndex, window_around
from mapvote.core.point_map import PointMap
from mapvote.core.record import record
from mapvote.core.types import F32, F64, Bool, PosePrior, Registration
from mapvote.matching.matcher import CONVERGENCE
from mapvote.matching.ndt import Room, align, arrange, expect, likelihoods, room_for
from mapvote.matching.ndt_voxels import LEVELS, Level, NdtGrid, Voxels, window_of


@record(votes=True)
@dataclass(frozen=True, slots=True)
class NdtWindow:
    """Numbers of the part of a map that NDT holds, and of what the map itself is off by."""

    half_window_m: float = 96.0
    """The window reaches this far to the sides of its centre: as far as a scan has enough points."""
    below_m: float = 24.0
    """The window reaches this far below its centre."""
    above_m: float = 40.0
    """The window reaches this far above its centre."""
    central_m: float = 24.0
    """A vehicle this far from the window's centre still has 72 m of map to all sides."""
    slab_m: float = 252.0
    """Height of one block, a whole number of voxels at every level: a stray point costs no tower."""
    ahead_m: float = 144.0
    """Tiles this near are made ready ahead of need: the window and twice ``central_m``."""
    kept_m: float = 192.0
    """Tiles this near are kept: the window and four times ``central_m``."""
    map_sigma_m: float = 0.01
    """Standard deviation of the map around a scan, which no residual shows."""
    map_sigma_deg: float = 0.03
    """Standard deviation of the map's attitude around a scan, likewise."""


NDT_WINDOW = NdtWindow()


class NdtMap:
    """All levels over one bounded window around ``centre`` (map metres), coarse to fine. Grows by :meth:`enter`."""

    def __init__(self, centre: F64, levels: Sequence[Level] = LEVELS, numbers: NdtWindow = NDT_WINDOW) -> None:
        self.numbers = numbers
        half_m = numbers.half_window_m
        self._reach = np.array([half_m, half_m, numbers.below_m])
        sides = self._reach + np.array([half_m, half_m, numbers.above_m])
        self.levels = [
            NdtGrid(one, window_of(np.round(sides / one.voxel_m).astype(np.int64), np.zeros(3, np.int64), one.voxel_m))
            for one in levels
        ]
        self._map_variance = np.array([numbers.map_sigma_m**2] * 3 + [np.radians(numbers.map_sigma_deg) ** 2] * 3)
        self._no_prior = np.eye(4), np.zeros((6, 6))
        self._room = room_for(0)
        """A megabyte that every alignment uses: new memory would be cold."""
        self.recentre(centre)

    def recentre(self, centre: F64) -> None:
        """Put the middle of the window at ``centre`` (3,)."""
        self.centre = np.asarray(centre, dtype=np.float64).copy()
        for grid in self.levels:
            grid.move(self.centre - self._reach)

    def begin_anew(self, centre: F64) -> None:
        """Forget all voxels and put the middle at ``centre`` (3,), in the same memory: to ask for as much again, 15 MB,
        takes longer than to fill it."""
        for grid in self.levels:
            grid.clear()
        self.recentre(centre)

    def is_central(self, position: F64) -> bool:
        """Whether ``position`` (3,) is near enough to the middle for the window to hold what a scan reaches."""
        off_m = [abs(a - b) for a, b in zip(position.tolist(), self.centre.tolist(), strict=True)]
        return max(off_m) <= self.numbers.central_m

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

    def refine(
        self,
        clouds: Sequence[F32],
        T_map_lidar_guess: F64,
        prior: PosePrior | None = None,
        first_level: int = 0,
        settled: tuple[float, float] = CONVERGENCE.settled,
    ) -> Registration:
        """See :class:`mapvote.matching.matcher.LocalMatcher`. ``prior`` enters as a factor at the finest level."""
        T = np.array(T_map_lidar_guess, dtype=np.float64)
        iterations = 0
        covariance = np.empty((6, 6))
        last = len(self.levels) - 1
        for i in range(first_level, last + 1):
            grid = self.levels[i]
            tolerance_m = max(0.001, settled[i == last] * grid.level.floor_m)
            believed = self._no_prior
            if prior is not None and i == last:
                believed = np.ascontiguousarray(prior.T_map_lidar), prior.information
            where = grid.window, grid.voxels.cells, grid.level.iterations, tolerance_m, self._map_variance
            cloud = clouds[i - len(self.levels)]
            room = self._arranged(cloud, T, grid)
            score, inlier_share, more, converged = align(cloud.shape[1], T, *where, *believed, room, covariance)
            iterations += more
        return Registration(T, covariance, score, inlier_share, iterations, converged)

    def likelihood(self, cloud: F32, T_map_lidar: F64, level: int = 0) -> F64:
        """See :class:`mapvote.matching.matcher.LocalMatcher`."""
        grid = self.levels[level]
        out = np.empty(len(T_map_lidar))
        poses = np.ascontiguousarray(T_map_lidar)
        room = self._arranged(cloud, poses[0], grid)
        likelihoods(cloud.shape[1], poses, grid.window, grid.voxels.cells, room, out)
        return out

    def _arranged(self, cloud: F32, T_map_lidar: F64, grid: NdtGrid) -> Room:
        """The room, with a cloud for poses near this one."""
        if cloud.shape[1] > len(self._room.home):
            self._room = room_for(cloud.shape[1] * 5 // 4)
        arrange(cloud, T_map_lidar, grid.window, self._room)
        return self._room

    def expected(self, points_map: F64, noise_m: float) -> tuple[F64, Bool]:
        """See :class:`mapvote.matching.matcher.LocalMatcher`."""
        finest = self.levels[-1]
        likelihood = np.empty(len(points_map))
        near = np.empty(len(points_map), dtype=np.bool_)
        expect(points_map, noise_m, finest.window, finest.voxels, self.levels[0].window, likelihood, near)
        return likelihood[likelihood >= 0.0], near


def build_ndt(points_map: NDArray[np.floating], centre: F64 | None = None) -> NdtMap:
    """The NDT map of points (n, 3) in map metres, its window around ``centre`` (default: the middle of the points)."""
    if centre is None:
        centre = 0.5 * corners(points_map).sum(axis=0).astype(np.float64)
    ndt_map = NdtMap(centre)
    ndt_map.enter(points_map)
    return ndt_map


class MapWindow:
    """Built anew when the vehicle leaves its middle: in a millisecond or two where :meth:`prepare` has been called, and
    in the memory of the one before, which earlier callers must not use any longer.

    Memory is bounded by the tiles around the vehicle. ``levels``: all, or the last ones.
    """

    def __init__(self, point_map: PointMap, levels: Sequence[Level] = LEVELS) -> None:
        self.point_map = point_map
        self.levels = levels
        self.ndt_map: NdtMap | None = None
        self._ready: dict[TileIndex, list[list[Voxels]]] = {}
        """By tile, by level."""
        self._all_ready: list[TileIndex] | None = None
        """Tiles of a square around the vehicle, of which every one in the map is ready."""
        self._begun: tuple[TileIndex, list[F64]] | None = None
        """A tile of which not every level is ready, and its points: they are read once for all levels."""

    def __call__(self, position: F64) -> NdtMap:
        if self.ndt_map is None or not self.ndt_map.is_central(position):
            return self._laid_out(position)
        return self.ndt_map

    def go_on_in(self, point_map: PointMap) -> None:
        """The map is another version from here on: what is ready of tiles that stayed the same remains so."""
        old = self.point_map
        self.point_map = point_map
        self.ndt_map = None
        same = {tile for tile in self._ready if old.tiles.get(tile) is point_map.tiles.get(tile)}
        self._ready = {tile: ready for tile, ready in self._ready.items() if tile in same}
        self._all_ready = None
        self._begun = None

    def prepare(self, position: F64) -> None:
        """One step ahead: one level of the nearest tile that is not ready. For most scans, so that none has it all."""
        x, y = position[:2].tolist()
        square = window_around(self.point_map.lattice, x, y, 2 * NDT_WINDOW.ahead_m)
        tiles = list(square.tiles())
        if tiles == self._all_ready:
            return
        ahead = [tile for tile in tiles if tile in self.point_map.tiles and not self._is_ready(tile)]
        if ahead:
            here = np.array(self.point_map.lattice.cell_of(x, y)) / TILE_CELLS - 0.5
            self._step(min(ahead, key=lambda tile: float(np.hypot(*(tile - here)))))
        else:
            self._all_ready = tiles

    def _is_ready(self, tile: TileIndex) -> bool:
        return len(self._ready.get(tile, [])) == len(self.levels)

    def _step(self, tile: TileIndex) -> None:
        """One more level of a tile."""
        if self._begun is None or self._begun[0] != tile:
            self._begun = tile, _slabs(self.point_map.tiles[tile].points_map)
        ready = self._ready.setdefault(tile, [])
        ready.append([_voxels_of(slab, self.levels[len(ready)]) for slab in self._begun[1]])
        if self._is_ready(tile):
            self._begun = None

    def _laid_out(self, position: F64) -> NdtMap:
        kept = set(tiles_within(self.point_map, position, NDT_WINDOW.kept_m))
        self._ready = {tile: ready for tile, ready in self._ready.items() if tile in kept}
        self._all_ready = None
        here = tiles_within(self.point_map, position)
        for tile in here:
            while not self._is_ready(tile):
                self._step(tile)
        if self.ndt_map is None:
            self.ndt_map = NdtMap(position, self.levels)
        else:
            self.ndt_map.begin_anew(position)
        for i, grid in enumerate(self.ndt_map.levels):
            grid.join([voxels for tile in here for voxels in self._ready[tile][i]])
        return self.ndt_map


def tiles_within(point_map: PointMap, position: F64, half_m: float = NDT_WINDOW.half_window_m) -> list[TileIndex]:
    """The map's tiles that a square around ``position`` (3,) touches, in ascending order."""
    window = window_around(point_map.lattice, float(position[0]), float(position[1]), 2 * half_m)
    return [tile for tile in window.tiles() if tile in point_map.tiles]


def _slabs(points: F64) -> list[F64]:
    """The points (n, 3) of a tile, slab of height by slab. Most have one: to sort and copy it would be a waste."""
    slab = np.floor(points[:, 2] / NDT_WINDOW.slab_m)
    if len(slab) and slab.min() == slab.max():
        return [points]
    return [points.compress(slab == height, axis=0) for height in np.unique(slab)]


def _voxels_of(points: F64, level: Level) -> Voxels:
    """The voxels of points (n, 3)."""
    low, high = np.floor(corners(points) / level.voxel_m).astype(np.int64)
    room = 1024 + len(points) // 8  # more than a street has in voxels of a metre
    grid = NdtGrid(level, window_of(high - low + 1, low, level.voxel_m), room)
    grid.enter(points)
    place, sums, cells = grid.voxels
    return Voxels(place[: grid.n].copy(), sums[: grid.n].copy(), cells[: grid.n].copy())
