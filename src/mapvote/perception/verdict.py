"""From the evidence of a drive to votes (METHOD 4, rules C to I): sums over the voxels that matter in each cell.

A cell's votes are numbers of (scan, voxel) pairs: mapped voxels struck speak for unchanged-occupied, mapped voxels
seen through for changed-empty, free voxels struck for changed-occupied, and seen through for unchanged-empty. What is
observed is weighed against what was observable, so neither scan rate nor beams need retuning.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from scipy import ndimage

from mapvote.config import VotingSettings
from mapvote.core.columns import TOP_BIT, dilated, neighbourhood
from mapvote.core.types import I32, U8, U64, Bool, CellState
from mapvote.core.voting import VOTE_UNIT, decide
from mapvote.perception.classify import below_top
from mapvote.perception.evidence import PLANES, STRUCK_ITSELF, THROUGH_ITSELF, count_of, is_open

_LOWEST, _HIGHEST = np.uint64(0b11), np.uint64(3) << np.uint64(TOP_BIT - 1)


@dataclass(frozen=True, slots=True)
class Verdict:
    """What a drive says of a window."""

    tally: I32
    """(rows, cols, 5) votes in VOTE_UNITs."""
    gone: U64
    """(rows, cols) mapped voxels that are there no more, should the cell be changed-empty."""
    new: U64
    """(rows, cols) voxels of new surface, should it be changed-occupied."""
    beside: Bool
    """(rows, cols) cells all of whose new voxels lie next to mapped ones (rule C)."""
    adrift: Bool
    """(rows, cols) mapped cells whose voxels no ray struck and hardly any crossed, while rays passed below (rule H)."""
    loose: U64
    """(rows, cols) mapped voxels into which no hit ever fell, and through which rays went (rule I)."""

    def states(self) -> U8:
        return decide(self.tally)


@numba.njit(cache=True, nogil=True)
def _ones(word: np.uint64) -> int:
    """How many bits are set."""
    count = 0
    while word:
        word &= word - np.uint64(1)
        count += 1
    return count


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


@numba.njit(cache=True, nogil=True)
def _weigh(
    planes: U64, base: I32, occupied: U64, near: U64, free: U64, low: Bool, crossed: bool, by_height: bool,
    empty_votes: float, gone_votes: float, clear_share: float, brief_share: float, min_scans: int, min_support: int,
    tally: I32, gone: U64, new: U64, beside: Bool, adrift: Bool,
) -> None:  # fmt: skip
    for r in range(occupied.shape[0]):
        for c in range(occupied.shape[1]):
            cell, mapped = planes[r + 1, c + 1], occupied[r, c]
            through, struck = np.uint64(0), np.uint64(0)
            for k in range(PLANES):
                through |= cell[k]
                struck |= cell[PLANES + k]
            if not through | struck:
                continue
            strange, beyond = np.uint64(0) if mapped else struck, np.uint64(0)
            kept, lost, found, refuted, rays, clear = 0, 0, 0, 0, 0, 0
            for bit in range(64):
                one = np.uint64(1) << np.uint64(bit)
                if not (through | struck) & one:
                    continue
                t, s = count_of(cell, 0, bit), count_of(cell, PLANES, bit)
                rays = max(rays, t)
                if mapped & one:
                    kept += s
                    if not crossed or is_open(cell, bit):
                        lost += t
                        clear = max(clear, t)
                        if gone_votes * t > s:
                            gone[r, c] |= one
                elif strange & one and s >= min_scans and s > empty_votes * t:
                    if _is_brief(planes, base, r + 1, c + 1, bit, brief_share):
                        continue
                    if free[r, c] & one:
                        new[r, c] |= one
                        found += s
                        refuted += t
                    elif not near[r, c] & one:
                        beyond |= one
            if kept or found < min_support:
                found, refuted, new[r, c] = 0, 0, 0
            else:  # a new thing's upper parts, where the map knew nothing, come with it
                beside[r, c] = not new[r, c] & ~near[r, c]
                new[r, c] |= beyond | ~(below_top(new[r, c]) | free[r, c])
            if low[r, c] or clear < clear_share * rays:
                lost = 0  # hardly ever seen through: foliage, or the end of the view
            if mapped and not (kept or lost or low[r, c]):
                under = (mapped & (~mapped + np.uint64(1))) - np.uint64(1)  # below the lowest voxel
                adrift[r, c] = 2 * _ones(under & through) >= _ones(under) > 0
            if lost and not kept:
                gone[r, c] |= mapped & ~struck  # what no ray reached goes with what it stood on
            votes = tally[r, c]
            votes[0] = kept * VOTE_UNIT
            votes[1] = round(empty_votes * VOTE_UNIT * (refuted if by_height and found else 0 if mapped else rays))
            votes[2] = found * VOTE_UNIT
            votes[3] = round(lost * gone_votes * VOTE_UNIT)
            votes[4] = 1 if not (votes[0] or votes[1] or votes[2] or votes[3]) else 0


def weigh(planes: U64, base: I32, occupied: U64, near: U64, free: U64, low: Bool, settings: VotingSettings) -> Verdict:
    """Votes of a window (rows, cols) from its counters and the map's words.

    ``planes`` (rows + 2, cols + 2, WORDS) and ``base`` (rows + 2, cols + 2), the layers of their bits 0, have the
    cells around the window too. ``near``: voxels in which a hit may belong to a mapped voxel next to them (rule C);
    ``free``: what the map knows to be free (rule D); ``low``: cells whose map hardly rises above the ground (rule G:
    kerbs, grass, trails of cars' bumpers are never called gone). A cell that the map has points in is never
    changed-occupied (paper III-A).
    """
    shape, rules = occupied.shape, settings.rules
    everything = np.full(shape, ~np.uint64(0))
    tally, beside, adrift = np.zeros((*shape, 5), np.int32), np.zeros(shape, np.bool_), np.zeros(shape, np.bool_)
    gone, new = np.zeros(shape, np.uint64), np.zeros(shape, np.uint64)
    _weigh(
        planes, base, occupied, near if "C" in rules else np.zeros(shape, np.uint64),
        free if "D" in rules else everything, low if "G" in rules else np.zeros(shape, np.bool_), "A" in rules,
        "F" in rules, settings.empty_votes if "F" in rules else 1.0, settings.gone_votes if "E" in rules else 1.0,
        settings.clear_share if "E" in rules else 0.0, settings.brief_share if "G" in rules else 0.0,
        settings.min_scans if "G" in rules else 1,
        settings.min_support if "G" in rules else 1, tally, gone, new, beside, adrift,
    )  # fmt: skip
    loose = np.where(low, np.uint64(0), _loose(planes[1:-1, 1:-1]))
    return Verdict(tally, gone, new, beside, adrift, loose)


def _loose(planes: U64) -> U64:
    """(rows, cols) mapped voxels into which no hit ever fell, and through which rays went, as through the voxels above
    and below them: grazing a roof says nothing (rule A). The ground bounds the lowest, the end of the word the highest.
    """
    itself = planes[..., THROUGH_ITSELF]
    through = np.bitwise_or.reduce(planes[..., :PLANES], axis=-1) | itself
    below, above = through << np.uint64(1) | _LOWEST, through >> np.uint64(1) | _HIGHEST
    return np.asarray(itself & ~planes[..., STRUCK_ITSELF] & below & above)


def unexplained(states: U8, beside: Bool, reach: int) -> Bool:
    """(rows, cols) cells of ``beside`` that rule C gives up: an error of pose puts hits next to what is mapped, and
    there alone. A new thing that touches an old one also stands where nothing explains it: the cells next to it that
    are ``reach`` cells or less from such a place belong to it."""
    changed = states == CellState.CHANGED_OCCUPIED
    core = changed & ~beside
    joined = ndimage.binary_dilation(core, np.ones((3, 3)), iterations=reach, mask=changed)
    return np.asarray(changed & ~(core | joined))


def fallen(states: U8, adrift: Bool, reach: int) -> Bool:
    """(rows, cols) cells of rule H: what stood on things that are gone, and no ray could reach, is gone with them.

    The roof of a demolished house, too high for the sensor once nothing is behind it. An ``adrift`` cell goes with the
    changed-empty or the unchanged-occupied cell that is nearer, so that of two roofs that meet only one falls; a
    connected group of those that go falls if a changed-empty cell lies within ``reach`` cells of it.
    """
    gone, kept = states == CellState.CHANGED_EMPTY, states == CellState.UNCHANGED_OCCUPIED
    if not gone.any():
        return np.zeros_like(adrift)
    to_gone = ndimage.distance_transform_cdt(~gone, "chessboard")
    goes = adrift & (to_gone < ndimage.distance_transform_cdt(~kept, "chessboard")) if kept.any() else adrift
    group, count = ndimage.label(goes, structure=np.ones((3, 3)))
    falls = np.bincount(group[to_gone <= reach], minlength=count + 1) > 0
    falls[0] = False
    return np.asarray(falls[group])


def beside_new(planes: U64, occupied: U64, base: I32) -> U64:
    """(rows, cols) voxels in which, or next to which, something was struck where the map holds nothing."""
    struck = np.bitwise_or.reduce(planes[..., PLANES : 2 * PLANES], axis=-1)
    return dilated(struck & ~occupied, base, 1)


@numba.njit(cache=True, nogil=True)
def remnants(gone: U64, loose: U64, base: I32) -> U64:
    """(rows, cols) rule I: voxels of ``loose`` that touch one of ``gone``, or another that does (26 neighbours).

    What is left of a demolished thing beside something that stands: hits on that veto it (rule B), but none ever fell
    into its own voxels, and rays went through them. ``base`` (rows, cols): the layers of the words' bits 0.
    """
    rows, cols = gone.shape
    found, reached = np.zeros_like(gone), gone.copy()
    grown = True
    while grown:
        grown = False
        for r in range(rows):
            for c in range(cols):
                left = loose[r, c] & ~reached[r, c]
                if left:
                    more = left & neighbourhood(reached, base, r, c, 1)
                    if more:
                        found[r, c] |= more
                        reached[r, c] |= more
                        grown = True
    return found


def drop_specks(states: U8, min_cells: int) -> Bool:
    """(rows, cols) changed cells whose 8-connected component of equal state has fewer than ``min_cells`` (rule G)."""
    specks = np.zeros(states.shape, dtype=np.bool_)
    for change in (CellState.CHANGED_OCCUPIED, CellState.CHANGED_EMPTY):
        label, _ = ndimage.label(states == change, structure=np.ones((3, 3)))
        size = np.bincount(label.ravel())
        size[0] = min_cells
        specks |= size[label] < min_cells
    return specks
