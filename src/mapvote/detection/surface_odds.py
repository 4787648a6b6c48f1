"""How sure a vehicle is of each cell that it calls changed, by its own evidence: log-odds that the cell did change.

Most cells that are wrongly called changed lie at the rim of what did change, where centimetres decide which of two
cells holds a surface. What tells them apart is how much of the thing is in the cell (detection/surface_looks.py), and
how deep in it its surface lies. docs/measurements/probability.md has how the numbers were fitted, and how they do.
"""

from __future__ import annotations

import numpy as np

from mapvote.core.grid import CELL_SIZE, CELLS, TILE_CELLS
from mapvote.core.types import F32, F64, I64, U8, CellState

# By benchmarks/probability.py.
_BUILT = np.array([-5.09, 0.72, 3.31, 0.41, 0.0, 22.8])
_DEMOLISHED = np.array([-8.98, 1.05, 3.18, 0.76, 0.47, 23.6])
"""Log-odds: of nothing; of each thing looked at in the cell; of a metre of depth."""


def deepest_m(points: F32, cells: I64) -> F64:
    """(n,) how far from the nearest side of its cell the point lies that lies farthest, of ``points`` (m, 3) from a
    tile's corner, in each of the flat ``cells`` (n,); 0 where there is none."""
    deep = np.zeros(CELLS)
    if len(points):
        places = points[:, :2].astype(np.float64) / CELL_SIZE
        cell = np.clip(np.floor(places), 0, TILE_CELLS - 1)
        within = places - cell
        flat = (cell[:, 1] * TILE_CELLS + cell[:, 0]).astype(np.int64)
        np.maximum.at(deep, flat, CELL_SIZE * np.minimum(within, 1.0 - within).min(axis=1))
    return deep[cells]


def log_odds(states: U8, looked: F64, depth_m: F64) -> F64:
    """(n,) nats that cells called ``states`` (n,), CHANGED_OCCUPIED or CHANGED_EMPTY, did change, by what was
    looked at (n, k) (detection/surface_looks.py) and how deep in them their surface lies (n,)."""
    curve = np.where((states == CellState.CHANGED_OCCUPIED)[:, None], _BUILT, _DEMOLISHED)
    told = np.column_stack([np.ones(len(states)), looked, depth_m])
    return np.asarray((curve * told).sum(axis=1))
