"""Two ways to count a drive, one interface: the paper's votes per scan, and columns of evidence (METHOD 4).

A voter takes in scan after scan and gives, tile by tile, the same thing: a tally, and what would go and come.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mapvote.config import VotingSettings
from mapvote.core.columns import above_ground_points, cut_reference, dilated, reference_window
from mapvote.core.grid import Grid, TileIndex, tile_grid
from mapvote.core.sensors import Sensor
from mapvote.core.types import F64, I32, NO_VOTE, U8, U64, Bool, CellState, PointMap, Reference
from mapvote.core.voting import decide, one_hot
from mapvote.perception.classify import classify_paper
from mapvote.perception.evidence import Evidence, free_words
from mapvote.perception.tally import Tally
from mapvote.perception.verdict import Verdict, beside_new, drop_specks, fallen, remnants, unexplained, weigh
from mapvote.perception.visibility import ScanView

ALL_BITS = ~np.uint64(0)
_HALO = 64
"""Cells around a tile that rules H and I look at: 19 m, a house."""
Plane = Any
"""An array of one tile or window, of any type."""


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
        out: dict[TileIndex, TileVotes] = {}
        said: dict[TileIndex, Verdict] = {}
        crowded: dict[TileIndex, U64] = {}
        maps: dict[TileIndex, Reference] = {}
        for tile, planes in sorted(self.evidence.tiles.items()):
            window = tile_grid(self.point_map.lattice, tile)
            around = reference_window(self.point_map, window.padded(1))
            counts = self._around(self.evidence.tiles, around.grid, 0)
            near = dilated(around.occupied, around.base, 1)[1:-1, 1:-1]
            here = cut_reference(around, window)
            known = here.free if here.free is not None else above_ground_points(self.point_map, window)
            low = here.top_z - here.ground_z < self.voting.min_height_m
            verdict = weigh(counts, around.base, here.occupied, near, known, low, self.voting)
            if verdict.tally.any():
                free = free_words(planes, here.occupied)
                if here.free is not None:
                    free[here.free != 0] = 0  # what the map knows need not be sent
                out[tile] = TileVotes(verdict.tally, verdict.states(), verdict.gone, None, verdict.new, free)
                said[tile], maps[tile] = verdict, here
                crowded[tile] = beside_new(counts, around.occupied, around.base)[1:-1, 1:-1]
        if "C" in self.voting.rules:
            self._drop_explained(out, {tile: verdict.beside for tile, verdict in said.items()})
        if "H" in self.voting.rules:
            self._drop_what_fell(out, {tile: verdict.adrift for tile, verdict in said.items()}, maps)
        if "G" in self.voting.rules:
            self._drop_specks(out)
        if "I" in self.voting.rules:
            self._drop_remnants(out, {tile: verdict.loose for tile, verdict in said.items()}, crowded, maps)
        return out

    def _drop_explained(self, votes: dict[TileIndex, TileVotes], beside: dict[TileIndex, Bool]) -> None:
        """Rule C, with the cells around a tile, so that what touches across its edge is joined from both sides."""
        states = {tile: v.states.copy() for tile, v in votes.items()}
        halo = self.voting.join_cells
        for tile, v in votes.items():
            wide = tile_grid(self.point_map.lattice, tile).padded(halo)
            near = self._around(states, wide, NO_VOTE), self._around(beside, wide, False)
            cells = unexplained(*near, halo)[halo:-halo, halo:-halo]
            v.states[cells] = CellState.UNDETERMINED
            v.tally[cells] = one_hot(np.array(CellState.UNDETERMINED, dtype=np.uint8))

    def _drop_what_fell(
        self, votes: dict[TileIndex, TileVotes], adrift: dict[TileIndex, Bool], maps: dict[TileIndex, Reference]
    ) -> None:
        """Rule H, with enough of a tile's neighbours that groups across its edge are judged alike from both sides."""
        states = {tile: v.states for tile, v in votes.items()}
        fell = {}
        for tile in votes:
            wide = tile_grid(self.point_map.lattice, tile).padded(_HALO)
            near = (self._around(states, wide, NO_VOTE), self._around(adrift, wide, False))
            fell[tile] = fallen(*near, self.voting.fall_cells)[_HALO:-_HALO, _HALO:-_HALO]
        for tile, cells in fell.items():
            votes[tile].states[cells] = CellState.CHANGED_EMPTY
            votes[tile].tally[cells] = one_hot(np.array(CellState.CHANGED_EMPTY, dtype=np.uint8))
            gone = votes[tile].gone
            assert gone is not None
            gone[cells] = maps[tile].occupied[cells]

    def _drop_specks(self, votes: dict[TileIndex, TileVotes]) -> None:
        """Rule G, with the cells around a tile, so that a component across its edge counts in full."""
        states = {tile: v.states.copy() for tile, v in votes.items()}
        halo = self.voting.min_cells
        for tile, v in votes.items():
            wide = self._around(states, tile_grid(self.point_map.lattice, tile).padded(halo), NO_VOTE)
            v.states[drop_specks(wide, halo)[halo:-halo, halo:-halo]] = CellState.UNDETERMINED

    def _drop_remnants(
        self,
        votes: dict[TileIndex, TileVotes],
        loose: dict[TileIndex, U64],
        crowded: dict[TileIndex, U64],
        maps: dict[TileIndex, Reference],
    ) -> None:
        """Rule I, with enough of a tile's neighbours. A cell of which nothing is left that way is changed-empty, unless
        new hits lie next to what went: they may be what stands there, put beside it by an error of pose."""
        base = {tile: here.base for tile, here in maps.items()}
        gone: dict[TileIndex, U64] = {}
        for tile, v in votes.items():
            assert v.gone is not None
            gone[tile] = np.where(v.states == CellState.CHANGED_EMPTY, v.gone, np.uint64(0))
        for tile, v in votes.items():
            wide = tile_grid(self.point_map.lattice, tile).padded(_HALO)
            near = self._around(gone, wide, 0), self._around(loose, wide, 0), self._around(base, wide, 0)
            left = remnants(*near)[_HALO:-_HALO, _HALO:-_HALO]
            nothing_left = ((left | gone[tile]) == maps[tile].occupied) & (left & crowded[tile] == 0)
            fell = (left != 0) & nothing_left & (v.states != CellState.CHANGED_EMPTY)
            v.states[fell] = CellState.CHANGED_EMPTY
            v.tally[fell] = one_hot(np.array(CellState.CHANGED_EMPTY, dtype=np.uint8))
            down = v.states == CellState.CHANGED_EMPTY
            assert v.gone is not None
            v.gone[down] |= left[down]
            votes[tile] = replace(v, remnants=np.where(down, np.uint64(0), left))

    def _around(self, planes: dict[TileIndex, Plane], wide: Grid, elsewhere: int) -> Plane:
        """The planes of several tiles as one window."""
        first = next(iter(planes.values()))
        out = np.full((*wide.shape, *first.shape[2:]), elsewhere, dtype=first.dtype)
        for tile in wide.tiles():
            if tile in planes:
                grid = tile_grid(self.point_map.lattice, tile)
                common = grid.intersection(wide)
                out[common.slices_in(wide)] = planes[tile][common.slices_in(grid)]
        return out


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
