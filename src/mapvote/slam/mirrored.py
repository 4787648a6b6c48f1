"""Reflections below the road: points that lie under a surface which rays from above have struck.

A wet road, a window and the side of a car send rays on to what the range then puts below the ground. No such point is
there. Only where ground lies on all sides at one height is a point under it surely none: beside a wall that goes down
to a yard it may be the wall. Near a place where vehicles drove above each other, what lies below is real.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from mapvote.core.heights import crossings, heights_over_ground
from mapvote.core.point_map import PointMap
from mapvote.core.types import F32, F64, Bool

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
