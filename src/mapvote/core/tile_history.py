"""The history of a tile: when each cell last changed, and the objects that appeared and disappeared there."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mapvote.core.grid import CELLS, TILE_CELLS
from mapvote.core.types import I64

U32 = NDArray[np.uint32]
PLANES = 4


@dataclass(frozen=True)
class Memory:
    """Of the cells of which there is anything to remember, for they are few; of all others every value is zero."""

    cells: I64
    """(n,) flat, ascending."""
    values: U32
    """(4, n) of each cell what the four planes below hold; never all zero."""

    @classmethod
    def none(cls) -> Memory:
        """Of a tile that is as it was surveyed."""
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
        """(4, m) what is remembered of flat ``cells`` (m,), in any order."""
        found = np.zeros((PLANES, len(cells)), dtype=np.uint32)
        if len(self.cells):
            near = np.minimum(np.searchsorted(self.cells, cells), len(self.cells) - 1)
            known = self.cells[near] == cells
            found[:, known] = self.values[:, near[known]]
        return found

    def but(self, cells: I64, values: U32) -> Memory:
        """The same, but of flat ``cells`` (m,), ascending, these ``values`` (4, m)."""
        joined, planes, at = self._joined(cells)
        planes[:, at] = values
        return _sparse(joined, planes, sure=bool(values.any(axis=0).all()))

    def with_changed(self, cells: I64, version: int) -> Memory:
        """The same, but flat ``cells`` (m,), ascending, changed in ``version``."""
        joined, planes, at = self._joined(cells)
        planes[0, at] = version
        return _sparse(joined, planes, sure=version > 0)

    def _joined(self, cells: I64) -> tuple[I64, U32, I64]:
        """(own cells and ``cells`` (m,), (n,) ascending; their values (4, n), zero where they are new; which of all
        each of ``cells`` is (m,))."""
        named = np.zeros(CELLS, dtype=np.bool_)  # np.union1d takes four times as long, nonzero of numbers ten times
        named[self.cells] = named[cells] = True
        joined = np.flatnonzero(named)
        planes = np.zeros((PLANES, len(joined)), dtype=np.uint32)
        planes[:, np.searchsorted(joined, self.cells)] = self.values
        return joined, planes, np.searchsorted(joined, cells)


def _sparse(cells: I64, values: U32, sure: bool) -> Memory:
    """A memory of cells (n,) of which some values (4, n) may be all zero, unless one is ``sure`` that none are."""
    if sure:
        return Memory(cells, values)
    kept = np.flatnonzero(values.any(axis=0))
    return Memory(cells[kept], values[:, kept])
