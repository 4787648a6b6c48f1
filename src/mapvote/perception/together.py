"""What the cells of a drive say together: the rules that look beyond a cell, over all its tiles (docs/method.md).

Rule C gives up hits that an error of pose explains, H lets roofs fall with their walls, G drops specks, and I takes
down what is left of demolished things beside what stands. Each looks at a tile with some cells of its neighbours
around it, so that what lies across an edge is judged alike from both sides.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from mapvote.config import VotingSettings
from mapvote.core.grid import Grid, Lattice, TileIndex, tile_grid
from mapvote.core.types import NO_VOTE, U8, U64, Bool, CellState, Reference
from mapvote.core.voting import one_hot
from mapvote.perception.verdict import Verdict, drop_specks, fallen, remnants, unexplained

_HALO = 64
"""Cells around a tile that rules H and I look at: 19 m, a house."""
Plane = Any
"""An array of one tile or window, of any type."""


@dataclass(slots=True)
class Judged:
    """One tile on its way from evidence to votes. The rules change states, tally and masks in place."""

    here: Reference
    verdict: Verdict
    states: U8
    """(256, 256) decided so far."""
    crowded: U64
    """(256, 256) voxels next to which something new was struck."""
    remnants: U64
    """(256, 256) map voxels that are there no more though the rest of the cell stands."""

    def decide(self, cells: Bool, state: CellState) -> None:
        """Let all votes of ``cells`` (256, 256) be for ``state``."""
        self.states[cells] = state
        self.verdict.tally[cells] = one_hot(np.array(state, dtype=np.uint8))


Tiles = Mapping[TileIndex, Judged]


def settle(tiles: Tiles, lattice: Lattice, voting: VotingSettings) -> None:
    """Apply those of the rules C, H, G and I that ``voting.rules`` names, in this order."""
    if "C" in voting.rules:
        _give_up_explained(tiles, lattice, voting.join_cells)
    if "H" in voting.rules:
        _let_fall(tiles, lattice, voting.fall_cells)
    if "G" in voting.rules:
        _drop_specks(tiles, lattice, voting.min_cells)
    if "I" in voting.rules:
        _take_remnants(tiles, lattice)


def _give_up_explained(tiles: Tiles, lattice: Lattice, join_cells: int) -> None:
    beside = {tile: judged.verdict.beside for tile, judged in tiles.items()}
    rule = partial(unexplained, reach=join_cells)
    for tile, cells in _beyond(lattice, join_cells, rule, (_states(tiles), NO_VOTE), (beside, False)).items():
        tiles[tile].decide(cells, CellState.UNDETERMINED)


def _let_fall(tiles: Tiles, lattice: Lattice, fall_cells: int) -> None:
    adrift = {tile: judged.verdict.adrift for tile, judged in tiles.items()}
    rule = partial(fallen, reach=fall_cells)
    for tile, cells in _beyond(lattice, _HALO, rule, (_states(tiles), NO_VOTE), (adrift, False)).items():
        tiles[tile].decide(cells, CellState.CHANGED_EMPTY)
        tiles[tile].verdict.gone[cells] = tiles[tile].here.occupied[cells]


def _drop_specks(tiles: Tiles, lattice: Lattice, min_cells: int) -> None:
    rule = partial(drop_specks, min_cells=min_cells)
    for tile, cells in _beyond(lattice, min_cells, rule, (_states(tiles), NO_VOTE)).items():
        tiles[tile].states[cells] = CellState.UNDETERMINED


def _take_remnants(tiles: Tiles, lattice: Lattice) -> None:
    """A cell of which nothing is left is changed-empty, unless new hits lie next to what went: they may be what stands
    there, put beside it by an error of pose."""
    empty = int(CellState.CHANGED_EMPTY)
    loose = {tile: judged.verdict.loose for tile, judged in tiles.items()}
    base = {tile: judged.here.base for tile, judged in tiles.items()}
    gone = {t: np.where(judged.states == empty, judged.verdict.gone, np.uint64(0)) for t, judged in tiles.items()}
    for tile, left in _beyond(lattice, _HALO, remnants, (gone, 0), (loose, 0), (base, 0)).items():
        judged = tiles[tile]
        nothing_left = ((left | gone[tile]) == judged.here.occupied) & (left & judged.crowded == 0)
        judged.decide((left != 0) & nothing_left & (judged.states != empty), CellState.CHANGED_EMPTY)
        down = judged.states == empty
        judged.verdict.gone[down] |= left[down]
        judged.remnants = np.where(down, np.uint64(0), left)


def _states(tiles: Tiles) -> dict[TileIndex, U8]:
    return {tile: judged.states for tile, judged in tiles.items()}


def _beyond(
    lattice: Lattice, halo: int, rule: Callable[..., Plane], *planes: tuple[Mapping[TileIndex, Plane], int]
) -> dict[TileIndex, Plane]:
    """``rule`` of ``planes``, tile by tile with ``halo`` cells around it, cut back to the tile. Each plane comes with
    what it is where there is no tile. Nothing changes until all tiles are through."""
    out = {}
    for tile in planes[0][0]:
        wide = tile_grid(lattice, tile).padded(halo)
        near = [around(lattice, plane, wide, elsewhere) for plane, elsewhere in planes]
        out[tile] = rule(*near)[halo:-halo, halo:-halo]
    return out


def around(lattice: Lattice, planes: Mapping[TileIndex, Plane], wide: Grid, elsewhere: int) -> Plane:
    """The planes of several tiles as one window ``wide``; ``elsewhere`` where there is no tile."""
    first = next(iter(planes.values()))
    out = np.full((*wide.shape, *first.shape[2:]), elsewhere, dtype=first.dtype)
    for tile in wide.tiles():
        if tile in planes:
            grid = tile_grid(lattice, tile)
            common = grid.intersection(wide)
            out[common.slices_in(wide)] = planes[tile][common.slices_in(grid)]
    return out
