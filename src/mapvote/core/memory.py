"""What a tile remembers of itself: when each cell last changed, and what came and went there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapvote.core.grid import TILE_CELLS
from mapvote.core.types import Bool

U32 = NDArray[np.uint32]
PLANES = 4


@dataclass(frozen=True)
class Memory:
    """One plane each, stacked (4, 256, 256) uint32, so that they are stored as one. All zero: nothing ever changed."""

    planes: U32

    @classmethod
    def none(cls) -> Memory:
        """Of a tile that is as it was surveyed."""
        return cls(np.zeros((PLANES, TILE_CELLS, TILE_CELLS), dtype=np.uint32))

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
        """(256, 256) how many things came here and went again."""
        return self.planes[2]

    @property
    def stayed_s(self) -> U32:
        """(256, 256) how long they stayed, all together, seconds."""
        return self.planes[3]

    def with_changed(self, cells: Bool, version: int) -> Memory:
        """The same, but ``cells`` (256, 256) changed in ``version``."""
        planes = self.planes.copy()
        planes[0][cells] = version
        return Memory(planes)

    @classmethod
    def first_change(cls, cells: Bool, version: int) -> Memory:
        """Of a tile that remembered nothing until ``cells`` (256, 256) changed in ``version``."""
        memory = cls.none()
        memory.planes[0][cells] = version
        return memory
