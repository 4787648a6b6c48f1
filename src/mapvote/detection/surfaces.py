"""The voter of surfaces: a drive is counted scan by scan, and judged at its end, one window of tiles after another."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from functools import reduce

import numpy as np

from mapvote.config import VotingSettings
from mapvote.core.columns import EVERY_BIT
from mapvote.core.grid import Grid, Lattice, TileIndex
from mapvote.core.point_map import PointMap
from mapvote.core.reference import above_ground_points, reference_window
from mapvote.core.types import NO_VOTE, U64
from mapvote.core.voting import one_hot
from mapvote.detection.confidence import looks
from mapvote.detection.evidence import NOTHING, WORDS, Facts, count_scan, free_words, judge_window, weigh_voxels
from mapvote.detection.packed_tiles import PackedTiles
from mapvote.detection.voter import TileVotes
from mapvote.perception.frontend import Observation

_BLOCK = 2
"""Tiles along the side of a block: with the cells around it 60 MB at a time."""
HALO = 96
"""Cells around a block that are judged along, so that what lies across its edge is judged alike from both sides: 29 m,
a house and what stands before it."""


class SurfaceVoter:
    """Surfaces: evidence per voxel over the drive, weighed at its end. Decides alone: its tally is one vote a cell."""

    def __init__(self, voting: VotingSettings, point_map: PointMap) -> None:
        self.voting, self.point_map = voting, point_map
        self.evidence = PackedTiles(point_map.lattice, WORDS)

    def observe(self, seen: Observation) -> U64:
        """Count one scan; returns (rows, cols) words of voxels whose points may be new."""
        return count_scan(self.evidence, seen)

    def votes(self) -> dict[TileIndex, TileVotes]:
        """Every tile with evidence, in ascending order."""
        return dict(sorted(self.each()))

    def each(self, only: Collection[TileIndex] | None = None) -> Iterator[tuple[TileIndex, TileVotes]]:
        """The same one by one, block by block; ``only``: of these tiles."""
        counted = self.evidence
        for tiles, window in blocks(self.point_map.lattice, counted if only is None else counted.keys() & set(only)):
            yield from self._judge(tiles, window)

    def _judge(self, tiles: list[TileIndex], window: Grid) -> Iterator[tuple[TileIndex, TileVotes]]:
        here = reference_window(self.point_map, window)
        known = here.free if here.free is not None else above_ground_points(self.point_map, window)
        height_m = here.top_z - here.ground_z
        weighed, counted, free = Facts.none(window.shape), self.evidence, {}
        for tile in window.tiles():
            if tile in counted:
                planes = counted[tile]
                weigh_voxels(planes, counted.overlap(tile, window), here.occupied, known, weighed)
                if tile in tiles:
                    free[tile] = free_words(planes)
        states, gone, new = judge_window(weighed, here.occupied, height_m, self.voting.min_height_m)
        amount = np.where(here.occupied != 0, np.bitwise_count(here.occupied), weighed.hits)
        told = here.free if here.free is not None else np.zeros_like(known)
        for tile in tiles:
            cut = self._cut(tile, window)
            if (states[cut] != NO_VOTE).any():
                own = np.ascontiguousarray(states[cut])
                upwards = None if here.free is None else here.free[cut]
                yield (
                    tile,
                    TileVotes(
                        tally=one_hot(own),
                        states=own,
                        gone=np.ascontiguousarray(gone[cut]),
                        new=_with_the_unknown(new[cut], weighed.beyond[cut], upwards),
                        free=np.where(told[cut] != 0, NOTHING, free[tile] & ~here.occupied[cut]),
                        looked=looks(states, amount, height_m, cut),
                    ),
                )

    def _cut(self, tile: TileIndex, window: Grid) -> tuple[slice, slice]:
        return self.point_map.lattice.tile(tile).slices_in(window)


def blocks(lattice: Lattice, tiles: Iterable[TileIndex]) -> Iterator[tuple[list[TileIndex], Grid]]:
    """Tiles whose votes are wanted together, each tile once, and the window in which they are judged."""
    every = sorted(tiles)
    for row, col in sorted({(r // _BLOCK, c // _BLOCK) for r, c in every}):
        inner = [t for t in every if (t[0] // _BLOCK, t[1] // _BLOCK) == (row, col)]
        yield inner, reduce(Grid.union, map(lattice.tile, inner)).padded(HALO)


def _with_the_unknown(new: U64, beyond: U64, free: U64 | None) -> U64:
    """(rows, cols) the voxels ``new`` of each cell, those hit ``beyond`` what the map knew, and the
    upper parts that the map does not know to be ``free``."""
    below_top = new.copy()
    for shift in (1, 2, 4, 8, 16, 32):
        below_top |= below_top >> np.uint64(shift)
    return np.where(new != 0, new | beyond | ~(below_top | (EVERY_BIT if free is None else free)), NOTHING)
