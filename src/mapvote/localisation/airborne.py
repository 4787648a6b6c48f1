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
    few = points_lidar[thin(points_lidar, size)].astype(np.float64)
    rays = np.ascontiguousarray(points_lidar[:: -(-len(points_lidar) // _RAYS) or 1])  # of one kind: one compilation
    range2 = (few**2).sum(axis=1)
    expected = len(rays) / _SOLID_ANGLE * _VOXEL_M**2 / np.maximum(range2, _VOXEL_M**2)
    return few[(range2 > _REACH_M**2) | (_hits_around(rays, few, _table_for(rays)) > _SHARE * expected)]


def _table_for(rays: NDArray[np.floating]) -> I64:
    """(2, 2^k) zeros: the keys of voxels, and how many rays end in each."""
    return np.zeros((2, 1 << max(10, int(2 * len(rays)).bit_length())), dtype=np.int64)


@numba.njit(cache=True, nogil=True)
def _hits_around(rays: NDArray[np.floating], few: F64, table: I64) -> I64:
    """(m,) how many of ``rays`` (n, 3) end in the voxel of each of ``few``; ``table``: see :func:`_table_for`."""
    keys, counts = table[0], table[1]
    far2, slot = (_REACH_M + 2.0 * _VOXEL_M) ** 2, np.int64(0)
    for i in range(len(rays)):
        if rays[i, 0] ** 2 + rays[i, 1] ** 2 + rays[i, 2] ** 2 > far2:
            continue
        key = voxel_key(rays[i, 0], rays[i, 1], rays[i, 2], _VOXEL_M)
        if key != keys[slot]:  # neighbours in a scan mostly share a voxel
            slot = slot_of(key, keys)
            keys[slot] = key
        counts[slot] += 1
    out = np.empty(len(few), dtype=np.int64)
    for i in range(len(few)):
        out[i] = counts[slot_of(voxel_key(few[i, 0], few[i, 1], few[i, 2], _VOXEL_M), keys)]
    return out
