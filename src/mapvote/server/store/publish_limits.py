"""What holds a version back until an operator has looked: too much of a tile, or too large a thing, changes at once.

Each tile and each connected change is judged by itself, so that nothing hides behind what else a publish learns.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy

from mapvote.codec.ballot import tile_key
from mapvote.config import FuseSettings
from mapvote.core.grid import CELL_SIZE, CELLS, TILE_CELLS
from mapvote.core.types import I64
from mapvote.server.store.fusion_jobs import Fused


def hold_reasons(changed: Sequence[Fused], settings: FuseSettings) -> list[str]:
    """What the policy says against publishing these tiles."""
    reasons = []
    for fused in changed:
        name = f"tile {tile_key(fused.index)}"
        if fused.points and fused.deleted > settings.max_deleted_share * fused.points:
            share = fused.deleted / fused.points
            reasons.append(f"deletes {share:.0%} of the points of {name}, more than {settings.max_deleted_share:.0%}")
        if fused.freed > settings.max_freed_share * CELLS:
            freed = fused.freed / CELLS
            reasons.append(f"learns free space in {freed:.0%} of {name}, more than {settings.max_freed_share:.0%}")
    for what, cells in (("removes", "cells_gone"), ("adds", "cells_new")):
        rows, cols = lattice_cells([(f, getattr(f, cells)) for f in changed])
        areas = areas_m2(rows, cols)
        largest = int(np.argmax(areas)) if len(areas) else 0
        if len(areas) and areas[largest] > settings.max_change_m2:
            about = f"{what} one connected thing of {areas[largest]:.0f} m2"
            reasons.append(f"{about}, more than {settings.max_change_m2:.0f} m2")
    return reasons


def lattice_cells(found: Sequence[tuple[Fused, I64]]) -> tuple[I64, I64]:
    """(rows, cols) on the lattice of flat cells of some tiles."""
    rows = [f.index[0] * TILE_CELLS + cells // TILE_CELLS for f, cells in found]
    cols = [f.index[1] * TILE_CELLS + cells % TILE_CELLS for f, cells in found]
    nothing = np.empty(0, dtype=np.int64)
    return np.concatenate([nothing, *rows]), np.concatenate([nothing, *cols])


def areas_m2(rows: I64, cols: I64) -> np.ndarray:
    """(k,) the area of each thing: cells that touch, corners included, whatever tile they are in."""
    if not len(rows):
        return np.empty(0)
    keys = (rows << 32) + cols
    order = np.argsort(keys)
    ordered, pairs = keys[order], []
    for step in (1, (1 << 32) - 1, 1 << 32, (1 << 32) + 1):
        near = np.searchsorted(ordered, keys + step)
        near[near == len(keys)] = 0
        touching = np.flatnonzero(ordered[near] == keys + step)
        pairs.append(np.stack([touching, order[near[touching]]]))
    a, b = np.concatenate(pairs, axis=1)
    links = scipy.sparse.coo_array((np.ones(len(a), dtype=np.int8), (a, b)), shape=(len(keys), len(keys)))
    labels = scipy.sparse.csgraph.connected_components(links, directed=False)[1]
    return np.bincount(labels) * CELL_SIZE**2
