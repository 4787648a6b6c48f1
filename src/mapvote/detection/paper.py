"""One scan against the reference: a state per cell (paper III-A, III-B), as the paper's sentences are read."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import numpy as np

from mapvote.config import PaperSettings, VotingSettings
from mapvote.core.columns import EVERY_BIT
from mapvote.core.grid import TILE_CELLS, Grid, Lattice, TileIndex
from mapvote.core.point_map import PointMap
from mapvote.core.sensors import Sensor
from mapvote.core.types import I32, N_STATES, NO_VOTE, U8, U16, U64, Bool, CellState
from mapvote.core.voting import VOTE_UNIT, cast, decide, weight_table
from mapvote.detection import sightings as bits
from mapvote.detection.votes import TileVotes
from mapvote.perception.frontend import Observation

_SIGHT = {
    "points": bits.CLEAR,
    "cells": bits.CLEAR_OF_CELLS,
    "farthest": bits.BEFORE_FARTHEST,
    "column": bits.THROUGH_COLUMN,
}
_TALL = {"bottom": bits.BEGINS_ABOVE, "height": bits.REACHES_HIGHER}


@lru_cache(maxsize=64)
def reading_table(voting: VotingSettings, paper: PaperSettings) -> tuple[U8, I32]:
    """The reading as a table: (states (2, 65536) by whether the map holds points and by word, weights (65536,)).

    A cell with n_min points or more is occupied and worth w(n), Eq. (1), in VOTE_UNITs; with fewer undetermined or
    empty; with none empty if it was visible, else undetermined or without a vote. NO_VOTE where no ray was fired, and,
    in case 5 (``skip_tall_cells``), where the map is too tall.
    """
    words = np.arange(bits.WORDS)
    n = words & bits.MOST_POINTS
    shift = bits.WITHOUT_MOVERS if paper.movers == "removed" else 0
    visible = words & (_SIGHT[paper.line_of_sight] << shift) != 0
    fired = words & (bits.FIRED << shift) != 0
    occupied = n >= paper.n_min
    empty = (n == 0) & visible
    if paper.few_points == "empty":
        empty |= (n > 0) & ~occupied
    unseen = int(CellState.UNDETERMINED) if paper.occluded == "votes" else NO_VOTE
    states = np.empty((2, bits.WORDS), dtype=np.uint8)
    for mapped, if_occupied, if_empty in (
        (0, CellState.CHANGED_OCCUPIED, CellState.UNCHANGED_EMPTY),
        (1, CellState.UNCHANGED_OCCUPIED, CellState.CHANGED_EMPTY),
    ):
        states[mapped] = np.where(n > 0, CellState.UNDETERMINED, np.where(fired, unseen, NO_VOTE))
        states[mapped, empty] = if_empty
        states[mapped, occupied] = if_occupied
        if voting.skip_tall_cells:
            states[mapped, words & _TALL[paper.tall_rule] != 0] = NO_VOTE
    points = weight_table(voting.weighted, voting.a, voting.b, voting.k, paper.n_min, bits.MOST_POINTS)
    return states, np.where(occupied, points[n], VOTE_UNIT).astype(np.int32)


def classify_paper(words: U16, mapped: Bool, voting: VotingSettings, paper: PaperSettings) -> tuple[U8, I32]:
    """The paper's five states and the votes each is worth: (states uint8, weights int32 in VOTE_UNITs), (rows, cols).

    ``words`` (rows, cols) what the scan says (:mod:`mapvote.detection.sightings`), ``mapped`` where the map holds
    obstacle points; see :func:`reading_table`.
    """
    states, weights = reading_table(voting, paper)
    return states[mapped.astype(np.intp), words], weights[words]


class Tally:
    """Votes per cell and class over a drive: :func:`mapvote.core.voting.cast` on the tiles that a window touches."""

    def __init__(self, lattice: Lattice) -> None:
        self.lattice = lattice
        self.tiles: dict[TileIndex, I32] = {}
        """(256, 256, 5) int32 in VOTE_UNITs."""

    def cast(self, grid: Grid, states: U8, weights: I32) -> None:
        """Cast one scan's ``states`` (rows, cols of ``grid``) with ``weights``."""
        for tile in grid.tiles():
            window = self.lattice.tile(tile)
            common = window.intersection(grid)
            if tile not in self.tiles:
                self.tiles[tile] = np.zeros((TILE_CELLS, TILE_CELLS, N_STATES), dtype=np.int32)
            inner, outer = common.slices_in(window), common.slices_in(grid)
            cast(self.tiles[tile][inner], states[outer], weights[outer])


class PaperVoter:
    """Paper III: every scan classifies every cell and casts its votes."""

    def __init__(self, voting: VotingSettings, paper: PaperSettings, sensor: Sensor, point_map: PointMap) -> None:
        self.voting, self.paper, self.sensor = voting, paper, sensor
        self._tally = Tally(point_map.lattice)

    def observe(self, seen: Observation) -> U64:
        """Cast one scan's votes; returns (rows, cols) words of voxels whose points may be new."""
        words = bits.sightings(seen, self.sensor, self.paper.n_min, self.paper)
        states, weights = classify_paper(words, seen.reference.counts > 0, self.voting, self.paper)
        self._tally.cast(seen.view.grid, states, weights)
        return np.where(states == CellState.CHANGED_OCCUPIED, EVERY_BIT, np.uint64(0))

    def votes(self) -> dict[TileIndex, TileVotes]:
        """Every tile with a vote, in ascending order."""
        return dict(self.each())

    def each(self) -> Iterator[tuple[TileIndex, TileVotes]]:
        """The same one by one."""
        for tile, tally in sorted(self._tally.tiles.items()):
            if tally.any():
                new = np.where(tally[..., CellState.CHANGED_OCCUPIED] > 0, EVERY_BIT, np.uint64(0))
                yield tile, TileVotes(tally, decide(tally), None, None, new, None)
