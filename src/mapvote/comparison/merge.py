"""Overlapping maps become one: registered to each other, adjusted together, one point a voxel.

The paper's first map is made so ([9]: mapping, then merging of several maps). Every pair that overlaps gives one link
of a pose graph over the maps; the first map stays where it is. Maps that contradict each other after that are refused.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from mapvote.comparison.patches import Patches
from mapvote.comparison.register import Registered, register_clouds
from mapvote.core.columns import TOP_BIT
from mapvote.core.geometry import inverse
from mapvote.core.grid import CELL_SIZE, TileIndex
from mapvote.core.point_map import PointMap, all_points, cut_tiles, map_from_points
from mapvote.core.tile import Tile
from mapvote.core.types import F64, U64, MapvoteError
from mapvote.core.voxels import VoxelCloud
from mapvote.slam.pose_graph import Anchors, Links, optimise
from mapvote.slam.road_prior import road_under

MOST_APART_M = 0.1
"""By the median over the patches of a pair, after the adjustment."""
_HELD = 1e-4


@dataclass(frozen=True, slots=True)
class Merged:
    """One map of several."""

    point_map: PointMap
    T_first_each: F64
    """(k, 4, 4) where each map lies in the frame of the first."""
    apart_m: dict[tuple[int, int], float]
    """Median distance of the patches of each pair that overlaps, after the adjustment."""


def merge_maps(maps: Sequence[PointMap]) -> Merged:
    """One map in the frame and on the lattice of the first. The ground is computed anew, from the driven paths where
    the maps carry them; the paths stay. A voxel is free if the middle of one that a map knows to be free comes to lie
    in it, and no map has a point there.

    MapvoteError, with figures, if a map overlaps no other one, is bent, or contradicts another by more than 0.1 m.
    """
    if len(maps) < 2:
        raise MapvoteError("merge: give two maps or more")
    clouds = [all_points(one) for one in maps]
    pairs, why = {}, {}
    for i, j in combinations(range(len(maps)), 2):
        try:
            pairs[i, j] = register_clouds(clouds[i], clouds[j])
        except MapvoteError as error:
            why[i, j] = str(error)
    T = _adjusted(len(maps), pairs, why)
    apart_m = {(i, j): _apart_m(found.patches, inverse(T[i]) @ T[j]) for (i, j), found in pairs.items()}
    _refuse_contradictions(pairs, apart_m)
    return Merged(_laid(maps, clouds, T), T, apart_m)


def _adjusted(n: int, pairs: dict[tuple[int, int], Registered], why: dict[tuple[int, int], str]) -> F64:
    """(n, 4, 4) where the maps lie in the first one's frame: along the pairs, then all links together."""
    T = np.tile(np.eye(4), (n, 1, 1))
    placed = {0}
    while len(placed) < n:
        step = next(((i, j) for i, j in pairs if (i in placed) != (j in placed)), None)
        if step is None:
            lost = min(set(range(n)) - placed)
            reasons = "; ".join(f"with map {min(p) + 1}: {text}" for p, text in why.items() if lost in p)
            raise MapvoteError(f"map {lost + 1} cannot be registered to any of the others ({reasons})")
        i, j = step
        if i in placed:
            T[j] = T[i] @ pairs[step].T_a_b
        else:
            T[i] = T[j] @ inverse(pairs[step].T_a_b)
        placed |= {i, j}
    links = [
        Links(np.array([i]), np.array([j]), one.T_a_b[None], one.fit.sigma_m, float(np.radians(one.fit.sigma_deg)))
        for (i, j), one in pairs.items()
    ]
    return optimise(T, links, [Anchors(np.array([0]), np.eye(4)[None], _HELD, _HELD)], iterations=10)


def _apart_m(patches: Patches, T_a_b: F64) -> float:
    return float(np.median(np.linalg.norm(patches.residuals(T_a_b)[patches.compared, :3], axis=1)))


def _refuse_contradictions(pairs: dict[tuple[int, int], Registered], apart_m: dict[tuple[int, int], float]) -> None:
    complaints = [f"maps {i + 1} and {j + 1}: {part.told()}" for (i, j), one in pairs.items() for part in one.bent]
    complaints += [
        f"maps {i + 1} and {j + 1} are {far:.2f} m apart (median of {int(pairs[i, j].patches.compared.sum())} patches)"
        for (i, j), far in apart_m.items()
        if far > MOST_APART_M
    ]
    if complaints:
        raise MapvoteError(
            f"the maps contradict each other by more than {MOST_APART_M:g} m after adjustment: {'; '.join(complaints)}"
        )


def _laid(maps: Sequence[PointMap], clouds: Sequence[F64], T: F64) -> PointMap:
    first = maps[0]
    cloud = VoxelCloud(first.lattice)
    driven = []
    for one, points, T_first in zip(maps, clouds, T, strict=True):
        cloud.enter(points @ T_first[:3, :3].T + T_first[:3, 3])
        driven += [path @ T_first[:3, :3].T + T_first[:3, 3] for path in one.driven]
    points = cloud.points()[0]
    roads = [road_under(_poses(path), np.ones(len(path), dtype=np.bool_), points).points_map for path in driven]
    merged = map_from_points(
        points,
        lattice=first.lattice,
        georeference=first.georeference,
        road=np.concatenate(roads) if roads else None,
    )
    ends = [one.surveyed_ns for one in maps]
    surveyed_ns = max(end for end in ends if end is not None) if all(end is not None for end in ends) else None
    tiles = _with_free(merged, maps, T)
    return replace(merged, tiles=tiles, driven=tuple(driven), surveyed_ns=surveyed_ns)


def _with_free(merged: PointMap, maps: Sequence[PointMap], T: F64) -> dict[TileIndex, Tile]:
    """The tiles of the merged map with what the maps know to be free."""
    free: dict[TileIndex, U64] = {}
    for one, T_first in zip(maps, T, strict=True):
        for tile in one.tiles.values():
            if tile.free is None or not tile.free.any():
                continue
            middles = _middles(tile) @ T_first[:3, :3].T + T_first[:3, 3]
            if not len(middles):
                continue
            for index, mine in cut_tiles(middles, merged.lattice):
                if index in merged.tiles and merged.tiles[index].has_ground:
                    into = merged.tiles[index]
                    rows, cols, _ = into.window.indices_of(middles[mine])
                    bit = np.floor(middles[mine, 2] / CELL_SIZE).astype(np.int64) - into.base[rows, cols]
                    good = (bit >= 0) & (bit < TOP_BIT)
                    words = free.setdefault(index, np.zeros(into.window.shape, dtype=np.uint64))
                    marks = np.uint64(1) << bit[good].astype(np.uint64)
                    np.bitwise_or.at(words, (rows[good], cols[good]), marks)
    return {
        index: replace(tile, free=free[index] & ~tile.obstacle_words) if index in free else tile
        for index, tile in merged.tiles.items()
    }


def _middles(tile: Tile) -> F64:
    """(n, 3) middles of a tile's free voxels, map metres."""
    assert tile.free is not None
    parts = []
    x, y = tile.window.centres()
    for bit in range(TOP_BIT):
        rows, cols = np.nonzero(tile.free >> np.uint64(bit) & np.uint64(1))
        parts.append(np.column_stack([x[cols], y[rows], (tile.base[rows, cols] + bit + 0.5) * CELL_SIZE]))
    return np.concatenate(parts)


def _poses(path: F64) -> F64:
    T = np.tile(np.eye(4), (len(path), 1, 1))
    T[:, :3, 3] = path
    return T
