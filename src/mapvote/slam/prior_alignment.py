"""The frame that priors agree on: a track moved as a whole so that it fits all of them, wild ones apart.

Odometry keeps its shape far better than satellites keep their place, and satellites keep their place far better than
one of them does. So the first prior founds nothing: the track is turned about the vertical and shifted to the
robust least-squares fit of them all. Source: Umeyama 1991 for the fit, Cauchy weights for the wild.
"""

from __future__ import annotations

import numpy as np

from mapvote.core.geometry import from_xyz_rpy
from mapvote.core.types import F64

_ROUNDS = 30
WILD_SIGMAS = 2.5
"""A prior so many sigmas off weighs half; farther off, less and less (Cauchy)."""


def trust_in(off_m: F64, sigma_m: float) -> F64:
    """(n,) weight in (0, 1] of priors that lie ``off_m`` (n,) from where the others have them."""
    return np.asarray(1.0 / (1.0 + (off_m / (WILD_SIGMAS * sigma_m)) ** 2))


def fit_to_priors(positions: F64, prior_positions: F64, sigma_m: float, yaw_rad: float = 0.0) -> F64:
    """(4, 4) turn about z and shift that fits positions (n, 3) to their priors (n, 3), robustly.

    ``yaw_rad`` is kept where the track is too short to say anything about it.
    """
    spread = float(np.linalg.norm(positions[:, :2].std(axis=0)))
    T = _shifted(positions, prior_positions, yaw_rad, np.ones(len(positions)))
    scale = max(sigma_m, float(np.median(_off(T, positions, prior_positions))))
    for _ in range(_ROUNDS):
        weights = trust_in(_off(T, positions, prior_positions), scale)
        yaw = _yaw(positions, prior_positions, weights) if spread > 3.0 * sigma_m else yaw_rad
        moved = _shifted(positions, prior_positions, yaw, weights)
        # The scale comes down to the stated sigma step by step: at first the whole track may look wild.
        scale = max(sigma_m, 0.7 * scale)
        if scale == sigma_m and np.abs(moved - T).max() < 1e-6:
            return moved
        T = moved
    return T


def _off(T: F64, positions: F64, priors: F64) -> F64:
    return np.asarray(np.linalg.norm(positions @ T[:3, :3].T + T[:3, 3] - priors, axis=1))


def _yaw(positions: F64, priors: F64, weights: F64) -> float:
    w = weights / weights.sum()
    a, b = positions[:, :2] - w @ positions[:, :2], priors[:, :2] - w @ priors[:, :2]
    cross, dot = w @ (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), w @ (a * b).sum(axis=1)
    return float(np.arctan2(cross, dot))


def _shifted(positions: F64, priors: F64, yaw: float, weights: F64) -> F64:
    T = from_xyz_rpy(0.0, 0.0, 0.0, 0.0, 0.0, yaw)
    w = weights / weights.sum()
    T[:3, 3] = w @ priors - T[:3, :3] @ (w @ positions)
    return T
