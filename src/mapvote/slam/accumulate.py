"""Scans at known poses become a map: points without moving objects, ground, known-free columns.

A draft of the map gives the ground and the occupied voxels. Each scan is then counted as a vehicle counts it: in how
many scans was a voxel hit, in how many did rays pass it (detection/evidence.py). At the end the rules of
slam/clean_map.py drop points that are no standing surface. Their voxels are unknown, not free.

Only points that passed the filter of moving objects enter the map, at whatever range: a car that drives ahead of the
surveyor is too far off for the counting. Returns from beyond the filter's reach are left out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from mapvote.config import Settings
from mapvote.core.columns import TOP_BIT, column_bits, rebased
from mapvote.core.grid import CELL_SIZE, TILE_CELLS, tile_of_cells
from mapvote.core.kernel import kernel
from mapvote.core.point_map import SCANS, PointMap, map_from_points
from mapvote.core.reference import LocalMap
from mapvote.core.sensor_height import heights_over_ground
from mapvote.core.tile import Tile
from mapvote.core.types import F32, F64, I32, I64, U64, Bool, Drive
from mapvote.core.voxels import VoxelCloud
from mapvote.detection.evidence import HIT, PASSES, WORDS, count_scan, free_words, least_passed
from mapvote.detection.packed_tiles import PackedTiles, count_of
from mapvote.localisation.localiser import GivenPoses
from mapvote.perception.frontend import Frontend, Observation, PlacedScan
from mapvote.perception.moving_objects import MovingFilter
from mapvote.slam.clean_map import mirrored, seen_through, specks, strays, trails

ROAD_M = 0.1
"""Points this low above the ground are the road itself, also under a car."""


class Layer:
    """Collects the scans of all drives, then gives the map."""

    def __init__(self, draft: PointMap, settings: Settings, road: F64 | None = None) -> None:
        """``road`` (n, 3), map metres: where vehicles drove, from which the ground grows."""
        self.draft, self.road, self.settings = draft, road, settings
        self.cloud = VoxelCloud(draft.lattice)
        self.evidence = PackedTiles(draft.lattice, WORDS)
        self._driven: list[F64] = []
        self._around = LocalMap(draft, 2.0 * settings.mapping.reach_m)
        self._near = LocalMap(draft, settings.voting.window_m)

    def lay(self, drive: Drive, T_map_lidar: F64, registered: Bool, count: Callable[[], None]) -> None:
        """Enter every registered scan of one drive at its pose (n, 4, 4). ``count`` is called after each scan read."""
        movers = MovingFilter(drive.sensor, self.settings.moving, self.settings.mapping.reach_m)
        frontend = Frontend(
            GivenPoses(drive.stamps_ns, T_map_lidar),
            movers,
            self._around,
            self._near,
            with_sight=False,
            sensor=drive.sensor,
        )
        self._driven.append(T_map_lidar[registered, :3, 3])
        for i, scan in enumerate(drive):
            if registered[i]:
                self._enter(frontend.observe(scan))
            count()
        self._enter(frontend.finish())

    def _enter(self, seen: list[Observation]) -> None:
        for observation in seen:
            scan, moving = observation.scan, observation.moving
            self.cloud.enter(scan.points_map, _left_out(scan, moving, self.settings.mapping.reach_m))
            count_scan(self.evidence, observation)

    def finish(self) -> PointMap:
        """The map of all points added so far."""
        points, scans = self.cloud.points()
        counts = self._counts(points)
        kept = ~(_standing(points, self.draft) & seen_through(counts))
        points, scans, counts = points[kept], scans[kept], counts[kept]
        # Trails lift the draft's ground; above the true one stand the undersides of cars that had passed for ground.
        laid, lattice = map_from_points(points, lattice=self.draft.lattice, road=self.road), self.draft.lattice
        obstacle = _standing(points, laid)
        dropped = (obstacle & seen_through(counts)) | mirrored(points, laid, self.road)
        if self.settings.mapping.drop_strays:
            driven = np.concatenate(self._driven) if self._driven else np.zeros((0, 3))
            dropped |= obstacle & strays(points, scans, driven, lattice)
            left = np.flatnonzero(obstacle & ~dropped)
            height = heights_over_ground(laid, points[left])
            dropped[left] |= trails(points[left], counts[left, 0] - counts[left, 1], height, lattice)
            left = np.flatnonzero(obstacle & ~dropped)
            dropped[left] |= specks(points[left], scans[left], lattice)
        fields = {SCANS: np.minimum(scans[~dropped], 255).astype(np.uint8)}
        point_map = map_from_points(points[~dropped], lattice=lattice, road=self.road, fields=fields)
        tiles = {tile: replace(content, free=self._free(content)) for tile, content in point_map.tiles.items()}
        return replace(point_map, tiles=tiles)

    def _counts(self, points: F64) -> I64:
        """(n, 3) in how many scans the voxels of points (n, 3) were hit, passed and crossed; 0 outside columns."""
        out = np.zeros((len(points), 3), dtype=np.int64)
        rows, cols = self.draft.lattice.cells_of(points)
        tile_rows, tile_cols = tile_of_cells(rows, cols)
        for tile, planes in self.evidence.items():
            mine = np.flatnonzero((tile_rows == tile[0]) & (tile_cols == tile[1]))
            r, c = rows[mine] - tile[0] * TILE_CELLS, cols[mine] - tile[1] * TILE_CELLS
            bits = np.floor(points[mine, 2] / CELL_SIZE).astype(np.int64) - self.draft.tile(tile).base[r, c]
            counts = np.zeros((len(mine), 3), dtype=np.int64)
            _counts_of(planes, r, c, bits, counts)
            out[mine] = counts
        return out

    def _free(self, after: Tile) -> U64:
        """Known-free columns of one tile of the finished map, on its own ground."""
        if after.index not in self.evidence:
            return np.zeros(after.window.shape, dtype=np.uint64)
        before = self.draft.tile(after.index).base
        free = free_words(self.evidence[after.index])
        after = replace(after)  # what it works out for this alone goes with it
        out = rebased(free, before - after.base) & ~after.obstacle_words
        out[np.isnan(after.ground_z)] = 0
        return out


def _standing(points: F64, ground: PointMap) -> Bool:
    """(n,) which points (n, 3) stand above the ground of ``ground``; none outside its tiles."""
    out = np.zeros(len(points), dtype=np.bool_)
    rows, cols = ground.lattice.cells_of(points)
    tile_rows, tile_cols = tile_of_cells(rows, cols)
    for (row, col), tile in ground.tiles.items():
        here = np.flatnonzero((tile_rows == row) & (tile_cols == col))
        r, c = rows[here] - row * TILE_CELLS, cols[here] - col * TILE_CELLS
        out[here] = column_bits(points[here, 2], tile.ground_z[r, c], tile.base[r, c])[1]
    return out


def _left_out(scan: PlacedScan, moving: Bool, reach_m: float) -> Bool:
    """Points (n,) that do not enter the map: what moves, what is beyond ``reach_m``, and what is too low to be an
    obstacle, in or next to cells where something moves: wheels and bumpers, not road."""
    ground_z, out = scan.reference.ground_z, np.empty(len(moving), np.bool_)
    beside = np.zeros(ground_z.size, np.bool_)
    _no_map(scan.points_map, scan.origin_map, reach_m**2, moving, scan.obstacle, scan.cell, ground_z, beside, out)
    return out


@kernel
def _no_map(
    points: F64, origin: F64, reach_squared: float, moving: Bool, obstacle: Bool, cell: I32, ground_z: F32,
    beside: Bool, out: Bool,
) -> None:  # fmt: skip
    """Into ``out`` (n,) which of the points (n, 3) :func:`_left_out` means; ``cell`` (n,) row * cols + col of
    ``ground_z`` (rows, cols), -1 outside it. ``beside`` (rows * cols,): scratch, all False."""
    rows, cols = ground_z.shape
    for i in range(len(points)):
        if moving[i] and cell[i] >= 0:
            r, c = divmod(cell[i], cols)
            for k in range(max(r - 1, 0), min(r + 2, rows)):
                for j in range(max(c - 1, 0), min(c + 2, cols)):
                    beside[k * cols + j] = True
    for i in range(len(points)):
        x, y = points[i, 0] - origin[0], points[i, 1] - origin[1]
        out[i] = moving[i] | (x * x + y * y > reach_squared)
        if cell[i] >= 0 and beside[cell[i]] and not obstacle[i]:
            r, c = divmod(cell[i], cols)
            out[i] |= points[i, 2] - ground_z[r, c] > ROAD_M


@kernel
def _counts_of(planes: U64, rows: I64, cols: I64, bits: I64, out: I64) -> None:
    """Into ``out`` (n, 3) in how many scans the voxels (row, col, bit) of a tile were hit, passed and crossed; outside
    columns ``out`` stays as it is."""
    for i in range(len(bits)):
        if 0 <= bits[i] < TOP_BIT:
            cell = planes[rows[i], cols[i]]
            out[i, 0], out[i, 1] = count_of(cell, HIT, bits[i]), count_of(cell, PASSES, bits[i])
            out[i, 2] = least_passed(cell, bits[i])
