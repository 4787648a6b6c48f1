"""The probability that a decided cell really changed, and the deletions that wait because of it.

Confidence. Votes decide; the confidence of the voters refines the probability of the decision. One of them may lie, so
the agreed confidence is the least that a quorum states: the median of those who voted for a change, the lower one of
two, and never more than a quorum of them states. One of the quorum is honest, so no liar raises a probability above the
statement of an honest vehicle.

Probabilities. Two logistic curves, calibrated on simulated streets with known truth (docs/measurements/probability.md).
The input of the first is the confidence or, where none is stated, the numbers of votes for and against and of the eight
neighbouring cells that changed likewise. It judges cells: at the rim of an object that did change, centimetres decide
which of two cells holds its surface, which does no harm to the map. The second predicts harm: a deleted point lies on a
surface that still stands. Such cells are few, so it has few parameters; nearly all lie before a wall that stands, where
range noise put some of its points and rays pass now.

The budget. A cell is emptied if the votes decide so. With ``fuse.false_deletions`` set, a cell stays while its
probability of a false deletion is above the budget: its points are kept, its votes are not spent, and it is emptied
once vehicles that drive by are surer.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mapvote.codec.ballot import UNSAID, Odds, changed_cells_of, in_nats, pack_odds
from mapvote.codec.planes import unpack_plane
from mapvote.config import FuseSettings
from mapvote.core.grid import CELL_SIZE, TILE_CELLS, Lattice, TileIndex
from mapvote.core.record import record
from mapvote.core.types import F64, I8, I32, I64, U8, CellState
from mapvote.fusion.tile_vote import Vote


def agreed_odds(votes: Sequence[Vote], states: U8, quorum: int) -> Odds:
    """The agreed confidence of the vehicles that voted for each changed cell of ``states`` (256, 256), one of ``votes``
    a vehicle. No confidence for a cell where fewer than ``quorum`` state theirs."""
    cells = changed_cells_of(states)
    saying = [vote for vote in votes if vote.odds is not None and vote.states is not None]
    if len(saying) < max(quorum, 1) or not len(cells):
        return Odds.none()
    decided = states.reshape(-1)[cells]
    said = np.full((len(saying), len(cells)), UNSAID, dtype=np.int8)
    for row, vote in zip(said, saying, strict=True):
        assert vote.odds is not None
        assert vote.states is not None
        row[:] = np.where(vote.states.reshape(-1)[cells] == decided, vote.odds.at(cells), UNSAID)
    said.sort(axis=0)
    tellers = (said != UNSAID).sum(axis=0)
    rank = np.maximum(tellers // 2 + 1, max(quorum, 1))
    enough = np.flatnonzero(tellers >= rank)
    return Odds(cells[enough], said[len(saying) - rank[enough], enough])


def pack_agreed(odds: Odds, states: U8) -> bytes | None:
    """The agreed confidence of the cells that ``states`` (256, 256) call changed, a byte each in their order, UNSAID
    among them; None if none is stated."""
    steps = odds.at(changed_cells_of(states))
    return pack_odds(steps) if (steps != UNSAID).any() else None


def unpack_agreed(data: bytes | None, states: U8) -> Odds:
    """The inverse of :func:`pack_agreed`; MapvoteError if damaged."""
    cells = changed_cells_of(states)
    return Odds.none() if data is None else Odds(cells, unpack_plane(data, "<i1", (len(cells),), "decision: odds"))


@record()
@dataclass(frozen=True, slots=True)
class HarmCurves:
    """Coefficients of the logistic curves (docs/measurements/probability.md)."""

    most_votes: int = 3
    """Votes up to which more of them count: the fit used three vehicles."""
    built: tuple[float, ...] = (-0.78, 1.13, -0.01, 2.96)
    """Log-odds of a lone built cell with two votes for it and none against; of a third vote; of one against; of eight
    such cells around."""
    demolished: tuple[float, ...] = (-1.37, 1.15, -0.57, 3.18)
    """The same of a demolished cell."""
    built_stated: tuple[float, float] = (0.752, 1.166)
    """Log-odds of a built cell with the stated probability 1/2; of each stated nat."""
    demolished_stated: tuple[float, float] = (0.31, 1.012)
    """The same of a demolished cell."""
    false_deletion: tuple[float, float] = (-9.03, 5.668)
    """Log-odds that a deleted point lies on a standing surface if no cell beside it stands; of a row of ``STANDING``
    cells."""
    false_deletion_stated: tuple[float, float, float] = (-8.481, 5.043, -0.294)
    """The same, and of each stated nat."""


HARM_CURVES = HarmCurves()

# By votes alone, of ballots that do not say how sure their vehicle is: of columns, and of older formats.
# By benchmarks/probability.py at 9f8814a, as are those below.
STANDING = 3
"""Cells that stand beside one: so many are a row of a wall, before which noise put points; more add nothing."""


def change_probability(
    states: U8, votes: I32 | I64, against: I32 | I64, beside: I32 | I64, odds: I8 | None = None
) -> F64:
    """(n,) probability that cells decided as ``states``, CHANGED_OCCUPIED or CHANGED_EMPTY, did change: votes for
    it, votes against it (not: undetermined), how many of the eight cells around changed likewise, and the confidence,
    UNSAID where none is stated; (n,) each."""
    built = (states == CellState.CHANGED_OCCUPIED)[:, None]
    more = np.minimum(votes, HARM_CURVES.most_votes) - 2.0
    features = np.column_stack([np.ones(len(states)), more, against, np.asarray(beside, dtype=np.float64) / 8.0])
    alone = (np.where(built, HARM_CURVES.built, HARM_CURVES.demolished) * features).sum(axis=1)
    if odds is None:
        return _logistic(alone)
    curve = np.where(built, HARM_CURVES.built_stated, HARM_CURVES.demolished_stated)
    return _logistic(np.where(odds == UNSAID, alone, curve[:, 0] + curve[:, 1] * in_nats(odds)))


def false_deletion_probability(standing: I32 | I64, odds: I8) -> F64:
    """(n,) probability that emptying cells decided changed-empty deletes something that still stands: by how many of
    the eight cells around are decided to stand, and the confidence, UNSAID where none is stated; (n,) each."""
    row = np.minimum(standing, STANDING) / STANDING
    alone = HARM_CURVES.false_deletion[0] + HARM_CURVES.false_deletion[1] * row
    curve = HARM_CURVES.false_deletion_stated
    return _logistic(np.where(odds == UNSAID, alone, curve[0] + curve[1] * row + curve[2] * in_nats(odds)))


def _logistic(log_odds: F64) -> F64:
    return np.asarray(1.0 / (1.0 + np.exp(-log_odds)))


def alike_beside(rows: I64, cols: I64, kinds: I64) -> I32:
    """(n,) how many of the eight cells around each of n different cells are among them and of the same kind."""
    if not len(rows):
        return np.zeros(0, dtype=np.int32)
    high = int(rows.min())
    wide = int(cols.min())
    width = int(cols.max()) - wide + 3
    step = int(kinds.max()) + 1
    keys = ((rows - high + 1) * width + cols - wide + 1) * step + kinds
    around = [(i * width + j) * step for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]
    return np.sum([np.isin(keys + offset, keys) for offset in around], axis=0, dtype=np.int32)


WAYPOINT_CELLS = 20
"""6 m: who drives by sees all of it."""


@dataclass(frozen=True, slots=True)
class PendingDeletions:
    """Cells of a tile that stay though the votes say that they are empty."""

    cells: I64
    """(n,) flat cells, ascending."""
    probability: F64
    """(n,) that something that stands would be deleted."""

    @classmethod
    def none(cls) -> PendingDeletions:
        """Nothing waits."""
        return cls(np.empty(0, dtype=np.int64), np.empty(0))

    def at(self, cell: tuple[int, int]) -> float | None:
        """Probability of the waiting deletion of one cell (row, col) of the tile; None if it does not wait."""
        places = np.flatnonzero(self.cells == cell[0] * TILE_CELLS + cell[1])
        return float(self.probability[places[0]]) if len(places) else None


def beyond_budget(states: U8, odds: Odds, settings: FuseSettings) -> PendingDeletions:
    """The cells that ``states`` (256, 256) empty and that are beyond the budget.

    ``odds``: how sure those are who voted so, see :func:`mapvote.fusion.loss_budget.agreed_odds`.
    """
    if settings.false_deletions >= 1.0:
        return PendingDeletions.none()
    cells = np.flatnonzero(states == int(CellState.CHANGED_EMPTY))
    probability = false_deletion_probability(standing_beside(states, cells), odds.at(cells))
    waits = probability > settings.false_deletions
    return PendingDeletions(cells[waits], probability[waits])


def standing_beside(states: U8, cells: I64) -> I64:
    """(n,) how many of the eight cells around each of the flat ``cells`` (n,) stand by ``states`` (256, 256).

    Beyond the tile's border all is taken to be as just within.
    """
    stands = np.pad(states == int(CellState.UNCHANGED_OCCUPIED), 1, mode="edge")
    rows = cells // TILE_CELLS + 1
    cols = cells % TILE_CELLS + 1
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
    """Probability of the likeliest of them."""


def waypoints(pending: Mapping[TileIndex, PendingDeletions], lattice: Lattice) -> list[Waypoint]:
    """Waiting deletions on some tiles, by squares of WAYPOINT_CELLS cells, those with the most cells first."""
    waiting = [(tile, waits) for tile, waits in pending.items() if len(waits.cells)]
    if not waiting:
        return []
    rows = np.concatenate([tile[0] * TILE_CELLS + waits.cells // TILE_CELLS for tile, waits in waiting])
    cols = np.concatenate([tile[1] * TILE_CELLS + waits.cells % TILE_CELLS for tile, waits in waiting])
    probability = np.concatenate([waits.probability for _, waits in waiting])
    squares = np.stack([rows // WAYPOINT_CELLS, cols // WAYPOINT_CELLS], axis=1)
    square, size = np.unique(squares, axis=0, return_inverse=True, return_counts=True)[1:]
    square = square.reshape(-1)
    x = lattice.x0 + CELL_SIZE * (np.bincount(square, weights=cols) / size + 0.5)
    y = lattice.y0 + CELL_SIZE * (np.bincount(square, weights=rows) / size + 0.5)
    likeliest = np.zeros(len(size))
    np.maximum.at(likeliest, square, probability)
    ranked = np.argsort(-size, kind="stable")
    return [Waypoint(float(x[i]), float(y[i]), int(size[i]), float(likeliest[i])) for i in ranked]
