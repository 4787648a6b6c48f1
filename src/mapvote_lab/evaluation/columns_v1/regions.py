"""What the cells of a drive say together: the rules that look beyond a cell, over all its tiles.

Rule C gives up hits that an error of pose explains, H lets roofs fall with their walls, G drops specks, and I takes
down what is left of demolished things beside what stands (docs/columns-v1.md).
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numba
import numpy as np

from mapvote.core.columns import TOP_BIT, dilated, neighbourhood
from mapvote.core.grid import Lattice, TileIndex
from mapvote.core.types import I32, NO_VOTE, U8, U64, Bool, CellState
from mapvote.detection.evidence import PLANES
from mapvote.detection.surface_rules import fallen
from mapvote_lab.evaluation.columns_v1.counters import STRUCK_ITSELF, THROUGH_ITSELF, ever
from mapvote_lab.evaluation.columns_v1.judged import Judged
from mapvote_lab.evaluation.columns_v1.rules import Rules
from mapvote_lab.evaluation.columns_v1.specks import small_groups
from mapvote_lab.evaluation.columns_v1.spreading import flooded
from mapvote_lab.evaluation.columns_v1.tile_windows import HALO, beyond_tiles

_LOWEST, _HIGHEST = np.uint64(0b11), np.uint64(3) << np.uint64(TOP_BIT - 1)
JOIN_CELLS = 6
"""Rule C: how far a new thing reaches along mapped cells."""
FALL_CELLS = 15
"""Rule H: how far what is gone takes unseen cells with it."""
MIN_CELLS = 4
"""Rule G: smaller groups of changed cells are dropped."""
_BESIDE = np.int64(1)
"""One cell to all sides; no literal, for which :func:`neighbourhood` would be compiled once more."""


Tiles = Mapping[TileIndex, Judged]


def apply_region_rules(tiles: Tiles, lattice: Lattice, rules: Rules) -> None:
    """Apply the rules C, H, G and I, in this order, as far as ``rules`` has them hold."""
    if rules.pose_explains:
        _give_up_explained(tiles, lattice, JOIN_CELLS)
    if rules.roofs_fall:
        _let_fall(tiles, lattice, FALL_CELLS)
    if rules.brief_is_passing:
        _drop_specks(tiles, lattice, MIN_CELLS)
    if rules.remnants_go:
        _take_remnants(tiles, lattice)


def _give_up_explained(tiles: Tiles, lattice: Lattice, join_cells: int) -> None:
    beside = {tile: judged.weighed.beside for tile, judged in tiles.items()}
    rule = partial(unexplained, reach=join_cells)
    for tile, cells in beyond_tiles(lattice, join_cells, rule, (_states(tiles), NO_VOTE), (beside, False)).items():
        tiles[tile].overrule(cells, CellState.UNDETERMINED)


def _let_fall(tiles: Tiles, lattice: Lattice, fall_cells: int) -> None:
    adrift = {tile: judged.weighed.adrift for tile, judged in tiles.items()}
    rule = partial(fallen, reach=fall_cells)
    for tile, cells in beyond_tiles(lattice, HALO, rule, (_states(tiles), NO_VOTE), (adrift, False)).items():
        tiles[tile].overrule(cells, CellState.CHANGED_EMPTY)
        tiles[tile].weighed.gone[cells] = tiles[tile].here.occupied[cells]


def _drop_specks(tiles: Tiles, lattice: Lattice, min_cells: int) -> None:
    rule = partial(drop_specks, min_cells=min_cells)
    for tile, cells in beyond_tiles(lattice, min_cells, rule, (_states(tiles), NO_VOTE)).items():
        tiles[tile].states[cells] = CellState.UNDETERMINED


def _take_remnants(tiles: Tiles, lattice: Lattice) -> None:
    """A cell of which nothing is left is changed-empty, unless new hits lie next to what went: they may be what stands
    there, put beside it by an error of pose."""
    empty = int(CellState.CHANGED_EMPTY)
    loose = {tile: judged.weighed.loose for tile, judged in tiles.items()}
    base = {tile: judged.here.base for tile, judged in tiles.items()}
    gone = {t: np.where(judged.states == empty, judged.weighed.gone, np.uint64(0)) for t, judged in tiles.items()}
    for tile, left in beyond_tiles(lattice, HALO, remnants, (gone, 0), (loose, 0), (base, 0)).items():
        judged = tiles[tile]
        nothing_left = ((left | gone[tile]) == judged.here.occupied) & (left & judged.crowded == 0)
        judged.overrule((left != 0) & nothing_left & (judged.states != empty), CellState.CHANGED_EMPTY)
        down = judged.states == empty
        judged.weighed.gone[down] |= left[down]
        judged.remnants = np.where(down, np.uint64(0), left)


def unexplained(states: U8, beside: Bool, reach: int) -> Bool:
    """(rows, cols) cells of ``beside`` that rule C gives up: an error of pose puts hits next to what is mapped, and
    there alone. A new thing that touches an old one also stands where nothing explains it: the cells next to it that
    are ``reach`` cells or less from such a place belong to it."""
    changed = states == CellState.CHANGED_OCCUPIED
    return np.asarray(changed & ~flooded(changed & ~beside, changed, reach))


def _states(tiles: Tiles) -> dict[TileIndex, U8]:
    return {tile: judged.states for tile, judged in tiles.items()}


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
                    more = left & neighbourhood(reached, base, r, c, _BESIDE)
                    if more:
                        found[r, c] |= more
                        reached[r, c] |= more
                        grown = True
    return found


def drop_specks(states: U8, min_cells: int) -> Bool:
    """(rows, cols) changed cells whose 8-connected component of equal state has fewer than ``min_cells`` (rule G)."""
    there, gone = states == CellState.CHANGED_OCCUPIED, states == CellState.CHANGED_EMPTY
    return np.asarray(small_groups(there, min_cells) | small_groups(gone, min_cells))


def beside_new(planes: U64, occupied: U64, base: I32) -> U64:
    """(rows, cols) voxels in which, or next to which, something was struck where the map holds nothing."""
    struck = ever(planes, PLANES)
    return dilated(struck & ~occupied, base, 1)


def loose_voxels(planes: U64) -> U64:
    """(rows, cols) mapped voxels into which, or beside which within its own error, no hit ever fell, and through which
    rays went, as through the voxels above and below them: grazing a roof says nothing (rule A). The ground bounds the
    lowest, the end of the word the highest.
    """
    itself = planes[..., THROUGH_ITSELF]
    through = ever(planes, 0) | itself
    below, above = through << np.uint64(1) | _LOWEST, through >> np.uint64(1) | _HIGHEST
    return np.asarray(itself & ~planes[..., STRUCK_ITSELF] & below & above)
