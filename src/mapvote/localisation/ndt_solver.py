"""Gauss-Newton on one level of an NDT map, compiled as a whole: pair up, sum, solve, move, until it stands still.

Pose errors are (6,) vectors (rho, phi) in map axes about the sensor: t' = t + rho, R' = exp(phi) R.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from mapvote.core.types import F32, F64
from mapvote.localisation.ndt_kernels import Pairs, linearise, pair_up
from mapvote.localisation.ndt_voxels import Window

_UNPAIRED = np.int32(-(1 << 30))
"""No point's home: all are to be paired."""
LEVER_M = 20.0
"""Distance at which a rotation is weighed against a shift, where one number must serve both."""


class Place(NamedTuple):
    """One level of the map, and when to stop on it."""

    window: Window
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


@numba.njit(cache=True, nogil=True)
def inverse_of(A: F64) -> F64:
    """The inverse of a symmetric positive definite (6, 6) matrix (Gauss and Jordan; no pivots are needed)."""
    out, left = np.zeros((6, 6)), A.copy()
    for k in range(6):
        out[k, k] = 1.0
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
    return out


@numba.njit(cache=True, nogil=True)
def _times(A: F64, B: F64) -> F64:
    """A B of small matrices; a call of BLAS would take longer than the product."""
    out = np.zeros((A.shape[0], B.shape[1]))
    for r in range(A.shape[0]):
        for k in range(A.shape[1]):
            for c in range(B.shape[1]):
                out[r, c] += A[r, k] * B[k, c]
    return out


@numba.njit(cache=True, nogil=True)
def _scale(A: F64, by: float) -> F64:
    """A, multiplied in place. Array expressions and slices would take longer to compile than all else here."""
    for r in range(A.shape[0]):
        for c in range(A.shape[1]):
            A[r, c] *= by
    return A


@numba.njit(cache=True, nogil=True)
def _add(A: F64, B: F64) -> F64:
    """A, with B added in place."""
    for r in range(A.shape[0]):
        for c in range(A.shape[1]):
            A[r, c] += B[r, c]
    return A


@numba.njit(cache=True, nogil=True)
def _covariance(H_inv: F64, M: F64, floor: float, known: Certainty) -> F64:
    """The robust ("sandwich") estimate H^-1 M H^-1, M being the scatter of the points' own gradients, times ``scale``
    for what neighbouring points have in common, plus what the map itself is off by."""
    out = M.copy()
    for k in range(6):
        out[k, k] += floor
    out = _scale(_times(_times(H_inv, out), H_inv), known.scale)
    for k in range(6):
        out[k, k] += known.map_variance[k]
    return out


@numba.njit(cache=True, nogil=True)
def _move(T: F64, step: F64) -> None:
    """Shift the sensor by rho and turn it by phi, both in map axes, in place (Rodrigues)."""
    x, y, z = step[3, 0], step[4, 0], step[5, 0]
    angle = np.sqrt(x * x + y * y + z * z)
    s = np.sin(angle) / angle if angle > 1e-8 else 1.0
    c = 2.0 * (np.sin(0.5 * angle) / angle) ** 2 if angle > 1e-8 else 0.5
    W = np.zeros((3, 3))
    W[0, 1], W[0, 2], W[1, 0], W[1, 2], W[2, 0], W[2, 1] = -z, y, z, -x, -y, x
    turn = _times(W, W)
    for i in range(3):
        for j in range(3):
            turn[i, j] = (1.0 if i == j else 0.0) + s * W[i, j] + c * turn[i, j]
    turned = _times(turn, T)  # its last row takes no part
    for i in range(3):
        for j in range(3):
            T[i, j] = turned[i, j]
        T[i, 3] += step[i, 0]


@numba.njit(cache=True, nogil=True)
def _length(step: F64) -> float:
    """How far a step shifts the sensor, or a point 20 m away by its turn, whichever is more."""
    shift = np.sqrt(step[0, 0] ** 2 + step[1, 0] ** 2 + step[2, 0] ** 2)
    turn = np.sqrt(step[3, 0] ** 2 + step[4, 0] ** 2 + step[5, 0] ** 2)
    return max(shift, turn * LEVER_M)


@numba.njit(cache=True, nogil=True)
def _to_prior(T: F64, T_prior: F64) -> F64:
    """(6, 1) the step that leads to the prior: phi with R_prior = exp(phi) R, for turns below pi."""
    R, step = np.zeros((3, 3)), np.empty((6, 1))
    for r in range(3):
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
    return step


@numba.njit(cache=True, nogil=True)
def align(points: F32, T: F64, level: Place, known: Certainty, pairs: Pairs) -> tuple[F64, float, float, int, bool]:
    """Move T (4, 4), in place, to where the points (3, n) of the lidar frame fit the level best.

    Returns (covariance (6, 6), mean likelihood, share of inliers, iterations, has it converged). A direction that
    nothing fixes gets a small curvature, hence a large variance and no step, instead of a singular matrix. A prior
    is weighed against the scan by their information.
    """
    H, M, g = np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 1))
    size = level.window.size
    has_prior = known.information[0, 0] > 0.0
    pairs.home.fill(_UNPAIRED)
    for k in range(3):
        pairs.origin[k] = T[k, 3]
    converged, iterations, likelihood, inliers = False, 0, 0.0, 0.0
    covariance, H_inv, floor = np.zeros((6, 6)), np.zeros((6, 6)), 0.0
    for k in range(6):
        covariance[k, k] = 1.0
    while iterations < level.iterations and not converged:
        iterations += 1
        pair_up(points, T, level.window, level.cells, pairs)
        likelihood, inliers = linearise(points, pairs, T, H, M, g)
        trace = 0.0
        for k in range(6):
            trace += H[k, k]
        floor = 1e-6 * max(trace, 1.0)
        for k in range(6):
            H[k, k] += floor
        H_inv = inverse_of(H)
        step = _scale(_times(H_inv, g), -1.0)
        if has_prior:
            covariance = _covariance(H_inv, M, floor, known)
            information = inverse_of(covariance)
            pull = _add(_times(information, step), _times(known.information, _to_prior(T, known.T_prior)))
            covariance = inverse_of(_add(information, known.information))
            step = _times(covariance, pull)
        length = _length(step)
        if length > 0.5 * size:
            step = _scale(step, 0.5 * size / length)
        _move(T, step)
        converged = length < level.tolerance_m
    if iterations and not has_prior:
        covariance = _covariance(H_inv, M, floor, known)
    return covariance, likelihood, inliers, iterations, converged
