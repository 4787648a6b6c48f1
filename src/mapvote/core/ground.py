"""The ground: the surface that vehicles drive on, and the layer at which each column begins (paper II)."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from mapvote.core.grid import CELL_SIZE, Grid
from mapvote.core.types import F32, F64, I32, I64


def base_layers(ground_z: F32) -> I32:
    """(rows, cols) lattice layer of bit 0: floor(ground_z / 0.3), unknown cells filled from the nearest known one."""
    known = np.isfinite(ground_z)
    if not known.any():
        return np.zeros(ground_z.shape, dtype=np.int32)
    low = np.where(known, ground_z, np.inf).astype(np.float64)
    _lower_envelope(low, 0.02 * CELL_SIZE, 0.02 * CELL_SIZE * np.sqrt(2.0))
    filled = np.where(known, ground_z.astype(np.float64), low)
    return np.floor(filled / CELL_SIZE).astype(np.int32)


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
