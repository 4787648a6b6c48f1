"""Rays gathered into fans of about a beam's width in azimuth, and the cells that a fan crosses.

A fan is walked once over the cells; each of its rays then marks the voxels between its height on entering and on
leaving each of them. One walk thus serves all beams of a firing, and the loop along a ray runs over vectors of cells.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from mapvote.core.columns import TOP_BIT
from mapvote.core.geometry import turn
from mapvote.core.grid import CELL_SIZE
from mapvote.core.types import F32, F64, I32, U8, U64

FANS = 2048
"""Fans in a turn (0.18 deg, a firing or two): two cross every cell at 40 m. A fan's direction is its rays' mean."""
FULL_RANGE_M = 25.0
"""Nearer than this every second fan suffices for two to a cell, nearer than half of it every fourth, and so on."""
INFINITY = np.float32(np.inf)


class Fans(NamedTuple):
    """Rays by fan."""

    start: I32
    """(FANS + 1,) first ray of each fan."""
    slope: F32
    """Voxels of height per metre of horizontal way, of every ray."""
    stop: F32
    """Horizontal metres to the end of what the ray proves."""
    end: F32
    """(FANS,) the largest of them in each fan; 0 without rays."""
    direction: F64
    """(FANS, 2) mean direction of the rays, of length 1."""
    nearest: F32
    """(FANS,) horizontal metres to the nearest obstacle ..."""
    farthest: F32
    """... and to the farthest return."""


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _rays(points: F64, origin: F64, clearance: float) -> tuple[F32, F32, F32, F32, F32, I32]:
    """(reach, direction x, y, slope, stop, fan) of every ray, each (n,): see :class:`Fans`. Without a branch, and by an
    index that cannot be negative, so that it vectorises."""
    n = len(points)
    reach, slope, stop = np.empty(n, np.float32), np.empty(n, np.float32), np.empty(n, np.float32)
    x, y, fan = np.empty(n, np.float32), np.empty(n, np.float32), np.empty(n, np.int32)
    for i in range(np.uint64(0), np.uint64(n)):
        dx, dy = np.float32(points[i, 0] - origin[0]), np.float32(points[i, 1] - origin[1])
        dz = np.float32(points[i, 2] - origin[2])
        h = np.sqrt(dx * dx + dy * dy)
        reach[i], x[i], y[i] = h, dx / h, dy / h
        slope[i] = dz / (np.float32(CELL_SIZE) * h)
        stop[i] = h - np.float32(clearance) * h / np.sqrt(h * h + dz * dz)
        fan[i] = min(np.int32(turn(dx, dy) * np.float32(FANS)), np.int32(FANS - 1))
    return reach, x, y, slope, stop, fan


@numba.njit(cache=True, nogil=True)
def gather_rays(points: F64, obstacle: NDArray[np.bool_], origin: F64, clearance: float) -> Fans:
    """Sort rays into fans."""
    reach, x, y, rise, end, fan = _rays(points, origin, clearance)
    start = np.zeros(FANS + 1, np.int32)
    direction = np.zeros((FANS, 2))
    nearest = np.full(FANS, INFINITY, np.float32)
    farthest = np.zeros(FANS, np.float32)
    for i in range(len(points)):
        h, f = reach[i], fan[i]
        if not h >= CELL_SIZE:  # the sensor's own cell proves nothing
            continue
        start[f + 1] += 1
        direction[f, 0] += x[i]
        direction[f, 1] += y[i]
        farthest[f] = max(farthest[f], h)
        if obstacle[i] and h < nearest[f]:
            nearest[f] = h
    for f in range(FANS):
        start[f + 1] += start[f]
        norm = np.sqrt(direction[f, 0] ** 2 + direction[f, 1] ** 2)
        if norm > 0.0:
            direction[f, 0] /= norm
            direction[f, 1] /= norm
    slope, stop, last = np.empty(start[FANS], np.float32), np.empty(start[FANS], np.float32), np.zeros(FANS, np.float32)
    filled = start[:FANS].copy()
    for i in range(len(points)):
        if not reach[i] >= CELL_SIZE:
            continue
        f = fan[i]
        slope[filled[f]], stop[filled[f]] = rise[i], end[i]
        last[f] = max(last[f], end[i])
        filled[f] += 1
    return Fans(start, slope, stop, last, direction, nearest, farthest)


class Way(NamedTuple):
    """A fan's way over the cells (Amanatides and Woo 1987), at one of them. Distances are horizontal metres."""

    r: int
    c: int
    entered: float
    """Where it comes into the cell ..."""
    next_r: float
    """... where it leaves its row ..."""
    next_c: float
    """... and its column."""
    width_r: float
    """From row to row."""
    width_c: float


@numba.njit(cache=True, nogil=True)
def _set_out(x: float, y: float, dx: float, dy: float, at: float) -> Way:
    """The way from (x, y), in cells, in direction (dx, dy), where it has come ``at`` metres."""
    far, along = 1e18, 1e-9  # what runs along an axis never comes to the next row or column
    c, r = int(np.floor(x + dx * at / CELL_SIZE)), int(np.floor(y + dy * at / CELL_SIZE))
    next_c = far if abs(dx) < along else ((c + (dx > 0)) - x) / dx * CELL_SIZE
    next_r = far if abs(dy) < along else ((r + (dy > 0)) - y) / dy * CELL_SIZE
    width_c = far if abs(dx) < along else CELL_SIZE / abs(dx)
    width_r = far if abs(dy) < along else CELL_SIZE / abs(dy)
    return Way(r, c, max(0.0, next_c - width_c, next_r - width_r), next_r, next_c, width_r, width_c)


@numba.njit(cache=True, nogil=True)
def _marks_from(f: int) -> float:
    """Horizontal metres from which fan ``f`` marks what it passes, see FULL_RANGE_M."""
    marks_from = FULL_RANGE_M
    while f % 2 == 0 and marks_from > CELL_SIZE:
        marks_from, f = 0.5 * marks_from, f // 2
    return 0.0 if marks_from <= CELL_SIZE else marks_from


class Crossed(NamedTuple):
    """The cells that a fan crosses, in order."""

    cell: I32
    """row * cols + col."""
    entered: F32
    """Horizontal metres at which the fan comes into each, and behind the last one at which it leaves."""
    bottom: I32
    """Bit 0 of each column, as a layer counted from the sensor's."""
    words: U64
    """What the fan's rays pass of each."""


@numba.njit(cache=True, nogil=True)
def _cross_cells(way: Way, ahead: tuple[int, int], end: float, base: I32, layer: int, out: Crossed) -> int:
    """Fill ``out`` with the cells of a way that steps ``ahead`` rows and columns, up to ``end`` metres or the window's
    edge. Returns how many there are."""
    rows, cols = base.shape
    r, c, t, next_r, next_c, width_r, width_c = way
    n = 0
    while 0 <= r < rows and 0 <= c < cols and t < end:
        out.cell[n], out.entered[n], out.bottom[n], out.words[n] = r * cols + c, t, base[r, c] - layer, 0
        n += 1
        t = min(next_c, next_r)
        if next_c < next_r:
            c += ahead[1]
            next_c += width_c
        else:
            r += ahead[0]
            next_r += width_r
    out.entered[n] = t
    return n


@numba.njit(inline="always")
def _entered_before(entered: F32, n: int, stop: np.float32) -> np.uint64:
    """How many of the first ``n`` ascending numbers lie below ``stop``."""
    low, high = np.uint64(0), np.uint64(n)
    while low < high:
        middle = (low + high) >> np.uint64(1)
        low, high = (middle + np.uint64(1), high) if entered[middle] < stop else (low, middle)
    return low


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _pass(slope: np.float32, stop: np.float32, height: np.float32, n: np.uint64, crossed: Crossed) -> None:
    """Enter what one ray passes of the first ``n`` cells: in each, the voxels between its heights on entering and on
    leaving. ``height`` of the sensor over its layer, in voxels. One vector lane a cell."""
    t, bottom, words = crossed.entered, crossed.bottom, crossed.words
    none, top, one = np.int32(0), np.int32(TOP_BIT), np.int32(1)
    for j in range(np.uint64(0), n):  # unsigned: an index that cannot be negative vectorises
        enter = np.int32(np.floor(height + slope * t[j])) - bottom[j]
        leave = np.int32(np.floor(height + slope * min(t[j + np.uint64(1)], stop))) - bottom[j]
        low = min(max(np.int32(min(enter, leave)), none), top)
        high = min(max(np.int32(max(enter, leave) + one), none), top)
        words[j] |= (np.uint64(1) << np.uint64(high)) - (np.uint64(1) << np.uint64(low))


@numba.njit(cache=True, nogil=True)
def mark_passed(fans: Fans, origin: F64, corner: tuple[float, float], base: I32, passed: U64) -> None:
    """Take every fan from where it marks to the end of its rays, and enter what they pass into ``passed`` (flat)."""
    rows, cols = base.shape
    layer = int(np.floor(origin[2] / CELL_SIZE))
    height = np.float32(origin[2] / CELL_SIZE - layer)
    x, y = (origin[0] - corner[0]) / CELL_SIZE, (origin[1] - corner[1]) / CELL_SIZE
    start, slope, stop = fans.start, fans.slope, fans.stop
    most = rows + cols + 1
    crossed = Crossed(
        np.empty(most, np.int32), np.empty(most + 1, np.float32), np.empty(most, np.int32), np.empty(most, np.uint64)
    )
    for f in range(FANS):
        marks_from = _marks_from(f)
        if fans.end[f] <= marks_from:
            continue
        dx, dy = fans.direction[f]
        ahead = (1 if dy > 0 else -1), (1 if dx > 0 else -1)
        n = _cross_cells(_set_out(x, y, dx, dy, marks_from), ahead, fans.end[f], base, layer, crossed)
        for k in range(start[f], start[f + 1]):
            _pass(slope[k], stop[k], height, _entered_before(crossed.entered, n, stop[k]), crossed)
        for j in range(n):
            passed[crossed.cell[j]] |= crossed.words[j]


@numba.njit(cache=True, nogil=True)
def mark_sight(fans: Fans, origin: F64, corner: tuple[float, float], sight: U8) -> None:
    """Walk every fan from the sensor to the edge of the window, and enter how far it sees into ``sight``."""
    rows, cols = sight.shape
    x, y = (origin[0] - corner[0]) / CELL_SIZE, (origin[1] - corner[1]) / CELL_SIZE
    for f in range(FANS):
        if fans.start[f] == fans.start[f + 1]:
            continue
        dx, dy = fans.direction[f]
        step_r, step_c = (1 if dy > 0 else -1), (1 if dx > 0 else -1)
        r, c, t0, next_r, next_c, width_r, width_c = _set_out(x, y, dx, dy, 0.0)
        while 0 <= r < rows and 0 <= c < cols:
            level = 1 if t0 > fans.farthest[f] else (2 if t0 > fans.nearest[f] else 3)
            if sight[r, c] < level:
                sight[r, c] = level
            t0 = min(next_c, next_r)
            if next_c < next_r:
                c += step_c
                next_c += width_c
            else:
                r += step_r
                next_r += width_r
