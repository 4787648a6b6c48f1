"""Gauss-Newton on one level of an NDT map, compiled as a whole: pair up, sum, solve, move, until it stands still.

Pose errors are (6,) vectors (rho, phi) in map axes about the sensor: t' = t + rho, R' = exp(phi) R.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mapvote.core.kernel import inlined, kernel
from mapvote.core.types import F32, F64, I32, I64
from mapvote.localisation.ndt_kernels import TOGETHER, Near, Pairs, linearise, pair_up
from mapvote.localisation.ndt_voxels import Window

_UNPAIRED = np.int32(-(1 << 30))
"""No point's home: all are to be paired."""
LEVER_M = 20.0
"""Distance at which a rotation is weighed against a shift, where one number must serve both."""


class Place(NamedTuple):
    """One level of the map, and when to stop on it."""

    window: Window
    near: Near
    cells: F64
    iterations: int
    tolerance_m: float
    """A step shorter than this, 20 m away too, has converged."""


class Certainty(NamedTuple):
    """What is known beside the scan."""

    scale: float
    """Of the covariance: what neighbouring residuals have in common."""
    map_variance: F64
    """(6,) what the map itself is off by."""
    T_prior: F64
    """(4, 4) what was believed of the pose ..."""
    information: F64
    """(6, 6) ... and how firmly; zero without a prior."""


class Work(NamedTuple):
    """Scratch of :func:`align`, float64 unless it says otherwise: an allocation in a kernel takes 50 ms to compile."""

    matrices: F64
    """(7, 6, 6)"""
    columns: F64
    """(3, 6, 1)"""
    turns: F64
    """(3, 3, 3)"""
    sums: F64
    """(50,)"""
    R: F32
    """(3, 3) float32"""
    d: F32
    """(3,) float32"""
    moved: I64
    """(TOGETHER,) int64"""
    partner: I32
    """(7, TOGETHER) int32"""


def room_to_work() -> Work:
    """Scratch for :func:`align`; any number of calls, one after the other, may use it."""
    single = np.empty((3, 3), np.float32), np.empty(3, np.float32)
    pairing = np.empty(TOGETHER, np.int64), np.empty((7, TOGETHER), np.int32)
    return Work(np.empty((7, 6, 6)), np.empty((3, 6, 1)), np.empty((3, 3, 3)), np.empty(50), *single, *pairing)


@kernel
def inverse_of(A: F64, left: F64, out: F64) -> None:
    """Into ``out`` the inverse of a symmetric positive definite (6, 6) matrix (Gauss and Jordan; no pivots are needed);
    ``left`` (6, 6): scratch."""
    for r in range(6):
        for c in range(6):
            left[r, c], out[r, c] = A[r, c], 1.0 if r == c else 0.0
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
def _covariance(H_inv: F64, M: F64, floor: float, known: Certainty, half: F64, out: F64) -> None:
    """The robust ("sandwich") estimate H^-1 M H^-1, M being the scatter of the points' own gradients, times ``scale``
    for what neighbouring points have in common, plus what the map itself is off by. Into ``out`` (6, 6); ``half``
    (6, 6): scratch, as M is."""
    for k in range(6):
        M[k, k] += floor
    _times(H_inv, M, half)
    _times(half, H_inv, out)
    for r in range(6):
        for c in range(6):
            out[r, c] *= known.scale
        out[r, r] += known.map_variance[r]


@inlined
def _move(T: F64, step: F64, W: F64, turn: F64, turned: F64) -> None:
    """Shift the sensor by rho and turn it by phi, both in map axes, in place (Rodrigues). W, turn, turned (3, 3):
    scratch."""
    x, y, z = step[3, 0], step[4, 0], step[5, 0]
    angle = np.sqrt(x * x + y * y + z * z)
    s = np.sin(angle) / angle if angle > 1e-8 else 1.0
    c = 2.0 * (np.sin(0.5 * angle) / angle) ** 2 if angle > 1e-8 else 0.5
    W[0, 0], W[0, 1], W[0, 2], W[1, 0], W[1, 1], W[1, 2], W[2, 0], W[2, 1], W[2, 2] = 0.0, -z, y, z, 0.0, -x, -y, x, 0.0
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
    return max(shift, turn * LEVER_M)


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
    x, y, z = 0.5 * (R[2, 1] - R[1, 2]), 0.5 * (R[0, 2] - R[2, 0]), 0.5 * (R[1, 0] - R[0, 1])
    sine = np.sqrt(x * x + y * y + z * z)
    angle = np.arctan2(sine, 0.5 * (R[0, 0] + R[1, 1] + R[2, 2] - 1.0))
    share = angle / sine if sine > 1e-9 else 1.0
    step[3, 0], step[4, 0], step[5, 0] = x * share, y * share, z * share
    for k in range(3):
        step[k, 0] = T_prior[k, 3] - T[k, 3]


@kernel
def align(
    points: F32, T: F64, level: Place, known: Certainty, pairs: Pairs, work: Work, covariance: F64
) -> tuple[float, float, int, bool]:  # fmt: skip
    """Move T (4, 4), in place, to where the points (3, n) of the lidar frame fit the level best.

    Returns (mean likelihood, share of inliers, iterations, has it converged), and fills ``covariance`` (6, 6). A
    direction that nothing fixes gets a small curvature, hence a large variance and no step, instead of a singular
    matrix. A prior is weighed against the scan by their information.
    """
    H, M, H_inv, information = work.matrices[0], work.matrices[1], work.matrices[2], work.matrices[3]
    left, half, both = work.matrices[4], work.matrices[5], work.matrices[6]
    g, step, to_prior = work.columns[0], work.columns[1], work.columns[2]
    size = level.window.size
    has_prior = known.information[0, 0] > 0.0
    for r in range(3):
        for i in range(pairs.home.shape[1]):
            pairs.home[r, i] = _UNPAIRED
        pairs.origin[r] = T[r, 3]
    for r in range(6):
        for c in range(6):
            covariance[r, c] = 1.0 if r == c else 0.0
    converged, iterations, likelihood, inliers, floor = False, 0, 0.0, 0.0, 0.0
    while iterations < level.iterations and not converged:
        iterations += 1
        pair_up(points, T, level.window, level.near, level.cells, pairs, work.moved, work.partner)
        likelihood, inliers = linearise(points, pairs, T, H, M, g, work.sums, work.R, work.d)
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
            _covariance(H_inv, M, floor, known, half, both)
            inverse_of(both, left, information)
            _to_prior(T, known.T_prior, work.turns[0], to_prior)
            _times(information, step, g)
            _times(known.information, to_prior, step)
            for r in range(6):
                g[r, 0] += step[r, 0]
                for c in range(6):
                    information[r, c] += known.information[r, c]
            inverse_of(information, left, covariance)
            _times(covariance, g, step)
        length = _length(step)
        if length > 0.5 * size:
            for k in range(6):
                step[k, 0] *= 0.5 * size / length
        _move(T, step, work.turns[0], work.turns[1], work.turns[2])
        converged = length < level.tolerance_m
    if iterations and not has_prior:
        _covariance(H_inv, M, floor, known, half, covariance)
    return likelihood, inliers, iterations, converged
