"""About which axis do the rings of a scan lie, whose points were tilted after they were measured?

A tilt of one degree hides the rings of a sensor with 32 beams: no ring keeps one elevation. About the axis that the
sensor turned about, elevations fall into few bins. That axis is searched near a first guess, coarse to fine.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapvote.core.record import record
from mapvote.core.types import F64


@record()
@dataclass(frozen=True, slots=True)
class RingAxisRules:
    """How the axis is searched."""

    lean_deg: float = 16.0
    """Farthest from z."""
    points: int = 3000
    """Points of a scan that are examined."""
    far_m: float = 8.0
    """Nearer points are left out: the beams of large sensors do not start in one point."""
    bin_deg: tuple[float, ...] = (0.4, 0.2, 0.1)
    """Bins of elevation of each round: a bin catches a ring that leans by as much."""
    steps: tuple[int, ...] = (60, 4, 4)
    """Steps to each side of the best axis so far, each of two thirds of a bin."""


RING_AXIS = RingAxisRules()


def ring_axis(points: NDArray[np.floating], rules: RingAxisRules = RING_AXIS) -> F64:
    """(3,) the unit vector about which the elevations of points (n, 3) lie in fewest bins; z or near it."""
    reach_m = np.linalg.norm(points, axis=1)
    far = points[reach_m > rules.far_m] / reach_m[reach_m > rules.far_m, None]
    sample = far[:: max(1, len(far) // rules.points)].astype(np.float64)
    if len(sample) < 100:
        return np.array([0.0, 0.0, 1.0])
    best = np.zeros(2)
    for bin_deg, steps in zip(rules.bin_deg, rules.steps, strict=True):
        step = np.radians(bin_deg * 2.0 / 3.0)
        reach = np.radians(rules.lean_deg)
        offsets = np.arange(-steps, steps + 1) * step
        tried = [best + np.array([x, y]) for x in offsets for y in offsets]
        tried = [one for one in tried if np.linalg.norm(one) < reach]
        best = max(tried, key=lambda one: _sharpness(sample, one, bin_deg))
    return _axis(best)


def level_by_axis(axis: F64) -> F64:
    """(3, 3) the smallest rotation that turns ``axis`` (3,) to z."""
    x, y, z = axis
    return np.array(
        [
            [1.0 - x * x / (1.0 + z), -x * y / (1.0 + z), -x],
            [-x * y / (1.0 + z), 1.0 - y * y / (1.0 + z), -y],
            [x, y, z],
        ]
    )


def _axis(lean: F64) -> F64:
    """The unit vector whose x and y are the sines ``lean`` (2,)."""
    return np.array([*lean, np.sqrt(1.0 - lean @ lean)])


def _sharpness(directions: F64, lean: F64, bin_deg: float) -> float:
    """How few bins the elevations of unit vectors (n, 3) about an axis fill: the sum of squares of their shares."""
    elevation_deg = np.degrees(np.arcsin(np.clip(directions @ _axis(lean), -1.0, 1.0)))
    filled = np.bincount(((elevation_deg + 90.0) / bin_deg).astype(np.int64))
    return float((filled.astype(np.float64) ** 2).sum()) / len(directions) ** 2
