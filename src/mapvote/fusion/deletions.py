"""Which voxels of a tile lose their points: all that its voters saw gone in cells that were emptied, and what is left
of gone things in cells that stand.

In a cell that stands one vehicle may have seen past what another met: a twig, a ledge, the edge of a wall. So half of
the vehicles can take only what stands apart. What touches something that stays goes if more than two thirds say so,
those among them who have the whole cell empty.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mapvote.core.columns import EVERY_BIT, rebased
from mapvote.core.grid import CELLS, TILE_CELLS
from mapvote.core.tile import Tile
from mapvote.core.types import I32, U8, U64, Bool, CellState
from mapvote.fusion.sparse_columns import Words, counted, nothing_reached, packed
from mapvote.fusion.tile_vote import TileVote


def words_gone(votes: Sequence[TileVote], states: U8, quorum: int, tile: Tile) -> U64 | None:
    """(256, 256) delete mask of ``tile``, None if there is nothing to delete; ``states`` (256, 256) as decided.

    In cells decided changed-empty, the voxels that ``quorum`` voters for it mark. In cells decided unchanged-occupied
    see :func:`_remnants`.
    """
    gone, emptied = None, Words.whole(states == int(CellState.CHANGED_EMPTY))
    if len(emptied.cells):
        reached = nothing_reached(quorum, len(emptied.cells))
        for vote in votes:
            vote.mark_deleted(emptied, reached)
        gone = np.zeros(states.shape, dtype=np.uint64)
        gone.reshape(-1)[emptied.cells] = reached[-1]
    stands = states == int(CellState.UNCHANGED_OCCUPIED)
    left, standing = [vote.remnants(states) for vote in votes], Words.whole(stands)
    # A mask in one stage only tells what would go.
    emptied_by = [vote.deletes(standing) if vote.tally is None else Words.none() for vote in votes]
    if sum(len(a.cells) + len(b.cells) > 0 for a, b in zip(left, emptied_by, strict=True)) < quorum:
        return gone
    remnants = _remnants(left, emptied_by, votes, states != int(CellState.CHANGED_EMPTY), quorum, tile)
    gone = np.zeros(states.shape, dtype=np.uint64) if gone is None else gone
    gone.reshape(-1)[remnants.cells] |= remnants.words
    return gone


def _remnants(
    left: Sequence[Words],
    emptied_by: Sequence[Words],
    votes: Sequence[TileVote],
    stays_in: Bool,
    quorum: int,
    tile: Tile,
) -> Words:
    """What of cells that stand goes: the voxels that ``quorum`` vehicles or more, and more than half of those that
    determined the cell, say are ``left`` of something, if they touch (26) nothing of the map that stays; and those that
    more than two thirds, two at least, say are left or gone with the whole cell. What lies beyond the tile's edge stays
    for all that is known here."""
    cells = np.unique(np.concatenate([found.cells for found in (*left, *emptied_by)]))
    halves = counted(cells, left)
    marks = halves + counted(cells, emptied_by)
    determined = np.sum([vote.determined(cells) for vote in votes], axis=0)[:, None]
    most = packed((halves >= quorum) & (2 * halves > determined))
    nearly_all = packed((marks >= max(quorum, 2)) & (3 * marks > 2 * determined))
    stays = np.where(stays_in, tile.obstacle_words, np.uint64(0))
    stays.reshape(-1)[cells] &= ~(most | nearly_all)
    return Words(cells, nearly_all | (most & ~_touched(cells, stays, tile.base)))


def _touched(cells: NDArray[np.intp], stays: U64, base: I32) -> U64:
    """(n,) the voxels of flat ``cells`` that touch one of ``stays``, or the tile's edge."""
    rows, cols = np.divmod(cells, TILE_CELLS)
    edge = (rows == 0) | (cols == 0) | (rows == TILE_CELLS - 1) | (cols == TILE_CELLS - 1)
    near = np.zeros(len(cells), dtype=np.uint64)
    for step in (TILE_CELLS * i + j for i in (-1, 0, 1) for j in (-1, 0, 1)):
        beside = np.clip(cells + step, 0, CELLS - 1)  # beyond the tile only for cells at its edge
        near |= rebased(stays.reshape(-1)[beside], base.reshape(-1)[beside] - base.reshape(-1)[cells])
    one = np.uint64(1)
    return np.where(edge, EVERY_BIT, near | (near << one) | (near >> one))
