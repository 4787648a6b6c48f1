"""NDT: the pose at which a scan fits a map of Gaussians best (paper II).

One level is compiled as a whole: points are paired with the voxels around them, Gauss-Newton steps are summed over the
pairs and solved, and the pose moves until it stands still. Equation numbers are those of Magnusson, The
Three-Dimensional Normal-Distributions Transform, 2009, chapter 6; :mod:`mapvote.matching.ndt_voxels` lists what is
done otherwise. A point is compared with its own voxel and the six beside it (DIRECT7). Pairs lie in columns, so that
the sums run over vectors of them, in float32 about the sensor; they serve until the pose has moved by a share of a
voxel. Pose errors are (6,) vectors (rho, phi) in map axes about the sensor: t' = t + rho, R' = exp(phi) R.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mapvote.core.kernel import fast_math, inlined, kernel
from mapvote.core.record import record
from mapvote.core.types import F32, F64, I32, I64
from mapvote.matching.ndt_voxels import SEVEN, Vector, Window, holds, voxel_of


@record(votes=True)
@dataclass(frozen=True, slots=True)
class NdtAlignment:
    """Numbers of the alignment of a scan with distributions."""

    covariance_scale: float = 5.0
    """Factor for the correlation of neighbouring residuals, calibrated so that normalised squared errors average 6."""
    inlier_e: float = 7.81
    """Squared Mahalanobis distance below which a point agrees with a voxel: 95 % of chi-square, 3 degrees of
    freedom."""
    cutoff_e: float = 25.0
    """Squared Mahalanobis distance beyond which a voxel's pull on a point, exp(-e / 2), is neglected."""
    sum_block: int = 1024
    """Points whose sums are taken in float32 before they are added up in float64."""
    paired_at_once: int = 64
    """Points that are paired together."""
    turn_lever_m: float = 20.0
    """Distance at which a rotation is weighed against a shift, metres."""


NDT_ALIGNMENT = NdtAlignment()
# Kernels take no records: they read these names.
COVARIANCE_SCALE = NDT_ALIGNMENT.covariance_scale
INLIER_E = NDT_ALIGNMENT.inlier_e
CUTOFF_E = NDT_ALIGNMENT.cutoff_e
_SUM_BLOCK = NDT_ALIGNMENT.sum_block
PAIRED_AT_ONCE = NDT_ALIGNMENT.paired_at_once
TURN_LEVER_M = NDT_ALIGNMENT.turn_lever_m
_UNPAIRED = np.int32(-(1 << 30))
"""No point's home: all are to be paired."""


class Room(NamedTuple):
    """Buffers of an alignment of up to n points: an allocation in a kernel takes 50 ms to compile."""

    of: F32
    """(7, 9, n) of each partner of each point: the voxel's mean from ``origin`` in map axes, and its precision xx, xy,
    xz, yy, yz, zz; zeros where there is no partner."""
    home: I32
    """(3, n) the voxel that the point lay in when it was paired, as an index of the window."""
    origin: F64
    """(3,) map metres: near the sensor, so that float32 suffices."""
    moved: I64
    """(PAIRED_AT_ONCE,) and below (7, PAIRED_AT_ONCE): who is paired, with whom."""
    partner: I32
    sums: F64
    """(50,), (3, 3) and (3,): of :func:`linearise`."""
    R: F32
    d: F32
    matrices: F64
    """(7, 6, 6), (3, 6, 1) and (3, 3, 3): of :func:`align`."""
    columns: F64
    turns: F64


def room_for(n: int) -> Room:
    """Any number of alignments of up to n points, one after the other, may use it."""
    return Room(
        np.empty((7, 9, n), np.float32), np.empty((3, n), np.int32), np.zeros(3),
        np.empty(PAIRED_AT_ONCE, np.int64), np.empty((7, PAIRED_AT_ONCE), np.int32),
        np.empty(50), np.empty((3, 3), np.float32), np.empty(3, np.float32),
        np.empty((7, 6, 6)), np.empty((3, 6, 1)), np.empty((3, 3, 3)),
    )  # fmt: skip


@inlined
def _in_map(points: F32, T: F64, i: int) -> Vector:
    """Point i in map metres."""
    x = np.float64(points[0, i])
    y = np.float64(points[1, i])
    z = np.float64(points[2, i])
    return (
        T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3],
        T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
        T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3],
    )


@kernel
def pair_up(points: F32, T: F64, window: Window, cells: F32, room: Room) -> None:
    """Pair those of the points (3, n) that lie in another voxel at pose T (4, 4) than when they were last paired.

    Block by block: who has moved, where their partners are, what these say. No step waits for the memory of the one
    before, nor guesses whether there is a partner: where there is none, the first voxel's numbers are masked.
    """
    rows, lowest, size, flat, beside = window
    of = room.of
    home = room.home
    origin = room.origin
    moved = room.moved
    partner = room.partner
    stride = rows.shape[1] * rows.shape[2]
    for first in range(0, points.shape[1], PAIRED_AT_ONCE):
        m = 0
        for i in range(first, min(first + PAIRED_AT_ONCE, points.shape[1])):
            x, y, z = _in_map(points, T, i)
            ax, ay, az = voxel_of(size, x, y, z)
            ix = ax - lowest[0]
            iy = ay - lowest[1]
            iz = az - lowest[2]
            moved[m] = i
            m += 1 if (ix != home[0, i]) | (iy != home[1, i]) | (iz != home[2, i]) else 0
            home[0, i] = ix
            home[1, i] = iy
            home[2, i] = iz
        for w in range(m):
            ix = np.int64(home[0, moved[w]])
            iy = np.int64(home[1, moved[w]])
            iz = np.int64(home[2, moved[w]])
            inside = holds(rows, ix, iy, iz, 1)
            at = ix * stride + iy * rows.shape[2] + iz if inside else stride + rows.shape[2] + 1
            for j in range(7):
                partner[j, w] = flat[np.uint64(at + beside[j])] if inside else np.int32(-1)
        for j in range(7):
            x = (lowest[0] + SEVEN[j, 0] + 0.5) * size - origin[0]
            y = (lowest[1] + SEVEN[j, 1] + 0.5) * size - origin[1]
            z = (lowest[2] + SEVEN[j, 2] + 0.5) * size - origin[2]
            for w in range(m):
                at = np.uint64(moved[w])
                k = np.uint64(max(partner[j, w], np.int32(0)))
                there = np.float32(1.0) if partner[j, w] >= 0 else np.float32(0.0)
                of[j, 0, at] = there * np.float32(home[0, at] * size + x + cells[k, 0])
                of[j, 1, at] = there * np.float32(home[1, at] * size + y + cells[k, 1])
                of[j, 2, at] = there * np.float32(home[2, at] * size + z + cells[k, 2])
                for c in range(np.uint64(3), np.uint64(9)):
                    of[j, c, at] = there * cells[k, c]


@inlined
def _likelihood(e: np.float32) -> np.float32:
    """exp(-e / 2) for e from 0 to CUTOFF_E, 0 beyond: Taylor's series at a 32nd of it, squared five times. Within
    2e-4 of itself where it is least, 1e-6 where it matters; without a call, so that loops over pairs vectorise."""
    y = np.float32(-1.0 / 64.0) * min(e, np.float32(CUTOFF_E))
    s = np.float32(1.0 / 24.0) + y * np.float32(1.0 / 120.0)
    s = np.float32(1.0) + y * (np.float32(1.0) + y * (np.float32(0.5) + y * (np.float32(1.0 / 6.0) + y * s)))
    s *= s
    s *= s
    s *= s
    s *= s
    s *= s
    return s if e <= np.float32(CUTOFF_E) else np.float32(0.0)


@fast_math
def _pull(of: F32, j: int, i: int, x: np.float32, y: np.float32, z: np.float32) -> tuple[np.float32, ...]:
    """The j-th partner of point i, which lies at (x, y, z) from the origin, as (e, w C, w C u) with u the point from
    the voxel's mean, C its precision, e = u C u and w = exp(-e / 2), the weight of Eq. (6.9) with d1 = d2 = 1."""
    x = x - of[j, 0, i]
    y = y - of[j, 1, i]
    z = z - of[j, 2, i]
    c00 = of[j, 3, i]
    c01 = of[j, 4, i]
    c02 = of[j, 5, i]
    c11 = of[j, 6, i]
    c12 = of[j, 7, i]
    c22 = of[j, 8, i]
    b0 = c00 * x + c01 * y + c02 * z
    b1 = c01 * x + c11 * y + c12 * z
    b2 = c02 * x + c12 * y + c22 * z
    e = x * b0 + y * b1 + z * b2
    w = _likelihood(e)
    e = e if c00 + c11 + c22 > np.float32(0.0) else np.float32(1e9)
    return e, w * c00, w * c01, w * c02, w * c11, w * c12, w * c22, w * b0, w * b1, w * b2


@fast_math
def _both(p: tuple[np.float32, ...], q: tuple[np.float32, ...]) -> tuple[np.float32, ...]:
    """The smaller e, and the sums of the rest."""
    p0, p1, p2, p3, p4, p5, p6, p7, p8, p9 = p
    q0, q1, q2, q3, q4, q5, q6, q7, q8, q9 = q
    return min(p0, q0), p1 + q1, p2 + q2, p3 + q3, p4 + q4, p5 + q5, p6 + q6, p7 + q7, p8 + q8, p9 + q9


@fast_math
def _sum_block(points: F32, of: F32, first: int, last: int, R: F32, d: F32, sums: F64) -> None:
    """Add up points from ``first`` to ``last`` at rotation R (3, 3), the sensor at ``d`` (3,) metres from the origin.

    ``sums`` (50,): the upper triangle of H = J^T w C J row by row, g = J^T w C u (the sums of Eqs. (6.13) and (6.12),
    of which Gauss-Newton drops the other terms), the upper triangle of the sum of g_i g_i^T, likelihoods, inliers.
    J = [I, -[p]x] is the derivative of the point by (rho, phi). One vector lane a point; no stores, no branches.
    """
    zero, at = np.float32(0.0), np.int64(0)  # a number: by seven literals _pull would be compiled seven times
    h00, h01, h02, h11, h12, h22 = zero, zero, zero, zero, zero, zero
    q00, q01, q02, q10, q11, q12, q20, q21, q22 = zero, zero, zero, zero, zero, zero, zero, zero, zero
    r00, r01, r02, r11, r12, r22 = zero, zero, zero, zero, zero, zero
    s0, s1, s2, s3, s4, s5, likelihood, inliers = zero, zero, zero, zero, zero, zero, zero, zero
    m00, m01, m02, m03, m04, m05, m11, m12 = zero, zero, zero, zero, zero, zero, zero, zero
    m13, m14, m15, m22, m23, m24, m25 = zero, zero, zero, zero, zero, zero, zero
    m33, m34, m35, m44, m45, m55 = zero, zero, zero, zero, zero, zero
    for i in range(np.uint64(first), np.uint64(last)):  # unsigned: an index that cannot be negative vectorises
        x, y, z = points[0, i], points[1, i], points[2, i]
        px = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z
        py = R[1, 0] * x + R[1, 1] * y + R[1, 2] * z
        pz = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z
        x, y, z = px + d[0], py + d[1], pz + d[2]
        pull = _both(_pull(of, at, i, x, y, z), _pull(of, at + 1, i, x, y, z))
        pull = _both(pull, _both(_pull(of, at + 2, i, x, y, z), _pull(of, at + 3, i, x, y, z)))
        pull = _both(pull, _both(_pull(of, at + 4, i, x, y, z), _pull(of, at + 5, i, x, y, z)))
        e, c00, c01, c02, c11, c12, c22, g0, g1, g2 = _both(pull, _pull(of, at + 6, i, x, y, z))
        likelihood += _likelihood(e)
        inliers += np.float32(1.0) if e < np.float32(INLIER_E) else zero
        # Columns of Q = C (-[p]x) = C times ((0, pz, -py), (-pz, 0, px), (py, -px, 0)).
        a00, a01, a02 = c02 * py - c01 * pz, c00 * pz - c02 * px, c01 * px - c00 * py
        a10, a11, a12 = c12 * py - c11 * pz, c01 * pz - c12 * px, c11 * px - c01 * py
        a20, a21, a22 = c22 * py - c12 * pz, c02 * pz - c22 * px, c12 * px - c02 * py
        h00, h01, h02, h11, h12, h22 = h00 + c00, h01 + c01, h02 + c02, h11 + c11, h12 + c12, h22 + c22
        q00, q01, q02 = q00 + a00, q01 + a01, q02 + a02
        q10, q11, q12 = q10 + a10, q11 + a11, q12 + a12
        q20, q21, q22 = q20 + a20, q21 + a21, q22 + a22
        # Rotation: (-[p]x)^T Q.
        r00, r01, r02 = r00 + py * a20 - pz * a10, r01 + py * a21 - pz * a11, r02 + py * a22 - pz * a12
        r11, r12, r22 = r11 + pz * a01 - px * a21, r12 + pz * a02 - px * a22, r22 + px * a12 - py * a02
        g3, g4, g5 = py * g2 - pz * g1, pz * g0 - px * g2, px * g1 - py * g0
        s0, s1, s2, s3, s4, s5 = s0 + g0, s1 + g1, s2 + g2, s3 + g3, s4 + g4, s5 + g5
        m00, m01, m02, m03 = m00 + g0 * g0, m01 + g0 * g1, m02 + g0 * g2, m03 + g0 * g3
        m04, m05, m11, m12 = m04 + g0 * g4, m05 + g0 * g5, m11 + g1 * g1, m12 + g1 * g2
        m13, m14, m15, m22 = m13 + g1 * g3, m14 + g1 * g4, m15 + g1 * g5, m22 + g2 * g2
        m23, m24, m25, m33 = m23 + g2 * g3, m24 + g2 * g4, m25 + g2 * g5, m33 + g3 * g3
        m34, m35, m44, m45, m55 = m34 + g3 * g4, m35 + g3 * g5, m44 + g4 * g4, m45 + g4 * g5, m55 + g5 * g5
    for k, value in enumerate((
        h00, h01, h02, q00, q01, q02, h11, h12, q10, q11, q12, h22, q20, q21, q22, r00, r01, r02, r11, r12, r22,
        s0, s1, s2, s3, s4, s5, m00, m01, m02, m03, m04, m05, m11, m12, m13, m14, m15, m22, m23, m24, m25, m33, m34,
        m35, m44, m45, m55, likelihood, inliers,
    )):  # fmt: skip
        sums[k] += value


@inlined
def linearise(points: F32, room: Room, T: F64, H: F64, M: F64, g: F64) -> tuple[float, float]:
    """The reweighted least squares of points (3, n) at pose T, for pairs made there: fills H (6, 6), the scatter M
    (6, 6) of the points' own gradients, and g (6, 1). Returns (mean likelihood, share of inliers)."""
    sums = room.sums
    R = room.R
    d = room.d
    sums[:] = 0.0
    for r in range(3):
        d[r] = T[r, 3] - room.origin[r]
        for c in range(3):
            R[r, c] = T[r, c]
    n = points.shape[1]
    for first in range(0, n, _SUM_BLOCK):
        _sum_block(points, room.of, first, min(first + _SUM_BLOCK, n), R, d, sums)
    k = 0
    for r in range(6):
        for c in range(r, 6):
            H[r, c] = H[c, r] = sums[k]
            M[r, c] = M[c, r] = sums[27 + k]
            k += 1
        g[r, 0] = sums[21 + r]
    return sums[48] / max(1, n), sums[49] / max(1, n)


@kernel
def likelihoods(points: F32, T: F64, window: Window, cells: F32, out: F64) -> None:
    """Into ``out`` (m,) the mean likelihood, in [0, 1], of points (3, n) at each of the poses T (m, 4, 4): what
    :func:`linearise` says, for a single look without pairs."""
    rows, lowest, size, flat, beside = window
    stride = rows.shape[1] * rows.shape[2]
    for pose in range(len(T)):
        total = 0.0
        for i in range(points.shape[1]):
            x, y, z = _in_map(points, T[pose], i)
            ax, ay, az = voxel_of(size, x, y, z)
            ix = ax - lowest[0]
            iy = ay - lowest[1]
            iz = az - lowest[2]
            if not holds(rows, ix, iy, iz, 1):
                continue
            x = x - (ax + 0.5) * size
            y = y - (ay + 0.5) * size
            z = z - (az + 0.5) * size
            nearest = CUTOFF_E + 1.0
            at = ix * stride + iy * rows.shape[2] + iz
            for j in range(7):
                k = flat[at + beside[j]]
                if k < 0 or cells[k, 3] + cells[k, 6] + cells[k, 8] == 0.0:
                    continue
                ux = x - SEVEN[j, 0] * size - cells[k, 0]
                uy = y - SEVEN[j, 1] * size - cells[k, 1]
                uz = z - SEVEN[j, 2] * size - cells[k, 2]
                # e = u C u, C the precision: the squared Mahalanobis distance.
                vx = cells[k, 3] * ux + 2.0 * (cells[k, 4] * uy + cells[k, 5] * uz)
                vy = cells[k, 6] * uy + 2.0 * cells[k, 7] * uz
                nearest = min(nearest, vx * ux + vy * uy + cells[k, 8] * uz * uz)
            total += np.float64(_likelihood(np.float32(nearest)))
        out[pose] = total / max(1, points.shape[1])


@kernel
def inverse_of(A: F64, left: F64, out: F64) -> None:
    """Into ``out`` the inverse of a symmetric positive definite (6, 6) matrix (Gauss and Jordan; no pivots are needed);
    ``left`` (6, 6): scratch."""
    for r in range(6):
        for c in range(6):
            left[r, c] = A[r, c]
            out[r, c] = 1.0 if r == c else 0.0
    for k in range(6):
        pivot = 1.0 / left[k, k]
        for c in range(6):
            left[k, c] *= pivot
            out[k, c] *= pivot
        for r in range(6):
            if r != k:
                share = left[r, k]
                for c in range(6):
                    left[r, c] -= share * left[k, c]
                    out[r, c] -= share * out[k, c]


@kernel
def _times(A: F64, B: F64, out: F64) -> None:
    """A B of small matrices; a call of BLAS would take longer than the product."""
    for r in range(A.shape[0]):
        for c in range(B.shape[1]):
            out[r, c] = 0.0
        for k in range(A.shape[1]):
            for c in range(B.shape[1]):
                out[r, c] += A[r, k] * B[k, c]


@inlined
def _covariance(H_inv: F64, M: F64, floor: float, map_variance: F64, half: F64, out: F64) -> None:
    """The robust ("sandwich") estimate H^-1 M H^-1, M being the scatter of the points' own gradients, times
    COVARIANCE_SCALE, plus what the map itself is off by. Into ``out`` (6, 6); ``half`` (6, 6): scratch, as M is."""
    for k in range(6):
        M[k, k] += floor
    _times(H_inv, M, half)
    _times(half, H_inv, out)
    for r in range(6):
        for c in range(6):
            out[r, c] *= COVARIANCE_SCALE
        out[r, r] += map_variance[r]


@inlined
def _move(T: F64, step: F64, W: F64, turn: F64, turned: F64) -> None:
    """Shift the sensor by rho and turn it by phi, both in map axes, in place (Rodrigues). W, turn, turned (3, 3):
    scratch."""
    x = step[3, 0]
    y = step[4, 0]
    z = step[5, 0]
    angle = np.sqrt(x * x + y * y + z * z)
    s = np.sin(angle) / angle if angle > 1e-8 else 1.0
    c = 2.0 * (np.sin(0.5 * angle) / angle) ** 2 if angle > 1e-8 else 0.5
    W[0, 0] = 0.0
    W[0, 1] = -z
    W[0, 2] = y
    W[1, 0] = z
    W[1, 1] = 0.0
    W[1, 2] = -x
    W[2, 0] = -y
    W[2, 1] = x
    W[2, 2] = 0.0
    _times(W, W, turn)
    for i in range(3):
        for j in range(3):
            turn[i, j] = (1.0 if i == j else 0.0) + s * W[i, j] + c * turn[i, j]
    for i in range(3):
        for j in range(3):
            W[i, j] = T[i, j]
    _times(turn, W, turned)
    for i in range(3):
        for j in range(3):
            T[i, j] = turned[i, j]
        T[i, 3] += step[i, 0]


@inlined
def _length(step: F64) -> float:
    """How far a step shifts the sensor, or a point 20 m away by its turn, whichever is more."""
    shift = np.sqrt(step[0, 0] ** 2 + step[1, 0] ** 2 + step[2, 0] ** 2)
    turn = np.sqrt(step[3, 0] ** 2 + step[4, 0] ** 2 + step[5, 0] ** 2)
    return max(shift, turn * TURN_LEVER_M)


@inlined
def _to_prior(T: F64, T_prior: F64, R: F64, step: F64) -> None:
    """Into ``step`` (6, 1) what leads to the prior: phi with R_prior = exp(phi) R, for turns below pi. R (3, 3):
    scratch."""
    for r in range(3):
        for c in range(3):
            R[r, c] = 0.0
        for k in range(3):
            for c in range(3):
                R[r, c] += T_prior[r, k] * T[c, k]
    x = 0.5 * (R[2, 1] - R[1, 2])
    y = 0.5 * (R[0, 2] - R[2, 0])
    z = 0.5 * (R[1, 0] - R[0, 1])
    sine = np.sqrt(x * x + y * y + z * z)
    angle = np.arctan2(sine, 0.5 * (R[0, 0] + R[1, 1] + R[2, 2] - 1.0))
    share = angle / sine if sine > 1e-9 else 1.0
    step[3, 0] = x * share
    step[4, 0] = y * share
    step[5, 0] = z * share
    for k in range(3):
        step[k, 0] = T_prior[k, 3] - T[k, 3]


@kernel
def align(
    points: F32, T: F64, window: Window, cells: F32, most: int, tolerance_m: float, map_variance: F64, T_prior: F64,
    prior: F64, room: Room, covariance: F64,
) -> tuple[float, float, int, bool]:  # fmt: skip
    """Move T (4, 4), in place, to where the points (3, n) of the lidar frame fit the level best.

    Returns (mean likelihood, share of inliers, iterations, has it converged), and fills ``covariance`` (6, 6). A
    direction that nothing fixes gets a small curvature, hence a large variance and no step, instead of a singular
    matrix. ``most`` steps are taken; one shorter than ``tolerance_m``, 20 m away too, has converged. ``map_variance``
    (6,): variance of the map's own errors. The prior pose T_prior (4, 4) is weighed against the scan by its information
    ``prior`` (6, 6), zeros without one.
    """
    H = room.matrices[0]
    M = room.matrices[1]
    H_inv = room.matrices[2]
    information = room.matrices[3]
    left = room.matrices[4]
    half = room.matrices[5]
    both = room.matrices[6]
    g = room.columns[0]
    step = room.columns[1]
    to_prior = room.columns[2]
    size = window.size
    has_prior = prior[0, 0] > 0.0
    for r in range(3):
        for i in range(points.shape[1]):
            room.home[r, i] = _UNPAIRED
        room.origin[r] = T[r, 3]
    for r in range(6):
        for c in range(6):
            covariance[r, c] = 1.0 if r == c else 0.0
    converged = False
    iterations = 0
    likelihood = 0.0
    inliers = 0.0
    floor = 0.0
    while iterations < most and not converged:
        iterations += 1
        pair_up(points, T, window, cells, room)
        likelihood, inliers = linearise(points, room, T, H, M, g)
        trace = 0.0
        for k in range(6):
            trace += H[k, k]
        floor = 1e-6 * max(trace, 1.0)
        for k in range(6):
            H[k, k] += floor
        inverse_of(H, left, H_inv)
        _times(H_inv, g, step)
        for k in range(6):
            step[k, 0] *= -1.0
        if has_prior:
            _covariance(H_inv, M, floor, map_variance, half, both)
            inverse_of(both, left, information)
            _to_prior(T, T_prior, room.turns[0], to_prior)
            _times(information, step, g)
            _times(prior, to_prior, step)
            for r in range(6):
                g[r, 0] += step[r, 0]
                for c in range(6):
                    information[r, c] += prior[r, c]
            inverse_of(information, left, covariance)
            _times(covariance, g, step)
        length = _length(step)
        if length > 0.5 * size:
            for k in range(6):
                step[k, 0] *= 0.5 * size / length
        _move(T, step, room.turns[0], room.turns[1], room.turns[2])
        converged = length < tolerance_m
    if iterations and not has_prior:
        _covariance(H_inv, M, floor, map_variance, half, covariance)
    return likelihood, inliers, iterations, converged
