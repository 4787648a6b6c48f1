"""A vote is spent once a version has changed its cell: which cells two versions of a tile differ in, and which votes
still count.

That the cell looks as it did is no test: what came and went leaves it bit for bit as at first, and the votes that
brought it would bring it again.
"""

from __future__ import annotations

from collections.abc import Mapping

import numba
import numpy as np
from numpy.typing import NDArray

from mapvote.core.grid import CELLS, TILE_CELLS
from mapvote.core.memory import Memory
from mapvote.core.tile import Tile
from mapvote.core.types import I64, U8, U64, Bool
from mapvote.fusion.tile_vote import TileVote, silenced


def unspent(vote: TileVote, tile: Tile, misread: Mapping[int, Bool] | None = None) -> TileVote:
    """The vote in the cells where it counts on ``tile``: those that have not changed since the version that its vehicle
    drove with. ``misread``: by version, (256, 256) cells in which that version showed what no longer is history."""
    spent = None if tile.memory is None else tile.memory.changed_after(vote.version)
    wrong = None if misread is None else misread.get(vote.version)
    if wrong is not None:
        spent = np.union1d(np.flatnonzero(wrong), [] if spent is None else spent).astype(np.int64)
    return vote if spent is None else silenced(vote, spent)


def differing(a: Tile, b: Tile) -> Bool:
    """(256, 256) cells in which two versions of a tile hold other points, or know other voxels to be free. Learning
    that nothing is free is no difference."""
    differ = _other_points(a, b).reshape(TILE_CELLS, TILE_CELLS)
    if a.free is b.free:
        return differ
    nothing = np.uint64(0)
    return np.asarray(differ | ((nothing if a.free is None else a.free) != (nothing if b.free is None else b.free)))


def changed_in(version: int, before: Tile, after: Tile) -> Memory:
    """What ``after`` remembers if ``version`` made it of ``before``."""
    return (before.memory or Memory.none()).with_changed(np.flatnonzero(differing(before, after)), version)


def _other_points(a: Tile, b: Tile) -> Bool:
    """(65536,) cells that hold other points."""
    if a.points is b.points:
        return np.zeros(CELLS, dtype=np.bool_)
    sides = [(tile.cells, np.ascontiguousarray(tile.points).view(np.uint32)) for tile in (a, b)]
    missing = _out_of_step(*sides[0], *sides[1])
    differ, unsure = missing > 0, missing == 3
    if unsure.any():
        digests = [_cell_digests(*side, unsure) for side in sides]
        differ[unsure] = (digests[0] != digests[1])[unsure]
    return np.asarray(differ)


@numba.njit(cache=True, nogil=True)
def _out_of_step(cells_a: I64, words_a: NDArray[np.uint32], cells_b: I64, words_b: NDArray[np.uint32]) -> U8:
    """(65536,) of which side a cell has points (n, 3) that do not follow in the other: 1 and 2, or 3 of both.

    Each point of b is matched with at most one of a, in order. So cells of 0 hold the same points; those of 1 and 2
    hold more on one side; and of an edit few are 3.
    """
    missing = np.zeros(CELLS, dtype=np.uint8)
    k = 0
    for i in range(len(cells_a)):
        if k < len(cells_b) and (
            words_a[i, 0] == words_b[k, 0] and words_a[i, 1] == words_b[k, 1] and words_a[i, 2] == words_b[k, 2]
        ):
            k += 1
        else:
            missing[cells_a[i]] |= 1
    for cell in cells_b[k:]:
        missing[cell] |= 2
    return missing


@numba.njit(cache=True, nogil=True)
def _cell_digests(cells: I64, words: NDArray[np.uint32], among: Bool) -> U64:
    """(65536,) a 64-bit FNV-1a hash over the words of the points (n, 3) of each cell ``among`` these (65536,), 0 for
    all others and for a cell without points."""
    out = np.zeros(65536, dtype=np.uint64)
    for i in range(len(cells)):
        if among[cells[i]]:
            h = out[cells[i]]
            if h == 0:
                h = np.uint64(0xCBF29CE484222325)
            for k in range(3):
                h = (h ^ np.uint64(words[i, k])) * np.uint64(0x100000001B3)
            out[cells[i]] = h
    return out
