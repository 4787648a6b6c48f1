"""Point clouds on the lattice: voxel down-sampling and the ground surface (paper II; METHOD 2, "ground").

The ground follows the road: it is the highest surface below all points whose slope stays under a
maximum grade (a lower Lipschitz envelope), so kerbs, crowns and ramps stay ground and walls do not.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from mapvote.core.grid import CELL_SIZE, Grid
from mapvote.core.types import F32, F64, I64


def voxel_keys(points: NDArray[np.floating], x0: float, y0: float, size: float = CELL_SIZE) -> I64:
    """(n,) int64 key of each point's voxel on the lattice: equal keys, same voxel; order is by x, then y, then z.

    Voxel layers start at z = 0. Coordinates must lie within +-2^20 voxels (314 km at 0.3 m).
    """
    p = points.astype(np.float64)
    ix = np.floor((p[:, 0] - x0) / size).astype(np.int64)
    iy = np.floor((p[:, 1] - y0) / size).astype(np.int64)
    iz = np.floor(p[:, 2] / size).astype(np.int64)
    key: I64 = ((ix + (1 << 20)) << 42) | ((iy + (1 << 20)) << 21) | (iz + (1 << 20))
    return key


def voxel_downsample(points: NDArray[np.floating], size: float, x0: float = 0.0, y0: float = 0.0) -> I64:
    """Indices (m,) of one point per voxel, the first of each in input order, ascending. Deterministic."""
    _, first = np.unique(voxel_keys(points, x0, y0, size), return_index=True)
    return np.sort(first)


@numba.njit(cache=True, nogil=True)
def scattered(key: np.int64) -> np.int64:
    """A hash of a voxel key whose low bits depend on all three indices (Fibonacci hashing, high half folded in)."""
    h = key * np.int64(-7046029254386353131)
    return h ^ (h >> 32)


@numba.njit(cache=True, nogil=True)
def _thin(points: NDArray[np.float32], size: float, table: I64) -> I64:
    """Indices of the first point in each voxel of side ``size`` (open addressing, linear probing).

    ``table`` (2^k,) holds zeros; the answer is empty when it became half full and a larger one is needed.
    """
    mask = len(table) - 1
    keep = np.empty(len(table) // 2, dtype=np.int64)
    n = 0
    scale = 1.0 / size
    last = np.int64(0)
    for i in range(len(points)):
        ix = np.int64(points[i, 0] * scale + 1048576.0)
        iy = np.int64(points[i, 1] * scale + 1048576.0)
        iz = np.int64(points[i, 2] * scale + 1048576.0)
        key = (ix << 42) | (iy << 21) | iz
        if key == last:  # neighbours in a scan mostly share a voxel
            continue
        last = key
        slot = scattered(key) & mask
        while table[slot] != 0 and table[slot] != key:
            slot = (slot + 1) & mask
        if table[slot] == 0:
            if n == len(keep):
                return keep[:0]
            table[slot] = key
            keep[n] = i
            n += 1
    return keep[:n].copy()


def thin(points: NDArray[np.floating], size: float) -> I64:
    """Indices (m,) of the first of (n, 3) points in each voxel of side ``size``, ascending. Within 2^20 voxels of 0.

    Does in a millisecond what :func:`voxel_downsample` does on the lattice; for scans, in their own frame.
    """
    cloud = np.ascontiguousarray(points, dtype=np.float32)
    slots = 1 << 15
    while True:
        keep = _thin(cloud, size, np.zeros(slots, dtype=np.int64))
        if len(keep) or len(cloud) == 0:
            return keep
        slots *= 2


@numba.njit(cache=True, nogil=True)
def _lowest(rows: I64, cols: I64, z: F64, inside: NDArray[np.bool_], out: F64) -> None:
    for i in range(len(z)):
        if inside[i] and z[i] < out[rows[i], cols[i]]:
            out[rows[i], cols[i]] = z[i]


@numba.njit(cache=True, nogil=True)
def _lower_envelope(z: F64, straight: float, diagonal: float) -> None:
    """Two-pass chamfer: z[c] = min over c' of z[c'] + grade * |c - c'|, in place (Borgefors 1986)."""
    rows, cols = z.shape
    for r in range(rows):
        for c in range(cols):
            best = z[r, c]
            if c > 0:
                best = min(best, z[r, c - 1] + straight)
            if r > 0:
                best = min(best, z[r - 1, c] + straight)
                if c > 0:
                    best = min(best, z[r - 1, c - 1] + diagonal)
                if c + 1 < cols:
                    best = min(best, z[r - 1, c + 1] + diagonal)
            z[r, c] = best
    for r in range(rows - 1, -1, -1):
        for c in range(cols - 1, -1, -1):
            best = z[r, c]
            if c + 1 < cols:
                best = min(best, z[r, c + 1] + straight)
            if r + 1 < rows:
                best = min(best, z[r + 1, c] + straight)
                if c + 1 < cols:
                    best = min(best, z[r + 1, c + 1] + diagonal)
                if c > 0:
                    best = min(best, z[r + 1, c - 1] + diagonal)
            z[r, c] = best


@numba.njit(cache=True, nogil=True)
def _supported(low: F64, reach: int, grade: float, share: float) -> F64:
    """``low`` without the cells that hardly any of the known cells within ``reach`` cells agree with (inf instead).

    Agreement: within 0.3 m, and ``grade`` (metres per cell) times the distance more; by at least 2 cells and a
    ``share`` of them. Reflections below the road come singly or in small clusters far below all
    others, and the envelope would follow each down a cone.
    """
    rows, cols = low.shape
    plenty = share * (2 * reach + 1) ** 2
    out = np.full_like(low, np.inf)
    for r in range(rows):
        for c in range(cols):
            if not np.isfinite(low[r, c]):
                continue
            known, agree = 0, 0
            for i in range(max(r - reach, 0), min(r + reach + 1, rows)):
                for j in range(max(c - reach, 0), min(c + reach + 1, cols)):
                    if np.isfinite(low[i, j]):
                        known += 1
                        apart = max(abs(i - r), abs(j - c))
                        agree += abs(low[i, j] - low[r, c]) <= CELL_SIZE + grade * apart
                if agree >= plenty:
                    break
            if agree > 2 and agree >= share * known:  # the cell itself is one of them
                out[r, c] = low[r, c]
    return out


def ground_surface(points: NDArray[np.floating], grid: Grid, max_grade: float = 0.15, reach_m: float = 3.0) -> F32:
    """Height of the ground in every cell of ``grid``, (rows, cols) float32 in the points' frame, NaN where unknown.

    ``points`` (n, 3) in map metres. A cell farther than ``reach_m`` from any point is unknown. Only points inside
    ``grid`` are used: give a grid with a margin and cut it, so that windows agree where they meet. A cell
    with whose lowest point less than a fifth of the known cells within 2.1 m agree is measured wrongly and not used.
    """
    rows, cols, inside = grid.indices_of(points)
    low = np.full(grid.shape, np.inf)
    _lowest(rows, cols, points[:, 2].astype(np.float64), inside, low)
    low = _supported(low, 7, max_grade * CELL_SIZE, 0.2)
    distance = np.where(np.isfinite(low), 0.0, np.inf)
    _lower_envelope(distance, CELL_SIZE, CELL_SIZE * np.sqrt(2.0))
    _lower_envelope(low, max_grade * CELL_SIZE, max_grade * CELL_SIZE * np.sqrt(2.0))
    return np.where(distance <= reach_m, low, np.nan).astype(np.float32)
