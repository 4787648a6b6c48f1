"""The hot loops of NDT: sums per voxel, and the normal equations of one Gauss-Newton step.

Plain arrays in and out. ``index`` (nx, ny, nz) int32 is the dense window: row of a voxel in the other arrays, or
-1; ``lowest`` (3,) is the world voxel of index[0, 0, 0]; ``voxels`` (m, 3) world voxel of each row; ``sums`` (m, 11)
count, first and second moments about the voxel's centre, scratch; ``cells`` (m, 9) mean from the voxel's centre and
upper triangle of the precision, all zero without a distribution.
"""

from __future__ import annotations

import numba
import numpy as np

from mapvote.core.types import F64, I32, I64

INLIER_E = 7.81
"""Squared Mahalanobis distance below which a point agrees with a voxel: 95 % of chi-square, 3 degrees of freedom."""
FLATNESS = 0.08
"""A voxel whose points spread less than this share of its side in height is a flat patch."""
CUTOFF_E = 25.0
"""Beyond this a voxel's pull on a point, exp(-e / 2), is nothing."""


@numba.njit(cache=True, nogil=True)
def _diagonalise(A: F64, V: F64) -> None:
    """Jacobi's method on the upper triangle of a symmetric (3, 3) A, in place; the columns of V are eigenvectors."""
    V[:] = 0.0
    V[0, 0] = V[1, 1] = V[2, 2] = 1.0
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
                vp, vq = V[k, p], V[k, q]
                V[k, p] = c * vp - s * vq
                V[k, q] = s * vp + c * vq


@numba.njit(cache=True, nogil=True)
def _order(A: F64, V: F64) -> None:
    """Eigenvalues (diagonal of A) and eigenvectors (columns of V) in ascending order."""
    for p, q in ((0, 1), (1, 2), (0, 1)):
        if A[p, p] > A[q, q]:
            A[p, p], A[q, q] = A[q, q], A[p, p]
            for k in range(3):
                V[k, p], V[k, q] = V[k, q], V[k, p]


@numba.njit(cache=True, nogil=True)
def _upright(V: F64) -> None:
    """The first column becomes the upward direction across the last one."""
    x, y, z = V[0, 2], V[1, 2], V[2, 2]
    length = np.sqrt(max(1.0 - z * z, 1e-12))
    V[0, 0], V[1, 0], V[2, 0] = -x * z / length, -y * z / length, (1.0 - z * z) / length


@numba.njit(cache=True, nogil=True)
def enter_points(
    points: F64,
    lowest: I64,
    size: float,
    floor_m: float,
    min_points: int,
    index: I32,
    voxels: I64,
    sums: F64,
    cells: F64,
    n: int,
) -> int:
    """Enter points (map metres) into the voxels' sums and refresh the distributions they touch. Returns the new n."""
    touched = np.empty(len(points), dtype=np.int64)
    n_touched = 0
    for i in range(len(points)):
        ax = np.int64(np.floor(points[i, 0] / size))
        ay = np.int64(np.floor(points[i, 1] / size))
        az = np.int64(np.floor(points[i, 2] / size))
        ix, iy, iz = ax - lowest[0], ay - lowest[1], az - lowest[2]
        if not (0 <= ix < index.shape[0] and 0 <= iy < index.shape[1] and 0 <= iz < index.shape[2]):
            continue
        k = index[ix, iy, iz]
        if k < 0:
            k = n
            n += 1
            index[ix, iy, iz] = k
            voxels[k, 0], voxels[k, 1], voxels[k, 2] = ax, ay, az
            sums[k, :] = 0.0
        x = points[i, 0] - (ax + 0.5) * size
        y = points[i, 1] - (ay + 0.5) * size
        z = points[i, 2] - (az + 0.5) * size
        if sums[k, 10] == 0.0:
            sums[k, 10] = 1.0
            touched[n_touched] = k
            n_touched += 1
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
    # Along a direction in which a voxel is filled evenly it says nothing about position. The precision of an even
    # filling, less two standard deviations of its sample variance, is taken off; otherwise the rhythm of the voxels
    # would hold a vehicle in place on a bare road.
    A, V = np.empty((3, 3)), np.empty((3, 3))
    flat = FLATNESS * size
    for j in range(n_touched):
        k = touched[j]
        sums[k, 10] = 0.0
        m = sums[k, 0]
        if m < min_points:
            cells[k, :] = 0.0
            continue
        mx, my, mz = sums[k, 1] / m, sums[k, 2] / m, sums[k, 3] / m
        A[0, 0], A[0, 1], A[0, 2] = sums[k, 4] / m - mx * mx, sums[k, 5] / m - mx * my, sums[k, 6] / m - mx * mz
        A[1, 1], A[1, 2], A[2, 2] = sums[k, 7] / m - my * my, sums[k, 8] / m - my * mz, sums[k, 9] / m - mz * mz
        var_z = A[2, 2]
        _diagonalise(A, V)
        cells[k, 0], cells[k, 1], cells[k, 2] = mx, my, mz
        cells[k, 3:] = 0.0
        even_variance = size * size / 12.0 * max(0.0, 1.0 - 2.0 * np.sqrt(0.8 / m))
        even = 1.0 / (even_variance + floor_m * floor_m)
        _order(A, V)
        if var_z < flat * flat:
            # A flat patch knows its height only. One ring on the road is a line, thin to all sides: taken at face
            # value it would hold the next scan's rings where the last ones were.
            if A[1, 1] < flat * flat:
                _upright(V)
            A[1, 1] = A[2, 2] = np.inf
        for d in range(3):
            b = max(0.0, 1.0 / (max(A[d, d], 0.0) + floor_m * floor_m) - even)
            cells[k, 3] += b * V[0, d] * V[0, d]
            cells[k, 4] += b * V[0, d] * V[1, d]
            cells[k, 5] += b * V[0, d] * V[2, d]
            cells[k, 6] += b * V[1, d] * V[1, d]
            cells[k, 7] += b * V[1, d] * V[2, d]
            cells[k, 8] += b * V[2, d] * V[2, d]
    return n


@numba.njit(cache=True, nogil=True)
def reindex(voxels: I64, n: int, lowest: I64, index: I32) -> None:
    index[:] = -1
    for k in range(n):
        ix, iy, iz = voxels[k, 0] - lowest[0], voxels[k, 1] - lowest[1], voxels[k, 2] - lowest[2]
        if 0 <= ix < index.shape[0] and 0 <= iy < index.shape[1] and 0 <= iz < index.shape[2]:
            index[ix, iy, iz] = k


@numba.njit(cache=True, nogil=True)
def normal_equations(
    points: F64, R: F64, t: F64, lowest: I64, size: float, index: I32, cells: F64
) -> tuple[F64, F64, F64, float, float]:
    """H, g of the reweighted least squares at pose (R, t); M, the sum of g_i g_i^T; mean likelihood; inlier share."""
    H = np.zeros((6, 6))
    M = np.zeros((6, 6))
    g = np.zeros(6)
    gi = np.empty(6)
    likelihood = 0.0
    inliers = 0
    nx, ny, nz = index.shape
    for i in range(len(points)):
        # The lever arm is measured from the sensor, so that rotation and position stay separate unknowns.
        px = R[0, 0] * points[i, 0] + R[0, 1] * points[i, 1] + R[0, 2] * points[i, 2]
        py = R[1, 0] * points[i, 0] + R[1, 1] * points[i, 1] + R[1, 2] * points[i, 2]
        pz = R[2, 0] * points[i, 0] + R[2, 1] * points[i, 1] + R[2, 2] * points[i, 2]
        x, y, z = px + t[0], py + t[1], pz + t[2]
        ax, ay, az = np.int64(np.floor(x / size)), np.int64(np.floor(y / size)), np.int64(np.floor(z / size))
        ix, iy, iz = ax - lowest[0], ay - lowest[1], az - lowest[2]
        if ix < 1 or iy < 1 or iz < 1 or ix >= nx - 1 or iy >= ny - 1 or iz >= nz - 1:
            continue
        # Offsets from the centre of the point's own voxel.
        ox, oy, oz = x - (ax + 0.5) * size, y - (ay + 0.5) * size, z - (az + 0.5) * size
        a00, a01, a02, a11, a12, a22 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        b0, b1, b2 = 0.0, 0.0, 0.0
        nearest = np.inf
        for j in range(7):
            dx = (1 if j == 1 else 0) - (1 if j == 2 else 0)
            dy = (1 if j == 3 else 0) - (1 if j == 4 else 0)
            dz = (1 if j == 5 else 0) - (1 if j == 6 else 0)
            k = index[ix + dx, iy + dy, iz + dz]
            if k < 0 or cells[k, 3] + cells[k, 6] + cells[k, 8] == 0.0:
                continue
            ux = ox - dx * size - cells[k, 0]
            uy = oy - dy * size - cells[k, 1]
            uz = oz - dz * size - cells[k, 2]
            c00, c01, c02, c11, c12, c22 = cells[k, 3], cells[k, 4], cells[k, 5], cells[k, 6], cells[k, 7], cells[k, 8]
            v0 = c00 * ux + c01 * uy + c02 * uz
            v1 = c01 * ux + c11 * uy + c12 * uz
            v2 = c02 * ux + c12 * uy + c22 * uz
            e = ux * v0 + uy * v1 + uz * v2
            nearest = min(nearest, e)
            if e > CUTOFF_E:
                continue
            w = np.exp(-0.5 * e)
            a00 += w * c00
            a01 += w * c01
            a02 += w * c02
            a11 += w * c11
            a12 += w * c12
            a22 += w * c22
            b0 += w * v0
            b1 += w * v1
            b2 += w * v2
        if nearest == np.inf:
            continue
        likelihood += np.exp(-0.5 * nearest)
        if nearest < INLIER_E:
            inliers += 1
        # J = [I, -[p]x]; H += J^T A J, g += J^T b, with A and b summed over the neighbours first.
        gi[0], gi[1], gi[2] = b0, b1, b2
        gi[3], gi[4], gi[5] = py * b2 - pz * b1, pz * b0 - px * b2, px * b1 - py * b0
        # Columns of C = A (-[p]x) = A times ((0, pz, -py), (-pz, 0, px), (py, -px, 0)).
        q00, q01, q02 = -a01 * pz + a02 * py, a00 * pz - a02 * px, -a00 * py + a01 * px
        q10, q11, q12 = -a11 * pz + a12 * py, a01 * pz - a12 * px, -a01 * py + a11 * px
        q20, q21, q22 = -a12 * pz + a22 * py, a02 * pz - a22 * px, -a02 * py + a12 * px
        H[0, 0] += a00
        H[0, 1] += a01
        H[0, 2] += a02
        H[1, 1] += a11
        H[1, 2] += a12
        H[2, 2] += a22
        H[0, 3] += q00
        H[0, 4] += q01
        H[0, 5] += q02
        H[1, 3] += q10
        H[1, 4] += q11
        H[1, 5] += q12
        H[2, 3] += q20
        H[2, 4] += q21
        H[2, 5] += q22
        H[3, 3] += py * q20 - pz * q10
        H[3, 4] += py * q21 - pz * q11
        H[3, 5] += py * q22 - pz * q12
        H[4, 4] += pz * q01 - px * q21
        H[4, 5] += pz * q02 - px * q22
        H[5, 5] += px * q12 - py * q02
        for r in range(6):
            g[r] += gi[r]
            for c in range(r, 6):
                M[r, c] += gi[r] * gi[c]
    for r in range(6):
        for c in range(r):
            H[r, c] = H[c, r]
            M[r, c] = M[c, r]
    n = max(1, len(points))
    return H, g, M, likelihood / n, inliers / n
