"""A vehicle's confidence in each cell that it calls changed: log-odds that the cell did change, by its own evidence.

Most cells that are wrongly called changed lie at the rim of a true change, where centimetres decide which of two cells
holds a surface. They are distinguished by the size of the object, the number of neighbouring cells with the same
change, the cell's share of the object beside its neighbours', the height of a deleted object, and how deep in the cell
the surface lies. The number of rays that crossed a deleted object, and the rule that decided it, add nothing
(docs/measurements/probability.md, which also describes the fit and its calibration).
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from mapvote.codec.ballot import changed_cells_of
from mapvote.core.grid import CELL_SIZE, CELLS, TILE_CELLS
from mapvote.core.tile import Tile
from mapvote.core.types import F32, F64, I32, I64, U8, Bool, CellState

LOOKS = 4
MOST_CELLS = 200
"""Sizes of objects are cut here."""
MOST_HEIGHT_M = 6.0
_BESIDE = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]
# By benchmarks/probability.py.
_BUILT = np.array([-4.104, 0.525, 3.454, 0.382, 0.0, 21.98])
_DEMOLISHED = np.array([-8.435, 0.982, 2.939, 0.689, 0.474, 22.654])
"""Coefficients of the log-odds: constant; the LOOKS features of the cell; metres of depth."""


def looks(states: U8, amount: I32, height_m: F32, tile: tuple[slice, slice]) -> F64:
    """(m, LOOKS) features of the cells of one ``tile`` of a window that its ``states`` call changed, ascending.

    The features of a cell: ln(1 + cells of its 8-connected object); the share of its eight neighbours with the same
    state; ln(1 + its amount) - ln(1 + the largest amount of these neighbours), where ``amount`` is the number of mapped
    voxels, or of hits of new ones; the height of the map in the cell (``height_m``) if it is changed-empty, else 0. The
    planes (rows, cols) of the window reach a cell or more beyond the tile.
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
    """For the cells (n,): the size of their 8-connected group of ``alike``, the number of their eight neighbours in
    ``alike``, and ln(1 + their amount) - ln(1 + the largest amount of these)."""
    group, _ = ndimage.label(alike, structure=np.ones((3, 3)))
    sizes = np.bincount(group.ravel())[group[rows, cols]]
    mine = np.where(alike, amount, 0)
    beside = np.stack([alike[rows + i, cols + j] for i, j in _BESIDE])
    most = np.max([mine[rows + i, cols + j] for i, j in _BESIDE], axis=0)
    return sizes, beside.sum(axis=0), np.log1p(mine[rows, cols]) - np.log1p(most)


def depths_m(states: U8, mapped: Tile | None, new_points: F32) -> F64:
    """(m,) metres: how deep the surface lies in each cell that ``states`` (256, 256) call changed: the largest distance
    of one of its points from the nearest side of the cell. The points are the map's obstacles in a changed-empty cell
    and ``new_points`` (n, 3), from the tile's corner, in a changed-occupied one; 0 without any."""
    cells = changed_cells_of(states)
    out = _deepest_m(new_points)[cells]
    if mapped is not None:
        gone = states.reshape(-1)[cells] == CellState.CHANGED_EMPTY
        out[gone] = _deepest_m(mapped.points[mapped.columns[1]])[cells[gone]]
    return out


def _deepest_m(points: F32) -> F64:
    """(65536,) metres: the largest distance from the nearest side of its cell of points (n, 3) from a tile's corner."""
    deep = np.zeros(CELLS)
    places = points[:, :2].astype(np.float64) / CELL_SIZE
    cell = np.clip(np.floor(places), 0, TILE_CELLS - 1)
    within = places - cell
    flat = (cell[:, 1] * TILE_CELLS + cell[:, 0]).astype(np.int64)
    np.maximum.at(deep, flat, CELL_SIZE * np.minimum(within, 1.0 - within).min(axis=1))
    return deep


def log_odds(states: U8, looked: F64, depth_m: F64) -> F64:
    """(n,) log-odds, nats, that cells with ``states`` (n,), CHANGED_OCCUPIED or CHANGED_EMPTY, did change.
    ``looked`` (n, k): the features of :func:`looks`; ``depth_m`` (n,): see :func:`depths_m`."""
    curve = np.where((states == CellState.CHANGED_OCCUPIED)[:, None], _BUILT, _DEMOLISHED)
    features = np.column_stack([np.ones(len(states)), looked, depth_m])
    return np.asarray((curve * features).sum(axis=1))
