"""The partial reference map R_i around a vehicle (paper III-A): the map as planes over one window."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice, repeat

import numpy as np

from mapvote.core.columns import fill_base, mark_obstacles
from mapvote.core.grid import TILE_CELLS, Grid, TileIndex, window_around
from mapvote.core.groups import widened
from mapvote.core.point_map import PointMap
from mapvote.core.record import record
from mapvote.core.types import F64, U64, Reference

Layout = Iterator[Reference | None]
"""The planes of a window on their way: each step takes a few milliseconds at most, the last one gives them."""


@record()
@dataclass(frozen=True, slots=True)
class LayoutSteps:
    """Numbers of the laying-out of planes, which is spread over scans."""

    band_rows: int = 64
    """Rows of the start of columns in a step: some tenths of a millisecond for a window of three tiles."""
    beyond_cells: int = 68
    """Cells that the vehicle drives beyond its middle tile before it needs the next planes."""
    cells: int = 1
    """Cells that the vehicle drives for each step after the first of a scan. A layout has 30 to 60 steps, more where
    more tiles lie around."""


LAYOUT_STEPS = LayoutSteps()


def reference_window(point_map: PointMap, grid: Grid) -> Reference:
    """The map's planes over ``grid`` (any window; what lies outside every tile is unknown and empty)."""
    return _finished(_laid_out(point_map, grid, replace(LAYOUT_STEPS, band_rows=grid.rows)))


def _finished(layout: Layout) -> Reference:
    return next(filter(None, layout))


def _laid_out(point_map: PointMap, grid: Grid, steps: LayoutSteps, measured: bool = True) -> Layout:
    # Ground and free space, tile by tile: reading a tile may unpack it.
    ground_z = np.full(grid.shape, np.nan, dtype=np.float32)
    free = np.zeros(grid.shape, dtype=np.uint64)
    tiles = []
    for index in grid.tiles():
        if index not in point_map.tiles:
            continue
        yield None
        tile = point_map.tiles[index]
        tiles.append(tile)
        common = tile.window.intersection(grid)
        ground_z[common.slices_in(grid)] = tile.ground_z[common.slices_in(tile.window)]
        if tile.free is not None:
            free[common.slices_in(grid)] = tile.free[common.slices_in(tile.window)]
    # The start of each column: by the tile alone where it has ground, so that every editor of the tile reads the words
    # as they were written.
    base = np.zeros(grid.shape, dtype=np.int32)
    occupied = np.zeros(grid.shape, dtype=np.uint64)
    scratch = occupied.view(np.float64)  # pages of another plane would take longer than to clear this one
    for _ in fill_base(ground_z, base, steps.band_rows, scratch):
        yield None
    for tile in tiles:
        if tile.has_ground:
            common = tile.window.intersection(grid)
            base[common.slices_in(grid)] = tile.base[common.slices_in(tile.window)]
            yield None
    # The obstacles in each column.
    occupied.fill(0)
    yield None
    free_words = free if any(t.free is not None for t in tiles) else None
    none = np.broadcast_to(np.int32(0), grid.shape)  # planes of one value take no memory
    low, high = (np.broadcast_to(np.float32(z), grid.shape) for z in (np.inf, -np.inf))
    planes = Reference(grid, ground_z, base, occupied, none, low, high, free_words)
    if measured:
        planes = replace(planes, counts=none.copy(), bottom_z=low.copy(), top_z=high.copy())
    measures = (planes.counts, planes.bottom_z, planes.top_z) if measured else None
    for tile in tiles:
        yield None
        mark_obstacles(occupied, tile.points, tile.window, grid, ground_z, base, measures)
    yield planes


def above_ground_points(point_map: PointMap, grid: Grid) -> U64:
    """(rows, cols) all bits where the map holds a ground point in the cell or next to it, else none.

    A substitute for the known-free columns of a map without them: the rays that measured the ground there passed the
    air above it, so an obstacle would most likely be in the map. Where there is no ground point, this is unknown.
    """
    wide = grid.padded(1)
    seen = np.zeros(wide.shape, dtype=np.bool_)
    for index in wide.tiles():
        if index in point_map.tiles:
            tile = point_map.tiles[index]
            rows, cols, here = wide.indices_of(tile.points_map[~tile.columns[1]])
            seen[rows[here], cols[here]] = True
    return np.where(widened(seen, 1)[1:-1, 1:-1], ~np.uint64(0), np.uint64(0))


class LocalMap:
    """The reference around a moving vehicle: arrays over the tiles around it, made anew only when it has left them.

    The next one is made step by step while the vehicle drives through the tile that will be its middle: so many steps
    per call as the cells that it drove, so that it is there before the vehicle needs it, at any speed.
    """

    def __init__(
        self, point_map: PointMap, window_m: float, steps: LayoutSteps = LAYOUT_STEPS, *, measured: bool = True
    ) -> None:
        """``measured``: count the obstacle points of each cell and measure their heights, too; else these three planes
        say that there are none. They take a third of the memory, and half of the time."""
        self.point_map = point_map
        self.window_m = window_m
        self.measured = measured
        self.steps = steps
        self.outer: Reference | None = None
        """The planes made last; windows are views into them."""
        self._middle: TileIndex | None = None
        self._next: tuple[TileIndex, Layout] | None = None
        """Another middle, and its planes on their way."""
        self._place = 0, 0
        """Row and column of the last call."""

    def on(self, point_map: PointMap) -> LocalMap:
        """The same on another map."""
        return LocalMap(point_map, self.window_m, self.steps, measured=self.measured)

    def at(self, origin_map: F64) -> tuple[Reference, Reference]:
        """(the partial reference map R_i, ``window_m`` wide around ``origin_map`` (3,); the planes it is cut from)."""
        lattice = self.point_map.lattice
        window = window_around(lattice, origin_map[0], origin_map[1], self.window_m)
        row = window.row0 + window.rows // 2
        col = window.col0 + window.cols // 2
        middle = row // TILE_CELLS, col // TILE_CELLS
        if self.outer is None or window.intersection(self.outer.grid) != window:
            self.outer = _finished(self._ahead(middle, window))
            self._middle = middle
            self._next = None
        elif middle != self._middle:
            ahead = self._ahead(middle, window)
            driven = max(abs(row - self._place[0]), abs(col - self._place[1]))
            done = next(filter(None, islice(ahead, 1 + driven // self.steps.cells)), None)
            self._next = middle, ahead if done is None else repeat(done)
        self._place = row, col
        return _cut(self.outer, window), self.outer

    def _ahead(self, middle: TileIndex, window: Grid) -> Layout:
        if self._next is not None and self._next[0] == middle:
            return self._next[1]
        beside = self.steps.beyond_cells + (window.rows + 1) // 2
        around = self.point_map.lattice.tile(middle).padded(beside)
        return _laid_out(self.point_map, around, self.steps, self.measured)


def _cut(outer: Reference, window: Grid) -> Reference:
    """The planes of ``outer`` over ``window``, which lies inside it: views, but for those whose cells points and rays
    find by one number."""
    cut = window.slices_in(outer.grid)
    return Reference(
        window,
        outer.ground_z[cut].copy(),
        outer.base[cut].copy(),
        outer.occupied[cut],
        outer.counts[cut],
        outer.bottom_z[cut],
        outer.top_z[cut],
        None if outer.free is None else outer.free[cut],
    )
