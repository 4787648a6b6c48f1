"""A tile's points in levels of detail: any prefix of them is an even, thinner picture of the tile.

Each point belongs to the coarsest level in whose voxels it is the first; within a level the order is random, and the
same on every run. Levels are added to one another, so nothing is sent twice (Potree's additive levels, Schuetz 2016,
on our tiles instead of an octree: a tile is one node, whose parts are its levels).
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from mapvote.core.grid import CELL_SIZE, TILE_CELLS
from mapvote.core.types import F32, F64, I64, U8, U16

SPACINGS_M = (4.8, 2.4, 1.2, 0.6, 0.3)
"""Voxel side of each level; one more level takes what is left."""
N_LEVELS = len(SPACINGS_M) + 1
SIDE_M = TILE_CELLS * CELL_SIZE
ABOVE_OFFSET_M = 10.0
_STEPS = 65535
_LEAST_Z_STEP_M = 0.002
_BYTES = "<u4,<u4,<f4,<f4"
_MAGIC = 0x3143564D


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

    def part(self, level: int) -> bytes:
        """One level for the wire, see :func:`cloud_bytes`."""
        start = 0 if level == 0 else int(self.ends[level - 1])
        return cloud_bytes(self.packed[start : int(self.ends[level])], self.z0_m, self.z_step_m)


def make_levels(points: F32, ground_z: F32) -> Levels:
    """Sort points (n, 3), from the tile's corner, into levels; ``ground_z`` (256, 256) as in the tile."""
    shuffled = points[np.random.default_rng(0).permutation(len(points))]
    level = _levels(shuffled, np.array(SPACINGS_M))
    order = np.argsort(level, kind="stable")
    packed, z0, step = pack(shuffled[order], ground_z)
    return Levels(packed, np.cumsum(np.bincount(level, minlength=N_LEVELS)), z0, step)


def pack(points: F32, ground_z: F32) -> tuple[U16, float, float]:
    """(packed (n, 4), z0_m, z_step_m) of points from a tile's corner, in their order, see :class:`Levels`."""
    if not len(points):
        return np.zeros((0, 4), dtype=np.uint16), 0.0, _LEAST_Z_STEP_M
    z = points[:, 2].astype(np.float64)
    z0 = float(z.min())
    step = max(_LEAST_Z_STEP_M, float(z.max() - z0) / _STEPS)
    out = np.empty((len(points), 4), dtype=np.uint16)
    out[:, :2] = np.clip(np.rint(points[:, :2] * (_STEPS / SIDE_M)), 0, _STEPS)
    out[:, 2] = np.rint((z - z0) / step)
    cells = np.clip((points[:, :2] / CELL_SIZE).astype(np.int64), 0, TILE_CELLS - 1)
    ground = ground_z[cells[:, 1], cells[:, 0]].astype(np.float64)
    known = ground_z[np.isfinite(ground_z)]
    ground = np.where(np.isfinite(ground), ground, np.median(known) if len(known) else z0)
    out[:, 3] = np.clip(np.rint((z - ground + ABOVE_OFFSET_M) * 100), 0, _STEPS)
    return out, z0, step


def cloud_bytes(packed: U16, z0_m: float, z_step_m: float) -> bytes:
    """Sixteen bytes (0x3143564D, number of points, z0_m, z_step_m as uint32, uint32, float32, float32), then
    (n, 4) uint16, all little-endian."""
    head = np.array([(_MAGIC, len(packed), z0_m, z_step_m)], dtype=_BYTES)
    return head.tobytes() + np.ascontiguousarray(packed, dtype="<u2").tobytes()


def unpack_cloud(data: bytes) -> F64:
    """(n, 3) metres from the tile's corner, of what :func:`cloud_bytes` gave."""
    _, n, z0, step = np.frombuffer(data, dtype=_BYTES, count=1)[0]
    packed = np.frombuffer(data, dtype="<u2", offset=16).reshape(int(n), 4).astype(np.float64)
    return packed[:, :3] * [SIDE_M / _STEPS, SIDE_M / _STEPS, float(step)] + [0.0, 0.0, float(z0)]


@numba.njit(cache=True, nogil=True)
def _levels(points: F32, spacings: np.ndarray) -> U8:
    """(n,) level of each point, in the order given. Beyond 512 layers of the finest voxel, heights count as one."""
    n = len(points)
    out = np.full(n, len(spacings), dtype=np.uint8)
    if n == 0:
        return out
    low, high = points[0, 2], points[0, 2]
    for i in range(n):
        low, high = min(low, points[i, 2]), max(high, points[i, 2])
    for level in range(len(spacings)):
        size = spacings[level]
        side = int(np.ceil(76.8 / size)) + 1
        layers = min(int((high - low) / size) + 1, 512)
        taken = np.zeros(side * side * layers, dtype=np.bool_)
        for coarser in (True, False):  # what coarser levels hold takes its voxels first
            for i in range(n):
                if (out[i] < level) != coarser:
                    continue
                x = min(max(int(points[i, 0] / size), 0), side - 1)
                y = min(max(int(points[i, 1] / size), 0), side - 1)
                z = min(int((points[i, 2] - low) / size), layers - 1)
                voxel = (z * side + y) * side + x
                if not coarser and not taken[voxel]:
                    out[i] = level
                taken[voxel] = True
    return out
