"""The scan's side of NDT: the normal equations of one Gauss-Newton step.

Equation numbers are those of Magnusson, The Three-Dimensional Normal-Distributions Transform, 2009, chapter 6; where
we deviate, mapvote.localisation.ndt says how. Steps are inlined by numba; docs/measurements/speed.md tells the cost.
"""

from __future__ import annotations

import numba
import numpy as np

from mapvote.core.types import F64, I32
from mapvote.localisation.ndt_voxels import Symmetric, Vector, Window, holds, voxel_of

INLIER_E = 7.81
"""Squared Mahalanobis distance below which a point agrees with a voxel: 95 % of chi-square, 3 degrees of freedom."""
CUTOFF_E = 25.0
"""Beyond this a voxel's pull on a point, exp(-e / 2), is nothing."""


@numba.njit(inline="always")
def _neighbour(j: int) -> tuple[int, int, int]:
    """Way to the j-th of seven voxels: the point's own and the six beside it (DIRECT7). Unrolled by the compiler."""
    dx = (1 if j == 1 else 0) - (1 if j == 2 else 0)
    dy = (1 if j == 3 else 0) - (1 if j == 4 else 0)
    dz = (1 if j == 5 else 0) - (1 if j == 6 else 0)
    return dx, dy, dz


@numba.njit(inline="always")
def transform_point(R: F64, points: F64, i: int) -> Vector:
    """Point i turned into map axes, about the sensor: so that rotation and position stay separate unknowns."""
    x = R[0, 0] * points[i, 0] + R[0, 1] * points[i, 1] + R[0, 2] * points[i, 2]
    y = R[1, 0] * points[i, 0] + R[1, 1] * points[i, 1] + R[1, 2] * points[i, 2]
    z = R[2, 0] * points[i, 0] + R[2, 1] * points[i, 1] + R[2, 2] * points[i, 2]
    return x, y, z


@numba.njit(inline="always")
def linearise(
    rows: I32, size: float, cells: F64, ix: np.int64, iy: np.int64, iz: np.int64, ox: float, oy: float, oz: float
) -> tuple[Symmetric, Vector, float]:
    """Pull of the voxel (ix, iy, iz) of ``rows`` and the six beside it on a point at (ox, oy, oz) from its centre.

    With u the point from a voxel's mean, C its precision, e = u C u and w = exp(-e / 2), the weight of Eq. (6.9) with
    d1 = d2 = 1: (A = sum of w C, b = sum of w C u, the smallest e). Gauss-Newton drops the other terms of Eq. (6.13).
    """
    a00, a01, a02, a11, a12, a22 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    b0, b1, b2 = 0.0, 0.0, 0.0
    nearest = np.inf
    for j in range(7):
        dx, dy, dz = _neighbour(j)
        k = rows[ix + dx, iy + dy, iz + dz]
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
        if e <= CUTOFF_E:
            w = np.exp(-0.5 * e)
            a00, a01, a02 = a00 + w * c00, a01 + w * c01, a02 + w * c02
            a11, a12, a22 = a11 + w * c11, a12 + w * c12, a22 + w * c22
            b0, b1, b2 = b0 + w * v0, b1 + w * v1, b2 + w * v2
    return (a00, a01, a02, a11, a12, a22), (b0, b1, b2), nearest


@numba.njit(inline="always")
def accumulate(H: F64, M: F64, g: F64, gi: F64, p: Vector, A: Symmetric, b: Vector) -> None:
    """H += J^T A J, g += J^T b (the sums of Eqs. (6.13) and (6.12)) and M += (J^T b)(J^T b)^T, upper triangles.

    J = [I, -[p]x], the derivative of the point by (rho, phi); ``gi`` (6,) is scratch.
    """
    px, py, pz = p
    a00, a01, a02, a11, a12, a22 = A
    b0, b1, b2 = b
    gi[0], gi[1], gi[2] = b0, b1, b2
    gi[3], gi[4], gi[5] = py * b2 - pz * b1, pz * b0 - px * b2, px * b1 - py * b0
    # Columns of Q = A (-[p]x) = A times ((0, pz, -py), (-pz, 0, px), (py, -px, 0)).
    q00, q01, q02 = -a01 * pz + a02 * py, a00 * pz - a02 * px, -a00 * py + a01 * px
    q10, q11, q12 = -a11 * pz + a12 * py, a01 * pz - a12 * px, -a01 * py + a11 * px
    q20, q21, q22 = -a12 * pz + a22 * py, a02 * pz - a22 * px, -a02 * py + a12 * px
    # Position: A.
    H[0, 0] += a00
    H[0, 1] += a01
    H[0, 2] += a02
    H[1, 1] += a11
    H[1, 2] += a12
    H[2, 2] += a22
    # Position by rotation: Q.
    H[0, 3] += q00
    H[0, 4] += q01
    H[0, 5] += q02
    H[1, 3] += q10
    H[1, 4] += q11
    H[1, 5] += q12
    H[2, 3] += q20
    H[2, 4] += q21
    H[2, 5] += q22
    # Rotation: (-[p]x)^T Q.
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


@numba.njit(cache=True, nogil=True)
def normal_equations(points: F64, R: F64, t: F64, window: Window, cells: F64) -> tuple[F64, F64, F64, float, float]:
    """H, g of the reweighted least squares at pose (R, t); M, the sum of g_i g_i^T; mean likelihood; inlier share."""
    H, M, g, gi = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros(6), np.empty(6)
    likelihood, inliers = 0.0, 0
    rows, lowest, size = window  # unpacked once: a group handed on for each point would cost a little
    for i in range(len(points)):
        p = transform_point(R, points, i)
        x, y, z = p[0] + t[0], p[1] + t[1], p[2] + t[2]
        ax, ay, az = voxel_of(size, x, y, z)
        ix, iy, iz = ax - lowest[0], ay - lowest[1], az - lowest[2]
        if not holds(rows, ix, iy, iz, 1):
            continue
        ox, oy, oz = x - (ax + 0.5) * size, y - (ay + 0.5) * size, z - (az + 0.5) * size
        A, b, nearest = linearise(rows, size, cells, ix, iy, iz, ox, oy, oz)
        if nearest == np.inf:
            continue
        likelihood += np.exp(-0.5 * nearest)
        if nearest < INLIER_E:
            inliers += 1
        accumulate(H, M, g, gi, p, A, b)
    for r in range(6):
        for c in range(r):
            H[r, c] = H[c, r]
            M[r, c] = M[c, r]
    n = max(1, len(points))
    return H, g, M, likelihood / n, inliers / n
