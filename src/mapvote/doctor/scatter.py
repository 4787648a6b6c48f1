"""By how much ranges scatter: each ray of a scan against the rays beside it."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from mapvote.core.types import F32

_RAYS = 500
_BESIDE = 8
_QUARTER = 0.3186
"""Of a normal distribution's absolute values a quarter is smaller than this many standard deviations."""
_NEAREST_M, _FARTHEST_M = 3.0, 40.0


def range_scatter_m(points: F32) -> float:
    """Standard deviation of a range from the surface that the rays beside it show, metres; 0 for a scan of few points.

    On a plane the inverse range is linear in the direction: it is fitted to the eight nearest directions. Edges and
    leaves scatter without being wrong, so the better quarter of the rays is taken for all.
    """
    length = np.linalg.norm(points, axis=1).astype(np.float64)
    inside = (length > _NEAREST_M) & (length < _FARTHEST_M)
    if inside.sum() < 20 * _BESIDE:
        return 0.0
    length, direction = length[inside], points[inside] / length[inside, None]
    chosen = np.linspace(0, len(length) - 1, _RAYS).astype(np.int64)
    _, beside = cKDTree(direction).query(direction[chosen], k=_BESIDE + 1)
    beside = beside[:, 1:]
    plane = np.linalg.pinv(direction[beside]) @ (1.0 / length[beside])[:, :, None]
    inverse = (direction[chosen][:, None, :] @ plane)[:, 0, 0]
    off = np.abs(1.0 / np.maximum(inverse, 1e-3) - length[chosen])
    return float(np.quantile(off, 0.25)) / _QUARTER
