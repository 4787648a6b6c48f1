"""Two ways to count a drive, one interface: the paper's votes per scan, and columns of evidence (METHOD 4).

A voter takes in scan after scan and gives, tile by tile, the same thing: a tally, and what would go and come.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapvote.config import VotingSettings
from mapvote.core.columns import above_ground_points, cut_reference, dilated, reference_window
from mapvote.core.grid import TileIndex, tile_grid
from mapvote.core.sensors import Sensor
from mapvote.core.types import F64, I32, U8, U64, CellState, PointMap, Reference
from mapvote.core.voting import decide
from mapvote.perception.classify import classify_paper
from mapvote.perception.evidence import Evidence, free_words
from mapvote.perception.tally import Tally
from mapvote.perception.together import Judged, around, settle
from mapvote.perception.verdict import beside_new, weigh
from mapvote.perception.visibility import ScanView

ALL_BITS = ~np.uint64(0)


@dataclass(frozen=True, slots=True)
class Seen:
    """What one localised scan saw."""

    view: ScanView
    reference: Reference
    origin_map: F64
    sigma_m: float
    """Standard deviation of the position, metres."""


@dataclass(frozen=True, slots=True)
class TileVotes:
    """What a voter says of one tile."""

    tally: I32
    """(256, 256, 5) votes in VOTE_UNITs."""
    states: U8
    """(256, 256) decided by this vehicle alone."""
    gone: U64 | None
    """(256, 256) map voxels that are there no more where the cell is changed-empty; None: all of them."""
    remnants: U64 | None
    """(256, 256) map voxels that are there no more though the rest of the cell stands; None: not asked."""
    new: U64
    """(256, 256) voxels whose points are new where the cell is changed-occupied."""
    free: U64 | None
    """(256, 256) voxels seen to be free in cells where the map knew of none; None: not asked."""


class PaperVoter:
    """Paper III: every scan classifies every cell and casts its votes."""

    def __init__(self, voting: VotingSettings, sensor: Sensor, point_map: PointMap) -> None:
        self.voting, self.sensor = voting, sensor
        self._tally = Tally(point_map.lattice)

    def add(self, seen: Seen) -> U64:
        """Cast one scan's votes; returns (rows, cols) words of voxels whose points may be new."""
        states, weights = classify_paper(seen.view, seen.reference, seen.origin_map, self.sensor, self.voting)
        self._tally.add(seen.view.grid, states, weights)
        return np.where(states == CellState.CHANGED_OCCUPIED, ALL_BITS, np.uint64(0))

    def votes(self) -> dict[TileIndex, TileVotes]:
        """Every tile with a vote, in ascending order."""
        out = {}
        for tile, tally in sorted(self._tally.tiles.items()):
            if tally.any():
                new = np.where(tally[..., CellState.CHANGED_OCCUPIED] > 0, ALL_BITS, np.uint64(0))
                out[tile] = TileVotes(tally, decide(tally), None, None, new, None)
        return out


class ColumnVoter:
    """METHOD 4: evidence per voxel over the drive, weighed at its end."""

    def __init__(self, voting: VotingSettings, point_map: PointMap, evidence: Evidence) -> None:
        """``evidence`` is shared with other voters of this map, and filled by whoever made it."""
        self.voting, self.point_map, self.evidence = voting, point_map, evidence

    def add(self, seen: Seen) -> U64:
        """Take note of one scan; returns (rows, cols) words of voxels whose points may be new."""
        return seen.view.hit & ~seen.reference.occupied

    def votes(self) -> dict[TileIndex, TileVotes]:
        """Every tile with evidence, in ascending order."""
        judged: dict[TileIndex, Judged] = {}
        for tile in sorted(self.evidence.tiles):
            found = self._judge(tile)
            if found.verdict.tally.any():
                judged[tile] = found
        settle(judged, self.point_map.lattice, self.voting)
        out = {}
        for tile, found in judged.items():
            here, verdict = found.here, found.verdict
            free = free_words(self.evidence.tiles[tile], here.occupied)
            if here.free is not None:
                free[here.free != 0] = 0  # what the map knows need not be sent
            out[tile] = TileVotes(verdict.tally, found.states, verdict.gone, found.remnants, verdict.new, free)
        return out

    def _judge(self, tile: TileIndex) -> Judged:
        """What the tile's own evidence says, cell by cell."""
        window = tile_grid(self.point_map.lattice, tile)
        outer = reference_window(self.point_map, window.padded(1))
        counts = around(self.point_map.lattice, self.evidence.tiles, outer.grid, 0)
        near = dilated(outer.occupied, outer.base, 1)[1:-1, 1:-1]
        here = cut_reference(outer, window)
        known = here.free if here.free is not None else above_ground_points(self.point_map, window)
        low = here.top_z - here.ground_z < self.voting.min_height_m
        verdict = weigh(counts, outer.base, here.occupied, near, known, low, self.voting)
        crowded = beside_new(counts, outer.occupied, outer.base)[1:-1, 1:-1]
        return Judged(here, verdict, verdict.states(), crowded, np.zeros_like(verdict.gone))


Voter = PaperVoter | ColumnVoter


class Panel:
    """The voters of one vehicle, by their settings. Voters that count alike share their counters."""

    def __init__(self, votings: Sequence[VotingSettings], sensor: Sensor, point_map: PointMap) -> None:
        self._evidence: dict[tuple[bool, bool, float], Evidence] = {}
        self.voters: dict[VotingSettings, Voter] = {}
        for voting in votings:
            if voting.method == "columns":
                by_ray, veto = "A" in voting.rules, "B" in voting.rules
                fresh = Evidence(point_map.lattice, by_ray, veto)
                evidence = self._evidence.setdefault((by_ray, veto, voting.wide_sigma_m), fresh)
                self.voters[voting] = ColumnVoter(voting, point_map, evidence)
            else:
                self.voters[voting] = PaperVoter(voting, sensor, point_map)

    def add(self, seen: Seen) -> U64:
        """One scan for every voter; returns (rows, cols) words of voxels whose points may be new for any of them."""
        for (_, _, wide_sigma_m), evidence in self._evidence.items():
            evidence.add(seen.view, seen.reference, reach=2 if seen.sigma_m > wide_sigma_m else 1)
        new = np.zeros(seen.view.grid.shape, dtype=np.uint64)
        for voter in self.voters.values():
            new |= voter.add(seen)
        return new
