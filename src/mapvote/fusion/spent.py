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
from mapvote.core.types import I64, U64, Bool
from mapvote.fusion.tile_vote import TileVote, restrict


def unspent(vote: TileVote, tile: Tile, misread: Mapping[int, Bool] | None = None) -> TileVote:
    """The vote in the cells where it counts on ``tile``: those that have not changed since the version that its vehicle
    drove with. ``misread``: by version, (256, 256) cells in which that version showed what no longer is history."""
    counts = None if tile.memory is None else tile.memory.changed <= vote.version
    wrong = None if misread is None else misread.get(vote.version)
    if wrong is not None:
        counts = ~wrong if counts is None else counts & ~wrong
    return restrict(vote, counts)


def differing(a: Tile, b: Tile) -> Bool:
    """(256, 256) cells in which two versions of a tile hold other points, or know other voxels to be free. Learning
    that nothing is free is no difference."""
    points = _digests(a) != _digests(b) if a.points is not b.points else np.zeros(CELLS, dtype=np.bool_)
    differ = points.reshape(TILE_CELLS, TILE_CELLS)
    if a.free is b.free:
        return differ
    nothing = np.uint64(0)
    return np.asarray(differ | ((nothing if a.free is None else a.free) != (nothing if b.free is None else b.free)))


def changed_in(version: int, before: Tile, after: Tile) -> Memory:
    """What ``after`` remembers if ``version`` made it of ``before``."""
    changed = differing(before, after)
    return (
        Memory.first_change(changed, version) if before.memory is None else before.memory.with_changed(changed, version)
    )


def _digests(tile: Tile) -> U64:
    if not len(tile.points):
        return np.zeros(CELLS, dtype=np.uint64)
    return _cell_digests(tile.cells, np.ascontiguousarray(tile.points).view(np.uint32))


@numba.njit(cache=True, nogil=True)
def _cell_digests(cells: I64, words: NDArray[np.uint32]) -> U64:
    """(65536,) a 64-bit FNV-1a hash over the words of each cell's points (n, 3), 0 for a cell without points."""
    out = np.zeros(65536, dtype=np.uint64)
    for i in range(len(cells)):
        h = out[cells[i]]
        if h == 0:
            h = np.uint64(0xCBF29CE484222325)
        for k in range(3):
            h = (h ^ np.uint64(words[i, k])) * np.uint64(0x100000001B3)
        out[cells[i]] = h
    return out
