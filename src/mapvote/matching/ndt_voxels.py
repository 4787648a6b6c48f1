"""The map side of NDT: points become a normal distribution per voxel, in a window around a vehicle.

Magnusson, The Three-Dimensional Normal-Distributions Transform, 2009, chapter 6, whose numbers the equations have, with
three changes: every voxel's distribution is widened by an isotropic floor instead of an eigenvalue clamp; Gauss-Newton
steps on the reweighted form (:mod:`mapvote.matching.ndt`) replace full Newton, which diverges from 0.4 m; voxels
are found through a dense index over a bounded window. In a finished map the window is made of tiles, whose voxels are
summed up before they are needed. numba inlines the steps; docs/measurements/speed.md has the cost.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mapvote.core.kernel import inlined, kernel
from mapvote.core.record import record
from mapvote.core.types import F32, F64, I32, I64


@dataclass(frozen=True, slots=True)
class Level:
    """One step of the coarse-to-fine search."""

    voxel_m: float
    """Side of the NDT voxels."""
    floor_m: float
    """Standard deviation added to every voxel's distribution, isotropic."""
    points_m: float
    """The scan is thinned to one point per voxel of this side."""
    iterations: int
    """Most Gauss-Newton steps at this level."""


@record(votes=True)
@dataclass(frozen=True, slots=True)
class NdtVoxelRule:
    """Levels of voxels, and voxels that have a distribution."""

    levels: tuple[Level, ...] = (Level(3.0, 0.5, 1.0, 15), Level(2.0, 0.25, 1.0, 15), Level(1.0, 0.1, 0.7, 15))
    """Coarse to fine: voxels of the paper's 0.3 m have no basin, and denser scans gave no better median."""
    min_points: int = 3
    """Points of a voxel with a distribution, at least: two make a line."""
    flatness: float = 0.08
    """Spread of a voxel's points in height, as a share of its side, below which it is a flat patch."""


NDT_VOXEL_RULE = NdtVoxelRule()
LEVELS = NDT_VOXEL_RULE.levels
# Kernels take no records: they read these names.
MIN_POINTS = NDT_VOXEL_RULE.min_points
FLATNESS = NDT_VOXEL_RULE.flatness
SEVEN = np.array([(0, 0, 0), (1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)])
"""(7, 3) ways to a point's own voxel and the six beside it (DIRECT7)."""

Vector = tuple[float, float, float]


class Window(NamedTuple):
    """The part of space in which voxels are found."""

    rows: I32
    """(nx, ny, nz) row of each voxel in :class:`Voxels`, or -1."""
    lowest: I64
    """(3,) world voxel of rows[0, 0, 0]."""
    size: float
    """Side of a voxel, metres."""
    flat: I32
    """The rows, flat ..."""
    beside: I64
    """... and (7,) ways there to a voxel and the six beside it."""


def window_of(shape: I64, lowest: I64, size: float) -> Window:
    """An empty one of ``shape`` (3,)."""
    nx, ny, nz = shape.tolist()
    rows = np.full((nx, ny, nz), -1, dtype=np.int32)
    return Window(rows, lowest, size, rows.reshape(-1), SEVEN @ [ny * nz, nz, 1])


class Voxels(NamedTuple):
    """All voxels that points ever fell into, inside the window or not."""

    place: I64
    """(m, 3) world voxel of each row."""
    sums: F64
    """(m, 11) count, first and second moments about the voxel's centre (x y z xx xy xz yy yz zz), 1 if the distribution
    is older than they are."""
    cells: F32
    """(m, 9) mean from the voxel's centre, and the precision xx, xy, xz, yy, yz, zz; zeros without a distribution. A
    row mostly lies in one line of the processor's cache."""


@inlined
def _diagonalise(A: F64, V: F64) -> None:
    """Jacobi's method on the upper triangle of a symmetric (3, 3) A, in place; the columns of V are eigenvectors."""
    for r in range(3):
        for k in range(3):
            V[r, k] = 1.0 if r == k else 0.0
    for _ in range(8):
        off = abs(A[0, 1]) + abs(A[0, 2]) + abs(A[1, 2])
        if off < 1e-10 * (abs(A[0, 0]) + abs(A[1, 1]) + abs(A[2, 2])):
            return
        for p, q, r in ((0, 1, 2), (0, 2, 1), (1, 2, 0)):
            if A[p, q] == 0.0:
                continue
            theta = 0.5 * (A[q, q] - A[p, p]) / A[p, q]
            t = (1.0 if theta >= 0.0 else -1.0) / (abs(theta) + np.sqrt(theta * theta + 1.0))
            c = 1.0 / np.sqrt(t * t + 1.0)
            s = t * c
            A[p, p] -= t * A[p, q]
            A[q, q] += t * A[p, q]
            A[p, q] = 0.0
            rp = A[min(r, p), max(r, p)]
            rq = A[min(r, q), max(r, q)]
            A[min(r, p), max(r, p)] = c * rp - s * rq
            A[min(r, q), max(r, q)] = s * rp + c * rq
            for k in range(3):
                vp = V[k, p]
                vq = V[k, q]
                V[k, p] = c * vp - s * vq
                V[k, q] = s * vp + c * vq


@inlined
def _order(A: F64, V: F64) -> None:
    """Eigenvalues (diagonal of A) and eigenvectors (columns of V) in ascending order."""
    for p, q in ((0, 1), (1, 2), (0, 1)):
        if A[p, p] > A[q, q]:
            A[p, p], A[q, q] = A[q, q], A[p, p]
            for k in range(3):
                V[k, p], V[k, q] = V[k, q], V[k, p]


@inlined
def _upright(V: F64) -> None:
    """The first column becomes the upward direction across the last one."""
    x = V[0, 2]
    y = V[1, 2]
    z = V[2, 2]
    length = np.sqrt(max(1.0 - z * z, 1e-12))
    V[0, 0] = -x * z / length
    V[1, 0] = -y * z / length
    V[2, 0] = (1.0 - z * z) / length


@inlined
def voxel_of(size: float, x: float, y: float, z: float) -> tuple[np.int64, np.int64, np.int64]:
    """World voxel of a point, map metres."""
    return np.int64(np.floor(x / size)), np.int64(np.floor(y / size)), np.int64(np.floor(z / size))


@inlined
def holds(rows: I32, ix: np.int64, iy: np.int64, iz: np.int64, margin: int) -> bool:
    """Whether the window has this voxel (counted from its lowest), and ``margin`` more to all sides."""
    nx, ny, nz = rows.shape
    return margin <= ix < nx - margin and margin <= iy < ny - margin and margin <= iz < nz - margin


@inlined
def _add_moments(sums: F64, k: int, x: float, y: float, z: float) -> None:
    """One more point in voxel ``k``, from its centre: the sums behind Eqs. (6.2) and (6.3)."""
    sums[k, 0] += 1.0
    sums[k, 1] += x
    sums[k, 2] += y
    sums[k, 3] += z
    sums[k, 4] += x * x
    sums[k, 5] += x * y
    sums[k, 6] += x * z
    sums[k, 7] += y * y
    sums[k, 8] += y * z
    sums[k, 9] += z * z


@inlined
def _mean_and_covariance(sums: F64, k: int, A: F64) -> Vector:
    """Eqs. (6.2) and (6.3), divided by the count: the mean is returned, the upper triangle of A is the covariance."""
    m = sums[k, 0]
    mx = sums[k, 1] / m
    my = sums[k, 2] / m
    mz = sums[k, 3] / m
    A[0, 0] = sums[k, 4] / m - mx * mx
    A[0, 1] = sums[k, 5] / m - mx * my
    A[0, 2] = sums[k, 6] / m - mx * mz
    A[1, 1] = sums[k, 7] / m - my * my
    A[1, 2] = sums[k, 8] / m - my * mz
    A[2, 2] = sums[k, 9] / m - mz * mz
    return mx, my, mz


@inlined
def _set_precision(cells: F32, k: int, A: F64, V: F64, floor_variance: float, even: float) -> None:
    """The inverse covariance of voxel ``k`` from eigenvalues (diagonal of A) and eigenvectors (columns of V).

    A voxel does not constrain the position along a direction in which it is filled evenly. The precision of an even
    filling, less two standard deviations of its sample variance, is taken off (``even``); otherwise the rhythm of the
    voxels would hold a vehicle in place on a bare road.
    """
    xx = xy = xz = yy = yz = zz = 0.0
    for d in range(3):
        b = max(0.0, 1.0 / (max(A[d, d], 0.0) + floor_variance) - even)
        xx += b * V[0, d] * V[0, d]
        xy += b * V[0, d] * V[1, d]
        xz += b * V[0, d] * V[2, d]
        yy += b * V[1, d] * V[1, d]
        yz += b * V[1, d] * V[2, d]
        zz += b * V[2, d] * V[2, d]
    cells[k, 3] = xx
    cells[k, 4] = xy
    cells[k, 5] = xz
    cells[k, 6] = yy
    cells[k, 7] = yz
    cells[k, 8] = zz


@kernel
def refresh(voxels: Voxels, touched: I64, size: float, floor_m: float, scratch: F64) -> None:
    """The distributions of the rows ``touched`` (m,), from their sums. A distribution needs MIN_POINTS, and is
    widened by ``floor_m`` to all sides; ``size``: side of a voxel, metres; ``scratch`` (2, 3, 3)."""
    A = scratch[0]
    V = scratch[1]
    sums = voxels.sums
    thin = (FLATNESS * size) * (FLATNESS * size)
    floor_variance = floor_m * floor_m
    for k in touched:
        sums[k, 10] = 0.0
        m = sums[k, 0]
        if m < MIN_POINTS:
            for c in range(9):
                voxels.cells[k, c] = 0.0
            continue
        voxels.cells[k, 0], voxels.cells[k, 1], voxels.cells[k, 2] = _mean_and_covariance(sums, k, A)
        flat = A[2, 2] < thin
        _diagonalise(A, V)
        _order(A, V)
        if flat:
            # It constrains its height only. One ring on the road is a line, thin to all sides: taken literally it would
            # hold the next scan's rings where the last ones were.
            if A[1, 1] < thin:
                _upright(V)
            A[1, 1] = A[2, 2] = np.inf
        even_variance = size * size / 12.0 * max(0.0, 1.0 - 2.0 * np.sqrt(0.8 / m))
        _set_precision(voxels.cells, k, A, V, floor_variance, 1.0 / (even_variance + floor_variance))


@kernel
def enter_points(points: F64, window: Window, voxels: Voxels, n: int, touched: I64) -> tuple[int, int, int]:
    """Enter points (n, 3) in map metres into the sums of their voxels.

    Returns (the new number of rows, how many points were read, how many rows to :func:`refresh` are new in
    ``touched`` (n,)): fewer points than all where ``voxels`` has no row left, so that rows are made for voxels and not
    for points. Points outside ``window`` are left out.
    """
    rows = window.rows
    lowest = window.lowest
    size = window.size
    sums = voxels.sums
    n_touched = 0
    looked_at = len(points)
    for i in range(len(points)):
        ax, ay, az = voxel_of(size, points[i, 0], points[i, 1], points[i, 2])
        ix = ax - lowest[0]
        iy = ay - lowest[1]
        iz = az - lowest[2]
        if not holds(rows, ix, iy, iz, 0):
            continue
        k = rows[ix, iy, iz]
        if k < 0:
            if n == len(sums):
                looked_at = i
                break
            k = n
            n += 1
            rows[ix, iy, iz] = k
            voxels.place[k, 0] = ax
            voxels.place[k, 1] = ay
            voxels.place[k, 2] = az
            for c in range(11):
                sums[k, c] = 0.0
        if sums[k, 10] == 0.0:
            sums[k, 10] = 1.0
            touched[n_touched] = k
            n_touched += 1
        x = points[i, 0] - (ax + 0.5) * size
        y = points[i, 1] - (ay + 0.5) * size
        z = points[i, 2] - (az + 0.5) * size
        _add_moments(sums, k, x, y, z)
    return n, looked_at, n_touched


@kernel
def join_voxels(others: Voxels, window: Window, voxels: Voxels, n: int, shared: I64) -> tuple[int, int]:
    """Add the voxels (m,) of points that are not in ``voxels`` yet. ``voxels`` must have a row left for each.

    Returns (the new number of rows, how many of ``shared`` (m,) are filled): rows that both have, to :func:`refresh`.
    Voxels outside ``window`` are left out.
    """
    rows = window.rows
    lowest = window.lowest
    n_shared = 0
    for j in range(len(others.place)):
        ix = others.place[j, 0] - lowest[0]
        iy = others.place[j, 1] - lowest[1]
        iz = others.place[j, 2] - lowest[2]
        if not holds(rows, ix, iy, iz, 0):
            continue
        k = rows[ix, iy, iz]
        if k >= 0:
            for c in range(11):
                voxels.sums[k, c] += others.sums[j, c]
            shared[n_shared] = k
            n_shared += 1
            continue
        rows[ix, iy, iz] = n
        for c in range(3):
            voxels.place[n, c] = others.place[j, c]
        for c in range(11):
            voxels.sums[n, c] = others.sums[j, c]
        for c in range(9):
            voxels.cells[n, c] = others.cells[j, c]
        n += 1
    return n, n_shared


class NdtGrid:
    """One level of the map: voxels of one size. All are kept; those inside the window can be found."""

    def __init__(self, level: Level, window: Window, room: int = 1024) -> None:
        """``room``: voxels that it has memory for at first."""
        self.level = level
        self.window = window
        self.n = 0
        self._voxels = _room_for(room)
        self._stale = list[I64]()

    @property
    def voxels(self) -> Voxels:
        """With the distributions of all entered points, computed when they are read: of a map that grows the
        coarse levels hardly ever are."""
        for rows in self._stale:
            self._refresh(rows)
        self._stale.clear()
        return self._voxels

    def _refresh(self, rows: I64) -> None:
        refresh(self._voxels, rows, self.level.voxel_m, self.level.floor_m, np.empty((2, 3, 3)))

    def clear(self) -> None:
        """Forget all voxels; their memory stays."""
        self.n = 0
        self._stale.clear()

    def move(self, lowest_map: F64) -> None:
        """Let the window begin at this corner (3,), map metres: what was entered and lies inside is found again."""
        self.window.lowest[:] = np.round(lowest_map / self.level.voxel_m).astype(np.int64)
        self.window.rows.fill(-1)
        if self.n:
            at = self._voxels.place[: self.n] - self.window.lowest
            inside = np.flatnonzero(((at >= 0) & (at < self.window.rows.shape)).all(axis=1))
            self.window.rows[tuple(at[inside].T)] = inside

    def enter(self, points_map: F64) -> None:
        """Enter points (n, 3) in map metres; those outside the window are left out."""
        left = points_map
        while len(left):
            if self.n == len(self._voxels.place):
                self._voxels = Voxels(*(np.concatenate([a, np.zeros_like(a)]) for a in self._voxels))
            touched = np.empty(len(left), dtype=np.int64)
            self.n, looked_at, n_touched = enter_points(left, self.window, self._voxels, self.n, touched)
            self._stale.append(touched[:n_touched].copy())
            left = left[looked_at:]

    def join(self, others: Sequence[Voxels]) -> None:
        """Add voxels of this level, of points that were not entered; those outside the window are left out."""
        room = self.n + sum(len(more.place) for more in others)
        if room > len(self._voxels.place):
            more = _room_for(room - self.n)
            place, sums, cells = self._voxels
            self._voxels = Voxels(
                np.concatenate([place[: self.n], more.place]),
                np.concatenate([sums[: self.n], more.sums]),
                np.concatenate([cells[: self.n], more.cells]),
            )
        shared = np.empty(room - self.n, dtype=np.int64)
        n_shared = 0
        for part in others:
            self.n, more_shared = join_voxels(part, self.window, self._voxels, self.n, shared[n_shared:])
            n_shared += more_shared
        self._refresh(shared[:n_shared])


def _room_for(n: int) -> Voxels:
    return Voxels(np.zeros((n, 3), dtype=np.int64), np.zeros((n, 11)), np.zeros((n, 9), dtype=np.float32))
