"""Columns: every 0.3 m cell has one 64-bit word, bit i = voxel i of that column (docs/decisions/evidence.md).

Voxels lie on the world lattice: layer = floor(z / 0.3). Bit 0 is the layer that holds the ground of the
cell (``base``), so words follow the terrain and 64 bits reach 19.2 m above the road; the top bit
stands for everything from there upwards. Neighbouring cells are compared by shifting by their bases' difference.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapvote.core.grid import CELL_SIZE, Grid
from mapvote.core.kernel import inlined, kernel
from mapvote.core.record import record
from mapvote.core.types import F32, F64, I32, I64, U64, Bool, read_only


@record(votes=True)
@dataclass(frozen=True, slots=True)
class ColumnRule:
    """Columns above the ground."""

    ground_margin_m: float = 0.3
    """Height above the ground below which points are ground, metres: they never make a cell occupied
    (docs/method.md)."""


COLUMN_RULE = ColumnRule()
# Kernels take no records: they read these names.
GROUND_MARGIN_M = COLUMN_RULE.ground_margin_m
TOP_BIT = 63


@inlined
def height_above(z: float, ground_z: float, base: int) -> float:
    """Height of a point above the ground of its cell; where that is unknown, above the bottom of its column."""
    return z - (base * CELL_SIZE if np.isnan(ground_z) else ground_z)


@inlined
def layer_bit(layer: int, base: int) -> int:
    """Which bit of its column's word a layer of the world is; what lies beyond the word goes to its ends."""
    return min(max(layer - base, 0), TOP_BIT)


@inlined
def column_bit(z: float, base: int) -> int:
    """Which bit of its column's word a height belongs to, see :func:`layer_bit`."""
    return layer_bit(int(np.floor(z / CELL_SIZE)), base)


def column_bits(z: F64, ground_z: F32, base: I32) -> tuple[I64, Bool]:
    """(bit (n,), obstacle (n,)) of points: ``z`` their heights, ``ground_z`` and ``base`` those of their cells.

    The one rule of what is an obstacle and what is ground: see :func:`height_above` and GROUND_MARGIN_M.
    """
    bit = np.clip(np.floor(z / CELL_SIZE).astype(np.int64) - base, 0, TOP_BIT)
    return bit, z - np.where(np.isnan(ground_z), base * CELL_SIZE, ground_z) >= GROUND_MARGIN_M


def mark_obstacles(
    words: U64, points: F32, window: Grid, outer: Grid, ground_z: F32, base: I32,
    measures: tuple[I32, F32, F32] | None = None,
) -> None:  # fmt: skip
    """Enter the points (n, 3), metres from the corner of ``window``, that are obstacles into the column ``words`` of
    ``outer``, by the rule of :func:`column_bits`; ``ground_z``, ``base``: of ``outer``. Points outside it are left out;
    those inside lie in the cells of :func:`flat_cells`. ``measures``: of the obstacles of each cell how many there are,
    the height of the lowest and of the highest; they are kept up, too."""
    counts, bottom_z, top_z = measures or (np.empty((0, 0), np.int32), *np.empty((2, 0, 0), np.float32))
    corner = window.x0, window.y0, float(window.lattice.x0), float(window.lattice.y0)
    place = window.row0, window.col0, window.rows, window.cols, window.row0 - outer.row0, window.col0 - outer.col0
    cloud = read_only(np.ascontiguousarray(points))
    _mark_obstacles(words, cloud, corner, place, read_only(ground_z), read_only(base), counts, bottom_z, top_z)


@kernel
def _mark_obstacles(
    words: U64, points: F32, corner: tuple[float, float, float, float], place: tuple[int, int, int, int, int, int],
    ground_z: F32, base: I32, counts: I32, bottom_z: F32, top_z: F32,
) -> None:  # fmt: skip
    """``corner``: x and y of the window's and of the lattice's. ``place``: the window's first row and column, how many
    it has, and how far up and to the right it begins in the planes (rows, cols)."""
    x0, y0, lattice_x0, lattice_y0 = corner
    row0, col0, height, width, up, right = place
    rows, cols = words.shape
    measured = len(counts) > 0
    for i in range(len(points)):
        row = int(np.floor((np.float64(points[i, 1]) + y0 - lattice_y0) / CELL_SIZE)) - row0
        col = int(np.floor((np.float64(points[i, 0]) + x0 - lattice_x0) / CELL_SIZE)) - col0
        r = min(max(row, 0), height - 1) + up
        c = min(max(col, 0), width - 1) + right
        if r < 0 or c < 0 or r >= rows or c >= cols:
            continue
        z = np.float64(points[i, 2])
        if height_above(z, ground_z[r, c], base[r, c]) < GROUND_MARGIN_M:
            continue
        words[r, c] |= np.uint64(1) << np.uint64(column_bit(z, base[r, c]))
        if measured:
            counts[r, c] += 1
            bottom_z[r, c] = min(bottom_z[r, c], z)
            top_z[r, c] = max(top_z[r, c], z)


def rebased(words: U64, layers: I32) -> U64:
    """(...) columns seen from bases ``layers`` (...) lower: where > 0 bits move up, and what passes bit 63 is gone."""
    up = np.clip(layers, 0, 63).astype(np.uint64)
    down = np.clip(-layers, 0, 63).astype(np.uint64)
    return np.where(np.abs(layers) < 64, words << up >> down, np.uint64(0))


def dilated(words: U64, base: I32, reach: int) -> U64:
    """(rows, cols) of every column the voxels within ``reach`` cells (a square) and one layer of a set bit; bases may
    differ."""
    rows, cols = words.shape
    near = np.zeros_like(words)
    for i in range(-reach, reach + 1):
        for j in range(-reach, reach + 1):
            here = slice(max(-i, 0), rows - max(i, 0)), slice(max(-j, 0), cols - max(j, 0))
            beside = slice(max(i, 0), rows + min(i, 0)), slice(max(j, 0), cols + min(j, 0))
            near[here] |= rebased(words[beside], base[beside] - base[here])
    return near | (near << np.uint64(1)) | (near >> np.uint64(1))


EVERY_BIT = ~np.uint64(0)


@inlined
def below_top(word: np.uint64) -> np.uint64:
    """Every bit at or below the highest set one; 0 for 0."""
    for shift in (1, 2, 4, 8, 16, 32):
        word |= word >> np.uint64(shift)
    return word


@inlined
def span_of(word: np.uint64) -> np.uint64:
    """The bits from the lowest to the highest set one: the height span of a column; 0 for 0."""
    lowest = word & (~word + np.uint64(1))
    return below_top(word) & ~(lowest - np.uint64(1)) if word else np.uint64(0)


def flat_cells(window: Grid, points: NDArray[np.float32]) -> NDArray[np.int64]:
    """(n,) row * cols + col of points (n, 3) from the window's corner, metres; the outermost cells take points that
    rounding moved out. The result equals :meth:`Grid.indices_of` of :meth:`Grid.to_map` bit for bit."""
    corner = window.x0, window.y0, window.lattice.x0, window.lattice.y0
    flat = np.empty(len(points), dtype=np.int64)
    cloud = read_only(np.ascontiguousarray(points))
    _enter_cells(cloud, *corner, window.row0, window.col0, window.rows, window.cols, flat)
    return flat


@kernel
def _enter_cells(
    points: NDArray[np.float32], x0: float, y0: float, lattice_x0: float, lattice_y0: float, row0: int, col0: int,
    rows: int, cols: int, flat: NDArray[np.int64],
) -> None:  # fmt: skip
    for i in range(len(points)):
        row = int(np.floor((np.float64(points[i, 1]) + y0 - lattice_y0) / CELL_SIZE)) - row0
        col = int(np.floor((np.float64(points[i, 0]) + x0 - lattice_x0) / CELL_SIZE)) - col0
        flat[i] = min(max(row, 0), rows - 1) * cols + min(max(col, 0), cols - 1)


def base_layers(ground_z: F32) -> I32:
    """(rows, cols) lattice layer of bit 0: floor(ground_z / 0.3), unknown cells filled from the nearest known one."""
    base = np.zeros(ground_z.shape, dtype=np.int32)
    for _ in fill_base(ground_z, base, len(base), np.empty(ground_z.shape)):
        pass
    return base


def fill_base(ground_z: F32, base: I32, band_rows: int, low: F64) -> Iterator[None]:
    """Enter :func:`base_layers` into ``base`` (rows, cols), which come as zeros, in steps of ``band_rows`` rows.
    ``low`` (rows, cols): scratch."""
    if not np.isfinite(ground_z).any():
        return
    rows = len(ground_z)
    slope = 0.02 * CELL_SIZE
    bands = [(first, min(first + band_rows, rows)) for first in range(0, rows, band_rows)]
    for first, end in bands:
        _fill_rows(read_only(ground_z), first, end, 1, slope, low, base)
        yield
    for first, end in reversed(bands):
        _fill_rows(read_only(ground_z), end - 1, first - 1, -1, slope, low, base)
        yield


@kernel
def _fill_rows(ground_z: F32, first: int, end: int, step: int, slope: float, low: F64, base: I32) -> None:
    """The rows of a band, see :func:`lower_rows`: downwards into ``low`` alone, upwards into ``base`` too."""
    cols = ground_z.shape[1]
    for r in range(first, end, step):
        own = ground_z[r]
        row = low[r]
        if step > 0:
            for c in range(np.uint64(0), np.uint64(cols)):
                row[c] = np.inf if np.isnan(own[c]) else np.float64(own[c])
        lower_rows(low, r, r + step, step, slope, slope * np.sqrt(2.0))
        if step < 0:
            layers = base[r]
            for c in range(np.uint64(0), np.uint64(cols)):
                layers[c] = np.int32(np.floor((np.float64(own[c]) if np.isfinite(own[c]) else row[c]) / CELL_SIZE))


def lower_envelope(z: F64, straight: float, diagonal: float) -> None:
    """Two-pass chamfer: z[c] = min over c' of z[c'] + grade * |c - c'|, in place (Borgefors 1986)."""
    rows = len(z)
    lower_rows(z, 0, rows, 1, straight, diagonal)
    lower_rows(z, rows - 1, -1, -1, straight, diagonal)


@kernel
def lower_rows(z: F64, first: int, end: int, step: int, straight: float, diagonal: float) -> None:
    """One pass of :func:`lower_envelope` over the rows from ``first`` to before ``end``: downwards with ``step`` 1,
    upwards with -1. Each row is lowered by the row that the pass came from, then from cell to cell."""
    rows, cols = z.shape
    last = np.uint64(cols - 1)
    for r in range(first, end, step):
        row = z[r]
        beside = z[r - step] if 0 <= r - step < rows else row  # a row beside itself lowers nothing
        lowest = np.inf
        for k in range(cols):
            at = np.uint64(k if step > 0 else cols - 1 - k)
            left = at - np.uint64(at > np.uint64(0))
            right = at + np.uint64(at < last)
            low = min(row[at], beside[at] + straight)
            low = min(low, min(beside[left], beside[right]) + diagonal)
            lowest = min(low, lowest + straight)
            row[at] = lowest
