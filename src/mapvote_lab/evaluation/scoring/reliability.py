"""Whether cells changed as often as their probability says: what a reliability diagram shows (DeGroot 1983)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mapvote.core.grid import TILE_CELLS, Grid, Lattice, TileIndex
from mapvote.core.types import F64, I64, U8, Bool, CellState
from mapvote.core.voting import VOTE_UNIT
from mapvote.fusion.fuse import Decision
from mapvote.fusion.loss_budget import alike_beside, change_probability
from mapvote_lab.evaluation.scoring.cells import UNSCORED, ratio

BINS = 10
"""Of equal width, from 0 to 1."""


@dataclass(frozen=True, slots=True)
class Reliability:
    """Of the scored cells that were decided as one kind of change. Bins without a cell have NaN."""

    predicted: F64
    """(BINS,) mean probability."""
    true: F64
    """(BINS,) share of the cells that did change so."""
    cells: I64
    """(BINS,)."""
    calibration_error: float
    """Mean distance of the two over the bins, weighed by their cells (ECE)."""
    brier: float
    """Mean square error of the probability, cell by cell."""


def reliability(
    decisions: Mapping[TileIndex, Decision], lattice: Lattice, truth: U8, window: Grid, state: CellState
) -> Reliability:
    """Hold the probabilities of the cells decided as ``state``, a changed one, against ``truth`` over ``window``.

    As the server tells them (:func:`mapvote.fusion.loss_budget.change_probability`); votes are of vehicles, so
    ``decisions`` are two-stage ones.
    """
    rows, cols, votes, against, odds = _decided(decisions, lattice, state)
    kinds = np.zeros(len(rows), dtype=np.int64)
    states = np.full(len(rows), state, dtype=np.uint8)
    said = change_probability(states, votes, against, alike_beside(rows, cols, kinds), odds.astype(np.int8))
    r, c = rows - window.row0, cols - window.col0
    inside = (r >= 0) & (r < window.rows) & (c >= 0) & (c < window.cols)
    found = truth[r[inside], c[inside]]
    scored = found != UNSCORED
    return binned(said[inside][scored], found[scored] == (1 if state == CellState.CHANGED_OCCUPIED else 2))


def binned(said: F64, true: Bool) -> Reliability:
    """Of probabilities (n,) and whether what they speak of is so (n,)."""
    which = np.minimum((said * BINS).astype(np.int64), BINS - 1)
    cells = np.bincount(which, minlength=BINS)
    with np.errstate(invalid="ignore"):
        predicted = np.bincount(which, weights=said, minlength=BINS) / cells
        share = np.bincount(which, weights=true, minlength=BINS) / cells
    apart = np.where(cells > 0, np.abs(np.nan_to_num(predicted) - np.nan_to_num(share)), 0.0)
    return Reliability(
        predicted,
        share,
        cells,
        ratio(float((apart * cells).sum()), len(said)),
        ratio(float(((said - true) ** 2).sum()), len(said)),
    )


def _decided(
    decisions: Mapping[TileIndex, Decision], lattice: Lattice, state: CellState
) -> tuple[I64, I64, I64, I64, I64]:
    """(rows, cols on the lattice, votes for it, votes for something else; undetermined ones say nothing; how sure those
    for it are), (n,) each."""
    parts = [np.zeros((5, 0), dtype=np.int64)]
    for index, decision in decisions.items():
        tile = lattice.tile(index)
        r, c = np.nonzero(decision.states == state)
        told = decision.tally[r, c].astype(np.int64) // VOTE_UNIT
        votes = told[:, state]
        others = told[:, : CellState.UNDETERMINED].sum(axis=1) - votes
        odds = decision.odds.at(r * TILE_CELLS + c)
        parts.append(np.stack([tile.row0 + r, tile.col0 + c, votes, others, odds]))
    rows, cols, votes, against, odds = np.concatenate(parts, axis=1)
    return rows, cols, votes, against, odds
