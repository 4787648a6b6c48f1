"""A window of five by five cells, and what one scan says of it, word by word."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mapvote.core.grid import CELL_SIZE, Grid, Lattice
from mapvote.core.types import Reference
from mapvote.perception.raycast import ScanView, Sight

SIDE = 5
GRID = Grid(Lattice(), 10, 10, SIDE, SIDE)
AT = (10 + 2, 10 + 2)
"""The middle cell of the window, in the tile."""
words = arrays(np.uint64, (SIDE, SIDE), elements=st.integers(0, 2**62))


def view_of(hit: np.ndarray, passed: np.ndarray, sight: int = Sight.CLEAR) -> ScanView:
    sights = np.full(GRID.shape, int(sight), np.uint8)
    return ScanView(GRID, (hit != 0).astype(np.int32), hit.astype(np.uint64), passed.astype(np.uint64), sights)


def reference_of(occupied: np.ndarray, ground_z: np.ndarray | None = None) -> Reference:
    ground = np.zeros(GRID.shape, np.float32) if ground_z is None else ground_z.astype(np.float32)
    filled = np.where(np.isnan(ground), 0.0, ground)
    base = np.floor(filled / CELL_SIZE).astype(np.int32)
    none = np.full(GRID.shape, np.inf, np.float32)
    counts = (occupied != 0).astype(np.int32)
    return Reference(GRID, ground, base, occupied.astype(np.uint64), counts, none, -none, None)


def middle(word: int) -> np.ndarray:
    out = np.zeros(GRID.shape, np.uint64)
    out[2, 2] = word
    return out


NOTHING = middle(0)
