"""Reasons of the policy to hold a version back: shares of a tile, and the area of one connected thing.

A thing may lie on many tiles, and a version may change all tiles of a city. So the cells are read some tiles at a time,
and only those at the edge of a tile are kept.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
import scipy

from mapvote.codec.ballot import tile_key
from mapvote.config import FuseSettings
from mapvote.core.grid import CELL_SIZE, CELLS, TILE_CELLS
from mapvote.core.types import F64, I64
from mapvote_server.store.fusion_jobs import JOB_SIZES, Fused


def hold_reasons(changed: Sequence[Fused], settings: FuseSettings) -> list[str]:
    """The policy's reasons against publishing these tiles."""
    reasons = []
    for fused in changed:
        name = f"tile {tile_key(fused.index)}"
        if fused.points and fused.deleted > settings.max_deleted_share * fused.points:
            share = fused.deleted / fused.points
            reasons.append(f"deletes {share:.0%} of the points of {name}, more than {settings.max_deleted_share:.0%}")
        if fused.freed > settings.max_freed_share * CELLS:
            freed = fused.freed / CELLS
            reasons.append(f"learns free space in {freed:.0%} of {name}, more than {settings.max_freed_share:.0%}")
    for verb, cells in (("removes", "cells_gone"), ("adds", "cells_new")):
        largest_m2 = areas_m2(_cells_of(changed, cells)).max(initial=0.0)
        if largest_m2 > settings.max_change_m2:
            about = f"{verb} one connected thing of {largest_m2:.0f} m2"
            reasons.append(f"{about}, more than {settings.max_change_m2:.0f} m2")
    return reasons


def _cells_of(changed: Sequence[Fused], cells: str) -> Iterator[tuple[I64, I64]]:
    """(rows, cols) on the lattice of a member of some tiles that names cells, some tiles at a time."""
    for start in range(0, len(changed), JOB_SIZES.sites):
        yield lattice_cells([(one, getattr(one, cells)) for one in changed[start : start + JOB_SIZES.sites]])


def lattice_cells(cells_by_tile: Sequence[tuple[Fused, I64]]) -> tuple[I64, I64]:
    """(rows, cols) on the lattice of flat cells of some tiles."""
    rows = [f.index[0] * TILE_CELLS + cells // TILE_CELLS for f, cells in cells_by_tile]
    cols = [f.index[1] * TILE_CELLS + cells % TILE_CELLS for f, cells in cells_by_tile]
    nothing = np.empty(0, dtype=np.int64)
    return np.concatenate([nothing, *rows]), np.concatenate([nothing, *cols])


def areas_m2(parts: Iterable[tuple[I64, I64]]) -> F64:
    """(k,) the area of each thing: cells that touch, corners included, whatever tile they are in.

    ``parts``: (rows, cols) of cells, (n,) each, different ones in each part; all cells of one tile are in one part.
    """
    counts = [np.empty(0, dtype=np.int64)]
    edge_keys = [np.empty(0, dtype=np.int64)]
    edge_labels = [np.empty(0, dtype=np.int64)]
    n_things = 0
    for rows, cols in parts:
        keys = (rows << 32) + cols
        labels = _joined(keys, np.arange(len(keys)), len(keys))
        counts.append(np.bincount(labels))
        # A thing goes on in another part only over the edge of a tile.
        at_edge = ((rows + 1) % TILE_CELLS <= 1) | ((cols + 1) % TILE_CELLS <= 1)
        edge_keys.append(keys[at_edge])
        edge_labels.append(labels[at_edge] + n_things)
        n_things += len(counts[-1])
    whole = _joined(np.concatenate(edge_keys), np.concatenate(edge_labels), n_things)
    cells = np.bincount(whole, weights=np.concatenate(counts))
    return cells.astype(np.float64) * CELL_SIZE**2


def _joined(keys: I64, labels: I64, n_labels: int) -> I64:
    """(n_labels,) the label of the thing that each label is a part of: those of cells that touch are one. ``keys``: row
    << 32 plus column of each cell (n,), ``labels`` (n,)."""
    if not len(keys):
        return np.arange(n_labels)
    order = np.argsort(keys)
    ordered = keys[order]
    pairs = []
    for step in (1, (1 << 32) - 1, 1 << 32, (1 << 32) + 1):
        near = np.searchsorted(ordered, keys + step)
        near[near == len(keys)] = 0
        touching = np.flatnonzero(ordered[near] == keys + step)
        pairs.append(labels[np.stack([touching, order[near[touching]]])])
    a, b = np.concatenate(pairs, axis=1)
    links = scipy.sparse.coo_array((np.ones(len(a), dtype=np.int8), (a, b)), shape=(n_labels, n_labels))
    joined: I64 = scipy.sparse.csgraph.connected_components(links, directed=False)[1].astype(np.int64)
    return joined
