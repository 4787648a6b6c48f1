"""The voter of surfaces: a drive is counted scan by scan, and judged at its end, one window of tiles after another.

Each changed cell carries its features. The vehicle's confidence in the cell follows from them: log-odds that the cell
did change, by its own evidence. Most cells that are wrongly called changed lie at the rim of a
true change, where centimetres decide which of two cells holds a surface. They are distinguished by the size of the
object, the number of neighbouring cells with the same change, the cell's share of the object beside its neighbours',
the height of a deleted object, and how deep in the cell the surface lies. The number of rays that crossed a deleted
object, and the rule that decided it, add nothing (docs/measurements/probability.md, which also describes the fit and
its calibration).
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from functools import partial, reduce

import numpy as np

from mapvote.codec.ballot import Planes, changed_cells_of
from mapvote.codec.planes import Words
from mapvote.config import Settings, VotingSettings
from mapvote.core.columns import EVERY_BIT
from mapvote.core.grid import CELL_SIZE, CELLS, TILE_CELLS, Grid, Lattice, TileIndex
from mapvote.core.groups import groups_of
from mapvote.core.point_map import PointMap
from mapvote.core.record import record
from mapvote.core.reference import above_ground_points, reference_window
from mapvote.core.sensors import Sensor
from mapvote.core.tile import Tile
from mapvote.core.types import F32, F64, I32, I64, NO_VOTE, U8, U64, Bool, CellState
from mapvote.perception.frontend import Observation
from mapvote.rules.evidence import (
    NO_VOXELS,
    SURFACE_RULE,
    Facts,
    SurfaceRule,
    count_scan,
    free_words,
    judge_window,
    weigh_voxels,
)
from mapvote.rules.packed_tiles import PackedTiles
from mapvote.rules.voter import Counted
from mapvote.rules.voxel_counts import VoxelCounts


@record(votes=True)
@dataclass(frozen=True, slots=True)
class JudgedBlocks:
    """Numbers of the windows in which a drive is judged at its end."""

    side_tiles: int = 2
    """Tiles along the side of a block: with the cells around it 60 MB at a time."""
    halo_cells: int = 96
    """Cells judged around a block, 29 m, a house and the space before it: objects across its edge are judged alike from
    both sides."""


JUDGED_BLOCKS = JudgedBlocks()


@record(votes=True)
@dataclass(frozen=True, slots=True)
class ChangeOdds:
    """The curve of a vehicle's log-odds that a cell did change; ``benchmarks/probability.py`` at 9f8814a fitted it.

    Coefficients: constant; the features of :func:`looks`; metres of depth (:func:`depths_m`).
    """

    most_cells: int = 200
    """Cells of an object that count at most."""
    most_height_m: float = 6.0
    """Height of a deleted object that counts at most."""
    built: tuple[float, ...] = (-4.104, 0.525, 3.454, 0.382, 0.0, 21.98)
    """Coefficients for changed-occupied, nats."""
    demolished: tuple[float, ...] = (-8.435, 0.982, 2.939, 0.689, 0.474, 22.654)
    """Coefficients for changed-empty, nats."""


CHANGE_ODDS = ChangeOdds()


def surface_voter(settings: Settings, sensor: Sensor, point_map: PointMap) -> SurfaceVoter:
    """The voter of ``SURFACES`` (core/rule.py); surfaces need no model of the sensor."""
    return SurfaceVoter(settings.voting, point_map)


class SurfaceVoter:
    """Surfaces: evidence per voxel over the drive, weighed at its end. Decides alone: its tally is one vote a cell."""

    def __init__(
        self,
        voting: VotingSettings,
        point_map: PointMap,
        rule: SurfaceRule = SURFACE_RULE,
        judged: JudgedBlocks = JUDGED_BLOCKS,
        odds: ChangeOdds = CHANGE_ODDS,
    ) -> None:
        self.voting = voting
        self.point_map = point_map
        self.rule = rule
        self.judged = judged
        self.odds = odds
        self.counts = VoxelCounts(point_map.lattice)

    def observe(self, seen: Observation) -> U64:
        """Count one scan; returns (rows, cols) words of voxels whose points may be new."""
        return count_scan(self.counts, seen, self.rule)

    def each(self, only: Collection[TileIndex] | None = None) -> Iterator[tuple[TileIndex, Counted]]:
        """Every tile with evidence, block by block; ``only``: of these tiles."""
        counted = self.counts.settled()
        wanted = counted if only is None else counted.keys() & set(only)
        for tiles, window in blocks(self.point_map.lattice, wanted, self.judged):
            yield from self._judge(counted, tiles, window)

    def _judge(self, counted: PackedTiles, tiles: list[TileIndex], window: Grid) -> Iterator[tuple[TileIndex, Counted]]:
        # The evidence of all tiles of the window, weighed by the map.
        here = reference_window(self.point_map, window)
        known_free = here.free if here.free is not None else above_ground_points(self.point_map, window)
        height_m = here.top_z - here.ground_z
        weighed = Facts.none(window.shape)
        free = {}
        for tile in window.tiles():
            if tile in counted:
                part = counted.overlap(tile, window)
                planes = counted.within(tile, part)
                weigh_voxels(planes, part, here.occupied, known_free, weighed, self.rule)
                if tile in tiles:
                    free[tile] = free_words(planes)
        states, gone, new = judge_window(weighed, here.occupied, height_m, self.voting.min_height_m, self.rule)
        # The votes of each tile of the block.
        amount = np.where(here.occupied != 0, np.bitwise_count(here.occupied), weighed.hits)
        mapped_free = here.free if here.free is not None else np.zeros_like(known_free)
        for tile in tiles:
            cut = self._cut(tile, window)
            if (states[cut] != NO_VOTE).any():
                own = np.ascontiguousarray(states[cut])
                upwards = None if here.free is None else here.free[cut]
                passed = np.where(mapped_free[cut] != 0, NO_VOXELS, free[tile] & ~here.occupied[cut])
                own_planes = Planes(states=own, gone=Words.of(gone[cut]), free=Words.of(passed))
                looked = looks(states, amount, height_m, cut, self.odds)
                new_here = _with_the_unknown(new[cut], weighed.beyond[cut], upwards)
                mapped = self.point_map.tiles.get(tile)
                yield tile, Counted(own_planes, new_here, partial(_log_odds_of, own, looked, mapped, self.odds))

    def _cut(self, tile: TileIndex, window: Grid) -> tuple[slice, slice]:
        return self.point_map.lattice.tile(tile).slices_in(window)


def blocks(
    lattice: Lattice, tiles: Iterable[TileIndex], judged: JudgedBlocks = JUDGED_BLOCKS
) -> Iterator[tuple[list[TileIndex], Grid]]:
    """Tiles that are judged together, each tile once, and the window in which they are judged."""
    every = sorted(tiles)
    side = judged.side_tiles
    for row, col in sorted({(r // side, c // side) for r, c in every}):
        inner = [t for t in every if (t[0] // side, t[1] // side) == (row, col)]
        yield inner, reduce(Grid.union, map(lattice.tile, inner)).padded(judged.halo_cells)


def _with_the_unknown(new: U64, beyond: U64, free: U64 | None) -> U64:
    """(rows, cols) the voxels ``new`` of each cell, those hit ``beyond`` what the map knew, and the
    upper parts that the map does not know to be ``free``."""
    below_top = new.copy()
    for shift in (1, 2, 4, 8, 16, 32):
        below_top |= below_top >> np.uint64(shift)
    return np.where(new != 0, new | beyond | ~(below_top | (EVERY_BIT if free is None else free)), NO_VOXELS)


N_FEATURES = 4
"""Features of :func:`looks`."""
_NEIGHBOURS = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]


def looks(states: U8, amount: I32, height_m: F32, tile: tuple[slice, slice], odds: ChangeOdds = CHANGE_ODDS) -> F64:
    """(m, N_FEATURES) features of the cells of one ``tile`` of a window that its ``states`` call changed, ascending.

    The features of a cell: ln(1 + cells of its 8-connected object); the share of its eight neighbours with the same
    state; ln(1 + its amount) - ln(1 + the largest amount of these neighbours), where ``amount`` is the number of mapped
    voxels, or of hits of new ones; the height of the map in the cell (``height_m``) if it is changed-empty, else 0. The
    planes (rows, cols) of the window reach a cell or more beyond the tile.
    """
    cells = changed_cells_of(np.ascontiguousarray(states[tile]))
    rows = cells // TILE_CELLS + tile[0].start
    cols = cells % TILE_CELLS + tile[1].start
    out = np.zeros((len(cells), N_FEATURES))
    for state in (CellState.CHANGED_OCCUPIED, CellState.CHANGED_EMPTY) if len(cells) else ():
        of_state = states[rows, cols] == state
        alike = states == state
        sizes, neighbours, share = _features_of_objects(alike, amount, rows[of_state], cols[of_state])
        height = np.minimum(np.nan_to_num(height_m[rows[of_state], cols[of_state]]), odds.most_height_m)
        rises = height if state == CellState.CHANGED_EMPTY else np.zeros(len(height))
        large = np.log1p(np.minimum(sizes, odds.most_cells))
        out[of_state] = np.column_stack([large, neighbours / len(_NEIGHBOURS), share, rises])
    return out


def _features_of_objects(alike: Bool, amount: I32, rows: I64, cols: I64) -> tuple[I64, I64, F64]:
    """For the cells (n,): the size of their 8-connected group of ``alike``, the number of their eight neighbours in
    ``alike``, and ln(1 + their amount) - ln(1 + the largest amount of these)."""
    group = groups_of(alike.astype(np.uint64), 1, rows, cols)
    sizes = np.bincount(group.ravel())[group[rows, cols]]
    amount_alike = np.where(alike, amount, 0)
    beside = np.stack([alike[rows + i, cols + j] for i, j in _NEIGHBOURS])
    most = np.max([amount_alike[rows + i, cols + j] for i, j in _NEIGHBOURS], axis=0)
    return sizes, beside.sum(axis=0), np.log1p(amount_alike[rows, cols]) - np.log1p(most)


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


def _log_odds_of(states: U8, looked: F64, mapped: Tile | None, odds: ChangeOdds, new_points: F32) -> F64:
    """(m,) :func:`log_odds` of the cells that ``states`` (256, 256) call changed, ascending."""
    changes = states.reshape(-1)[changed_cells_of(states)]
    return log_odds(changes, looked, depths_m(states, mapped, new_points), odds)


def log_odds(states: U8, looked: F64, depth_m: F64, odds: ChangeOdds = CHANGE_ODDS) -> F64:
    """(n,) log-odds, nats, that cells with ``states`` (n,), CHANGED_OCCUPIED or CHANGED_EMPTY, did change.
    ``looked`` (n, k): the features of :func:`looks`; ``depth_m`` (n,): see :func:`depths_m`."""
    built = (states == CellState.CHANGED_OCCUPIED)[:, None]
    curve = np.where(built, np.array(odds.built), np.array(odds.demolished))
    features = np.column_stack([np.ones(len(states)), looked, depth_m])
    return np.asarray((curve * features).sum(axis=1))
