"""A vote is spent once a version has changed its cell: which cells two versions of a tile differ in, and which votes
still count.

That the cell looks as it did is no test: what came and went leaves it bit for bit as at first, and the votes that
brought it would bring it again.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from mapvote.core.grid import CELLS, TILE_CELLS
from mapvote.core.kernel import kernel
from mapvote.core.memory import Memory
from mapvote.core.tile import Tile
from mapvote.core.types import I64, U8, Bool, read_only
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
    missing = np.zeros(CELLS, dtype=np.uint8)
    (cells_a, words_a), (cells_b, words_b) = sides
    _out_of_step(cells_a, read_only(words_a), cells_b, read_only(words_b), missing)
    differ, unsure = missing > 0, missing == 3
    if unsure.any():
        differ[unsure] = _other_sequences(*(_of_cells(*side, unsure) for side in sides))[unsure]
    return np.asarray(differ)


@kernel
def _out_of_step(
    cells_a: I64, words_a: NDArray[np.uint32], cells_b: I64, words_b: NDArray[np.uint32], missing: U8
) -> None:
    """Into ``missing`` (65536,), zeros, of which side a cell has points (n, 3) that do not follow in the other: 1 and
    2, or 3 of both.

    Each point of b is matched with at most one of a, in order. So cells of 0 hold the same points; those of 1 and 2
    hold more on one side; and of an edit few are 3.
    """
    k = 0
    for i in range(len(cells_a)):
        if k < len(cells_b) and (
            words_a[i, 0] == words_b[k, 0] and words_a[i, 1] == words_b[k, 1] and words_a[i, 2] == words_b[k, 2]
        ):
            k += 1
        else:
            missing[cells_a[i]] |= 1
    for i in range(k, len(cells_b)):
        missing[cells_b[i]] |= 2


def _of_cells(cells: I64, words: NDArray[np.uint32], among: Bool) -> tuple[I64, NDArray[np.uint32]]:
    """Cells (m,), ascending, and words (m, 3) of the points in the cells ``among`` (65536,), each cell's in order."""
    mine = np.flatnonzero(among[cells])
    mine = mine[np.argsort(cells[mine], kind="stable")]
    return cells[mine], words[mine]


def _other_sequences(a: tuple[I64, NDArray[np.uint32]], b: tuple[I64, NDArray[np.uint32]]) -> Bool:
    """(65536,) which cells hold other points, or as many in another order; see :func:`_of_cells`."""
    other = np.bincount(a[0], minlength=CELLS) != np.bincount(b[0], minlength=CELLS)
    same_a, same_b = ~other[a[0]], ~other[b[0]]
    other[a[0][same_a][(a[1][same_a] != b[1][same_b]).any(axis=1)]] = True
    return np.asarray(other)
