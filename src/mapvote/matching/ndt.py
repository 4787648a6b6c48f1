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

from mapvote.core.kernel import disjoint, fast_math, inlined, kernel
from mapvote.core.record import record
from mapvote.core.types import F32, F64, I32, I64, Bool
from mapvote.matching.ndt_voxels import SEVEN, Voxels, Window, holds, voxel_of


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
    block: int = 240
    """Points that are paired together, and whose sums are taken in float32 before they are added up in float64."""
    turn_lever_m: float = 20.0
    """Distance at which a rotation is weighed against a shift, metres."""


NDT_ALIGNMENT = NdtAlignment()
# Kernels take no records: they read these names.
COVARIANCE_SCALE = NDT_ALIGNMENT.covariance_scale
INLIER_E = NDT_ALIGNMENT.inlier_e
CUTOFF_E = NDT_ALIGNMENT.cutoff_e
BLOCK = NDT_ALIGNMENT.block
TURN_LEVER_M = NDT_ALIGNMENT.turn_lever_m
_UNPAIRED = np.int32(-2)
"""No point's home: all are to be paired."""


class Room(NamedTuple):
    """Buffers of an alignment of up to n points: an allocation in a kernel takes 50 ms to compile.

    Points lie in blocks, those with most partners first, so that few places for partners stay empty. The first three
    arrays are flat, and what belongs to a block lies together: its places are known to the compiler.
    """

    of: F32
    """(blocks, 7, 9, BLOCK) of each partner of each point: the voxel's mean from ``origin`` in map axes, and its
    precision xx, xy, xz, yy, yz, zz; zeros where there is no partner."""
    points: F32
    """(blocks, 3, BLOCK) in the lidar frame ..."""
    placed: F32
    """... and from ``origin`` in map axes, at the pose at which they were paired last."""
    home: I32
    """(blocks, BLOCK) the voxel that the point lay in when it was paired, as an index of the window's flat rows; -1
    outside."""
    partners: I64
    """(blocks,) the most partners of a point of the block."""
    origin: F64
    """(3,) map metres, the corner of a voxel near the sensor: float32 suffices from there."""
    here: I32
    """(BLOCK,) ``home`` at another pose."""
    moved: I64
    """(BLOCK,) and below (7, BLOCK) and (BLOCK,): who is paired, with whom, with how many."""
    partner: I32
    counts: I64
    whose: I32
    """(7 BLOCK,) the point of each partner: of :func:`likelihoods`."""
    centre: F32
    """(3, BLOCK) the centres of their voxels, from ``origin``."""
    pull: F32
    """(10, BLOCK) flat: of :func:`_pull_together`."""
    sums: F64
    """(50,), (3, 3) and (3,): of :func:`linearise`."""
    R: F32
    d: F32
    from_lowest: I32
    """(3,) voxels from the window's lowest one to the origin's."""
    matrices: F64
    """(7, 6, 6), (3, 6, 1) and (3, 3, 3): of :func:`align`."""
    columns: F64
    turns: F64


def room_for(n: int) -> Room:
    """Any number of alignments of up to n points, one after the other, may use it."""
    blocks = -(-n // BLOCK)
    points = blocks * 3 * BLOCK
    return Room(
        np.empty(blocks * 63 * BLOCK, np.float32), np.empty(points, np.float32), np.empty(points, np.float32),
        np.empty(blocks * BLOCK, np.int32), np.empty(blocks, np.int64), np.zeros(3), np.empty(BLOCK, np.int32),
        np.empty(BLOCK, np.int64), np.empty((7, BLOCK), np.int32), np.empty(BLOCK, np.int64),
        np.empty(7 * BLOCK, np.int32),
        np.empty((3, BLOCK), np.float32), np.empty(10 * BLOCK, np.float32), np.empty(50),
        np.empty((3, 3), np.float32), np.empty(3, np.float32), np.empty(3, np.int32),
        np.empty((7, 6, 6)), np.empty((3, 6, 1)), np.empty((3, 3, 3)),
    )  # fmt: skip


@kernel
def _place(block: int, T: F64, window: Window, room: Room, home: I32) -> None:
    """Move a block of points into the map by the pose T (4, 4); into ``home`` (BLOCK,) where it lies then."""
    rows, lowest, size, _, _ = window
    R = room.R
    d = room.d
    for r in range(3):
        d[r] = T[r, 3] - room.origin[r]
        for c in range(3):
            R[r, c] = T[r, c]
    first = 3 * BLOCK * block
    points = room.points
    placed = room.placed
    each = np.float32(1.0 / size)
    from_lowest = room.from_lowest
    for r in range(3):  # how far beyond the window does not matter
        between = np.int64(np.floor(room.origin[r] / size + 0.5)) - lowest[r]
        from_lowest[r] = min(max(between, -(1 << 20)), 1 << 20)
    nx = np.int32(rows.shape[0] - 2)
    ny = np.int32(rows.shape[1] - 2)
    nz = np.int32(rows.shape[2] - 2)
    for i in range(np.uint64(0), np.uint64(BLOCK)):  # unsigned: an index that cannot be negative vectorises
        east = np.uint64(first) + i
        north = east + np.uint64(BLOCK)
        up = north + np.uint64(BLOCK)
        x, y, z = points[east], points[north], points[up]
        px = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + d[0]
        py = R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + d[1]
        pz = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + d[2]
        placed[east] = px
        placed[north] = py
        placed[up] = pz
        ix = np.int32(np.int32(np.floor(px * each)) + from_lowest[0])
        iy = np.int32(np.int32(np.floor(py * each)) + from_lowest[1])
        iz = np.int32(np.int32(np.floor(pz * each)) + from_lowest[2])
        inside = (ix >= 1) & (iy >= 1) & (iz >= 1) & (ix <= nx) & (iy <= ny) & (iz <= nz)
        at = np.int32(np.int32(ix * (ny + np.int32(2)) + iy) * (nz + np.int32(2)) + iz)
        home[i] = at if inside else np.int32(-1)


@inlined
def _voxel_beside(window: Window, at: np.int64, way: int) -> tuple[np.uint64, bool]:
    """(row, whether there is one) of the voxel beside the one ``at``; without a branch, so that no search waits for the
    memory of the one before."""
    beside = window.beside
    inside = at >= 0
    at = at if inside else np.int64(beside[1] + beside[3] + beside[5])  # the first that has others to all sides
    k = window.flat[np.uint64(at + beside[way])]
    there = inside & (k >= 0)
    return np.uint64(k if there else 0), there


@inlined
def _find_partners(window: Window, at: np.int64, w: int, partner: I32) -> int:
    """How many voxels with points are at and beside the voxel ``at``, and into ``partner`` (7, n), of w, their rows
    times 8, plus the way there."""
    n = 0
    for j in range(7):
        k, there = _voxel_beside(window, at, j)
        partner[n, w] = np.int32(k * np.uint64(8) + np.uint64(j))
        n += 1 if there else 0
    return n


@kernel
def arrange(points: F32, T: F64, window: Window, room: Room) -> None:
    """Lay points (3, n) out in the room, those with most partners at the pose T (4, 4) first. All are to be paired."""
    n = points.shape[1]
    size = window.size
    blocks = -(-n // BLOCK)
    for r in range(3):
        room.origin[r] = np.floor(T[r, 3] / size) * size
        for i in range(BLOCK * blocks):
            at = 3 * BLOCK * (i // BLOCK) + r * BLOCK + i % BLOCK
            room.points[at] = points[r, i] if i < n else np.float32(1e9)  # what fills the last block is outside
    # A counting sort by how many of the seven partners are missing.
    first_with = room.moved
    for most in range(9):
        first_with[most] = 0
    for block in range(blocks):
        room.partners[block] = 0
        missing = room.home[BLOCK * block : BLOCK * (block + 1)]
        _place(block, T, window, room, missing)
        for i in range(min(BLOCK, n - BLOCK * block)):
            home = np.int64(missing[i])
            missing[i] = 0
            for j in range(7):
                missing[i] += not _voxel_beside(window, home, j)[1]
        for i in range(min(BLOCK, n - BLOCK * block)):
            first_with[missing[i] + 1] += 1
    for most in range(1, 8):
        first_with[most] += first_with[most - 1]
    for i in range(n):
        at = first_with[room.home[i]]
        first_with[room.home[i]] += 1
        for r in range(3):
            room.points[3 * BLOCK * (at // BLOCK) + r * BLOCK + at % BLOCK] = points[r, i]
    for i in range(BLOCK * blocks):
        room.home[i] = _UNPAIRED


@kernel
def pair_up(n: int, T: F64, window: Window, cells: F32, room: Room) -> None:
    """Pair those of the n points that lie in another voxel at pose T (4, 4) than when they were last paired.

    Block by block: who has moved, where their partners are, what these say. No step waits for the memory of the one
    before, nor guesses whether there is a partner.
    """
    side = np.float32(window.size)
    each = np.float32(1.0 / window.size)
    of = room.of
    moved = room.moved
    partner = room.partner
    home = room.here
    for block in range(-(-n // BLOCK)):
        _place(block, T, window, room, home)
        m = 0
        before = BLOCK * block
        for i in range(BLOCK):
            moved[m] = i
            m += 1 if home[i] != room.home[before + i] else 0
            room.home[before + i] = home[i]
        most = 0
        for w in range(m):
            room.counts[w] = _find_partners(window, np.int64(home[moved[w]]), w, partner)
            most = max(most, room.counts[w])
        for j in range(room.partners[block], most if m < BLOCK else 0):
            for i in range(9 * BLOCK):
                of[(7 * block + j) * 9 * BLOCK + i] = 0.0
        most = max(most, room.partners[block])
        room.partners[block] = most
        for w in range(m):
            east = np.uint64(3 * BLOCK * block + moved[w])
            for r in range(np.uint64(0), np.uint64(3)):
                of_voxel = np.floor(room.placed[east + r * np.uint64(BLOCK)] * each)
                room.centre[r, w] = (of_voxel + np.float32(0.5)) * side
        for j in range(most):
            first = np.uint64((7 * block + j) * 9 * BLOCK)
            for w in range(m):
                at = first + np.uint64(moved[w])
                if j >= room.counts[w]:
                    for c in range(np.uint64(9)):
                        of[at + c * np.uint64(BLOCK)] = np.float32(0.0)
                    continue
                k = np.uint64(partner[j, w] >> 3)
                way = np.uint64(partner[j, w] & 7)
                for r in range(np.uint64(0), np.uint64(3)):
                    of[at + r * np.uint64(BLOCK)] = room.centre[r, w] + side * np.float32(SEVEN[way, r]) + cells[k, r]
                for c in range(np.uint64(3), np.uint64(9)):
                    of[at + c * np.uint64(BLOCK)] = cells[k, c]


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
def _pull_together(of: F32, placed: F32, partners: int, pull: F32) -> None:
    """Sum over all partners of a block into ``pull`` (10, BLOCK) flat: the smallest e, and the sums of w C and of
    w C u, with u the point from the voxel's mean, C its precision, e = u C u and w = exp(-e / 2), the weight of Eq.
    (6.9) with d1 = d2 = 1. ``of`` (7, 9, BLOCK) and ``placed`` (3, BLOCK), flat: of the block."""
    n = np.uint64(BLOCK)
    for i in range(np.uint64(0), n):
        pull[i] = np.float32(1e9)
    for i in range(n, np.uint64(10) * n):
        pull[i] = np.float32(0.0)
    for j in range(partners):
        first = np.uint64(j * 9 * BLOCK)
        for i in range(np.uint64(0), n):  # one vector lane a point
            at = first + i
            x = placed[i] - of[at]
            y = placed[i + n] - of[at + n]
            z = placed[i + np.uint64(2) * n] - of[at + np.uint64(2) * n]
            c00 = of[at + np.uint64(3) * n]
            c01 = of[at + np.uint64(4) * n]
            c02 = of[at + np.uint64(5) * n]
            c11 = of[at + np.uint64(6) * n]
            c12 = of[at + np.uint64(7) * n]
            c22 = of[at + np.uint64(8) * n]
            b0 = c00 * x + c01 * y + c02 * z
            b1 = c01 * x + c11 * y + c12 * z
            b2 = c02 * x + c12 * y + c22 * z
            e = x * b0 + y * b1 + z * b2
            w = _likelihood(e)
            e = e if c00 + c11 + c22 > np.float32(0.0) else np.float32(1e9)
            pull[i] = min(pull[i], e)
            pull[i + n] += w * c00
            pull[i + np.uint64(2) * n] += w * c01
            pull[i + np.uint64(3) * n] += w * c02
            pull[i + np.uint64(4) * n] += w * c11
            pull[i + np.uint64(5) * n] += w * c12
            pull[i + np.uint64(6) * n] += w * c22
            pull[i + np.uint64(7) * n] += w * b0
            pull[i + np.uint64(8) * n] += w * b1
            pull[i + np.uint64(9) * n] += w * b2


@fast_math
def _sum_block(placed: F32, pull: F32, d: F32, sums: F64) -> None:
    """Add up a block of points, ``placed`` (3, BLOCK) flat, and what their partners say (:func:`_pull_together`), the
    sensor being at ``d`` (3,) metres from the origin.

    ``sums`` (50,): the upper triangle of H = J^T w C J row by row, g = J^T w C u (the sums of Eqs. (6.13) and (6.12),
    of which Gauss-Newton drops the other terms), the upper triangle of the sum of g_i g_i^T, likelihoods, inliers.
    J = [I, -[p]x] is the derivative of the point by (rho, phi). One vector lane a point; no stores, no branches.
    """
    zero, n = np.float32(0.0), np.uint64(BLOCK)
    h00, h01, h02, h11, h12, h22 = zero, zero, zero, zero, zero, zero
    q00, q01, q02, q10, q11, q12, q20, q21, q22 = zero, zero, zero, zero, zero, zero, zero, zero, zero
    r00, r01, r02, r11, r12, r22 = zero, zero, zero, zero, zero, zero
    s0, s1, s2, s3, s4, s5, likelihood, inliers = zero, zero, zero, zero, zero, zero, zero, zero
    m00, m01, m02, m03, m04, m05, m11, m12 = zero, zero, zero, zero, zero, zero, zero, zero
    m13, m14, m15, m22, m23, m24, m25 = zero, zero, zero, zero, zero, zero, zero
    m33, m34, m35, m44, m45, m55 = zero, zero, zero, zero, zero, zero
    for i in range(np.uint64(0), n):
        px = placed[i] - d[0]
        py = placed[i + n] - d[1]
        pz = placed[i + np.uint64(2) * n] - d[2]
        e = pull[i]
        c00 = pull[i + n]
        c01 = pull[i + np.uint64(2) * n]
        c02 = pull[i + np.uint64(3) * n]
        c11 = pull[i + np.uint64(4) * n]
        c12 = pull[i + np.uint64(5) * n]
        c22 = pull[i + np.uint64(6) * n]
        g0 = pull[i + np.uint64(7) * n]
        g1 = pull[i + np.uint64(8) * n]
        g2 = pull[i + np.uint64(9) * n]
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
def linearise(n: int, room: Room, H: F64, M: F64, g: F64) -> tuple[float, float]:
    """The reweighted least squares of the n points at the pose at which they were paired last: fills H (6, 6), the
    scatter M (6, 6) of the points' own gradients, and g (6, 1). Returns (mean likelihood, share of inliers)."""
    sums = room.sums
    sums[:] = 0.0
    for block in range(-(-n // BLOCK)):
        if room.partners[block] == 0:
            continue
        placed = room.placed[3 * BLOCK * block : 3 * BLOCK * (block + 1)]
        of = room.of[63 * BLOCK * block : 63 * BLOCK * (block + 1)]
        _pull_together(of, placed, room.partners[block], room.pull)
        _sum_block(placed, room.pull, room.d, sums)
    k = 0
    for r in range(6):
        for c in range(r, 6):
            H[r, c] = H[c, r] = sums[k]
            M[r, c] = M[c, r] = sums[27 + k]
            k += 1
        g[r, 0] = sums[21 + r]
    return sums[48] / max(1, n), sums[49] / max(1, n)


@disjoint
def likelihoods(n: int, T: F64, window: Window, cells: F32, room: Room, out: F64) -> None:
    """Into ``out`` (m,) the mean likelihood, in [0, 1], of the n points at each of the poses T (m, 4, 4), all near the
    one for which they were arranged: what :func:`linearise` says, for a single look without pairs.

    Without a branch: which voxels have points cannot be guessed, and a wrong guess costs as much as the rest. Two or
    three of the seven have some: they are listed first, and then asked by a loop that vectorises.
    """
    side = np.float32(window.size)
    each = np.float32(1.0 / window.size)
    home = room.here
    row = room.partner.reshape(-1)
    whose = room.whose
    distance = room.of
    nearest = room.pull
    for pose in range(len(T)):
        total = np.float32(0.0)
        for block in range(-(-n // BLOCK)):
            _place(block, T[pose], window, room, home)
            first = np.uint64(3 * BLOCK * block)
            here = np.uint64(min(BLOCK, n - BLOCK * block))
            partners = np.uint64(0)
            for i in range(here):
                nearest[i] = np.float32(1e9)
                for j in range(np.uint64(0), np.uint64(7)):
                    k, there = _voxel_beside(window, np.int64(home[i]), j)
                    row[partners] = np.int32(k * np.uint64(8) + j)
                    whose[partners] = i
                    partners += np.uint64(there)
            for w in range(partners):
                k = np.uint64(row[w] >> 3)
                way = np.uint64(row[w] & 7)
                point = np.uint64(whose[w])
                x = room.placed[first + point]
                y = room.placed[first + point + np.uint64(BLOCK)]
                z = room.placed[first + point + np.uint64(2 * BLOCK)]
                ux = x - (np.floor(x * each) + np.float32(0.5) + np.float32(SEVEN[way, 0])) * side - cells[k, 0]
                uy = y - (np.floor(y * each) + np.float32(0.5) + np.float32(SEVEN[way, 1])) * side - cells[k, 1]
                uz = z - (np.floor(z * each) + np.float32(0.5) + np.float32(SEVEN[way, 2])) * side - cells[k, 2]
                # e = u C u, C the precision: the squared Mahalanobis distance.
                vx = cells[k, 3] * ux + np.float32(2.0) * (cells[k, 4] * uy + cells[k, 5] * uz)
                vy = cells[k, 6] * uy + np.float32(2.0) * cells[k, 7] * uz
                e = vx * ux + vy * uy + cells[k, 8] * uz * uz
                there = cells[k, 3] + cells[k, 6] + cells[k, 8] > np.float32(0.0)
                distance[w] = e if there else np.float32(1e9)
            for w in range(partners):
                point = np.uint64(whose[w])
                nearest[point] = min(nearest[point], distance[w])
            for i in range(here):
                total += _likelihood(nearest[i])
        out[pose] = total / max(1, n)


@kernel
def expect(
    points: F64, noise_m: float, window: Window, voxels: Voxels, coarse: Window, likelihood: F64, near: Bool
) -> None:
    """Into ``likelihood`` (n,) the one to be expected of each of the points (n, 3), map metres, if it were drawn from
    its voxel's own distribution, with the sensor's noise; -1 where the voxel has none. Into ``near`` (n,) whether its
    voxel in a ``coarse`` window, or one beside that, holds anything.

    For u ~ N(0, S) and precision C: E exp(-u'Cu / 2) = det(I + S C)^-1/2.
    """
    sums = voxels.sums
    cells = voxels.cells
    noise = noise_m * noise_m
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        ax, ay, az = voxel_of(coarse.size, x, y, z)
        ix, iy, iz = ax - coarse.lowest[0], ay - coarse.lowest[1], az - coarse.lowest[2]
        near[i] = False
        if holds(coarse.rows, ix, iy, iz, 1):
            at = (ix * coarse.rows.shape[1] + iy) * coarse.rows.shape[2] + iz
            for j in range(7):
                near[i] |= coarse.flat[at + coarse.beside[j]] >= 0
        likelihood[i] = -1.0
        ax, ay, az = voxel_of(window.size, x, y, z)
        ix, iy, iz = ax - window.lowest[0], ay - window.lowest[1], az - window.lowest[2]
        if not holds(window.rows, ix, iy, iz, 0):
            continue
        k = window.rows[ix, iy, iz]
        if k < 0 or cells[k, 3] + cells[k, 6] + cells[k, 8] == 0.0:
            continue
        m = sums[k, 0]
        a, b, c = np.float64(cells[k, 0]), np.float64(cells[k, 1]), np.float64(cells[k, 2])
        s00, s01, s02 = sums[k, 4] / m - a * a + noise, sums[k, 5] / m - a * b, sums[k, 6] / m - a * c
        s11, s12, s22 = sums[k, 7] / m - b * b + noise, sums[k, 8] / m - b * c, sums[k, 9] / m - c * c + noise
        c00, c01, c02 = np.float64(cells[k, 3]), np.float64(cells[k, 4]), np.float64(cells[k, 5])
        c11, c12, c22 = np.float64(cells[k, 6]), np.float64(cells[k, 7]), np.float64(cells[k, 8])
        a00 = 1.0 + s00 * c00 + s01 * c01 + s02 * c02
        a01 = s00 * c01 + s01 * c11 + s02 * c12
        a02 = s00 * c02 + s01 * c12 + s02 * c22
        a10 = s01 * c00 + s11 * c01 + s12 * c02
        a11 = 1.0 + s01 * c01 + s11 * c11 + s12 * c12
        a12 = s01 * c02 + s11 * c12 + s12 * c22
        a20 = s02 * c00 + s12 * c01 + s22 * c02
        a21 = s02 * c01 + s12 * c11 + s22 * c12
        a22 = 1.0 + s02 * c02 + s12 * c12 + s22 * c22
        determinant = a00 * (a11 * a22 - a12 * a21) - a01 * (a10 * a22 - a12 * a20) + a02 * (a10 * a21 - a11 * a20)
        likelihood[i] = 1.0 / np.sqrt(max(determinant, 1.0))


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
    n: int, T: F64, window: Window, cells: F32, most: int, tolerance_m: float, map_variance: F64, T_prior: F64,
    prior: F64, room: Room, covariance: F64,
) -> tuple[float, float, int, bool]:  # fmt: skip
    """Move T (4, 4), in place, to where the n points fit the level best, which :func:`arrange` has laid out for it.

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
        pair_up(n, T, window, cells, room)
        likelihood, inliers = linearise(n, room, H, M, g)
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
        # How far it shifts the sensor, or a point 20 m away by its turn, whichever is more.
        shift = np.sqrt(step[0, 0] ** 2 + step[1, 0] ** 2 + step[2, 0] ** 2)
        turn = np.sqrt(step[3, 0] ** 2 + step[4, 0] ** 2 + step[5, 0] ** 2)
        length = max(shift, turn * TURN_LEVER_M)
        if length > 0.5 * size:
            for k in range(6):
                step[k, 0] *= 0.5 * size / length
        _move(T, step, room.turns[0], room.turns[1], room.turns[2])
        converged = length < tolerance_m
    if iterations and not has_prior:
        _covariance(H_inv, M, floor, map_variance, half, covariance)
    return likelihood, inliers, iterations, converged
