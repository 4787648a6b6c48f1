"""Point clouds as pages draw them: a tile's points in levels of detail, packed into bytes.

Any prefix of a tile's levels is an even, thinner picture of the tile. Each point belongs to the coarsest level in whose
voxels it is the tile's first; within a level the order is random, and the same on every run. Levels are added to one
another, so nothing is sent twice (Potree's additive levels, Schuetz 2016, on our tiles instead of an octree: a tile is
one node, whose parts are its levels).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapvote.core.grid import CELL_SIZE, TILE_CELLS, TileIndex
from mapvote.core.kernel import kernel
from mapvote.core.record import record
from mapvote.core.tile import Tile
from mapvote.core.types import F32, F64, I64, U8, U16, Bool
from mapvote.core.voxels import found_among

SPACINGS_M = (4.8, 2.4, 1.2, 0.6, 0.3)
"""Voxel side of each level; one more level takes the other points."""
N_LEVELS = len(SPACINGS_M) + 1
SIDE_M = TILE_CELLS * CELL_SIZE
_STEPS = 65535


@record()
@dataclass(frozen=True, slots=True)
class LayerRule:
    """Heights of a packed cloud."""

    least_z_step_m: float = 0.002
    """Least step of a height, metres."""
    layers: int = 512
    """Number of voxel layers: all heights above share the last one."""


LAYER_RULE = LayerRule()


@dataclass(frozen=True, slots=True)
class Levels:
    """One tile's points, coarse first."""

    packed: U16
    """(n, 4): x and y from the tile's corner in 1/65535 of its side, z in ``z_step_m`` from ``z0_m``, and centimetres
    above ground plus 1000."""
    ends: I64
    """(6,) where each level ends."""
    z0_m: float
    z_step_m: float
    bright: U8 | None = None
    """(n,) intensity of each point, 255 for 1.0; None if the map has none."""

    def part(self, level: int) -> bytes:
        """One level as :func:`cloud_bytes`, then the intensity of each point, a byte, if there is one."""
        rows = slice(0 if level == 0 else int(self.ends[level - 1]), int(self.ends[level]))
        bright = b"" if self.bright is None else self.bright[rows].tobytes()
        return cloud_bytes(self.packed[rows], self.z0_m, self.z_step_m) + bright

    @property
    def nbytes(self) -> int:
        """Size in memory."""
        return self.packed.nbytes + (0 if self.bright is None else self.bright.nbytes)


def make_levels(points: F32, ground_z: F32, most: int | None = None, bright: U8 | None = None) -> Levels:
    """Sort points (n, 3), from the tile's corner, into levels; ``ground_z`` (256, 256) as in the tile.

    ``most``: only the coarsest level and what else of the coarse ones fits into so many points, ``ends`` as if it were
    all: for a picture of a whole map. ``bright`` (n,): their intensity, 255 for 1.0.
    """
    sizes = np.array(SPACINGS_M)
    low, high = _heights(points)
    sides = np.ceil(SIDE_M / sizes).astype(np.int64) + 1
    layers = np.minimum(((high - low) / sizes).astype(np.int64) + 1, LAYER_RULE.layers)
    taken = np.zeros(int((sides * sides * layers).sum()), np.bool_)
    level = np.empty(len(points), np.uint8)
    _find_levels(points, low, sizes, sides, layers, taken, level)  # in the tile's order: neighbours come close together
    ends = np.cumsum(np.bincount(level, minlength=N_LEVELS))
    room = len(points) if most is None else max(most, int(ends[0]))
    chosen = np.flatnonzero(level <= np.searchsorted(ends, room))
    shuffled = np.random.default_rng(0).permutation(chosen)
    coarse_first = shuffled[np.argsort(level[shuffled], kind="stable")][:room]
    packed, z0, step = pack(points[coarse_first], ground_z)
    return Levels(packed, ends, z0, step, None if bright is None else bright[coarse_first])


def pack(points: F32, ground_z: F32) -> tuple[U16, float, float]:
    """(packed (n, 4), z0_m, z_step_m) of points from a tile's corner, in their order, see :class:`Levels`."""
    if not len(points):
        return np.zeros((0, 4), dtype=np.uint16), 0.0, LAYER_RULE.least_z_step_m
    low, high = _heights(points)
    step = max(LAYER_RULE.least_z_step_m, (high - low) / _STEPS)
    measured = ground_z[np.isfinite(ground_z)]
    elsewhere = float(np.median(measured)) if len(measured) else low
    packed = np.empty((len(points), 4), dtype=np.uint16)
    _pack(points, ground_z, elsewhere, low, step, packed)
    return packed, low, step


def _heights(points: F32) -> tuple[float, float]:
    return (float(points[:, 2].min()), float(points[:, 2].max())) if len(points) else (0.0, 0.0)


def cloud_bytes(packed: U16, z0_m: float, z_step_m: float) -> bytes:
    """Sixteen bytes (0x3143564D, number of points, z0_m, z_step_m as uint32, uint32, float32, float32), then
    (n, 4) uint16, all little-endian."""
    head = np.array([(0x3143564D, len(packed), z0_m, z_step_m)], dtype="<u4,<u4,<f4,<f4")
    return head.tobytes() + np.ascontiguousarray(packed, dtype="<u2").tobytes()


@kernel
def _find_levels(points: F32, low: float, sizes: F64, sides: I64, layers: I64, taken: Bool, out: U8) -> None:
    """Into ``out`` (n,) the level of each point: the coarsest in whose voxel no point came before. ``taken``: False for
    each voxel of all levels.

    Each voxel lies in one voxel of the coarser level, so a point that takes a voxel takes all those around it.
    """
    for i in range(len(points)):
        x = points[i, 0]
        y = points[i, 1]
        z = points[i, 2] - low
        out[i] = len(sizes)
        first = len(taken)
        for k in range(len(sizes) - 1, -1, -1):
            first -= sides[k] * sides[k] * layers[k]
            col = min(max(int(x / sizes[k]), 0), sides[k] - 1)
            row = min(max(int(y / sizes[k]), 0), sides[k] - 1)
            voxel = first + (min(int(z / sizes[k]), layers[k] - 1) * sides[k] + row) * sides[k] + col
            if taken[voxel]:
                break
            taken[voxel] = True
            out[i] = k


@kernel
def _pack(points: F32, ground_z: F32, elsewhere: float, z0: float, step: float, out: U16) -> None:
    """Into ``out`` (n, 4), see :class:`Levels`. ``elsewhere``: the ground where a cell knows none."""
    for i in range(len(points)):
        x = points[i, 0]
        y = points[i, 1]
        z = points[i, 2]
        row = min(max(int(y / CELL_SIZE), 0), TILE_CELLS - 1)
        col = min(max(int(x / CELL_SIZE), 0), TILE_CELLS - 1)
        ground = float(ground_z[row, col])
        if not np.isfinite(ground):
            ground = elsewhere
        out[i, 0] = min(max(round(x * (_STEPS / SIDE_M)), 0), _STEPS)
        out[i, 1] = min(max(round(y * (_STEPS / SIDE_M)), 0), _STEPS)
        out[i, 2] = round((z - z0) / step)
        out[i, 3] = min(max(round((z - ground + 10.0) * 100), 0), _STEPS)  # centimetres from 10 m below the ground


def came_and_went(before: Tile, after: Tile, index: TileIndex | None = None) -> bytes:
    """Points that differ between two states of one tile. ``index``: the tile's, if it was
    loaded without its window."""
    ground = (after if len(after.points) else before).ground_z
    gone = ~found_among(before.points, after.points)
    come = ~found_among(after.points, before.points)
    clouds = [cloud_bytes(*pack(points, ground)) for points in (before.points[gone], after.points[come])]
    return b"".join([np.array(index or after.index, dtype="<i4").tobytes(), *clouds])
