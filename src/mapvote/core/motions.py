"""Many rigid motions at once: what :mod:`mapvote.core.geometry` says of one (4, 4) ``T_a_b``, of n of them (n, 4, 4).

Of a trajectory every motion is asked for several times until it is settled, and of each alone numpy takes 40 times as
long as of all together.
"""

from __future__ import annotations

import numpy as np

from mapvote.core.geometry import log
from mapvote.core.types import F64

_SMALL = 1e-8
"""Radians: below, sines and tangents are their arguments."""
_NEARLY_PI = 1e-6
"""Radians: so near to a half turn the axis shows in the rotation's diagonal only."""


def inverses(T_a_b: F64) -> F64:
    """(n, 4, 4) T_b_a of motions (n, 4, 4), by the transpose of the rotation."""
    T = np.zeros_like(T_a_b)
    T[:, :3, :3] = T_a_b[:, :3, :3].transpose(0, 2, 1)
    T[:, :3, 3] = -_turned(T[:, :3, :3], T_a_b[:, :3, 3])
    T[:, 3, 3] = 1.0
    return T


def hats(v: F64) -> F64:
    """(n, 3, 3) cross-product matrices of vectors (n, 3)."""
    W = np.zeros((len(v), 3, 3))
    W[:, 2, 1], W[:, 0, 2], W[:, 1, 0] = v.T
    return W - W.transpose(0, 2, 1)


def exps(xi: F64) -> F64:
    """(n, 4, 4) SE(3) exponentials of tangent vectors (n, 6), translation first, metres and radians."""
    rho, phi = xi[:, :3], xi[:, 3:]
    angle, W = np.linalg.norm(phi, axis=1), hats(phi)
    small = angle < _SMALL
    safe = np.where(small, 1.0, angle)
    s = np.where(small, 1.0, np.sin(safe) / safe)
    half_chord = np.where(small, 0.5, 2.0 * (np.sin(0.5 * safe) / safe) ** 2)  # 1 - cos cancels at small angles
    rest = np.where(small, 1.0 / 6.0, (1.0 - s) / safe**2)
    W2 = W @ W
    T = np.zeros((len(xi), 4, 4))
    T[:, :3, :3] = np.eye(3) + s[:, None, None] * W + half_chord[:, None, None] * W2
    T[:, :3, 3] = _turned(np.eye(3) + half_chord[:, None, None] * W + rest[:, None, None] * W2, rho)
    T[:, 3, 3] = 1.0
    return T


def logs(T: F64) -> F64:
    """(n, 6) tangent vectors of motions (n, 4, 4), metres and radians; inverse of :func:`exps` for rotations below
    pi."""
    R = T[:, :3, :3]
    vee = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)
    length = np.linalg.norm(vee, axis=1)
    angle = np.arctan2(0.5 * length, 0.5 * (R.trace(axis1=1, axis2=2) - 1.0))
    small = angle < _SMALL
    safe = np.where(small, 1.0, angle)
    phi = np.where(small, 0.5, safe / np.where(length > 0.0, length, 1.0))[:, None] * vee
    W = hats(phi)
    rest = np.where(small, 1.0 / 12.0, (1.0 - 0.5 * safe / np.tan(0.5 * safe)) / safe**2)
    V_inv = np.eye(3) - 0.5 * W + rest[:, None, None] * (W @ W)
    out = np.concatenate([_turned(V_inv, T[:, :3, 3]), phi], axis=1)
    for k in np.flatnonzero(np.pi - angle < _NEARLY_PI):
        out[k] = log(T[k])
    return out


def rotation_angles(T: F64) -> F64:
    """(n,) magnitudes of the rotations of motions (n, 4, 4), radians in [0, pi]."""
    return np.asarray(np.linalg.norm(logs(T)[:, 3:], axis=1))


def adjoints(T: F64) -> F64:
    """(n, 6, 6) with exp(adjoint(T) xi) = T exp(xi) T^-1 of motions (n, 4, 4)."""
    R = T[:, :3, :3]
    out = np.zeros((len(T), 6, 6))
    out[:, :3, :3] = out[:, 3:, 3:] = R
    out[:, :3, 3:] = hats(T[:, :3, 3]) @ R
    return out


def _turned(M: F64, v: F64) -> F64:
    """(n, 3) vectors (n, 3), each by its own matrix (n, 3, 3)."""
    return np.asarray((M * v[:, None, :]).sum(axis=2))
