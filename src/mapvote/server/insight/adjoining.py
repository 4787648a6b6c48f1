"""Buildings that stand side by side: connected cells are cut where two of their walls run along each other.

No room is half a metre wide: a slot between two walls, so narrow and as long as a wall, is what lies between two
buildings, although their fronts, a cell thick or two, touch across it.
"""

from __future__ import annotations

import numpy as np
import scipy

from mapvote.core.types import F64, I32, I64, Bool
from mapvote.server.insight.polygons import Pieces, pieces

SLOT_CELLS = 4
"""1.2 m: two walls no farther apart are not those of one room."""
WALL_CELLS = 10
"""3 m: how long a slot is at least."""
LEAST_SHARE = 0.2
"""Of the cells that either side of a cut holds at least: no wall is cut off its building."""
_MOST_CUTS = 12
"""One after the other: of a row of buildings each is cut off by itself."""
_DISK = np.hypot(*np.indices((SLOT_CELLS + 1, SLOT_CELLS + 1)) - SLOT_CELLS // 2) <= SLOT_CELLS / 2 + 0.25


def buildings(rows: I64, cols: I64, kinds: I64) -> Pieces:
    """Connected cells of one kind, see :func:`pieces`, cut between buildings that stand side by side."""
    found = pieces(rows, cols, kinds)
    part = np.zeros(len(rows), dtype=np.int64)
    done: set[tuple[int, int]] = set()
    for turn in range(1, _MOST_CUTS + 1):
        fresh = _cut_each(rows, cols, found.objects, done)
        if not fresh.any():
            break
        part[fresh] += 1 << turn
        _, apart = np.unique(np.stack([kinds, part]), axis=1, return_inverse=True)
        found = pieces(rows, cols, apart.reshape(-1))
    return found


def _cut_each(rows: I64, cols: I64, objects: I32, done: set[tuple[int, int]]) -> Bool:
    """(n,) the cells on one side of the cut through each piece that has one. ``done``: pieces without, by their first
    cell and size, which need not be asked again."""
    fresh = np.zeros(len(rows), dtype=np.bool_)
    sizes = np.bincount(objects)
    for label in np.flatnonzero(sizes >= 2 * WALL_CELLS / LEAST_SHARE):
        mine = np.flatnonzero(objects == label)
        name = int(mine[0]), len(mine)
        if name in done:
            continue
        side = _beyond_cut(rows[mine], cols[mine])
        if side is None:
            done.add(name)
        else:
            fresh[mine[side]] = True
    return fresh


def _beyond_cut(rows: I64, cols: I64) -> Bool | None:
    """(n,) the cells beyond the cut along the longest slot that has enough on either side; None without one."""
    margin = SLOT_CELLS
    r, c = rows - rows.min() + margin, cols - cols.min() + margin
    image = np.zeros((r.max() + margin + 1, c.max() + margin + 1), dtype=np.bool_)
    image[r, c] = True
    slots, count = scipy.ndimage.label(scipy.ndimage.binary_closing(image, _DISK) & ~image, np.ones((3, 3)))
    at = np.stack([r, c], axis=1).astype(np.float64)
    best: tuple[float, Bool] | None = None
    for k in range(1, count + 1):
        slot = np.argwhere(slots == k).astype(np.float64)
        if len(slot) < WALL_CELLS:
            continue
        middle, along, length, width = _line(slot)
        across = (at - middle) @ np.array([-along[1], along[0]])
        beyond, bridge = across > 0, 0.5 * np.count_nonzero(np.abs(across) < 1)
        narrow = max(WALL_CELLS, bridge) <= length and width <= SLOT_CELLS
        enough = LEAST_SHARE <= beyond.mean() <= 1 - LEAST_SHARE
        if narrow and enough and (best is None or length > best[0]):
            best = length, beyond
    return None if best is None else best[1]


def _line(cells: F64) -> tuple[F64, F64, float, float]:
    """(middle (2,), direction (2,), length, width) of cells (n, 2), in cells, along their principal axis."""
    middle = cells.mean(axis=0)
    along = np.linalg.svd(cells - middle, full_matrices=False)[2][0]
    offset = cells - middle
    length, width = (np.ptp(offset @ way) + 1.0 for way in (along, np.array([-along[1], along[0]])))
    return middle, along, float(length), float(width)
