"""Odometry with its errors: a frame of its own, and drift."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from mapvote.core.geometry import exp, inverse, log
from mapvote.core.types import F64


def odometry(poses: F64, T_odom_start: F64, drift: float = 0.0) -> F64:
    """(n, 4, 4) what odometry says of these poses: it begins at T_odom_start and drifts by a share of the road, and
    turns a hundredth of that share each metre."""
    out = [T_odom_start]
    for before, after in pairwise(poses):
        step = log(inverse(before) @ after)
        road_m = np.linalg.norm(step[:3])
        step[:3] *= 1.0 + drift
        step[5] += 0.01 * drift * road_m
        out.append(out[-1] @ exp(step))
    return np.array(out)
