"""How sure a vehicle is of each cell that it calls changed, by its own evidence: log-odds that the cell did change.

Most cells that are wrongly called changed lie at the rim of what did change, where centimetres decide which of two
cells holds a surface. What tells them apart is how much of the thing is in the cell (detection/surface_looks.py), and
how deep in it its surface lies. docs/measurements/probability.md has how the numbers were fitted, and how they do.
"""

from __future__ import annotations

import numpy as np

from mapvote.codec.odds import changed_cells_of
from mapvote.core.grid import CELL_SIZE, CELLS, TILE_CELLS
from mapvote.core.tile import Tile
from mapvote.core.types import F32, F64, U8, CellState

# By benchmarks/probability.py.
_BUILT = np.array([-4.104, 0.525, 3.454, 0.382, 0.0, 21.98])
_DEMOLISHED = np.array([-8.435, 0.982, 2.939, 0.689, 0.474, 22.654])
"""Log-odds: of nothing; of each thing looked at in the cell; of a metre of depth."""


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
    looked at (n, k) (detection/surface_looks.py) and how deep in them their surface lies (n,)."""
    curve = np.where((states == CellState.CHANGED_OCCUPIED)[:, None], _BUILT, _DEMOLISHED)
    told = np.column_stack([np.ones(len(states)), looked, depth_m])
    return np.asarray((curve * told).sum(axis=1))
