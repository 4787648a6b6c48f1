"""New points of a tile <-> bytes: the voxel of each, and where in it to a 32nd of its side.

Half a centimetre is less than a sensor resolves and less than a vehicle knows of its position, yet as float32 three
quarters of a ballot were such digits. So vehicles round: a point stays in its voxel and moves by at most 4.7 mm along
each axis. Under zstd lie nine planes of bytes: the difference from each point's cell to the next (two), from each layer
to the next (four), and the place in the voxel (three).
"""

from __future__ import annotations

import numpy as np

from mapvote.codec.arrays import compress, unpack_bytes
from mapvote.core.grid import CELL_SIZE, CELLS, TILE_CELLS
from mapvote.core.types import F32, U8, MapvoteError

MAX_POINTS_PER_CELL = 64
"""One new point per voxel of a column: no honest ballot has more."""
_STEPS = 32
"""Of a voxel's side."""
MOST_OFF_M = 0.5 * CELL_SIZE / _STEPS
"""How far rounding moves a point along an axis, but for what float32 adds."""
_BYTES = 9
_MAX_BYTES = CELLS * MAX_POINTS_PER_CELL * _BYTES
_TOP_M = 1e5


def pack_points(points: F32) -> bytes:
    """(m, 3) from the tile's corner, inside it, in any order."""
    return compress(_planes(points).tobytes())


def unpack_points(data: bytes) -> F32:
    """(m, 3) float32 from the tile's corner; MapvoteError as :func:`unpack_sound_points`, and if one cell holds more
    than it may."""
    points = unpack_sound_points(data)
    if most_in_a_cell(points) > MAX_POINTS_PER_CELL:
        raise MapvoteError(f"ballot: new_points holds more than {MAX_POINTS_PER_CELL} points in one cell")
    return points


def unpack_sound_points(data: bytes) -> F32:
    """(m, 3) float32 from the tile's corner, of a ballot that the server took in; MapvoteError if damaged, not finite
    or outside the tile."""
    raw = np.frombuffer(unpack_bytes(data, _MAX_BYTES, "ballot: new_points"), dtype=np.uint8)
    if len(raw) % _BYTES:
        raise MapvoteError(f"ballot: new_points has {len(raw)} bytes, which is no number of points")
    planes = raw.reshape(_BYTES, -1)
    points, side = _placed(planes), np.float32(TILE_CELLS * CELL_SIZE)
    inside = (points[:, :2] >= 0).all() and (points[:, :2] < side).all() and (np.abs(points[:, 2]) <= _TOP_M).all()
    if not inside or (planes[6:] >= _STEPS).any():
        raise MapvoteError("ballot: new_points holds a point outside its tile or not finite")
    return points


def _planes(points: F32) -> U8:
    """(9, m) of points (m, 3): differences modulo 2 ** 16 and 2 ** 32, lowest byte first, and steps in a voxel."""
    place = points.T.astype(np.float64) / CELL_SIZE
    voxel = np.floor(place).astype(np.int64)
    voxel[:2] = np.clip(voxel[:2], 0, TILE_CELLS - 1)
    cells, layers = np.diff(voxel[1] * TILE_CELLS + voxel[0], prepend=0), np.diff(voxel[2], prepend=0)
    planes = np.empty((_BYTES, len(points)), dtype=np.uint8)
    for k, steps in enumerate((cells, cells >> 8, layers, layers >> 8, layers >> 16, layers >> 24)):
        planes[k] = steps & 0xFF
    planes[6:] = np.clip(((place - voxel) * _STEPS).astype(np.int64), 0, _STEPS - 1)
    return planes


def _placed(planes: U8) -> F32:
    """(m, 3) the points of (9, m) bytes, see :func:`_planes`."""
    ways = planes[:6].astype(np.int64)
    cell = np.cumsum(ways[0] + (ways[1] << 8)) & (CELLS - 1)
    layer = np.cumsum(ways[2] + (ways[3] << 8) + (ways[4] << 16) + (ways[5] << 24))
    layer = ((layer + (1 << 31)) & 0xFFFFFFFF) - (1 << 31)
    voxel = np.stack([cell % TILE_CELLS, cell // TILE_CELLS, layer])
    return np.ascontiguousarray(((voxel + (planes[6:] + 0.5) / _STEPS) * CELL_SIZE).T, dtype=np.float32)


def most_in_a_cell(points: F32) -> int:
    """The most of these points (m, 3), from the tile's corner and inside it, that lie in one cell."""
    cols, rows = np.minimum((points[:, :2].T.astype(np.float64) / CELL_SIZE).astype(np.int64), TILE_CELLS - 1)
    return int(np.bincount(rows * TILE_CELLS + cols, minlength=1).max())
