"""How sure a vehicle is of each cell that it calls changed, by its own evidence: log-odds that the cell did change.

Most cells that are wrongly called changed lie at the rim of what did change, where centimetres decide which of two
cells holds a surface. What tells them apart is how large the thing is, how many of the cells around changed likewise,
how much of it the cell holds against those, of what is gone how high it rose, and how deep in the cell its surface
lies. How often rays crossed what is gone, or which rule decided it, tells nothing beyond (docs/measurements/
probability.md, which also has how the numbers were fitted, and how they do).
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from mapvote.codec.odds import changed_cells_of
from mapvote.core.grid import CELL_SIZE, CELLS, TILE_CELLS
from mapvote.core.tile import Tile
from mapvote.core.types import F32, F64, I32, I64, U8, Bool, CellState

LOOKS = 4
MOST_CELLS = 200
"""A thing of more is as large as any."""
MOST_HEIGHT_M = 6.0
_BESIDE = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]
# By benchmarks/probability.py.
_BUILT = np.array([-4.104, 0.525, 3.454, 0.382, 0.0, 21.98])
_DEMOLISHED = np.array([-8.435, 0.982, 2.939, 0.689, 0.474, 22.654])
"""Log-odds: of nothing; of each thing looked at in the cell; of a metre of depth."""


def looks(states: U8, amount: I32, height_m: F32, tile: tuple[slice, slice]) -> F64:
    """(m, LOOKS) of the cells of one ``tile`` of a window that its ``states`` call changed, ascending.

    Of each: ln of 1 + the cells of the 8-connected thing it belongs to; which share of the eight cells around is alike;
    ln of how much of the thing it holds against the fullest of those, by ``amount``: the voxels that the map holds,
    else how often the new ones were hit; how high the map rises in it (``height_m``), of what is gone. The planes
    (rows, cols) of the window reach a cell or more beyond the tile.
    """
    cells = changed_cells_of(np.ascontiguousarray(states[tile]))
    rows, cols = cells // TILE_CELLS + tile[0].start, cells % TILE_CELLS + tile[1].start
    out = np.zeros((len(cells), LOOKS))
    for state in (CellState.CHANGED_OCCUPIED, CellState.CHANGED_EMPTY) if len(cells) else ():
        mine = states[rows, cols] == state
        alike = states == state
        sizes, around_it, share = _of_things(alike, amount, rows[mine], cols[mine])
        height = np.minimum(np.nan_to_num(height_m[rows[mine], cols[mine]]), MOST_HEIGHT_M)
        rises = height if state == CellState.CHANGED_EMPTY else np.zeros(len(height))
        out[mine] = np.column_stack([np.log1p(np.minimum(sizes, MOST_CELLS)), around_it / len(_BESIDE), share, rises])
    return out


def _of_things(alike: Bool, amount: I32, rows: I64, cols: I64) -> tuple[I64, I64, F64]:
    """Of the cells (n,): how many their 8-connected group of ``alike`` has, how many of the eight around are among
    them, and ln of their amount against the largest of those."""
    group, _ = ndimage.label(alike, structure=np.ones((3, 3)))
    sizes = np.bincount(group.ravel())[group[rows, cols]]
    mine = np.where(alike, amount, 0)
    beside = np.stack([alike[rows + i, cols + j] for i, j in _BESIDE])
    most = np.max([mine[rows + i, cols + j] for i, j in _BESIDE], axis=0)
    return sizes, beside.sum(axis=0), np.log1p(mine[rows, cols]) - np.log1p(most)


def depths_m(states: U8, mapped: Tile | None, new_points: F32) -> F64:
    """(m,) metres: how deep in each cell that ``states`` (256, 256) call changed its surface lies, that is how far from
    the nearest side that of its points is that lies farthest from all. Of what went those are the map's obstacles, of
    what came the ``new_points`` (n, 3) from the tile's corner; 0 where there are none."""
    cells = changed_cells_of(states)
    out = _deepest_m(new_points)[cells]
    if mapped is not None:
        gone = states.reshape(-1)[cells] == CellState.CHANGED_EMPTY
        out[gone] = _deepest_m(mapped.points[mapped.columns[1]])[cells[gone]]
    return out


def _deepest_m(points: F32) -> F64:
    """(65536,) of points (n, 3) from a tile's corner."""
    deep = np.zeros(CELLS)
    places = points[:, :2].astype(np.float64) / CELL_SIZE
    cell = np.clip(np.floor(places), 0, TILE_CELLS - 1)
    within = places - cell
    flat = (cell[:, 1] * TILE_CELLS + cell[:, 0]).astype(np.int64)
    np.maximum.at(deep, flat, CELL_SIZE * np.minimum(within, 1.0 - within).min(axis=1))
    return deep


def log_odds(states: U8, looked: F64, depth_m: F64) -> F64:
    """(n,) nats that cells called ``states`` (n,), CHANGED_OCCUPIED or CHANGED_EMPTY, did change, by what was
    looked at (n, k) (:func:`looks`) and how deep in them their surface lies (n,)."""
    curve = np.where((states == CellState.CHANGED_OCCUPIED)[:, None], _BUILT, _DEMOLISHED)
    told = np.column_stack([np.ones(len(states)), looked, depth_m])
    return np.asarray((curve * told).sum(axis=1))
