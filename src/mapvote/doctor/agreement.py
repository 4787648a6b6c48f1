"""Do prior and scans agree? What each reading leaves unexplained of the motion that the scans show, in metres."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mapvote.core import geometry
from mapvote.core.types import F64
from mapvote.doctor.motion import Run

LEVER_M = 10.0
"""A rotation counts as what it moves at this distance."""


def told(T: F64, run: Run) -> F64:
    """(m, 4, 4) the run's poses in the frame of its first, by poses T (n, 4, 4)."""
    first = geometry.inverse(T[run.indices[0]])
    return np.array([first @ T[i] for i in run.indices])


def residual(T_told: F64, T_seen: F64) -> F64:
    """(6,) position (metres) and rotation (radians) by which a told motion differs from the one seen."""
    difference = geometry.inverse(T_seen) @ T_told
    if np.linalg.det(difference[:3, :3]) < 0:
        return np.array([*difference[:3, 3], np.pi, np.pi, np.pi])
    return np.concatenate([T_told[:3, 3] - T_seen[:3, 3], geometry.log(difference)[3:]])


def residuals(T: F64, runs: Sequence[Run]) -> F64:
    """(2 * runs, 6) at the middle and the end of every run."""
    out = []
    for run in runs:
        poses = told(T, run)
        for k in (len(poses) // 2, len(poses) - 1):
            out.append(residual(poses[k], run.T_first_lidar[k]))
    return np.array(out)


def misfits(T: F64, runs: Sequence[Run]) -> F64:
    """(runs,) metres by which the motion of each run differs, a rotation by what it moves 10 m away."""
    r = residuals(T, runs)
    each = np.linalg.norm(r[:, :3], axis=1) + LEVER_M * np.linalg.norm(r[:, 3:], axis=1)
    return np.asarray(each.reshape(-1, 2).mean(axis=1))


def misfit(T: F64, runs: Sequence[Run], *, scale: bool = False) -> float:
    """The median of :func:`misfits`; for a ``scale`` of positions alone, of which rotations say nothing."""
    if not scale:
        return float(np.median(misfits(T, runs)))
    return float(np.median(np.linalg.norm(residuals(T, runs)[:, :3], axis=1).reshape(-1, 2).mean(axis=1)))
