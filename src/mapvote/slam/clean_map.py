"""Which points of a surveyed map are no standing surface, one function a rule:

| rule | a point is dropped if | what it was |
|---|---|---|
| ``seen_through`` | rays crossed its voxel in SEEN_THROUGH scans or more, and most scans did not hit it | a trail |
| ``trails`` | its low group of cells was passed more often than hit | a trail of what drove far off |
| ``strays`` | few of the places near by hit it, or it lies just over the face of another surface's voxel | noise |
| ``specks`` | it is one of a few voxels that touch no other surface, each hit by one scan | noise |
| ``mirrored`` | it lies below unbroken ground | a reflection |

Reflections. A wet road, a window or the side of a car deflects a ray, and the range puts its return below the ground.
A point below ground that is known and level on all sides is such a return. Beside a leap of the ground it may be a wall
that goes down to a yard, and near a place where vehicles drove above each other what lies below is real: both stay.

Strays. A beam that grazes an edge returns a place between two surfaces; a pane shows a room that is not there. No ray
speaks against such points, because other scans saw the wall in front of them. A surface is hit by more than MET_SHARE
of the scans that pass within NEAR_M of it; strays are not. A wall two centimetres from a voxel's face has points in two
voxels: the fewer points just over the face belong to the same wall.

Specks. Mixed pixels and mirrored rooms leave points that touch nothing, each hit once. A vehicle that comes by denies
them, and would be right: the map would change where nothing changed. ``import --clean`` asks the same of a map that
comes from elsewhere, by how many points each voxel holds.

Trails. A standing thing is hit as often as rays pass through its voxels, as a whole if not in each voxel. A thing that
drove was hit once or twice in each place, and rays passed there before and after.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from mapvote.core.grid import CELL_SIZE, TILE_CELLS, Lattice
from mapvote.core.kernel import kernel
from mapvote.core.point_map import PointMap
from mapvote.core.sensor_height import crossings, heights_over_ground
from mapvote.core.tile import Tile
from mapvote.core.types import F32, F64, I32, I64, Bool
from mapvote.core.voxels import slot_of, thin, voxel_keys

BELOW_M = 0.5
"""A point so far under the ground is no part of it, however rough."""
_BESIDE_CELLS = 2
_BRIDGE_M = 80.0
"""Of a place where two roads cross; as far as scans enter the map from."""


def mirrored(points: F64, point_map: PointMap, road: F64 | None) -> Bool:
    """(n,) which of the points (n, 3), map metres, are reflections below the ground of ``point_map``.

    ``road`` (m, 3): the road under all drives.
    """
    out = heights_over_ground(point_map, points) < -BELOW_M
    asked = np.flatnonzero(out)
    out[asked] = _is_closed(points[asked], point_map)
    if road is not None and len(road):
        above_each_other = road[np.unique(crossings(road))]
        if len(above_each_other):
            below = np.flatnonzero(out)
            tree = cKDTree(above_each_other[:, :2])
            out[below] = np.isinf(tree.query(points[below, :2], distance_upper_bound=_BRIDGE_M)[0])
    return out


def _is_closed(points: F64, point_map: PointMap) -> Bool:
    """(n,) whether the ground around the cell of each point (n, 3) is known and level."""
    out = np.zeros(len(points), dtype=np.bool_)
    rows, cols = point_map.lattice.cells_of(points)
    for tile in point_map.tiles.values():
        r, c = rows - tile.window.row0, cols - tile.window.col0
        here = np.flatnonzero((r >= 0) & (c >= 0) & (r < tile.window.rows) & (c < tile.window.cols))
        if len(here):
            out[here] = _unbroken(tile.ground_z)[r[here], c[here]]
    return out


def _unbroken(ground_z: F32) -> Bool:
    """(rows, cols) cells around which the ground is known and nowhere leaps."""
    side, known = 2 * _BESIDE_CELLS + 1, np.isfinite(ground_z)
    highest = ndimage.maximum_filter(np.where(known, ground_z, np.inf), side, mode="nearest")
    lowest = ndimage.minimum_filter(np.where(known, ground_z, -np.inf), side, mode="nearest")
    with np.errstate(invalid="ignore"):
        return np.asarray(highest - lowest <= BELOW_M)


NEAR_M = 20.0
"""A scan nearer than this, in the plane, should hit a standing surface."""
MET_SHARE = 0.03
"""Of these places, the share from which it must be hit: two scans of seventy, at 10 Hz and 40 km/h twice past."""
SPILL_M = 0.06
"""Points of two voxels so near on both sides of their common face are one surface: three sigmas of range noise."""
_PLACE_M = 1.0
_MOST_ASKED = 16
"""Voxels hit by more scans than this are not tested: 500 places within 20 m are a survey of a dozen passes."""


def strays(points: F64, scans: I32, driven: F64, lattice: Lattice) -> Bool:
    """(n,) which of a map's points (n, 3), one a voxel, in map metres, are no surface of their own.

    ``scans`` (n,): how many scans hit each; ``driven`` (m, 3): where all scans were taken. Places count, a metre apart,
    for who waits at a light sees the same again.
    """
    places = driven[thin(driven, _PLACE_M)]
    return _hardly_met(points, scans, places) | _spilled(points, scans, lattice)


def _hardly_met(points: F64, scans: I32, places: F64) -> Bool:
    out = np.zeros(len(points), dtype=np.bool_)
    if not len(places):
        return out
    tree = cKDTree(places[:, :2])
    # Places near one point are near each other: voxels hit oftener than the largest number required are skipped.
    most = tree.query_ball_point(places[:, :2], 2.001 * NEAR_M, return_length=True).max()
    asked = np.flatnonzero(scans < min(_MOST_ASKED, MET_SHARE * most))
    if len(asked):
        passed = tree.query_ball_point(points[asked, :2], NEAR_M, return_length=True)
        out[asked] = scans[asked] < MET_SHARE * passed
    return out


def _spilled(points: F64, scans: I32, lattice: Lattice) -> Bool:
    """Points over the side of a voxel beside which more scans hit a surface, less than SPILL_M off."""
    keys = voxel_keys(points, lattice.x0, lattice.y0)
    order = np.argsort(keys)
    out = np.zeros(len(points), dtype=np.bool_)
    if not len(points):
        return out
    for axis, origin in ((0, lattice.x0), (1, lattice.y0)):
        within = (points[:, axis] - origin) % CELL_SIZE
        aside = np.zeros(3)
        for sign in (-1.0, 1.0):
            aside[axis] = sign * CELL_SIZE
            wanted = voxel_keys(_middles(points, lattice) + aside, lattice.x0, lattice.y0)
            beside = order[np.minimum(np.searchsorted(keys, wanted, sorter=order), len(keys) - 1)]
            mine = CELL_SIZE - within if sign > 0 else within
            theirs = within[beside] if sign > 0 else CELL_SIZE - within[beside]
            same = (keys[beside] == wanted) & (mine + theirs < SPILL_M)
            out |= same & (mine < theirs) & (scans < scans[beside])
    return out


def _middles(points: F64, lattice: Lattice) -> F64:
    """(n, 3) the middle of each point's voxel: steps from there reach the next one whatever rounding does."""
    origin = np.array([lattice.x0, lattice.y0, 0.0])
    return np.asarray((np.floor((points - origin) / CELL_SIZE) + 0.5) * CELL_SIZE + origin)


SEEN_THROUGH = 6
"""Scans that must have crossed a voxel before it can be a trail."""
_TRAIL_SHARE = 0.3
"""Of the scans that crossed or hit a voxel, the share that must have hit it."""


def seen_through(counts: I64) -> Bool:
    """(n,) which voxels scans saw through, by ``counts`` (n, 3): in how many scans hit, passed, crossed.

    A voxel of a standing surface can be crossed, too. So the bound is far below that of a vehicle that calls it gone.
    """
    hit, crossed = counts[:, 0], counts[:, 2]
    return np.asarray((crossed >= SEEN_THROUGH) & (hit < _TRAIL_SHARE * (hit + crossed)))


LARGEST_SPECK = 5
"""Voxels that touch each other and no other surface."""


def specks(points: F64, times: I32, lattice: Lattice, largest: int = LARGEST_SPECK) -> Bool:
    """(n,) which of a map's obstacle points (n, 3), map metres, lie on nothing: in a group of at most ``largest``
    voxels that touch each other (26), touch no other voxel, and were hit once each.

    ``times`` (n,): how many scans hit the voxel of each point; of a map from elsewhere, how many points it holds.
    """
    keys = voxel_keys(points, lattice.x0, lattice.y0)
    table = np.zeros(1 << max(2 * len(keys), 2).bit_length(), dtype=np.int64)
    often, out = np.zeros(len(table), dtype=np.bool_), np.zeros(len(keys), dtype=np.bool_)
    _specks(keys, times <= 1, table, often, np.empty(largest + 1, np.int64), out)
    return out


def lone_points(tile: Tile) -> Bool:
    """(n,) which points of a tile of somebody's map are specks: an obstacle that is alone in its voxel, and whose voxel
    touches no other. Points within a voxel of the tile's edge are none: what they touch may lie beyond."""
    within = tile.points[:, :2].astype(np.float64)
    far = (within >= CELL_SIZE).all(axis=1) & (within < (TILE_CELLS - 1) * CELL_SIZE).all(axis=1)
    once = np.ones(len(within), dtype=np.int32)
    return np.asarray(far & tile.columns[1] & specks(tile.points_map, once, tile.window.lattice, largest=1))


def without_lone_points(point_map: PointMap) -> tuple[PointMap, int]:
    """The map without its :func:`lone_points`, and how many these were. Tiles without any stay the same objects."""
    tiles, dropped = dict(point_map.tiles), 0
    for index, tile in point_map.tiles.items():
        lone = lone_points(tile)
        if lone.any():
            tiles[index] = tile.without(lone)
            dropped += int(lone.sum())
    return replace(point_map, tiles=tiles), dropped


@kernel
def _specks(keys: I64, once: Bool, table: I64, often: Bool, group: I64, out: Bool) -> None:
    """:func:`specks` into ``out`` (n,), by flood fill from each voxel hit ``once``, which ends as soon as the group is
    no speck. ``table``, a hash table of the voxels, and ``often``, whether a voxel of it was hit more than once:
    scratch, zeros. ``group`` (largest + 1,): scratch."""
    largest = len(group) - 1
    for i in range(len(keys)):
        slot = slot_of(keys[i], table)
        often[slot] |= not once[i] or table[slot] == keys[i]  # a second point in one voxel
        table[slot] = keys[i]
    for i in range(len(keys)):
        group[0], n, k = keys[i], 1, 0
        alone = not often[slot_of(keys[i], table)]
        while alone and k < n:
            for around in range(27):
                dx, dy, dz = around // 9 - 1, around // 3 % 3 - 1, around % 3 - 1
                beside = group[k] + (np.int64(dx) << 42) + (np.int64(dy) << 21) + dz
                slot = slot_of(beside, table)
                known = table[slot] == 0
                for j in range(n):
                    known |= group[j] == beside
                if known:
                    continue
                if often[slot] or n == largest:
                    alone = False
                    break
                group[n] = beside
                n += 1
            k += 1
        out[i] = alone


TALL_M = 4.0
"""No lorry is taller (Directive 96/53/EC)."""


def trails(points: F64, balance: I64, height_m: F64, lattice: Lattice) -> Bool:
    """(n,) which of the points (n, 3), one a voxel, above the ground, are trails.

    ``balance`` (n,): the scans that hit each point's voxel, less the scans whose rays passed it without a return;
    ``height_m`` (n,) over the ground, NaN if unknown. What belongs to an 8-connected group of cells that
    was passed more often than hit is a trail, but for cells that rise to TALL_M: those did not drive.
    """
    if not len(points):
        return np.zeros(0, dtype=np.bool_)
    cells, at = _cells(points, lattice)
    top = np.full(len(cells), -np.inf)
    np.maximum.at(top, at, np.nan_to_num(height_m, nan=np.inf))
    of_cell = np.bincount(at, weights=balance, minlength=len(cells))
    group, count = _groups(cells)
    passed = np.bincount(group, weights=of_cell, minlength=count)[group] < 0
    return np.asarray((passed & (top < TALL_M))[at])


def _cells(points: F64, lattice: Lattice) -> tuple[I64, I64]:
    """((m, 2) row and column of every cell that one of the points (n, 3) is in, (n,) which of them each is in)."""
    rows, cols = lattice.cells_of(points)
    width = int(cols.max()) + 1 - int(cols.min())  # one number a cell: pairs are sorted 20 times as slowly
    flat, at = np.unique((rows - rows.min()) * width + cols - cols.min(), return_inverse=True)
    return np.column_stack([flat // width, flat % width]), at


def _groups(cells: I64) -> tuple[I64, int]:
    """((n,) the 8-connected group of each of n cells (n, 2), how many there are)."""
    beside = cKDTree(cells).query_pairs(1.5, output_type="ndarray") if len(cells) else np.zeros((0, 2), np.int64)
    graph = coo_matrix((np.ones(len(beside), np.bool_), tuple(beside.T)), shape=(len(cells), len(cells)))
    count, group = connected_components(graph, directed=False)
    return group.astype(np.int64), int(count)
