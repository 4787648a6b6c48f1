"""The voter of surfaces: a drive is counted scan by scan, and judged at its end, one window of tiles after another.

With its states go the looks of each cell that it calls changed. The vehicle's confidence in the cell follows from them:
log-odds that the cell did change, by its own evidence. Most cells that are wrongly called changed lie at the rim of a
true change, where centimetres decide which of two cells holds a surface. They are distinguished by the size of the
object, the number of neighbouring cells with the same change, the cell's share of the object beside its neighbours',
the height of a deleted object, and how deep in the cell the surface lies. The number of rays that crossed a deleted
object, and the rule that decided it, add nothing (docs/measurements/probability.md, which also describes the fit and
its calibration).
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from functools import reduce

import numpy as np
from scipy import ndimage

from mapvote.codec.ballot import changed_cells_of
from mapvote.config import Settings, VotingSettings
from mapvote.core.columns import EVERY_BIT
from mapvote.core.grid import CELL_SIZE, CELLS, TILE_CELLS, Grid, Lattice, TileIndex
from mapvote.core.point_map import PointMap
from mapvote.core.reference import above_ground_points, reference_window
from mapvote.core.sensors import Sensor
from mapvote.core.tile import Tile
from mapvote.core.types import F32, F64, I32, I64, NO_VOTE, U8, U64, Bool, CellState
from mapvote.core.voting import one_hot
from mapvote.perception.frontend import Observation
from mapvote.rules.evidence import NOTHING, WORDS, Facts, count_scan, free_words, judge_window, weigh_voxels
from mapvote.rules.packed_tiles import PackedTiles
from mapvote.rules.voter import TileVotes

_BLOCK = 2
"""Tiles along the side of a block: with the cells around it 60 MB at a time."""
HALO = 96
"""Cells around a block that are judged along, so that what lies across its edge is judged alike from both sides: 29 m,
a house and what stands before it."""


def surface_voter(settings: Settings, sensor: Sensor, point_map: PointMap) -> SurfaceVoter:
    """The voter of ``SURFACES`` (core/rule.py); surfaces need no model of the sensor."""
    return SurfaceVoter(settings.voting, point_map)


class SurfaceVoter:
    """Surfaces: evidence per voxel over the drive, weighed at its end. Decides alone: its tally is one vote a cell."""

    def __init__(self, voting: VotingSettings, point_map: PointMap) -> None:
        self.voting, self.point_map = voting, point_map
        self.evidence = PackedTiles(point_map.lattice, WORDS)

    def observe(self, seen: Observation) -> U64:
        """Count one scan; returns (rows, cols) words of voxels whose points may be new."""
        return count_scan(self.evidence, seen)

    def each(self, only: Collection[TileIndex] | None = None) -> Iterator[tuple[TileIndex, TileVotes]]:
        """Every tile with evidence, block by block; ``only``: of these tiles."""
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


LOOKS = 4
MOST_CELLS = 200
"""Sizes of objects are cut here."""
MOST_HEIGHT_M = 6.0
_BESIDE = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]
# By benchmarks/probability.py at 9f8814a.
_BUILT = np.array([-4.104, 0.525, 3.454, 0.382, 0.0, 21.98])
_DEMOLISHED = np.array([-8.435, 0.982, 2.939, 0.689, 0.474, 22.654])
"""Coefficients of the log-odds: constant; the LOOKS features of the cell; metres of depth."""


def looks(states: U8, amount: I32, height_m: F32, tile: tuple[slice, slice]) -> F64:
    """(m, LOOKS) features of the cells of one ``tile`` of a window that its ``states`` call changed, ascending.

    The features of a cell: ln(1 + cells of its 8-connected object); the share of its eight neighbours with the same
    state; ln(1 + its amount) - ln(1 + the largest amount of these neighbours), where ``amount`` is the number of mapped
    voxels, or of hits of new ones; the height of the map in the cell (``height_m``) if it is changed-empty, else 0. The
    planes (rows, cols) of the window reach a cell or more beyond the tile.
    """
    cells = changed_cells_of(np.ascontiguousarray(states[tile]))
    rows, cols = cells // TILE_CELLS + tile[0].start, cells % TILE_CELLS + tile[1].start
    out = np.zeros((len(cells), LOOKS))
    for state in (CellState.CHANGED_OCCUPIED, CellState.CHANGED_EMPTY) if len(cells) else ():
        mine = states[rows, cols] == state
        alike = states == state
        sizes, around_it, share = _of_things(alike, amount, rows[mine], cols[mine])
        height = np.minimum(np.nan_to_num(height_m[rows[mine], cols[mine]]), MOST_HEIGHT_M)
        rises = height if state == CellState.CHANGED_EMPTY else np.zeros(len(height))
        out[mine] = np.column_stack([np.log1p(np.minimum(sizes, MOST_CELLS)), around_it / len(_BESIDE), share, rises])
    return out


def _of_things(alike: Bool, amount: I32, rows: I64, cols: I64) -> tuple[I64, I64, F64]:
    """For the cells (n,): the size of their 8-connected group of ``alike``, the number of their eight neighbours in
    ``alike``, and ln(1 + their amount) - ln(1 + the largest amount of these)."""
    group, _ = ndimage.label(alike, structure=np.ones((3, 3)))
    sizes = np.bincount(group.ravel())[group[rows, cols]]
    mine = np.where(alike, amount, 0)
    beside = np.stack([alike[rows + i, cols + j] for i, j in _BESIDE])
    most = np.max([mine[rows + i, cols + j] for i, j in _BESIDE], axis=0)
    return sizes, beside.sum(axis=0), np.log1p(mine[rows, cols]) - np.log1p(most)


def depths_m(states: U8, mapped: Tile | None, new_points: F32) -> F64:
    """(m,) metres: how deep the surface lies in each cell that ``states`` (256, 256) call changed: the largest distance
    of one of its points from the nearest side of the cell. The points are the map's obstacles in a changed-empty cell
    and ``new_points`` (n, 3), from the tile's corner, in a changed-occupied one; 0 without any."""
    cells = changed_cells_of(states)
    out = _deepest_m(new_points)[cells]
    if mapped is not None:
        gone = states.reshape(-1)[cells] == CellState.CHANGED_EMPTY
        out[gone] = _deepest_m(mapped.points[mapped.columns[1]])[cells[gone]]
    return out


def _deepest_m(points: F32) -> F64:
    """(65536,) metres: the largest distance from the nearest side of its cell of points (n, 3) from a tile's corner."""
    deep = np.zeros(CELLS)
    places = points[:, :2].astype(np.float64) / CELL_SIZE
    cell = np.clip(np.floor(places), 0, TILE_CELLS - 1)
    within = places - cell
    flat = (cell[:, 1] * TILE_CELLS + cell[:, 0]).astype(np.int64)
    np.maximum.at(deep, flat, CELL_SIZE * np.minimum(within, 1.0 - within).min(axis=1))
    return deep


def log_odds(states: U8, looked: F64, depth_m: F64) -> F64:
    """(n,) log-odds, nats, that cells with ``states`` (n,), CHANGED_OCCUPIED or CHANGED_EMPTY, did change.
    ``looked`` (n, k): the features of :func:`looks`; ``depth_m`` (n,): see :func:`depths_m`."""
    curve = np.where((states == CellState.CHANGED_OCCUPIED)[:, None], _BUILT, _DEMOLISHED)
    features = np.column_stack([np.ones(len(states)), looked, depth_m])
    return np.asarray((curve * features).sum(axis=1))
