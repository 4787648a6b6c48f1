"""From the evidence of a drive to votes (docs/method.md, rules C to I): sums over the voxels that matter in each cell.

A cell's votes are numbers of (scan, voxel) pairs: mapped voxels struck speak for unchanged-occupied, mapped voxels
seen through for changed-empty, free voxels struck for changed-occupied, and seen through for unchanged-empty. What is
observed is weighed against what was observable, so neither scan rate nor beams need retuning.
"""

from __future__ import annotations

import numba
import numpy as np

from mapvote.config import VotingSettings
from mapvote.core.columns import TOP_BIT, below_top, dilated
from mapvote.core.grid import TileIndex
from mapvote.core.point_map import PointMap
from mapvote.core.reference import above_ground_points, cut_reference, reference_window
from mapvote.core.types import I32, U64, Bool
from mapvote.core.voting import VOTE_UNIT
from mapvote.detection.counters import PLANES, Evidence, count_of, free_words, is_open
from mapvote.detection.regions import apply_region_rules, around, beside_new, loose_voxels
from mapvote.detection.rules import ALL_RULES, Rules
from mapvote.detection.votes import Judged, TileVotes, Weighed
from mapvote.perception.frontend import Observation


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


def weigh(
    planes: U64, base: I32, occupied: U64, near: U64, free: U64, low: Bool, settings: VotingSettings,
    rules: Rules = ALL_RULES,
) -> Weighed:  # fmt: skip
    """Votes of a window (rows, cols) from its counters and the map's words.

    ``planes`` (rows + 2, cols + 2, WORDS) and ``base`` (rows + 2, cols + 2), the layers of their bits 0, have the
    cells around the window too. ``near``: voxels in which a hit may belong to a mapped voxel next to them (rule C);
    ``free``: what the map knows to be free (rule D); ``low``: cells whose map hardly rises above the ground (rule G:
    kerbs, grass, trails of cars' bumpers are never called gone). A cell that the map has points in is never
    changed-occupied (paper III-A).
    """
    shape = occupied.shape
    everything = np.full(shape, ~np.uint64(0))
    tally, beside, adrift = np.zeros((*shape, 5), np.int32), np.zeros(shape, np.bool_), np.zeros(shape, np.bool_)
    gone, new = np.zeros(shape, np.uint64), np.zeros(shape, np.uint64)
    brief = rules.brief_is_passing
    _weigh(
        planes, base, occupied, near if rules.pose_explains else np.zeros(shape, np.uint64),
        free if rules.new_where_free else everything, low if brief else np.zeros(shape, np.bool_), rules.empty_by_ray,
        rules.rays_at_height, settings.empty_votes if rules.rays_at_height else 1.0,
        settings.gone_votes if rules.rays_count_less else 1.0, settings.clear_share if rules.rays_count_less else 0.0,
        settings.brief_share if brief else 0.0, settings.min_scans if brief else 1,
        settings.min_support if brief else 1, tally, gone, new, beside, adrift,
    )  # fmt: skip
    loose = np.where(low, np.uint64(0), loose_voxels(planes[1:-1, 1:-1]))
    return Weighed(tally, gone, new, beside, adrift, loose)


class ColumnVoter:
    """Columns: evidence per voxel over the drive, weighed at its end."""

    def __init__(
        self,
        voting: VotingSettings,
        point_map: PointMap,
        rules: Rules = ALL_RULES,
        evidence: Evidence | None = None,
    ) -> None:
        """``evidence``: counters that another voter fills (who may be the only one to observe), else its own."""
        self.voting, self.point_map, self.rules = voting, point_map, rules
        self.evidence = evidence or Evidence(point_map.lattice, rules.empty_by_ray, rules.hits_veto)

    def observe(self, seen: Observation) -> U64:
        """Count one scan; returns (rows, cols) words of voxels whose points may be new."""
        reach = 2 if seen.scan.sigma_m > self.voting.wide_sigma_m else 1
        self.evidence.count(seen.view, seen.reference, reach)
        return seen.view.hit & ~seen.reference.occupied

    def votes(self) -> dict[TileIndex, TileVotes]:
        """Every tile with evidence, in ascending order."""
        judged: dict[TileIndex, Judged] = {}
        for tile in sorted(self.evidence.tiles):
            found = self._judge(tile)
            if found.weighed.tally.any():
                judged[tile] = found
        apply_region_rules(judged, self.point_map.lattice, self.voting, self.rules)
        out = {}
        for tile, found in judged.items():
            here, weighed = found.here, found.weighed
            free = free_words(self.evidence.tiles[tile], here.occupied)
            if here.free is not None:
                free[here.free != 0] = 0  # what the map knows need not be sent
            out[tile] = TileVotes(weighed.tally, found.states, weighed.gone, found.remnants, weighed.new, free)
        return out

    def _judge(self, tile: TileIndex) -> Judged:
        """What the tile's own evidence says, cell by cell."""
        window = self.point_map.lattice.tile(tile)
        outer = reference_window(self.point_map, window.padded(1))
        counts = around(self.point_map.lattice, self.evidence.tiles, outer.grid, 0)
        near = dilated(outer.occupied, outer.base, 1)[1:-1, 1:-1]
        here = cut_reference(outer, window)
        known = here.free if here.free is not None else above_ground_points(self.point_map, window)
        low = here.top_z - here.ground_z < self.voting.min_height_m
        weighed = weigh(counts, outer.base, here.occupied, near, known, low, self.voting, self.rules)
        crowded = beside_new(counts, outer.occupied, outer.base)[1:-1, 1:-1]
        return Judged(here, weighed, weighed.states(), crowded, np.zeros_like(weighed.gone))
