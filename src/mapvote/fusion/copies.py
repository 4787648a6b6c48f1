"""Which ballots of a tile are copies of one recorded drive (docs/decisions/voting.md).

Drives of two vehicles that share what two real drives cannot share count as one. Three things are compared. A copy that
is salted (cells set to undetermined or to any state at random), moved by whole cells, thinned or merged with another
drive keeps at least one of them.

Outline. The cells that a drive determines end where its rays thin out, where traffic stood in the way, where it turned
off: two drives down one lane have different borders. Both masks are closed and opened by 3 x 3 cells first, so that
single cells make no difference. Then two masks *differ* in the cells that one determined and the other did not
determine within one cell, or the other way round. The measure is the share of the cells by which the smaller mask
would differ from itself if it were shifted by three cells (.9 m) north or east. A copy differs in no cell, nor does a
copy of which every cell was moved by one.

Points. Two drives hardly ever measure two neighbouring points of a column at the same steps of 9.4 mm.

Free space. Two drives pass other voxels above a cell: of three neighbouring words that are not all equal and that occur
once in a drive, few occur in another drive.

Points and free space are compared by what does not depend on the place, so that moving by whole cells hides nothing.
Honest drives stay well away from all three bounds (docs/measurements/votes.md).

The copy that agrees best with all others counts: moved or added cells agree less. At most one of their vehicles is
honest. So all but one of those that do not count are liars for sure, and the quorum falls by as many.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from mapvote.codec.ballot import PLACES
from mapvote.config import FuseSettings
from mapvote.core.grid import CELL_SIZE, TILE_CELLS
from mapvote.core.kernel import inlined, kernel
from mapvote.core.record import record
from mapvote.core.types import I64, U8, U64, Bool, CellState, read_only
from mapvote.fusion.tile_vote import Vote


@record()
@dataclass(frozen=True, slots=True)
class CopyRule:
    """The numbers by which drives are compared."""

    least_moved: int = 200
    """Cells, in the rows compared. A mask that a shift of three cells changes less is not compared: it is small."""
    shared: float = 1.0 / 3.0
    """Share of the smaller drive's pairs of points, or patterns of free words, that drives of one recording share."""
    least_shared: int = 30
    """Drives with fewer pairs or patterns are not compared by these."""
    compared_cells: int = 7
    """One of so many cells is compared to find the copy that agrees best with the others."""


RULE = CopyRule()
_LAST = TILE_CELLS - 1
_APART = 3
"""Cells by which a mask is shifted; and one of so many rows is compared, which is enough for a share."""
_RIM = 1
"""Columns on either side that are not compared."""
_UN = int(CellState.UNDETERMINED)


@dataclass(frozen=True, slots=True)
class Copy:
    """A drive that does not count on a tile, because another one that is alike does."""

    vehicle: str
    digest: str
    """Hash of its ballot."""
    heard_vehicle: str
    heard_digest: str

    def __str__(self) -> str:
        return (
            f"{self.vehicle}'s ballot {self.digest[:12]} is a copy of {self.heard_vehicle}'s {self.heard_digest[:12]}"
        )


def originals(
    drives: Sequence[Vote], settings: FuseSettings, rule: CopyRule = RULE
) -> tuple[Sequence[Vote], list[Copy]]:
    """(the ``drives`` of a tile without copies, the copies); their order never matters.

    Nothing is judged where one vehicle may change the map, nor drives that send tallies, nor with ``min_difference`` 0.
    """
    judged = [drive for drive in drives if drive.sent is not None]
    if settings.min_votes < 2 or settings.min_difference <= 0.0 or len({drive.vehicle for drive in judged}) < 2:
        return drives, []
    judged.sort(key=lambda drive: (drive.end_ns, drive.digest))
    group = _groups(_alike(judged, settings.min_difference, rule))
    copies = []
    for first in np.flatnonzero(np.bincount(group) > 1):
        alike = [drive for drive, own in zip(judged, group, strict=True) if own == first]
        others = [drive for drive, own in zip(judged, group, strict=True) if own != first]
        heard = max(alike, key=lambda drive: _agreement(drive, others, rule.compared_cells))
        copies += [Copy(d.vehicle, d.digest, heard.vehicle, heard.digest) for d in alike if d is not heard]
    return without(copies, drives), copies


def without(copies: Sequence[Copy], drives: Sequence[Vote]) -> Sequence[Vote]:
    """The ``drives`` that are none of these copies."""
    silent = {(copy.vehicle, copy.digest) for copy in copies}
    return [drive for drive in drives if (drive.vehicle, drive.digest) not in silent]


def liars_among(copies: Sequence[Copy], heard: Sequence[Vote]) -> int:
    """How many vehicles excluded by ``copies`` on a tile lie for sure: all but one of those that are alike. ``heard``:
    the remaining drives."""
    silent = {copy.vehicle for copy in copies} - {drive.vehicle for drive in heard}
    groups = {copy.heard_digest for copy in copies if copy.vehicle in silent}
    return max(0, len(silent) - len(groups))


def _alike(drives: Sequence[Vote], least: float, rule: CopyRule) -> Bool:
    """(n, n) which pairs of drives, of two vehicles each, are one recorded drive; the lower half."""
    number = {name: i for i, name in enumerate(sorted({drive.vehicle for drive in drives}))}
    whose = np.array([number[drive.vehicle] for drive in drives])
    alike = np.zeros((len(drives), len(drives)), dtype=np.bool_)
    masks = smoothed(masks_of([drive.sent for drive in drives if drive.sent is not None]))
    find_alike(*_look(masks), whose, least, rule.least_moved, alike)
    for marks_of in (point_marks, free_marks):
        marks = [marks_of(drive, rule.least_shared) for drive in drives]
        sizes = np.array([len(own) for own in marks])
        # Honest drives share next to none, so that the pairs below have nothing to compare.
        marks = held_twice(marks)
        find_shared(np.concatenate(marks), _bounds(marks), sizes, whose, rule.shared, alike)
    return alike


def _bounds(parts: Sequence[U64]) -> I64:
    """(n + 1,) where each of n arrays begins, once they are joined."""
    return np.concatenate([[0], np.cumsum([len(part) for part in parts])]).astype(np.int64)


def held_twice(marks: Sequence[U64]) -> list[U64]:
    """The marks of each drive that another drive has too. All are ascending; no drive has one twice."""
    in_order = np.sort(np.concatenate(marks))
    common = np.unique(in_order[1:][in_order[1:] == in_order[:-1]])
    shared = []
    for own in marks:
        place = own.searchsorted(common)
        inside = place < len(own)
        shared.append(common[inside][own[place[inside]] == common[inside]])
    return shared


def _groups(alike: Bool) -> I64:
    """(n,) the group of each drive: with all that are alike to it, or to one that is alike to it, and so on."""
    if not alike.any():
        return np.arange(len(alike))
    graph = scipy.sparse.coo_array(alike)
    return np.asarray(scipy.sparse.csgraph.connected_components(graph, directed=False)[1], dtype=np.int64)


_NO_MARKS = read_only(np.empty(0, dtype=np.uint64))


def point_marks(drive: Vote, least: int) -> U64:
    """(n,) ascending: the heights of two new points of a column, the one next above the other, and their places in
    their voxels, in the steps of a ballot; none of fewer than ``least``."""
    if drive.new_points is None or len(drive.new_points) < least:
        return _NO_MARKS
    steps = np.floor(drive.new_points.astype(np.float64) / CELL_SIZE * PLACES).astype(np.int64)
    voxel, place = np.divmod(steps[:, :2], PLACES)
    cells = voxel[:, 1] * TILE_CELLS + voxel[:, 0]
    places = place[:, 1] * PLACES + place[:, 0] + PLACES * PLACES * steps[:, 2]
    # By cell, then by place: one number of both, since a ballot's heights (1e5 m) need 34 bits.
    in_order = np.sort((cells << 40) + places)
    above = np.flatnonzero(np.diff((in_order + (1 << 39)) >> 40) == 0)
    places = in_order & 0xFFFFFFFF
    return _enough(np.unique((places[above] << 32 | places[above + 1]).view(np.uint64)), least)


def free_marks(drive: Vote, least: int) -> U64:
    """(n,) ascending: patterns of three neighbouring free words that occur once in the drive; none of fewer than
    ``least``."""
    if drive.free is None or len(drive.free.cells) < least:
        return _NO_MARKS
    marks = np.empty(len(drive.free.cells), dtype=np.uint64)
    patterns = marks[: _patterns(drive.free.cells, drive.free.words, marks)]
    unique, times = np.unique(patterns, return_counts=True)
    return _enough(unique[times == 1], least)


def _enough(marks: U64, least: int) -> U64:
    return marks if len(marks) >= least else _NO_MARKS


@kernel
def _patterns(cells: NDArray[np.intp], words: U64, marks: U64) -> int:
    """Into ``marks`` (n,), returning how many: a number for the words (n,) of each cell that is not alone, and of those
    to its east and north, unless all three are equal. ``cells``: flat, ascending."""
    n = 0
    north = 0
    for i in range(len(cells) - 1):
        while north < len(cells) - 1 and cells[north] < cells[i] + TILE_CELLS:
            north += 1
        beside = cells[i + 1] == cells[i] + 1 and cells[i] % TILE_CELLS != _LAST
        if not beside or cells[north] != cells[i] + TILE_CELLS:
            continue
        if words[i] == words[i + 1] and words[i] == words[north]:
            continue
        mark = words[i] * np.uint64(0x9E3779B97F4A7C15) ^ words[i + 1] * np.uint64(0xC2B2AE3D27D4EB4F)
        mark = (mark ^ (mark >> np.uint64(29))) * np.uint64(0x165667B19E3779F9) + words[north]
        marks[n] = (mark ^ (mark >> np.uint64(32))) * np.uint64(0x9E3779B97F4A7C15)
        n += 1
    return n


@kernel
def find_shared(marks: U64, first: I64, sizes: I64, whose: I64, share: float, alike: Bool) -> None:
    """Set ``alike`` (n, n), lower half, where drives of two vehicles share at least ``share`` of the marks of the
    smaller one. ``marks``: ascending, from ``first[i]`` to ``first[i + 1]`` those of drive i that others have too, of
    ``sizes[i]`` in all. ``whose`` (n,): the vehicles."""
    for i in range(len(whose)):
        for k in range(i):
            smaller = min(sizes[i], sizes[k])
            if whose[i] == whose[k] or alike[i, k] or smaller == 0:
                continue
            a = first[i]
            b = first[k]
            both = 0
            while a < first[i + 1] and b < first[k + 1]:
                if marks[a] == marks[b]:
                    both += 1
                    a += 1
                    b += 1
                elif marks[a] < marks[b]:
                    a += 1
                else:
                    b += 1
            alike[i, k] = both >= share * smaller


def masks_of(planes: Iterable[U8]) -> U64:
    """(n, 256, 4) words of what n planes of states determined, the first column in the lowest bit."""
    # Only the states 4 (undetermined) and 255 (no vote) have the third bit set.
    bits = [np.packbits((plane & np.uint8(4)) == 0, bitorder="little") for plane in planes]
    return np.concatenate(bits).view(np.uint64).reshape(len(bits), TILE_CELLS, TILE_CELLS // 64)


def smoothed(masks: U64) -> U64:
    """Masks (n, 256, 4), closed and then opened by 3 x 3 cells: holes and islands less than three cells wide are
    gone."""
    out = np.empty_like(masks)
    _smooth(masks, np.empty_like(masks[0]), out)
    return out


@kernel
def _smooth(masks: U64, scratch: U64, out: U64) -> None:
    """:func:`smoothed` into ``out`` (n, 256, 4); ``scratch`` (256, 4). To erode is to dilate the complement, in which
    nothing lies beyond the tile."""
    for i in range(len(masks)):
        _dilate(masks[i], scratch)
        _invert(scratch)
        _dilate(scratch, out[i])
        # So far the complement of the closed mask: dilated again it is that of the closed mask eroded.
        _dilate(out[i], scratch)
        _invert(scratch)
        _dilate(scratch, out[i])


@inlined
def _invert(mask: U64) -> None:
    for r in range(mask.shape[0]):
        for w in range(mask.shape[1]):
            mask[r, w] = ~mask[r, w]


@inlined
def _dilate(mask: U64, out: U64) -> None:
    """Into ``out`` (256, 4) the cells that are or have a neighbour in the mask."""
    for r in range(TILE_CELLS):
        for w in range(4):
            any_bits = np.uint64(0)
            for k in range(max(r - 1, 0), min(r + 2, TILE_CELLS)):
                right = mask[k, w + 1] << np.uint64(63) if w < 3 else np.uint64(0)
                any_bits |= mask[k, w] | _moved_east(mask[k], w, 1) | (mask[k, w] >> np.uint64(1)) | right
            out[r, w] = any_bits


def _agreement(drive: Vote, others: Sequence[Vote], every: int) -> int:
    """How many more of the others' votes a drive agrees with than it opposes, in one of ``every`` so many cells."""
    assert drive.sent is not None
    own = drive.sent.reshape(-1)[::every]
    total = 0
    for other in others:
        assert other.sent is not None
        said = other.sent.reshape(-1)[::every]
        both = (own < _UN) & (said < _UN)
        total += 2 * int((both & (own == said)).sum()) - int(both.sum())
    return total


@kernel
def find_alike(moved: I64, looked: U64, whose: I64, least: float, least_moved: int, alike: Bool) -> None:
    """Set ``alike`` (n, n), lower half, where masks of two vehicles differ by less than the share ``least`` of what a
    shift makes. ``moved``, ``looked``: see :func:`_look`; ``whose`` (n,): the vehicles."""
    for i in range(len(moved)):
        for k in range(i):
            whole = min(moved[i], moved[k])
            if whose[i] == whose[k] or whole < least_moved:
                continue
            most = int(np.ceil(least * whole)) - 1
            alike[i, k] = _differing(looked[i], looked[k], np.int64(_RIM), most) <= most


def _look(masks: U64) -> tuple[I64, U64]:
    """Measures of masks (n, 256, 4), in the rows compared: (n,) the cells by which each would differ from itself if
    shifted, and (n, 85, 3, 4) words: what is set, what is or has a neighbour that is, and what is and has none that is
    not."""
    looked = np.empty((len(masks), len(range(1, _LAST, _APART)), 3, 4), np.uint64)
    moved = np.empty(len(masks), np.int64)
    east = np.empty_like(looked[0])
    _look_at(masks, looked, moved, east)
    return moved, looked


@kernel
def _look_at(masks: U64, looked: U64, moved: I64, east: U64) -> None:
    """:func:`_look` into ``looked`` and ``moved``; ``east`` (85, 3, 4): scratch."""
    for i in range(len(masks)):
        for n in range(looked.shape[1]):
            row = 1 + _APART * n
            for w in range(4):
                any_bits = np.uint64(0)
                every = ~np.uint64(0)
                for r in range(row - 1, row + 2):
                    here = masks[i, r, w]
                    west = _moved_east(masks[i, r], w, 1)
                    right = (here >> np.uint64(1)) | (masks[i, r, w + 1] << np.uint64(63) if w < 3 else np.uint64(0))
                    any_bits |= here | west | right
                    every &= here & west & right
                looked[i, n, 0, w] = masks[i, row, w]
                looked[i, n, 1, w] = any_bits
                looked[i, n, 2, w] = every
            for plane in range(3):
                for w in range(4):
                    east[n, plane, w] = _moved_east(looked[i, n, plane], w, _APART)
        north = _differing(looked[i, 1:], looked[i, :-1], np.int64(_RIM), TILE_CELLS**2)
        moved[i] = (north + _differing(looked[i], east, _RIM + _APART, TILE_CELLS**2)) // 2


@inlined
def _moved_east(row: U64, w: int, by: int) -> np.uint64:
    """Word ``w`` of a row of words (4,) that is moved by so many columns to the east."""
    carried = row[w - 1] >> np.uint64(64 - by) if w else np.uint64(0)
    return (row[w] << np.uint64(by)) | carried


@kernel
def _differing(a: U64, b: U64, rim: int, most: int) -> np.int64:
    """In how many cells two masks (rows, 3, 4) differ, but for ``rim`` columns on either side; once they are more than
    ``most``, some number above that."""
    count = np.int64(0)
    for n in range(len(a)):
        for w in range(4):
            word = (a[n, 0, w] & ~b[n, 1, w]) | (~a[n, 0, w] & b[n, 2, w])
            word |= (b[n, 0, w] & ~a[n, 1, w]) | (~b[n, 0, w] & a[n, 2, w])
            if w == 0:
                word &= ~np.uint64(0) << np.uint64(rim)
            if w == 3:
                word &= ~np.uint64(0) >> np.uint64(rim)
            # How many bits are set (Warren, Hacker's Delight, 5-1).
            word -= (word >> np.uint64(1)) & np.uint64(0x5555555555555555)
            twos = np.uint64(0x3333333333333333)
            word = (word & twos) + ((word >> np.uint64(2)) & twos)
            word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
            count += np.int64((word * np.uint64(0x0101010101010101)) >> np.uint64(56))
        if count > most:
            break
    return count
