"""A tile of the map: its points know their cells, its columns their base, and it remembers when each cell changed and
which objects appeared and disappeared there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapvote.core.columns import base_layers, column_bits, flat_cells, mark_obstacles
from mapvote.core.grid import CELLS, TILE_CELLS, Grid, TileIndex
from mapvote.core.points import Fields, point_fields
from mapvote.core.types import F32, F64, I32, I64, U32, U64, Bool, check_array, read_only

PLANES = 4
"""Planes of a tile's memory."""


@dataclass(frozen=True)
class Memory:
    """Memory of the cells that have any, for they are few; in all others every value is zero."""

    cells: I64
    """(n,) flat, ascending."""
    values: U32
    """(4, n) of each cell what the four planes below hold; never all zero."""

    @classmethod
    def none(cls) -> Memory:
        """The memory of a tile that never changed since its survey."""
        return cls(np.empty(0, dtype=np.int64), np.empty((PLANES, 0), dtype=np.uint32))

    @classmethod
    def of(cls, planes: U32) -> Memory:
        """From planes (4, 256, 256)."""
        flat = planes.reshape(PLANES, CELLS)
        cells = np.flatnonzero(flat.any(axis=0))
        return cls(cells, flat[:, cells])

    @cached_property
    def planes(self) -> U32:
        """(4, 256, 256) the planes below, one after another."""
        flat = np.zeros((PLANES, CELLS), dtype=np.uint32)
        flat[:, self.cells] = self.values
        return flat.reshape(PLANES, TILE_CELLS, TILE_CELLS)

    @property
    def changed(self) -> U32:
        """(256, 256) the version of each cell's last change; 0: none since the map's first version. A vote counts on
        a cell if its vehicle drove with a version that is not older."""
        return self.planes[0]

    @property
    def came_s(self) -> U32:
        """(256, 256) when what vehicles put here was first seen, seconds since 1970; 0: surveyed, or nothing there."""
        return self.planes[1]

    @property
    def stays(self) -> U32:
        """(256, 256) how many objects appeared here and disappeared again."""
        return self.planes[2]

    @property
    def stayed_s(self) -> U32:
        """(256, 256) how long they stayed, all together, seconds."""
        return self.planes[3]

    @property
    def brought(self) -> I64:
        """(m,) flat cells that hold what vehicles put there."""
        return self.cells[self.values[1] > 0]

    def changed_after(self, version: int) -> I64:
        """(m,) flat cells that changed after ``version``."""
        return self.cells[self.values[0] > version]

    def at(self, cells: I64) -> U32:
        """(4, m) memory of flat ``cells`` (m,), in any order."""
        values = np.zeros((PLANES, len(cells)), dtype=np.uint32)
        if len(self.cells):
            near = np.minimum(np.searchsorted(self.cells, cells), len(self.cells) - 1)
            present = self.cells[near] == cells
            values[:, present] = self.values[:, near[present]]
        return values

    def but(self, cells: I64, values: U32) -> Memory:
        """The same, but of flat ``cells`` (m,), ascending, these ``values`` (4, m)."""
        named = np.zeros(CELLS, dtype=np.bool_)  # np.union1d takes four times as long, nonzero of numbers ten times
        named[self.cells] = named[cells] = True
        joined = np.flatnonzero(named)
        planes = np.zeros((PLANES, len(joined)), dtype=np.uint32)
        planes[:, np.searchsorted(joined, self.cells)] = self.values
        planes[:, np.searchsorted(joined, cells)] = values
        kept = np.flatnonzero(planes.any(axis=0))
        return Memory(joined[kept], planes[:, kept])

    def with_changed(self, cells: I64, version: int) -> Memory:
        """The same, but flat ``cells`` (m,), ascending, changed in ``version``."""
        values = self.at(cells)
        values[0] = version
        return self.but(cells, values)


@dataclass(frozen=True, repr=False)
class Tile:
    """76.8 m x 76.8 m of map. ``points`` are the product; the planes hold ground and free space.

    Edited tiles are new tiles (``dataclasses.replace``): nothing here ever changes, so what follows from the points is
    worked out once.
    """

    window: Grid
    points: F32
    """(n, 3): x, y from the window's lower-left corner, z in map metres."""
    ground_z: F32
    """(256, 256) height of the ground, map metres; NaN where unknown. Fixed when the map is first built."""
    free: U64 | None = None
    """(256, 256) column words of voxels known to be free (see core.columns), or None if never learned."""
    memory: Memory | None = None
    """When each cell last changed; None: not since the map's first version."""
    fields: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    """Columns (n,) that came with the points of an imported map: intensity, red, classification, gps_time ..."""

    def __post_init__(self) -> None:
        check_array(self.points, "Tile.points", (None, 3), np.float32)
        check_array(self.ground_z, "Tile.ground_z", self.window.shape, np.float32, finite=False)
        if self.free is not None:
            check_array(self.free, "Tile.free", self.window.shape, np.uint64)
        for name, column in self.fields.items():
            if column.shape != (len(self.points),):
                raise ValueError(f"Tile.fields[{name!r}] is {column.shape}, but there are {len(self.points)} points")
        for name in ("points", "ground_z", "free"):
            plane = self.__dict__[name]
            self.__dict__[name] = plane if plane is None else read_only(plane)

    def __repr__(self) -> str:
        row, col = self.index
        return f"Tile({row}, {col}: {len(self.points):,} points)"

    @classmethod
    def empty(cls, window: Grid) -> Tile:
        """A tile where the map has nothing: no points, ground unknown."""
        return cls(window, np.empty((0, 3), dtype=np.float32), np.full(window.shape, np.nan, dtype=np.float32))

    def __reduce__(self) -> tuple[Any, ...]:
        """Computed values are not sent to other processes."""
        return Tile, (self.window, self.points, self.ground_z, self.free, self.memory, self.fields)

    def but(self, **planes: Any) -> Tile:
        """The tile with other ``planes``; values computed from the planes that stay are kept."""
        # The planes that each computed value follows from.
        sources = {
            "cells": {"points"},
            "base": {"ground_z"},
            "has_ground": {"ground_z"},
            "columns": {"points", "ground_z"},
            "obstacle_words": {"points", "ground_z"},
        }
        other = object.__new__(Tile)
        stays = (name for name in self.__dict__ if not sources.get(name, set()) & planes.keys())
        other.__dict__.update({name: self.__dict__[name] for name in stays}, **planes)
        other.__post_init__()
        return other

    def without(self, dropped: Bool) -> Tile:
        """The tile without some of its points (n,); the others keep their fields."""
        left = np.flatnonzero(~dropped)
        fields = {name: column.take(left) for name, column in self.fields.items()}
        return self.but(points=self.points.take(left, axis=0), fields=fields)

    def with_new(self, points: F32, sent: Fields | None = None) -> Tile:
        """The tile with more points (m, 3) after its own.

        Attributes ``sent`` (m,), as in ballots, go into the fields of their names; every other field is 0.
        """
        check_array(points, "Tile.points", (None, 3), np.float32)
        fields = {}
        for name, column in self.fields.items():
            row = point_fields().get(name)
            new = np.zeros(len(points), dtype=column.dtype)
            if row is not None:
                values = sent[name] if sent and name in sent else row.unknown(len(points))
                new = row.in_map(values, column)
            fields[name] = np.concatenate([column, new])
        return self.but(points=np.concatenate([self.points, points]), fields=fields)

    @property
    def index(self) -> TileIndex:
        """(row, col) of the tile."""
        return self.window.tile_index

    @property
    def points_map(self) -> F64:
        """(n, 3) the points in map metres."""
        return self.window.to_map(self.points)

    @cached_property
    def cells(self) -> I64:
        """(n,) flat cell of each point."""
        return flat_cells(self.window, self.points)

    @cached_property
    def base(self) -> I32:
        """(256, 256) lattice layer of bit 0 of each column, see :func:`mapvote.core.columns.base_layers`."""
        return base_layers(self.ground_z)

    @cached_property
    def has_ground(self) -> bool:
        """Whether the ground is known anywhere in it; if not, the start of its columns is unknown."""
        return bool(np.isfinite(self.ground_z).any())

    @cached_property
    def columns(self) -> tuple[I64, Bool]:
        """(bit of its column word (n,), is it an obstacle (n,)) of each point."""
        ground = self.ground_z.reshape(-1)[self.cells]
        base = self.base.reshape(-1)[self.cells]
        return column_bits(self.points[:, 2].astype(np.float64), ground, base)

    @cached_property
    def obstacle_words(self) -> U64:
        """(256, 256) column words of the obstacle points."""
        words = np.zeros(self.window.shape, dtype=np.uint64)
        mark_obstacles(words, self.points, self.window, self.window, self.ground_z, self.base)
        return words
