"""One rule of evidence: what did a drive's rays do to each surface of the map, and what stands where it was free?

A mapped voxel is gone that was crossed more often than HIT_RAYS times its hits, and stands that was met and is not. A
cell is changed-empty if a voxel of it is gone and none stands: what no ray could decide in it goes along. So do cells
beside it in which rays crossed something and met nothing, however few; and cells that no ray could decide go with what
falls. Points that touch no other go with most of what is around them, or not at all. A free voxel met more often than
rays spoke against it is new, if the whole of what it belongs to was met as often as rays passed it, and is not the rest
of what stands; so is what hits show behind something that went, for a wall set back has an old side and a new one.
docs/method.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numba
import numpy as np

from mapvote.config import VotingSettings
from mapvote.core.columns import below_top, dilated
from mapvote.core.grid import Lattice, TileIndex
from mapvote.core.point_map import PointMap
from mapvote.core.reference import bordered
from mapvote.core.types import F64, I32, NO_VOTE, U8, U64, Bool, CellState, Reference
from mapvote.core.voting import one_hot
from mapvote.detection.blocks import blocks
from mapvote.detection.counters import PLANES, count_of, newly_free
from mapvote.detection.lone_points import lone_cells, no_change
from mapvote.detection.regions import HALO, beyond_tiles, fallen
from mapvote.detection.surface_counts import CROSSED, MET, PASSED, PASSES, SurfaceEvidence, times_crossed
from mapvote.detection.surface_looks import amounts, looks
from mapvote.detection.surface_regions import grown, lasting, new_sides, on_its_own, stands_apart, supported
from mapvote.detection.votes import TileVotes
from mapvote.perception.frontend import Observation

# Set on corner 1 and 2, street 2 and KITTI 0001 in blocks of 12 and 25 scans: docs/decisions/evidence.md has each.
HIT_RAYS = 8
"""Scans that crossed a mapped voxel, against one that met it."""
GONE_RAYS = 3
"""Scans that must have crossed it beyond those: two may be an error of two poses."""
TOGETHER = 2
"""Scans whose rays cross it only together count as one of so many."""
NEW_RAYS = 0.5
"""Of the scans in which a free voxel was met, one goes against two that crossed it."""
FALL_CELLS = 8
"""How far what is gone takes cells with it that no ray could decide: 2.4 m."""


@dataclass(slots=True)
class _Judged:
    """One tile on the way to its votes: words and states, (256, 256) each."""

    here: Reference
    gone: U64
    stands: U64
    new: U64
    balance: I32
    """In how many scans the new voxels of each cell were met, less in how many a ray passed them, summed over them."""
    beyond: U64
    """Met where the map knew nothing, in no mapped cell."""
    crossed: Bool
    """Mapped cells in which rays crossed a voxel that none met, and met none that stands."""
    adrift: Bool
    """Mapped cells that no ray decided, with rays through half of what is under them or more."""
    lone: Bool
    """Mapped cells whose voxels touch no other mapped one."""
    amount: I32
    """How much of a thing is in each cell (detection/surface_looks.py)."""
    states: U8
    remnants: U64
    free: U64
    """Seen to be free where the map knew nothing."""


@numba.njit(cache=True, nogil=True)
def is_gone(cell: U64, bit: int, every: int) -> bool:
    """Whether the surface in one voxel of a cell (WORDS,) was crossed so much more often than met that it is gone;
    ``every`` as in :func:`times_crossed`."""
    return times_crossed(cell, bit, every) >= GONE_RAYS + HIT_RAYS * count_of(cell, MET, bit)


@numba.njit(cache=True, nogil=True)
def weigh_surfaces(
    planes: U64, occupied: U64, free: U64,
    gone: U64, stands: U64, unmet: U64, new: U64, beyond: U64, balance: I32,
) -> None:  # fmt: skip
    """Fill the last six planes (rows, cols), which come empty, from counters (rows, cols, WORDS) and the map's words:
    ``free`` it knows to be. See :class:`_Judged` for each."""
    for r in range(occupied.shape[0]):
        for c in range(occupied.shape[1]):
            cell = planes[r, c]
            asked = occupied[r, c]
            for k in range(PLANES):
                asked |= cell[MET + k]
            if not asked:
                continue
            for bit in range(64):
                one = np.uint64(1) << np.uint64(bit)
                if not asked & one:
                    continue
                met = count_of(cell, MET, bit)
                if occupied[r, c] & one:
                    if is_gone(cell, bit, TOGETHER):
                        gone[r, c] |= one
                    elif met:
                        stands[r, c] |= one
                    elif times_crossed(cell, bit, TOGETHER):
                        unmet[r, c] |= one
                elif met >= 1 + NEW_RAYS * count_of(cell, CROSSED, bit):
                    if free[r, c] & one:
                        new[r, c] |= one
                        balance[r, c] += met - count_of(cell, PASSES, bit)
                    else:
                        beyond[r, c] |= one


class SurfaceVoter:
    """Surfaces: evidence per voxel over the drive, weighed at its end. Decides alone: its tally is one vote a cell."""

    def __init__(self, voting: VotingSettings, point_map: PointMap) -> None:
        self.voting, self.point_map = voting, point_map
        self.evidence = SurfaceEvidence(point_map.lattice)

    def observe(self, seen: Observation) -> U64:
        """Count one scan; returns (rows, cols) words of voxels whose points may be new."""
        return self.evidence.count(seen)

    def votes(self) -> dict[TileIndex, TileVotes]:
        """Every tile with evidence, in ascending order."""
        return dict(sorted(self.each()))

    def each(self) -> Iterator[tuple[TileIndex, TileVotes]]:
        """The same one by one, in an order of its own: a drive of many tiles is judged block by block
        (three halos and a lone point are less than a tile)."""
        for wanted, tiles in blocks(self.evidence.tiles):
            judged = {tile: self._judge(tile) for tile in tiles}
            _decide_mapped(judged, self.point_map.lattice)
            _decide_new(judged, self.point_map.lattice)
            states, amount = _states(judged), {tile: found.amount for tile, found in judged.items()}
            for tile in wanted:
                if (judged[tile].states != NO_VOTE).any():
                    height_m = judged[tile].here.top_z - judged[tile].here.ground_z
                    yield tile, _votes_of(judged[tile], looks(self.point_map.lattice, tile, states, amount, height_m))

    def _judge(self, tile: TileIndex) -> _Judged:
        """What the tile's own evidence says, voxel by voxel and cell by cell."""
        window = self.point_map.lattice.tile(tile)
        here, outer, known = bordered(self.point_map, window)
        planes = self.evidence.tiles[tile]
        gone, stands, unmet, new, beyond = (np.zeros(window.shape, dtype=np.uint64) for _ in range(5))
        balance = np.zeros(window.shape, dtype=np.int32)
        weigh_surfaces(planes, here.occupied, known, gone, stands, unmet, new, beyond, balance)
        mapped, passed = here.occupied != 0, planes[..., PASSED]
        low = mapped & ~(here.top_z - here.ground_z >= self.voting.min_height_m)
        under = np.where(mapped, (here.occupied & (~here.occupied + np.uint64(1))) - np.uint64(1), np.uint64(0))
        clear = 2 * np.bitwise_count(under & passed) >= np.bitwise_count(under)
        states = np.full(window.shape, NO_VOTE, dtype=np.uint8)
        states[passed != 0] = CellState.UNCHANGED_EMPTY
        states[mapped & (passed != 0)] = CellState.UNDETERMINED
        states[~mapped & (beyond != 0)] = CellState.UNDETERMINED
        states[stands != 0] = CellState.UNCHANGED_OCCUPIED
        return _Judged(
            here=here,
            gone=np.where(low, np.uint64(0), gone),
            stands=stands,
            new=np.where(mapped, np.uint64(0), new),
            balance=balance,
            beyond=np.where(mapped, np.uint64(0), beyond),
            crossed=mapped & ~low & (stands == 0) & ((gone | unmet) != 0),
            adrift=mapped & ~low & (gone | stands == 0) & (under != 0) & clear,
            lone=lone_cells(outer.occupied, outer.base)[1:-1, 1:-1],
            amount=amounts(planes, here.occupied, new),
            states=states,
            remnants=np.zeros_like(gone),
            free=newly_free(planes, here),
        )


def _votes_of(found: _Judged, looked: F64) -> TileVotes:
    """What a new thing has where the map knew neither free space nor points comes along, and so do its upper parts."""
    known = ~np.uint64(0) if found.here.free is None else found.here.free
    new = np.where(found.new != 0, found.new | found.beyond | ~(_below_tops(found.new) | known), np.uint64(0))
    return TileVotes(one_hot(found.states), found.states, found.gone, found.remnants, new, found.free, looked)


@numba.njit(cache=True, nogil=True)
def _below_tops(words: U64) -> U64:
    out = np.empty_like(words)
    for r in range(words.shape[0]):
        for c in range(words.shape[1]):
            out[r, c] = below_top(words[r, c])
    return out


def _decide_mapped(tiles: dict[TileIndex, _Judged], lattice: Lattice) -> None:
    """What is gone, what falls with it, and what is left of it beside what stands."""
    gone = {tile: found.gone for tile, found in tiles.items()}
    empty = {tile: (found.gone != 0) & (found.stands == 0) for tile, found in tiles.items()}
    mapped = {tile: found.here.occupied for tile, found in tiles.items()}

    def firm(empty: Bool, gone: U64, mapped: U64) -> Bool:
        return supported(empty, gone) | on_its_own(empty, gone, mapped, (mapped != 0) & ~empty)

    for tile, cells in beyond_tiles(lattice, HALO, firm, (empty, False), (gone, 0), (mapped, 0)).items():
        tiles[tile].states[empty[tile]] = CellState.UNDETERMINED
        tiles[tile].states[cells] = CellState.CHANGED_EMPTY
    strong = {tile: found.states == CellState.CHANGED_EMPTY for tile, found in tiles.items()}
    crossed = {tile: found.crossed for tile, found in tiles.items()}
    for tile, cells in beyond_tiles(lattice, HALO, grown, (strong, False), (crossed, False)).items():
        tiles[tile].states[cells] = CellState.CHANGED_EMPTY
    states, adrift = _states(tiles), {tile: found.adrift for tile, found in tiles.items()}

    def fall(states: U8, adrift: Bool) -> Bool:
        return fallen(states, adrift, FALL_CELLS)

    for tile, cells in beyond_tiles(lattice, HALO, fall, (states, NO_VOTE), (adrift, False)).items():
        tiles[tile].states[cells] = CellState.CHANGED_EMPTY
    states, lone = _states(tiles), {tile: found.lone for tile, found in tiles.items()}
    for tile, cells in beyond_tiles(lattice, 1, no_change, (states, NO_VOTE), (lone, False)).items():
        tiles[tile].states[cells] = CellState.UNDETERMINED
    for found in tiles.values():
        down = found.states == CellState.CHANGED_EMPTY
        found.gone = np.where(down, found.here.occupied, found.gone)
        found.remnants = np.where(found.stands != 0, found.gone, np.uint64(0))


def _decide_new(tiles: dict[TileIndex, _Judged], lattice: Lattice) -> None:
    """Where something new stands: in what was free, and behind what went; but for the rest of what stands, for specks,
    and for traffic."""
    states, beyond = _states(tiles), {tile: found.beyond for tile, found in tiles.items()}
    for tile, cells in beyond_tiles(lattice, HALO, new_sides, (states, NO_VOTE), (beyond, 0)).items():
        tiles[tile].new |= np.where(cells, beyond[tile], np.uint64(0))
    new = {tile: found.new for tile, found in tiles.items()}
    balance = {tile: found.balance for tile, found in tiles.items()}
    kept = {tile: found.here.occupied & ~found.gone for tile, found in tiles.items()}
    stands = {tile: found.stands & ~found.gone for tile, found in tiles.items()}
    base = {tile: found.here.base for tile, found in tiles.items()}

    def stand(states: U8, new: U64, balance: I32, kept: U64, stands: U64, base: I32) -> Bool:
        cells = new != 0
        firm = supported(cells, new) | on_its_own(cells, new, new, kept != 0)
        return firm & lasting(cells, balance) & stands_apart(cells, new, dilated(stands, base, 1), states)

    planes = (states, NO_VOTE), (new, 0), (balance, 0), (kept, 0), (stands, 0), (base, 0)
    for tile, cells in beyond_tiles(lattice, HALO, stand, *planes).items():
        tiles[tile].states[new[tile] != 0] = CellState.UNDETERMINED
        tiles[tile].states[cells] = CellState.CHANGED_OCCUPIED


def _states(tiles: dict[TileIndex, _Judged]) -> dict[TileIndex, U8]:
    return {tile: found.states for tile, found in tiles.items()}
