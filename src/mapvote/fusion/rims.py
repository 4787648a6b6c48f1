"""Rims: cells that were voted changed and did not, beside one that did.

A wall two centimetres from the border of its cell leaves points in the next one, which noise carried there. When it
goes, or comes, vehicles see that cell change, too, and they are right: its points have to go, or come, with the wall.
But nothing of the world changed in it. So a rim's points are edited as was voted, and the cell is told as what it was
and is: empty. A rim is told by what vehicles say of it (likelier not changed than changed, beside one of which the
contrary holds: fusion/probability.py) or by where its points lie (fusion/spilled.py). A thing of which no cell is
likely has no rim: a pole alone fills no cell, and is what changed.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mapvote.codec.odds import UNSAID, changed_cells_of
from mapvote.core.grid import TILE_CELLS
from mapvote.core.tile import Tile
from mapvote.core.types import I64, U8, CellState
from mapvote.fusion.odds import Odds
from mapvote.fusion.probability import change_probability
from mapvote.fusion.spilled import spilled
from mapvote.fusion.tile_vote import TileVote

LIKELY = 0.5
"""Likelier than not."""


def without_rims(states: U8, odds: Odds, tile: Tile, votes: Sequence[TileVote]) -> U8:
    """The states (256, 256) as they are told: of rims that nothing changed.

    Where no vehicle says how sure it is (``odds``: every method but surfaces) there are none. ``tile``: as it was.
    """
    if not (odds.at(changed_cells_of(states)) != UNSAID).any():
        return states
    rim = np.concatenate([rims(states, odds), spilled(tile, votes, states)])
    if not len(rim):
        return states
    told = states.copy()
    told.reshape(-1)[rim] = int(CellState.UNCHANGED_EMPTY)
    return told


def rims(states: U8, odds: Odds) -> I64:
    """(n,) flat cells, ascending, that ``states`` (256, 256) call changed and are rims by what was said of them.

    ``odds``: how sure those are who voted so, see :func:`mapvote.fusion.odds.agreed_odds`; of cells of which nobody
    says that nothing is known, and none is a rim. A cell of the next tile makes no rim.
    """
    cells = changed_cells_of(states)
    kinds, said = states.reshape(-1)[cells], odds.at(cells)
    known = said != UNSAID
    none = np.zeros(len(cells), dtype=np.int64)
    likely = known & (change_probability(kinds, none, none, none, said) >= LIKELY)
    out = np.zeros(len(cells), dtype=np.bool_)
    rows, cols = cells // TILE_CELLS + 1, cells % TILE_CELLS + 1
    for kind in (CellState.CHANGED_OCCUPIED, CellState.CHANGED_EMPTY):
        sound = np.zeros((TILE_CELLS + 2, TILE_CELLS + 2), dtype=np.bool_)
        of_kind = likely & (kinds == kind)
        sound[rows[of_kind], cols[of_kind]] = True
        beside = np.any([sound[rows + i, cols + j] for i in (-1, 0, 1) for j in (-1, 0, 1)], axis=0)
        out |= (kinds == kind) & known & ~likely & beside
    return np.asarray(cells[out])
