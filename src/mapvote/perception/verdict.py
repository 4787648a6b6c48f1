"""From the evidence of a drive to votes (METHOD 4, rules C to G, and H): sums over the voxels that matter in each cell.

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
from mapvote.core.types import I32, U8, U64, Bool, CellState
from mapvote.core.voting import VOTE_UNIT, decide
from mapvote.perception.evidence import PLANES, count_of


@dataclass(frozen=True, slots=True)
class Verdict:
    """What a drive says of a window."""

    tally: I32
    """(rows, cols, 5) votes in VOTE_UNITs."""
    gone: U64
    """(rows, cols) mapped voxels that are there no more, should the cell be changed-empty."""
    new: U64
    """(rows, cols) voxels of new surface, should it be changed-occupied."""
    adrift: Bool
    """(rows, cols) mapped cells whose voxels no ray struck and hardly any reached, while rays passed below (rule H)."""

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
def _weigh(
    planes: U64, occupied: U64, near: U64, free: U64, low: Bool, by_height: bool, empty_votes: float, gone_votes: float,
    clear_share: float, min_scans: int, min_support: int, tally: I32, gone: U64, new: U64, adrift: Bool,
) -> None:  # fmt: skip
    for r in range(occupied.shape[0]):
        for c in range(occupied.shape[1]):
            cell, mapped = planes[r, c], occupied[r, c]
            through, struck = np.uint64(0), np.uint64(0)
            for k in range(PLANES):
                through |= cell[k]
                struck |= cell[PLANES + k]
            if not through | struck:
                continue
            strange, beyond = struck & ~mapped & ~near[r, c], np.uint64(0)
            candidates = strange & free[r, c]
            kept, lost, found, refuted, rays, clear = 0, 0, 0, 0, 0, 0
            for bit in range(64):
                one = np.uint64(1) << np.uint64(bit)
                if not (through | struck) & one:
                    continue
                t, s = count_of(cell, 0, bit), count_of(cell, PLANES, bit)
                rays = max(rays, t)
                if mapped & one:
                    kept += s
                    lost += t
                    clear = max(clear, t)
                    if gone_votes * t > s:
                        gone[r, c] |= one
                elif strange & one and s >= min_scans and s > empty_votes * t:
                    if candidates & one:
                        new[r, c] |= one
                        found += s
                        refuted += t
                    else:
                        beyond |= one
            if kept or found < min_support:
                found, refuted, new[r, c] = 0, 0, 0
            else:  # a new thing's upper parts, where the map knew nothing, come with it
                new[r, c] |= beyond
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


def weigh(planes: U64, occupied: U64, near: U64, free: U64, low: Bool, settings: VotingSettings) -> Verdict:
    """Votes of a window from its counters ``planes`` (rows, cols, 2 * PLANES) and the map's words (rows, cols).

    ``near``: what the map's voxels explain (rule C); ``free``: what the map knows to be free (rule D); ``low``: cells
    whose map hardly rises above the ground (rule G: kerbs, grass, trails of cars' bumpers are never called gone).
    """
    shape, rules = occupied.shape, settings.rules
    everything = np.full(shape, ~np.uint64(0))
    tally, adrift = np.zeros((*shape, 5), np.int32), np.zeros(shape, np.bool_)
    gone, new = np.zeros(shape, np.uint64), np.zeros(shape, np.uint64)
    _weigh(
        planes, occupied, near if "C" in rules else np.where(occupied, everything, np.uint64(0)),
        free if "D" in rules else everything, low if "G" in rules else np.zeros(shape, np.bool_),
        "F" in rules, settings.empty_votes if "F" in rules else 1.0, settings.gone_votes if "E" in rules else 1.0,
        settings.clear_share if "E" in rules else 0.0, settings.min_scans if "G" in rules else 1,
        settings.min_support if "G" in rules else 1, tally, gone, new, adrift,
    )  # fmt: skip
    return Verdict(tally, gone, new, adrift)


def fallen(states: U8, adrift: Bool, reach: int) -> Bool:
    """(rows, cols) cells of rule H: what stood on things that are gone, and no ray could reach, is gone with them.

    A group of ``adrift`` cells falls if a changed-empty cell lies within ``reach`` cells of it and none that the scans
    found occupied touches it: the roof of a demolished house, too high for the sensor once nothing is behind it.
    """
    group, count = ndimage.label(adrift, structure=np.ones((3, 3)))
    lost = ndimage.distance_transform_cdt(states != CellState.CHANGED_EMPTY, "chessboard") <= reach
    if not (states == CellState.CHANGED_EMPTY).any():
        lost = np.zeros_like(adrift)
    kept = ndimage.binary_dilation(states == CellState.UNCHANGED_OCCUPIED, np.ones((3, 3)))
    falls = np.bincount(group[lost], minlength=count + 1) > 0
    falls &= np.bincount(group[kept], minlength=count + 1) == 0
    falls[0] = False
    return np.asarray(falls[group])


def drop_specks(states: U8, min_cells: int) -> Bool:
    """(rows, cols) changed cells whose 8-connected component of equal state has fewer than ``min_cells`` (rule G)."""
    specks = np.zeros(states.shape, dtype=np.bool_)
    for change in (CellState.CHANGED_OCCUPIED, CellState.CHANGED_EMPTY):
        label, _ = ndimage.label(states == change, structure=np.ones((3, 3)))
        size = np.bincount(label.ravel())
        size[0] = min_cells
        specks |= size[label] < min_cells
    return specks
