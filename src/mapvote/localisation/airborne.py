"""Rain, snow and exhaust: returns from what hangs in the air, which speak neither for a place nor against it.

A surface that one ray meets is met by those beside it; a drop is met by one. Thinned to a point a voxel, a tenth of the
rays ending on drops is a third of the points, and every right pose would fit worse than any threshold.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from mapvote.core.types import F64, I64
from mapvote.core.voxels import slot_of, thin, voxel_key

_VOXEL_M = 0.5
_REACH_M = 20.0
"""Beyond, sparse surfaces and drops look alike, and drops are few: their share of all returns falls with the range."""
_SHARE = 0.1
"""Of the rays that a surface across the whole voxel would catch: drops catch some .01 of them where a tenth of all rays
end on drops, an open crown .1 and more."""
_RAYS = 40_000
"""Looked at, evenly through the scan: enough for a share."""
_SOLID_ANGLE = 0.5 * 2.0 * np.pi
"""That a spinning sensor's rays cover: 29 degrees of elevation all around."""


def solid_sample(points_lidar: NDArray[np.floating], size: float) -> F64:
    """(m, 3) one point in each voxel of side ``size``, without what hangs in the air.

    ``points_lidar`` (n, 3) is a whole scan, metres from the sensor, de-skewed or not.
    """
    few = points_lidar.take(thin(points_lidar, size), axis=0).astype(np.float64)
    every = -(-len(points_lidar) // _RAYS) or 1
    range2 = (few**2).sum(axis=1)
    rays = -(-len(points_lidar) // every)
    expected = rays / _SOLID_ANGLE * _VOXEL_M**2 / np.maximum(range2, _VOXEL_M**2)
    hits = _hits_around(np.ascontiguousarray(points_lidar), every, few)
    return few[(range2 > _REACH_M**2) | (hits > _SHARE * expected)]


@numba.njit(cache=True, nogil=True)
def _hits_around(points: NDArray[np.floating], every: int, few: F64) -> I64:
    """(m,) how many of every ``every``-th of ``points`` (n, 3) end in the voxel of each of ``few``.

    The table holds these voxels alone, and at most a quarter of it: rays that end elsewhere leave it as it is.
    """
    size = 1024
    while size < 4 * len(few):
        size *= 2
    keys, counts, far2 = np.zeros(size, np.int64), np.zeros(size, np.int64), (_REACH_M + 2.0 * _VOXEL_M) ** 2
    at = np.empty(len(few), np.int64)
    for i in range(len(few)):
        key = voxel_key(few[i, 0], few[i, 1], few[i, 2], _VOXEL_M)
        at[i] = slot_of(key, keys)
        keys[at[i]] = key
    for i in range(0, len(points), every):
        if points[i, 0] ** 2 + points[i, 1] ** 2 + points[i, 2] ** 2 > far2:
            continue
        key = voxel_key(points[i, 0], points[i, 1], points[i, 2], _VOXEL_M)
        slot = slot_of(key, keys)
        counts[slot] += 1 if keys[slot] == key else 0
    out = np.empty(len(few), dtype=np.int64)
    for i in range(len(few)):
        out[i] = counts[at[i]]
    return out
