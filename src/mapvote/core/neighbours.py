"""The points nearest to some places, by a sweep along the axis on which the points are spread most.

For some thousand places in a street it takes as long as a tree of scipy's, without the import of half of scipy.
"""

from __future__ import annotations

import numpy as np

from mapvote.core.geometry import corners
from mapvote.core.kernel import kernel
from mapvote.core.types import F64, I64


def nearest(points: F64, places: F64, count: int, reach_m: float = np.inf) -> tuple[F64, I64]:
    """(distances (m, count), ascending, metres; indices (m, count)) of the ``points`` (n, 3) nearest to each of the
    ``places`` (m, 3) and nearer than ``reach_m``; infinite and n where there are no more."""
    axis = int(np.argmax(np.diff(corners(points), axis=0)))
    order = np.argsort(points[:, axis])
    ordered = points[order]
    squared = np.full((len(places), count), reach_m**2)
    which = np.full((len(places), count), len(points), dtype=np.int64)
    places = np.ascontiguousarray(places)
    _sweep(ordered, axis, places, np.searchsorted(ordered[:, axis], places[:, axis]), squared, which)
    distances = np.where(which < len(points), np.sqrt(squared), np.inf)
    return distances, np.append(order, len(points))[which]


@kernel
def _sweep(points: F64, axis: int, places: F64, start: I64, squared: F64, which: I64) -> None:
    """Into ``squared`` (m, k), which holds the square of the greatest distance, and ``which`` (m, k) the nearest of the
    points (n, 3), which ascend along ``axis``; at each place the sweep begins at point ``start`` (m,)."""
    last = squared.shape[1] - 1
    for i in range(len(places)):
        x, y, z = places[i]
        farthest = squared[i, last]
        for way in (-1, 1):
            j = start[i] + min(way, 0)
            while 0 <= j < len(points) and (points[j, axis] - places[i, axis]) ** 2 < farthest:
                p = points[np.uint64(j)]
                apart = (p[0] - x) ** 2 + (p[1] - y) ** 2 + (p[2] - z) ** 2
                if apart < farthest:
                    k = last
                    while k > 0 and squared[i, k - 1] > apart:
                        squared[i, k] = squared[i, k - 1]
                        which[i, k] = which[i, k - 1]
                        k -= 1
                    squared[i, k] = apart
                    which[i, k] = j
                    farthest = squared[i, last]
                j += way
