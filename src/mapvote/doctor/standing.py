"""What a map holds twice, a little apart, and what leans though it should stand: found without knowing where it is."""

from __future__ import annotations

import numpy as np
import scipy

from mapvote.core.types import F64
from mapvote.doctor.finding import Finding

_FEW = 1000
"""Fewer points show nothing."""
_BIN_M = 0.05
_CELL_M, _SIDE = 0.2, 640
"""A square of 128 m in cells of 0.2 m is checked."""
_NEAREST_M, _FARTHEST_M = 1.0, 8.0
"""Nearer copies are lost in the thickness of the walls themselves."""
_PEAK = 5.3
"""Times the usual unevenness. Sound maps of streets give 2 at most, of 24 scans with side walls alike 4.7; copies
shifted by 1 to 5 m 6 to 20."""
_NEAR_CELL_M, _NEAR_SIDE = 0.1, 1024
_BESIDE_M = (0.4, 1.4)
"""Copies so near are looked for on a finer picture."""
_CONTRAST = 0.02
"""Of nine sound maps (six simulated, two of KITTI, a campus) none gives more than 0; copies shifted by .6 m .04 to .16:
on the campus, whose walls are hedges and noise, less than 0 too."""
_PATCH_M, _PATCH_POINTS = 1.0, 12
_UPRIGHT = 0.35
"""Of a patch's normal, its part along z: what is steeper than 70 deg stands."""
_LEAN_DEG, _LEAN_SIGMAS = 1.5, 4.0
_ALIKE = 10.0
"""So many neighbouring patches lie on one wall and say the same."""


def ghost_layer(height: F64) -> float | None:
    """How far above (+) or below the ground a second one lies, metres; None if there is none.

    ``height`` (n,) of points over the ground. A second road is as sharp a peak of their histogram as the first; kerbs,
    cars and hedges are broad.
    """
    if (np.abs(height) < 1.0).sum() < _FEW:
        return None
    count, edges = np.histogram(height[np.isfinite(height)], bins=np.arange(-2.5, 2.5, _BIN_M))
    peak = np.convolve(count, np.ones(3), mode="same")
    middle = 0.5 * (edges[1:] + edges[:-1])
    ground = float(peak[np.abs(middle) < 0.15].max())
    away = np.abs(middle) >= 0.35
    best = int(np.argmax(np.where(away, peak, 0)))
    around = np.abs(middle - middle[best])
    beside = float(np.median(peak[(around > 0.15) & (around < 0.4) & (np.abs(middle) > 0.15)]))
    return float(middle[best]) if peak[best] > 0.3 * ground and peak[best] > 2.0 * beside else None


def ghost_shift(standing: F64) -> tuple[float, float] | None:
    """(x, y) by which what stands is there twice, metres; None if it is not.

    ``standing`` (n, 3), points of walls and poles. Their picture from above is compared with itself, shifted. Farther
    than a metre only a copy makes a sharp peak, apart from shifts along straight walls. Nearer, walls are like
    themselves at every shift along them, but less so the larger it is: only a copy is more alike at its shift than at
    half of that.
    """
    if len(standing) < _FEW:
        return None
    reach = int(_FARTHEST_M / _CELL_M)
    near = _likeness(standing, _CELL_M, _SIDE, reach)
    usual = 1.4826 * float(np.median(np.abs(near - np.median(near))))
    # Only what rises above everything half a metre around it is a copy.
    ring = np.ones((7, 7), dtype=bool)
    ring[2:5, 2:5] = False
    sharp = near - scipy.ndimage.percentile_filter(near, 90, footprint=ring)
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1] * _CELL_M
    sharp[(np.hypot(x, y) < _NEAREST_M) | (near < scipy.ndimage.maximum_filter(near, 5))] = 0.0
    best = np.unravel_index(int(np.argmax(sharp)), sharp.shape)
    if sharp[best] >= _PEAK * usual:
        return float(x[best]), float(y[best])
    return _shift_beside(standing)


def _likeness(standing: F64, cell_m: float, side: int, reach: int) -> F64:
    """(2 reach + 1, 2 reach + 1) how much the picture from above is like itself, by shift in cells along y and x."""
    centre = np.median(standing[:, :2], axis=0)
    cells = np.floor((standing[:, :2] - centre) / cell_m).astype(np.int64) + side // 2
    cells = cells[((cells >= 0) & (cells < side)).all(axis=1)]
    picture = np.zeros((side, side))
    picture[cells[:, 1], cells[:, 0]] = 1.0
    picture -= scipy.ndimage.uniform_filter(picture, 25)
    # Half of the whitening that would leave only phases: walls are like themselves all along, copies are not.
    spectrum = np.abs(np.fft.rfft2(picture, s=(2 * side, 2 * side)))
    likeness = np.fft.fftshift(np.fft.irfft2(spectrum))
    near = likeness[side - reach : side + reach + 1, side - reach : side + reach + 1]
    return np.asarray(scipy.ndimage.uniform_filter(near, 3))


def _shift_beside(standing: F64) -> tuple[float, float] | None:
    reach = int(1.7 * _BESIDE_M[1] / _NEAR_CELL_M)
    near = _likeness(standing, _NEAR_CELL_M, _NEAR_SIDE, reach)
    near /= near[reach, reach]
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1].astype(np.float64)
    half, more = (
        scipy.ndimage.map_coordinates(near, [reach + f * y, reach + f * x], order=1, mode="nearest") for f in (0.5, 1.5)
    )
    contrast = near - np.maximum(half, more)
    away_m = np.hypot(x, y) * _NEAR_CELL_M
    contrast[(away_m < _BESIDE_M[0]) | (away_m > _BESIDE_M[1])] = 0.0
    best = np.unravel_index(int(np.argmax(contrast)), contrast.shape)
    if contrast[best] < _CONTRAST:
        return None
    return float(x[best]) * _NEAR_CELL_M, float(y[best]) * _NEAR_CELL_M


def check_lean(standing: F64) -> list[Finding]:
    """Do walls and poles stand upright? On a slope they do; in a map that is tilted they lean. ``standing`` (n, 3)."""
    sides = _sides(standing)
    if len(sides) < 3 * _ALIKE:
        return []
    # What stands along (a, b, 1) has sides n with n_x a + n_y b = -n_z: Cauchy's robust least squares.
    A, b = sides[:, :2], -sides[:, 2]
    lean: F64 = np.zeros(2)
    for _ in range(20):
        off = A @ lean - b
        spread = max(1.4826 * float(np.median(np.abs(off))), 0.005)
        weighted = A / (1.0 + (off / (1.5 * spread)) ** 2)[:, None]
        normal = weighted.T @ A + 1e-9 * np.eye(2)
        lean = np.asarray(np.linalg.solve(normal, weighted.T @ b))
    by = float(np.linalg.norm(lean))
    along = lean / max(by, 1e-9)
    sigma_deg = float(np.degrees(spread * np.sqrt(_ALIKE * along @ np.linalg.inv(normal) @ along)))
    by_deg = float(np.degrees(np.arctan(by)))
    if by_deg <= max(_LEAN_DEG, _LEAN_SIGMAS * sigma_deg):
        return []
    pitch, roll = np.degrees(np.arctan(lean[0])), np.degrees(np.arctan(-lean[1]))
    what = f"walls and poles lean by {by_deg:.1f} deg (+-{sigma_deg:.1f}): the map is tilted"
    mend = f"level it: turn its points back by pitch {pitch:.1f} deg (about y) and roll {roll:.1f} deg (about x)"
    return [Finding("warning", what, mend)]


def _sides(standing: F64) -> F64:
    """(m, 3) directions, near the horizontal, square to what stands: normals of walls, two for each pole."""
    if len(standing) < _FEW:
        return np.empty((0, 3))
    voxel = np.floor((standing - standing.min(axis=0)) / _PATCH_M).astype(np.int64)
    key = np.ravel_multi_index(tuple(voxel.T), tuple(voxel.max(axis=0) + 1))
    order = np.argsort(key, kind="stable")
    starts = np.flatnonzero(np.diff(key[order], prepend=-1))
    count = np.diff(np.append(starts, len(key)))
    points = standing[order] - standing.mean(axis=0)
    points -= np.repeat(np.add.reduceat(points, starts) / count[:, None], count, axis=0)
    covariance = np.add.reduceat(points[:, :, None] * points[:, None, :], starts) / count[:, None, None]
    spread, axes = np.linalg.eigh(covariance[count >= _PATCH_POINTS])
    wall = (spread[:, 0] < 0.06**2) & (spread[:, 1] > 0.2**2) & (spread[:, 0] < 0.1 * spread[:, 1])
    wall &= np.abs(axes[:, 2, 0]) < _UPRIGHT
    pole = (spread[:, 1] < 0.1**2) & (spread[:, 2] > 0.25**2) & (np.abs(axes[:, 2, 2]) > np.sqrt(1.0 - _UPRIGHT**2))
    return np.concatenate([axes[wall, :, 0], axes[pole, :, 0], axes[pole, :, 1]])
