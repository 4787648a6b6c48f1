"""Walls that hardly any ray crossed: what is little in every cell of them is enough over the whole.

The far wall of a house that was pulled down is seen from the road at a flat angle, past what stands before it. One scan
or two cross each of its voxels, none meets it, and no voxel alone says that it is gone. Together they do, if they are
many and belong to something that cannot have driven away: the trail of a car, which escaped the filter when the map was
made, is crossed as faintly.
"""

from __future__ import annotations

import numba
import numpy as np
from scipy import ndimage

from mapvote.core.types import F32, I32, U64, Bool
from mapvote.detection.counters import count_of
from mapvote.detection.surface_counts import MET, times_crossed

TALL_M = 4.0
"""No lorry is taller (Directive 96/53/EC); docs/decisions/evidence.md has what stood and what drove."""


@numba.njit(cache=True, nogil=True)
def often_crossed(planes: U64, occupied: U64, hit_rays: int, every: int) -> I32:
    """(rows, cols) how often the mapped voxels of each cell were crossed, beyond ``hit_rays`` for each time they were
    met, from counters (rows, cols, WORDS) and the map's words; ``every`` as in
    :func:`mapvote.detection.surface_counts.times_crossed`."""
    out = np.zeros(occupied.shape, dtype=np.int32)
    for r in range(occupied.shape[0]):
        for c in range(occupied.shape[1]):
            for bit in range(64):
                if occupied[r, c] >> np.uint64(bit) & np.uint64(1):
                    met = count_of(planes[r, c], MET, bit)
                    out[r, c] += max(times_crossed(planes[r, c], bit, every) - hit_rays * met, 0)
    return out


def faintly_gone(cells: Bool, often: I32, height_m: F32, least_cells: int, least_crossings: int) -> Bool:
    """(rows, cols) those of ``cells``, crossed and never met, whose 8-connected group has ``least_cells`` and was
    crossed ``least_crossings`` times in all (``often`` by cell), if it rises to TALL_M (``height_m`` by cell)."""
    group, count = ndimage.label(cells, structure=np.ones((3, 3)))
    of_each = np.arange(count + 1)
    enough = ndimage.sum_labels(often, group, of_each) >= least_crossings
    enough &= np.bincount(group.ravel(), minlength=count + 1) >= least_cells
    enough &= ndimage.maximum(height_m, group, of_each) >= TALL_M
    return np.asarray(cells & enough[group])
