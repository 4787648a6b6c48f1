"""The drive as a whole: a chain of scans held against the prior, for what is too small to show in runs of 20 m.

One fit tells scale, heading and pitch apart. How sure it is, is told by how the prior strays from the chain: positions
err alike for seconds, so that many scans say hardly more than a few would.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import optimize
from scipy.spatial.transform import Rotation

from mapvote.core.types import F64, I64
from mapvote.doctor.measured import Measured, at_times
from mapvote.doctor.motion import Run

CHAIN_SCANS = 150
"""Of a chain: some 300 m."""
_LEAST_FIT = 0.55
_POSITION_M, _ROTATION_RAD = 0.3, np.radians(0.5)
"""They weigh positions against rotations."""
_CHAIN_SCALE, _CHAIN_RAD = 0.003, np.radians(0.15)
"""What the chain itself may err by."""


@dataclass(frozen=True, slots=True)
class Whole:
    """How the prior differs from a chain of scans."""

    scale: Measured
    turn: Measured
    pitch: Measured
    length_m: float
    """Of the chain, end to end."""


def unbroken(chain: Run) -> Run:
    """Up to the first scan that does not fit those before it."""
    bad = np.flatnonzero(chain.fit < _LEAST_FIT)
    end = int(bad[0]) if len(bad) else len(chain.fit)
    return Run(chain.indices[:end], chain.T_first_lidar[:end], chain.fit[:end])


def held_against(T: F64, chain: Run, prior_sigma_m: float = 0.0) -> Whole | None:
    """The prior's poses T (n, 4, 4) against the chain; None where it is too short or hardly moves.

    ``prior_sigma_m``: an error that grows along the drive looks like a scale, and across it like a turn; from one end
    to the other two errors of the prior differ by sqrt(2) of it.
    """
    told, seen = T[chain.indices], chain.T_first_lidar
    if len(seen) < 5 or _spread(seen[:, :3, 3]) < 1.0:
        return None
    p, q = (one[:, :3, 3] - one[:, :3, 3].mean(axis=0) for one in (seen, told))
    R_told, R_seen = Rotation.from_matrix(told[:, :3, :3]), Rotation.from_matrix(seen[:, :3, :3])

    def off(x: F64) -> F64:
        aligned, own = Rotation.from_rotvec(x[:3]), Rotation.from_euler("zy", x[7:])
        positions = (np.exp(x[6]) * aligned.apply(p) + x[3:6] - q) / _POSITION_M
        rotations = ((aligned * R_seen * own).inv() * R_told).as_rotvec() / _ROTATION_RAD
        return np.concatenate([positions.ravel(), rotations.ravel()])

    start = np.concatenate([(R_told * R_seen.inv()).mean().as_rotvec(), np.zeros(6)])
    x = optimize.least_squares(off, start, loss="soft_l1", max_nfev=60).x
    strayed = off(x)[: p.size].reshape(-1, 3) * _POSITION_M
    length_m = float(np.linalg.norm(np.ptp(p, axis=0)))
    share = float(
        np.hypot(np.linalg.norm(strayed, axis=1).mean() / _spread(p), np.sqrt(2.0) * prior_sigma_m / length_m)
    )
    return _whole(x, share, float(np.linalg.norm(seen[-1, :3, 3])))


def _whole(x: F64, share: float, length_m: float) -> Whole:
    """``share``: by how much the prior may stray from the chain, of what the chain extends."""
    factor, yaw, pitch = float(np.exp(x[6])), float(x[7]), float(x[8])
    back = np.eye(4)
    back[:3, :3] = Rotation.from_euler("zy", [yaw, pitch]).inv().as_matrix()
    sigma_deg = float(np.degrees(np.hypot(share, _CHAIN_RAD)))

    def smaller(T: F64) -> F64:
        out = T.copy()
        out[:, :3, 3] /= factor
        return out

    def turned(T: F64) -> F64:
        return np.asarray(T @ back)

    return Whole(
        Measured("scale", factor, factor * float(np.hypot(share, _CHAIN_SCALE)), smaller),
        Measured("turn", float(np.degrees(yaw)), sigma_deg, turned),
        Measured("pitch", -float(np.degrees(pitch)), sigma_deg, turned),
        length_m,
    )


def _spread(p: F64) -> float:
    """Root mean square distance of positions (n, 3) from their middle."""
    return float(np.sqrt(((p - p.mean(axis=0)) ** 2).sum(axis=1).mean()))


def strays_less(T: F64, stamps_ns: I64, shift_s: float, chain: Run) -> float:
    """What part of the prior's straying from the chain a shift in time takes away."""
    with_it, without = (_strayed(one[chain.indices], chain) for one in (at_times(T, stamps_ns, shift_s), T))
    return 1.0 - with_it / max(without, 1e-9)


def _strayed(told: F64, chain: Run) -> float:
    """Root mean square distance of positions from the chain's, moved, turned and scaled to fit (Umeyama 1991)."""
    p, q = (one[:, :3, 3] - one[:, :3, 3].mean(axis=0) for one in (chain.T_first_lidar, told))
    U, D, Vt = np.linalg.svd(q.T @ p)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    scale = float((D * sign).sum() / max(float((p**2).sum()), 1e-12))
    return float(np.sqrt(((q - scale * p @ (U @ np.diag(sign) @ Vt).T) ** 2).sum(axis=1).mean()))
