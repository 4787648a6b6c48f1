"""From the evidence of a drive to votes (docs/columns-v1.md, rules C to I): sums over the voxels that matter in a cell.

A cell's votes are numbers of (scan, voxel) pairs: mapped voxels struck speak for unchanged-occupied, mapped voxels
seen through for changed-empty, free voxels struck for changed-occupied, and seen through for unchanged-empty. What is
observed is weighed against what was observable, so neither scan rate nor beams need retuning.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from mapvote.core.columns import TOP_BIT, below_top
from mapvote.core.types import I32, U64, Bool, CellState
from mapvote.core.voting import VOTE_UNIT
from mapvote.detection.evidence import PLANES, count_of, is_open
from mapvote_lab.evaluation.columns_v1.judged import Weighed
from mapvote_lab.evaluation.columns_v1.regions import loose_voxels
from mapvote_lab.evaluation.columns_v1.rules import ALL_RULES, Rules

# Set on the development streets (seeds 1, 11 and 12 of `street570`); the measurements had what
# each rule is worth on others.
EMPTY_VOTES = 0.1
"""Rule F: votes of a ray through a free voxel, against one for a hit in it."""
GONE_VOTES = 0.125
"""Rule E: votes of a ray through a mapped voxel, against one for a hit near it: foliage lets seven of eight through."""
CLEAR_SHARE = 0.3
"""Rule E: of the scans with rays through a cell, the share that must have seen through what it held."""
CLEAR_SCANS = 2
"""Rule E: of how many scans one voxel must have been seen through. What is wrong with a scan, where it was taken or
what mirrored it, is wrong with all its rays; free space is learned from two scans as well."""
BRIEF_SHARE = 0.35
"""Rule G: a new voxel struck in fewer of the scans able to was only passed by."""


UO, UE, CO, CE, UN = (int(state) for state in CellState)
"""Columns of a tally."""


@numba.njit(cache=True, nogil=True)
def _ones(word: np.uint64) -> int:
    """How many bits are set."""
    count = 0
    while word:
        word &= word - np.uint64(1)
        count += 1
    return count


@numba.njit(cache=True, nogil=True)
def _most_through(cell: U64) -> int:
    """The highest count of scans that saw through one of a cell's voxels, found bit by bit in all of them at once."""
    best, highest = ~np.uint64(0), 0
    for k in range(PLANES - 1, -1, -1):
        if best & cell[k]:
            best &= cell[k]
            highest |= 1 << k
    return highest


@numba.njit(cache=True, nogil=True)
def _is_brief(planes: U64, base: I32, r: int, c: int, bit: int, share: float) -> bool:
    """Whether rays went through a voxel from side to side in so many scans, and struck it or any voxel next to it in so
    few, that what they met there did not stay: a car that escaped the moving-object filter."""
    through = count_of(planes[r, c], 0, bit)
    struck = 0
    for i in range(r - 1, r + 2):
        for j in range(c - 1, c + 2):
            for k in range(bit - 1 + base[r, c] - base[i, j], bit + 2 + base[r, c] - base[i, j]):
                if 0 <= k < TOP_BIT:
                    struck = max(struck, count_of(planes[i, j], PLANES, k))
    return struck < share * (struck + through) and is_open(planes[r, c], bit)


class Maps(NamedTuple):
    """What a window's cells are weighed from: the counters, and the map's words. Planes of (rows, cols)."""

    planes: U64
    """(rows + 2, cols + 2, WORDS) counters, with the cells around the window."""
    base: I32
    """(rows + 2, cols + 2) layers of bits 0, likewise."""
    occupied: U64
    near: U64
    """Voxels in which a hit may belong to a mapped voxel next to them (rule C)."""
    free: U64
    """What the map knows to be free (rule D)."""
    low: Bool
    """Cells whose map hardly rises above the ground (rule G: kerbs, grass, trails of bumpers are never called gone)."""


class Weights(NamedTuple):
    """The constants of the same names, with those of the rules that do not hold put out of force."""

    crossed: bool
    """Whether a mapped voxel is seen through only if it is open (rule A)."""
    by_height: bool
    empty_votes: float
    gone_votes: float
    clear_share: float
    clear_scans: int
    brief_share: float


@numba.njit(cache=True, nogil=True)
def _weigh_mapped(cell: U64, mapped: np.uint64, w: Weights) -> tuple[int, int, int, np.uint64]:
    """A cell that the map has points in: (kept: hits on its voxels, lost: rays through them, clear: the most rays
    through one of them, and the word of the voxels that are gone)."""
    kept, lost, clear, gone = 0, 0, 0, np.uint64(0)
    for bit in range(64):
        one = np.uint64(1) << np.uint64(bit)
        if not mapped & one:
            continue
        through, struck = count_of(cell, 0, bit), count_of(cell, PLANES, bit)
        kept += struck
        if through and (not w.crossed or is_open(cell, bit)):
            lost += through
            clear = max(clear, through)
            if w.gone_votes * through > struck:
                gone |= one
    return kept, lost, clear, gone


@numba.njit(cache=True, nogil=True)
def _weigh_empty(maps: Maps, r: int, c: int, struck: np.uint64, w: Weights) -> tuple[int, int, np.uint64, np.uint64]:
    """A cell that the map has no points in, and hits in the voxels of ``struck``: (found: hits where the map knew free
    space, refuted: rays through the same voxels, their word, and the word of hits where the map knew nothing)."""
    cell = maps.planes[r + 1, c + 1]
    found, refuted, new, beyond = 0, 0, np.uint64(0), np.uint64(0)
    for bit in range(64):
        one = np.uint64(1) << np.uint64(bit)
        if not struck & one:
            continue
        through, hits = count_of(cell, 0, bit), count_of(cell, PLANES, bit)
        if hits <= w.empty_votes * through:
            continue
        if _is_brief(maps.planes, maps.base, r + 1, c + 1, bit, w.brief_share):
            continue
        if maps.free[r, c] & one:
            new |= one
            found += hits
            refuted += through
        elif not maps.near[r, c] & one:
            beyond |= one
    return found, refuted, new, beyond


@numba.njit(cache=True, nogil=True)
def _weigh(maps: Maps, w: Weights, tally: I32, gone: U64, new: U64, beside: Bool, adrift: Bool) -> None:
    """Fill the five planes, which come empty, cell by cell. See :class:`Weighed`."""
    for r in range(maps.occupied.shape[0]):
        for c in range(maps.occupied.shape[1]):
            cell, mapped, low = maps.planes[r + 1, c + 1], maps.occupied[r, c], maps.low[r, c]
            through, struck = np.uint64(0), np.uint64(0)
            for k in range(PLANES):
                through |= cell[k]
                struck |= cell[PLANES + k]
            if not through | struck:
                continue
            rays, votes = _most_through(cell), tally[r, c]
            if mapped:
                kept, lost, clear, gone[r, c] = _weigh_mapped(cell, mapped, w)
                if low or clear < max(w.clear_share * rays, w.clear_scans):
                    lost = 0  # hardly ever seen through: foliage, the end of the view, or what one scan erred in
                if lost and not kept:
                    gone[r, c] |= mapped & ~struck  # what no ray reached goes with what it stood on
                if not (kept or lost or low):
                    under = (mapped & (~mapped + np.uint64(1))) - np.uint64(1)  # below the lowest voxel
                    adrift[r, c] = 2 * _ones(under & through) >= _ones(under) > 0
                votes[UO], votes[CE] = kept * VOTE_UNIT, round(lost * w.gone_votes * VOTE_UNIT)
            else:
                found, refuted, word, beyond = _weigh_empty(maps, r, c, struck, w)
                if found:  # a new thing's upper parts, where the map knew nothing, come with it
                    beside[r, c] = not word & ~maps.near[r, c]
                    new[r, c] = word | beyond | ~(below_top(word) | maps.free[r, c])
                else:
                    found, refuted = 0, 0
                against = refuted if w.by_height and found else rays
                votes[UE], votes[CO] = round(w.empty_votes * VOTE_UNIT * against), found * VOTE_UNIT
            votes[UN] = 1 if not (votes[UO] or votes[UE] or votes[CO] or votes[CE]) else 0


def weigh(
    planes: U64, base: I32, occupied: U64, near: U64, free: U64, low: Bool, rules: Rules = ALL_RULES
) -> Weighed:  # fmt: skip
    """Votes of a window (rows, cols) from its counters and the map's words.

    ``planes`` (rows + 2, cols + 2, WORDS) and ``base`` (rows + 2, cols + 2), the layers of their bits 0, have the
    cells around the window too. ``near``: voxels in which a hit may belong to a mapped voxel next to them (rule C);
    ``free``: what the map knows to be free (rule D); ``low``: cells whose map hardly rises above the ground (rule G:
    kerbs, grass, trails of cars' bumpers are never called gone). A cell that the map has points in is never
    changed-occupied (paper III-A).
    """
    shape = occupied.shape
    tally, beside, adrift = np.zeros((*shape, 5), np.int32), np.zeros(shape, np.bool_), np.zeros(shape, np.bool_)
    gone, new = np.zeros(shape, np.uint64), np.zeros(shape, np.uint64)
    maps = Maps(
        planes,
        base,
        occupied,
        near if rules.pose_explains else np.zeros(shape, np.uint64),
        free if rules.new_where_free else np.full(shape, ~np.uint64(0)),
        low if rules.brief_is_passing else np.zeros(shape, np.bool_),
    )
    _weigh(maps, _weights(rules), tally, gone, new, beside, adrift)
    loose = np.where(low, np.uint64(0), loose_voxels(planes[1:-1, 1:-1]))
    return Weighed(tally, gone, new, beside, adrift, loose)


def _weights(rules: Rules) -> Weights:
    e, f, g = rules.rays_count_less, rules.rays_at_height, rules.brief_is_passing
    return Weights(
        crossed=rules.empty_by_ray,
        by_height=f,
        empty_votes=EMPTY_VOTES if f else 1.0,
        gone_votes=GONE_VOTES if e else 1.0,
        clear_share=CLEAR_SHARE if e else 0.0,
        clear_scans=CLEAR_SCANS if e else 0,
        brief_share=BRIEF_SHARE if g else 0.0,
    )
