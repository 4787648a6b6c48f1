"""The free space of maps in another frame: carried voxel by voxel into a map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mapvote.core.columns import TOP_BIT
from mapvote.core.geometry import inverse, transform
from mapvote.core.grid import CELL_SIZE
from mapvote.core.point_map import PointMap
from mapvote.core.types import F64, Bool


def with_free_space_of(point_map: PointMap, maps: Sequence[PointMap], T: F64) -> PointMap:
    """The map with the free space that ``maps`` know, which lie in its frame at T (k, 4, 4).

    Each voxel asks the maps for its own middle: the other way round, the voxels of a turned map leave gaps. No voxel
    that holds a point of the map becomes free."""
    out = {}
    from_map = [(one, inverse(T_map)) for one, T_map in zip(maps, T, strict=True)]
    for index, tile in point_map.tiles.items():
        rows, cols = np.nonzero(np.isfinite(tile.ground_z))
        words = np.zeros(len(rows), dtype=np.uint64)
        x, y = tile.window.centres()
        middles = np.column_stack([x[cols], y[rows], np.zeros(len(rows))])
        for one, T_one_map in from_map:
            for bit in range(TOP_BIT):
                middles[:, 2] = (tile.base[rows, cols] + bit + 0.5) * CELL_SIZE
                is_free = _is_free(one, transform(T_one_map, middles))
                words |= is_free.astype(np.uint64) << np.uint64(bit)
        free = np.zeros(tile.window.shape, dtype=np.uint64)
        free[rows, cols] = words
        free &= ~tile.obstacle_words
        out[index] = replace(tile, free=free) if free.any() else tile
    return replace(point_map, tiles=out)


def _is_free(one: PointMap, places: F64) -> Bool:
    """(n,) whether places (n, 3) lie in voxels that the map knows to be free."""
    out = np.zeros(len(places), dtype=np.bool_)
    for part, chosen, cell in one.by_tile(places):
        if part.free is not None:
            bit = np.floor(places[chosen, 2] / CELL_SIZE).astype(np.int64) - part.base[cell]
            words = part.free[cell] >> np.clip(bit, 0, TOP_BIT).astype(np.uint64)
            out[chosen] = (bit >= 0) & (bit < TOP_BIT) & (words & np.uint64(1) == 1)
    return out
