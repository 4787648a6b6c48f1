"""Deletions that wait: those by which something that stands is likelier to be lost than the operator allows.

A cell is emptied if the votes say so. Where an operator sets a budget, ``fuse.false_deletions``, a cell stays for which
the probability of a false deletion (fusion/probability.py) is above that: its points are kept, its votes are not spent,
and it goes once vehicles that drive by are surer of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mapvote.config import FuseSettings
from mapvote.core.grid import CELL_SIZE, TILE_CELLS, Lattice, TileIndex
from mapvote.core.types import F64, I64, U8, CellState
from mapvote.fusion.odds import Odds
from mapvote.fusion.probability import false_deletion_probability

WAYPOINT_CELLS = 20
"""6 m: who drives by sees all of it."""


@dataclass(frozen=True, slots=True)
class Pending:
    """Cells of a tile that stay though the votes say that they are empty."""

    cells: I64
    """(n,) flat cells, ascending."""
    probability: F64
    """(n,) that something that stands would be deleted."""

    @classmethod
    def none(cls) -> Pending:
        """Nothing waits."""
        return cls(np.empty(0, dtype=np.int64), np.empty(0))

    def at(self, cell: tuple[int, int]) -> float | None:
        """Of one cell (row, col) of the tile; None if it does not wait."""
        found = np.flatnonzero(self.cells == cell[0] * TILE_CELLS + cell[1])
        return float(self.probability[found[0]]) if len(found) else None


def beyond_budget(states: U8, odds: Odds, settings: FuseSettings) -> Pending:
    """Of the cells that ``states`` (256, 256) empty those that are beyond the budget.

    ``odds``: how sure those are who voted so, see :func:`mapvote.fusion.odds.agreed_odds`.
    """
    if settings.false_deletions >= 1.0:
        return Pending.none()
    cells = np.flatnonzero(states == int(CellState.CHANGED_EMPTY))
    probability = false_deletion_probability(standing_beside(states, cells), odds.at(cells))
    waits = probability > settings.false_deletions
    return Pending(cells[waits], probability[waits])


def standing_beside(states: U8, cells: I64) -> I64:
    """(n,) how many of the eight cells around each of the flat ``cells`` (n,) stand by ``states`` (256, 256).

    Beyond the tile's border all is taken to be as just within.
    """
    stands = np.pad(states == int(CellState.UNCHANGED_OCCUPIED), 1, mode="edge")
    rows, cols = cells // TILE_CELLS + 1, cells % TILE_CELLS + 1
    beside = [stands[rows + i, cols + j] for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]
    return np.sum(beside, axis=0, dtype=np.int64)


@dataclass(frozen=True, slots=True)
class Waypoint:
    """Cells that wait near each other: somebody should drive by there."""

    x: float
    """Middle of its cells, map metres."""
    y: float
    cells: int
    probability: float
    """Of the likeliest of them."""


def waypoints(pending: Mapping[TileIndex, Pending], lattice: Lattice) -> list[Waypoint]:
    """What waits on some tiles, by squares of WAYPOINT_CELLS cells, those with the most cells first."""
    found = [(tile, waits) for tile, waits in pending.items() if len(waits.cells)]
    if not found:
        return []
    rows = np.concatenate([tile[0] * TILE_CELLS + waits.cells // TILE_CELLS for tile, waits in found])
    cols = np.concatenate([tile[1] * TILE_CELLS + waits.cells % TILE_CELLS for tile, waits in found])
    probability = np.concatenate([waits.probability for _, waits in found])
    squares = np.stack([rows // WAYPOINT_CELLS, cols // WAYPOINT_CELLS], axis=1)
    square, size = np.unique(squares, axis=0, return_inverse=True, return_counts=True)[1:]
    square = square.reshape(-1)
    x = lattice.x0 + CELL_SIZE * (np.bincount(square, weights=cols) / size + 0.5)
    y = lattice.y0 + CELL_SIZE * (np.bincount(square, weights=rows) / size + 0.5)
    likeliest = np.zeros(len(size))
    np.maximum.at(likeliest, square, probability)
    ranked = np.argsort(-size, kind="stable")
    return [Waypoint(float(x[i]), float(y[i]), int(size[i]), float(likeliest[i])) for i in ranked]
