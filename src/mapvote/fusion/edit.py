"""How a tile's points come and go: which voxels lose their points, and which of the points offered are added.

An emptied cell loses all points that its voters deleted; a standing cell loses the remains of removed objects. In a
cell that stands one vehicle may have seen past what another hit: a twig, a ledge, the edge of a wall. So half of the
vehicles can delete only voxels that stand apart. A voxel next to a remaining one is deleted only if more than 2/3 of
the vehicles delete it, counting those to whom the whole cell is empty.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapvote.codec.planes import Words, bits_of, counted, nothing_reached, words_of
from mapvote.core.columns import EVERY_BIT, column_bits, rebased
from mapvote.core.grid import CELL_SIZE, CELLS, TILE_CELLS
from mapvote.core.kernel import inlined, kernel
from mapvote.core.points import Fields, as_numbers, merged_values
from mapvote.core.tile import Tile
from mapvote.core.types import F32, I32, I64, U8, U64, Bool, CellState
from mapvote.fusion.tile_vote import Vote


@dataclass(frozen=True, slots=True)
class EditVotes:
    """The votes behind points that come or go in cells of which the decision states no such change: voxels that are
    trimmed from a cell that stands, and points that noise carried into the next cell."""

    cells: I64
    """(n,) flat cells, ascending."""
    states: U8
    """(n,) CHANGED_EMPTY where points go, CHANGED_OCCUPIED where they come."""
    votes: I32
    """(n,) vehicles that voted for it: the fewest for any voxel that went."""
    against: I32
    """(n,) vehicles that determined the cell and did not."""

    @classmethod
    def none(cls) -> EditVotes:
        """Every edit follows the states."""
        cells = np.empty(0, dtype=np.int64)
        votes = np.empty(0, dtype=np.int32)
        return cls(cells, np.empty(0, dtype=np.uint8), votes, votes)

    def and_of(self, other: EditVotes) -> EditVotes:
        """These and the ``other`` ones, of other cells."""
        cells = np.concatenate([self.cells, other.cells])
        order = np.argsort(cells)
        rest = [np.concatenate([getattr(self, n), getattr(other, n)])[order] for n in ("states", "votes", "against")]
        return EditVotes(cells[order], *rest)


def delete_points(tile: Tile, gone: U64) -> tuple[Tile, int]:
    """The tile without the obstacle points whose voxel is marked in ``gone`` (256, 256), and how many were deleted.

    Ground points are never deleted. In a tile without known ground, words have no agreed beginning, so any mark
    deletes the whole column.
    """
    gone = _deleted(gone, tile)
    ground = tile.ground_z.reshape(-1)
    base = tile.base.reshape(-1)
    flat = gone.reshape(-1)
    dropped = np.zeros(len(tile.points), dtype=np.bool_)
    in_cells = np.flatnonzero((flat != 0)[tile.cells])
    cells = tile.cells[in_cells]
    bit, obstacle = column_bits(tile.points[in_cells, 2].astype(np.float64), ground[cells], base[cells])
    dropped[in_cells] = obstacle & ((flat[cells] >> bit.astype(np.uint64)) & np.uint64(1) != 0)
    deleted = int(np.count_nonzero(dropped))
    return (tile.without(dropped), deleted) if deleted else (tile, 0)


def add_points(tile: Tile, points: F32, fields: Fields, cells: I64, voters: I32, min_votes: int) -> tuple[Tile, int]:
    """The tile with one representative per voxel that at least ``min_votes`` voters support, and how many came.

    ``points`` (m, 3) from the tile's corner, their ``fields`` (m,) as in ballots, ``cells`` (m,) flat, ``voters`` (m,)
    small integers. A voter supports a voxel with a point in it or in the voxel above or below. Voxels that already hold
    a point of the map stay as they are. New points follow the old ones, ordered by cell and height.
    """
    if not len(points):
        return tile, 0
    voxels = _voxels(cells, points)
    order = np.argsort(voxels)
    changed = np.zeros(CELLS, dtype=np.bool_)
    changed[cells] = True
    mapped = np.flatnonzero(changed[tile.cells])
    taken = np.isin(voxels, _voxels(tile.cells[mapped], tile.points[mapped]))
    chosen = np.empty(len(voxels), np.int64)
    seen = np.full(int(voters.max()) + 1, -1, dtype=np.int64)
    numbers = as_numbers(fields, len(points))
    n = _represent(points, numbers, voxels, voters, taken, order, min_votes, seen, chosen)
    chosen = chosen[:n]
    if not len(chosen):
        return tile, 0
    merged = {name: merged_values(name, values, voxels, chosen) for name, values in fields.items()}
    return tile.with_new(points[chosen], merged), len(chosen)


def _voxels(cells: I64, points: F32) -> I64:
    """(n,) a number for the voxel of each point, ascending by cell, then layer; neighbours above each other differ by
    one."""
    layers = np.floor(points[:, 2].astype(np.float64) / CELL_SIZE).astype(np.int64)
    return cells * (1 << 24) + layers + (1 << 23)


@kernel
def _represent(
    points: F32, numbers: U64, voxels: I64, voters: I32, taken: Bool, order: I64, min_votes: int, seen: I64, out: I64
) -> int:
    """Into ``out`` (n,), returning how many, indices of one point per supported voxel, ascending by voxel: the one
    nearest to the mean of all offered there, of several the first by x, y, z, then by its attributes' ``numbers``
    (n, k).

    ``seen`` holds -1 for each voter. ``order`` sorts ``voxels``; within a voxel any order gives the same: the mean is a
    sum of whole micrometres.
    """
    n = len(voxels)
    n_out = 0
    low = 0
    start = 0
    while start < n:
        voxel = voxels[order[start]]
        stop = start + 1
        while stop < n and voxels[order[stop]] == voxel:
            stop += 1
        while voxels[order[low]] < voxel - 1:
            low += 1
        support = 0
        i = low
        while i < n and voxels[order[i]] <= voxel + 1:
            if seen[voters[order[i]]] != start:
                seen[voters[order[i]]] = start
                support += 1
            i += 1
        if support >= min_votes and not taken[order[start]]:
            out[n_out] = _nearest_to_mean(points, numbers, order, start, stop)
            n_out += 1
        start = stop
    return n_out


@inlined
def _nearest_to_mean(points: F32, numbers: U64, order: I64, start: int, stop: int) -> int:
    """The representative of the points ``order[start:stop]``, see :func:`_represent`."""
    x = np.int64(0)
    y = np.int64(0)
    z = np.int64(0)  # micrometres
    for k in range(start, stop):
        x += np.int64(np.rint(np.float64(points[order[k], 0]) * 1e6))
        y += np.int64(np.rint(np.float64(points[order[k], 1]) * 1e6))
        z += np.int64(np.rint(np.float64(points[order[k], 2]) * 1e6))
    of = 1e6 * (stop - start)
    best = order[start]
    nearest = np.inf
    for k in range(start, stop):
        i = order[k]
        dx = points[i, 0] - x / of
        dy = points[i, 1] - y / of
        dz = points[i, 2] - z / of
        distance = dx * dx + dy * dy + dz * dz
        if distance < nearest or (distance == nearest and _before(points, numbers, i, best)):
            best = i
            nearest = distance
    return best


@inlined
def _before(points: F32, numbers: U64, one: int, other: int) -> bool:
    for k in range(3):
        if points[one, k] != points[other, k]:
            return points[one, k] < points[other, k]
    for k in range(numbers.shape[1]):
        if numbers[one, k] != numbers[other, k]:
            return numbers[one, k] < numbers[other, k]
    return False


def words_gone(votes: Sequence[Vote], states: U8, quorum: int, tile: Tile) -> tuple[U64 | None, EditVotes]:
    """((256, 256) delete mask of ``tile``, None if there is nothing to delete; the votes for what is trimmed from cells
    that stand); ``states`` (256, 256) as decided.

    In cells decided changed-empty, the voxels that ``quorum`` voters for it mark. In cells decided unchanged-occupied
    see :func:`_remnants`.
    """
    # The voxels that leave the cells decided changed-empty.
    gone = None
    emptied = Words.whole(states == int(CellState.CHANGED_EMPTY))
    if len(emptied.cells):
        reached = nothing_reached(quorum, len(emptied.cells))
        for vote in votes:
            vote.mark_deleted(emptied, reached)
        gone = np.zeros(states.shape, dtype=np.uint64)
        gone.reshape(-1)[emptied.cells] = reached[-1]
    # The voxels that leave cells that stand.
    standing = Words.whole(states == int(CellState.UNCHANGED_OCCUPIED))
    left = [vote.remnants(states) for vote in votes]
    # A mask in one stage only names what would be deleted.
    emptied_by = [vote.deletes(standing) if vote.tally is None else Words.none() for vote in votes]
    if sum(len(a.cells) + len(b.cells) > 0 for a, b in zip(left, emptied_by, strict=True)) < quorum:
        return gone, EditVotes.none()
    gone = np.zeros(states.shape, dtype=np.uint64) if gone is None else gone
    stays = tile.obstacle_words & ~_deleted(gone, tile)
    remnants, marks, determined = _remnants(left, emptied_by, votes, stays, quorum, tile.base)
    gone.reshape(-1)[remnants.cells] |= remnants.words
    return gone, _trimmed(remnants, marks, determined, tile)


def _trimmed(remnants: Words, marks: I32, determined: I64, tile: Tile) -> EditVotes:
    """The votes for the ``remnants`` that hold points: ``marks`` (n, 64) vehicles by voxel, ``determined`` (n,)."""
    held = remnants.words & tile.obstacle_words.reshape(-1)[remnants.cells]
    # A column without known ground goes by any mark.
    voxels = bits_of(held if tile.has_ground else np.where(held == 0, held, remnants.words))
    trimmed = np.flatnonzero(voxels.any(axis=1))
    votes = np.where(voxels, marks, np.iinfo(np.int32).max).min(axis=1)[trimmed].astype(np.int32)
    against = (determined[trimmed] - votes).astype(np.int32)
    return EditVotes(remnants.cells[trimmed], np.full(len(trimmed), CellState.CHANGED_EMPTY, np.uint8), votes, against)


def _deleted(gone: U64, tile: Tile) -> U64:
    """(256, 256) the voxels that a delete mask takes: in a tile without known ground any mark takes the column."""
    return gone if tile.has_ground else np.where(gone == 0, gone, EVERY_BIT)


def _remnants(
    left: Sequence[Words],
    emptied_by: Sequence[Words],
    votes: Sequence[Vote],
    stays: U64,
    quorum: int,
    base: I32,
) -> tuple[Words, I32, I64]:
    """(the voxels that leave cells that stand; (n, 64) vehicles that call each voxel left, or gone with the cell; (n,)
    vehicles that determined each cell).

    A voxel that ``quorum`` vehicles, and more than half of those that determined the cell, call ``left`` of something
    goes if it touches (26) nothing that ``stays``. A voxel that more than two thirds, two at least, call left or gone
    with the whole cell goes in any case. ``stays`` (256, 256): the map without what leaves other cells; a voxel that
    half of the vehicles call left does not stay. Everything beyond the tile's edge stays.
    """
    cells = np.unique(np.concatenate([words.cells for words in (*left, *emptied_by)]))
    halves = counted(cells, left)
    marks = halves + counted(cells, emptied_by)
    determined = np.asarray(np.sum([vote.determined(cells) for vote in votes], axis=0, dtype=np.int64))
    most = words_of((halves >= quorum) & (2 * halves > determined[:, None]))
    nearly_all = words_of((marks >= max(quorum, 2)) & (3 * marks > 2 * determined[:, None]))
    stays = stays.copy()
    stays.reshape(-1)[cells] &= ~(most | nearly_all)
    return Words(cells, nearly_all | (most & ~_touched(cells, stays, base))), marks, determined


def _touched(cells: NDArray[np.intp], stays: U64, base: I32) -> U64:
    """(n,) the voxels of flat ``cells`` that touch one of ``stays``, or the tile's edge."""
    rows, cols = np.divmod(cells, TILE_CELLS)
    edge = (rows == 0) | (cols == 0) | (rows == TILE_CELLS - 1) | (cols == TILE_CELLS - 1)
    steps = [[TILE_CELLS * i + j] for i in (-1, 0, 1) for j in (-1, 0, 1)]
    beside = (cells + steps).clip(0, CELLS - 1)  # beyond the tile only for cells at its edge
    layers = base.reshape(-1)[beside] - base.reshape(-1)[cells]
    near = np.bitwise_or.reduce(rebased(stays.reshape(-1)[beside], layers), axis=0)
    one = np.uint64(1)
    return np.where(edge, EVERY_BIT, near | (near << one) | (near >> one))
