"""The partial reference map R_i around a vehicle (paper III-A): the map as planes over one window."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields
from itertools import repeat
from typing import Any

import numpy as np

from mapvote.core.columns import base_layers, fill_columns
from mapvote.core.grid import TILE_CELLS, Grid, TileIndex, window_around
from mapvote.core.point_map import PointMap
from mapvote.core.types import F64, U64, Reference

Layout = Iterator[Reference | None]
"""The planes of a window on their way: each step takes a few milliseconds at most, the last one gives them."""


def reference_window(point_map: PointMap, grid: Grid) -> Reference:
    """The map's planes over ``grid`` (any window; what lies outside every tile is unknown and empty)."""
    return _finished(_laid_out(point_map, grid))


def _finished(layout: Layout) -> Reference:
    return next(filter(None, layout))


def _laid_out(point_map: PointMap, grid: Grid) -> Layout:
    ground_z = np.full(grid.shape, np.nan, dtype=np.float32)
    free = np.zeros(grid.shape, dtype=np.uint64)
    tiles = [point_map.tiles[index] for index in grid.tiles() if index in point_map.tiles]
    for tile in tiles:
        common = tile.window.intersection(grid)
        ground_z[common.slices_in(grid)] = tile.ground_z[common.slices_in(tile.window)]
        if tile.free is not None:
            free[common.slices_in(grid)] = tile.free[common.slices_in(tile.window)]
    yield None
    base = base_layers(ground_z)
    yield None
    for tile in tiles:
        if tile.has_ground:  # by the tile alone, so that every editor of the tile reads the words as they were written
            common = tile.window.intersection(grid)
            base[common.slices_in(grid)] = tile.base[common.slices_in(tile.window)]
    occupied = np.zeros(grid.shape, dtype=np.uint64)
    counts = np.zeros(grid.shape, dtype=np.int32)
    bottom_z = np.full(grid.shape, np.inf, dtype=np.float32)
    top_z = np.full(grid.shape, -np.inf, dtype=np.float32)
    for tile in tiles:
        yield None
        rows, cols, _ = grid.indices_of(tile.points_map)
        z = tile.points[:, 2].astype(np.float64)
        fill_columns(rows, cols, z, ground_z, base, occupied, counts, bottom_z, top_z)
    free_words = free if any(t.free is not None for t in tiles) else None
    yield Reference(grid, ground_z, base, occupied, counts, bottom_z, top_z, free_words)


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
    seen[1:-1] |= seen[:-2] | seen[2:]
    near = seen[1:-1, :-2] | seen[1:-1, 1:-1] | seen[1:-1, 2:]
    return np.where(near, ~np.uint64(0), np.uint64(0))


class LocalMap:
    """The reference around a moving vehicle: arrays over the tiles around it, made anew only when it has left them.

    The next one is made step by step, one step per call, while the vehicle drives through the tile
    that will be its middle.
    """

    def __init__(self, point_map: PointMap, window_m: float) -> None:
        self.point_map = point_map
        self.window_m = window_m
        self.outer: Reference | None = None
        """The planes made last; windows are views into them."""
        self._middle: TileIndex | None = None
        self._next: tuple[TileIndex, Layout] | None = None
        """Another middle, and its planes on their way."""

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
            done = next(ahead)
            self._next = middle, ahead if done is None else repeat(done)
        return _cut(self.outer, window), self.outer

    def _ahead(self, middle: TileIndex, window: Grid) -> Layout:
        if self._next is not None and self._next[0] == middle:
            return self._next[1]
        return _laid_out(self.point_map, self.point_map.lattice.tile(middle).padded(max(TILE_CELLS, window.rows)))


def _cut(outer: Reference, window: Grid) -> Reference:
    """The planes of ``outer`` over ``window``, which lies inside it: views, but for those whose cells points and rays
    find by one number."""
    cut = window.slices_in(outer.grid)
    planes = {f.name: getattr(outer, f.name) for f in fields(Reference) if f.name != "grid"}
    views: dict[str, Any] = {name: None if plane is None else plane[cut] for name, plane in planes.items()}
    by_number = {name: np.ascontiguousarray(views[name]) for name in ("ground_z", "base")}
    return Reference(window, **views | by_number)
