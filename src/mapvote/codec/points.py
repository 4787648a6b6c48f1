"""New points of a tile <-> bytes: the voxel of each, and where in it to a 32nd of its side.

Half a centimetre is less than a sensor's noise and less than the error of a pose, yet as float32 three
quarters of a ballot were such digits. So vehicles round: a point stays in its voxel and moves by at most 4.7 mm along
each axis. Under zstd lie nine planes of bytes: the difference from each point's cell to the next (two), from each layer
to the next (four), and the place in the voxel (three).
"""

from __future__ import annotations

import numpy as np

from mapvote.codec.arrays import compress, unpack_bytes
from mapvote.core.grid import CELL_SIZE, CELLS, TILE_CELLS
from mapvote.core.kernel import kernel
from mapvote.core.types import F32, I64, U8, MapvoteError

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
    planes = np.empty((_BYTES, len(points)), dtype=np.uint8)
    _enter_planes(points, np.empty(3, dtype=np.int64), planes)
    return compress(planes.tobytes())


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
    points = np.empty((len(raw) // _BYTES, 3), dtype=np.float32)
    sound = _placed(raw.reshape(_BYTES, -1), points)
    if not sound or not _all_inside(points, np.float32(TILE_CELLS * CELL_SIZE)):
        raise MapvoteError("ballot: new_points holds a point outside its tile or not finite")
    return points


@kernel
def _enter_planes(points: F32, voxel: I64, planes: U8) -> None:
    """Fill ``planes`` (9, m) from points (m, 3): differences modulo 2 ** 16 and 2 ** 32, lowest byte first, and steps
    in a voxel. ``voxel`` (3,): scratch."""
    last_cell, last_layer = np.int64(0), np.int64(0)
    for i in range(len(points)):
        for axis in range(3):
            place = np.float64(points[i, axis]) / CELL_SIZE
            voxel[axis] = int(np.floor(place))
            if axis < 2:
                voxel[axis] = min(max(voxel[axis], 0), TILE_CELLS - 1)
            planes[6 + axis, i] = min(max(int((place - voxel[axis]) * _STEPS), 0), _STEPS - 1)
        cell = voxel[1] * TILE_CELLS + voxel[0]
        for k in range(2):
            planes[k, i] = ((cell - last_cell) >> (8 * k)) & 0xFF
        for k in range(4):
            planes[2 + k, i] = ((voxel[2] - last_layer) >> (8 * k)) & 0xFF
        last_cell, last_layer = cell, voxel[2]


@kernel
def _placed(planes: U8, points: F32) -> bool:
    """Fill ``points`` (m, 3) from (9, m); whether each lies in its voxel."""
    cell, layer, sound = np.int64(0), np.int64(0), True
    for i in range(len(points)):
        cell = (cell + np.int64(planes[0, i]) + (np.int64(planes[1, i]) << 8)) & (CELLS - 1)
        way = np.int64(0)
        for k in range(4):
            way |= np.int64(planes[2 + k, i]) << (8 * k)
        layer = ((layer + way + (1 << 31)) & 0xFFFFFFFF) - (1 << 31)
        for axis, voxel in enumerate((cell % TILE_CELLS, cell // TILE_CELLS, layer)):
            points[i, axis] = (voxel + (planes[6 + axis, i] + 0.5) / _STEPS) * CELL_SIZE
            sound &= planes[6 + axis, i] < _STEPS
    return sound


@kernel
def _all_inside(points: F32, side: np.float32) -> bool:
    """Whether all points (m, 3) are finite and within a tile; NaN fails every comparison."""
    sound = True
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        sound &= 0 <= x < side and 0 <= y < side and abs(z) <= _TOP_M
    return sound


def most_in_a_cell(points: F32) -> int:
    """The most of these points (m, 3), from the tile's corner and inside it, that lie in one cell."""
    return int(_most_in_a_cell(points, np.zeros(CELLS, dtype=np.int64)))


@kernel
def _most_in_a_cell(points: F32, counts: I64) -> int:
    """:func:`most_in_a_cell`; ``counts`` (cells,): scratch, zeros."""
    most = 0
    for i in range(len(points)):
        row, col = int(points[i, 1] / CELL_SIZE), int(points[i, 0] / CELL_SIZE)
        cell = min(row, TILE_CELLS - 1) * TILE_CELLS + min(col, TILE_CELLS - 1)
        counts[cell] += 1
        most = max(most, counts[cell])
    return most
