"""Two maps of one place, of any origin, brought into one frame and onto one lattice."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mapvote.comparison.register import Registered, register_maps
from mapvote.core.columns import TOP_BIT
from mapvote.core.geometry import inverse, rotation_angle, transform
from mapvote.core.grid import CELL_SIZE, TILE_CELLS, tile_of_cells
from mapvote.core.point_map import PointMap, all_fields, all_points, map_from_points
from mapvote.core.types import F64, Bool

_SAME_M, _SAME_DEG = 0.05, 0.1
"""Maps of one lattice that are registered this near to where they are already lie where they are: their free space
holds cell by cell."""


def brought_into(map_a: PointMap, map_b: PointMap, *, unbend: bool = False) -> tuple[PointMap, Registered]:
    """(b as a map in a's frame on a's lattice, how it was registered).

    Its ground is computed anew from its points; its free space comes along, unless b was unbent. A map that lies in a's
    frame already is returned as it is. MapvoteError where they do not register.
    """
    registered = register_maps(map_a, map_b, unbend=unbend)
    if map_a.lattice == map_b.lattice and not registered.unbent and _is_in_place(registered.T_a_b, all_points(map_b)):
        return map_b, registered
    fields = all_fields(map_b)
    moved = map_from_points(registered.points, lattice=map_a.lattice, map_id=map_b.map_id, fields=fields)
    return moved if registered.unbent else with_free_space_of(moved, [map_b], registered.T_a_b[None]), registered


def _is_in_place(T: F64, points: F64) -> bool:
    middle = np.median(points, axis=0)
    return bool(
        np.linalg.norm(T[:3, :3] @ middle + T[:3, 3] - middle) < _SAME_M and np.degrees(rotation_angle(T)) < _SAME_DEG
    )


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
    rows, cols = one.lattice.cells_of(places)
    layers = np.floor(places[:, 2] / CELL_SIZE).astype(np.int64)
    tile_rows, tile_cols = tile_of_cells(rows, cols)
    for (row, col), part in one.tiles.items():
        mine = np.flatnonzero((tile_rows == row) & (tile_cols == col))
        if part.free is None or not len(mine):
            continue
        r, c = rows[mine] - row * TILE_CELLS, cols[mine] - col * TILE_CELLS
        bit = layers[mine] - part.base[r, c]
        words = part.free[r, c] >> np.clip(bit, 0, TOP_BIT).astype(np.uint64)
        out[mine] = (bit >= 0) & (bit < TOP_BIT) & (words & np.uint64(1) == 1)
    return out
