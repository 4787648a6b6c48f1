"""How high a vehicle's sensor stands over the ground of a map: the one figure in which path and ground must agree."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from mapvote.core.point_map import PointMap
from mapvote.core.types import F64, I64

LEVEL_M = 0.3
"""Path and ground that disagree by more are two levels, or one of them is wrong."""
_BESIDE_M = 0.6
"""Paths that run as near as this, seen from above, run through the same cells."""
_STEPS = 20
"""Positions of one drive nearer than this in order are one pass, not two."""


@dataclass(frozen=True, slots=True)
class Heights:
    """The heights of a path over the ground, metres."""

    median_m: float
    """The sensor's height, if the ground is right. NaN if the ground is unknown all along."""
    worst_off_m: float
    """The largest difference to the median, with its sign: positive where the ground lies too low."""
    worst_xy: tuple[float, float]
    """Where that is, map metres."""
    off_share: float
    """Of the path: where the difference exceeds LEVEL_M."""
    unknown_share: float
    """Of the path: where the map has no ground."""

    def __str__(self) -> str:
        if np.isnan(self.median_m):
            return "no ground is known under the path"
        text = f"sensor {self.median_m:.2f} m over the ground (median), off by {abs(self.worst_off_m):.2f} m at most"
        return text if self.unknown_share == 0 else f"{text}; ground unknown under {self.unknown_share:.0%} of the path"

    @property
    def complaint(self) -> str:
        """What is wrong, in a line; empty if nothing is."""
        if np.isnan(self.median_m):
            return "the map has no ground under the path"
        if self.off_share == 0:
            return ""
        x, y = self.worst_xy
        return (
            f"path and ground disagree by more than {LEVEL_M} m along {self.off_share:.1%} of the path, "
            f"most by {abs(self.worst_off_m):.2f} m at ({x:.1f}, {y:.1f})"
        )


UNKNOWN = Heights(np.nan, np.nan, (np.nan, np.nan), 0.0, 1.0)


def check_heights(point_map: PointMap, positions: F64) -> Heights:
    """The heights of one sensor's path of positions (n, 3), map metres, over the map's ground."""
    heights = positions[:, 2] - point_map.ground_under(positions)
    known = np.isfinite(heights)
    if not known.any():
        return UNKNOWN
    median = float(np.median(heights[known]))
    off = np.where(known, heights - median, 0.0)
    worst = int(np.argmax(np.abs(off)))
    where = float(positions[worst, 0]), float(positions[worst, 1])
    share = float((np.abs(off[known]) > LEVEL_M).mean())
    return Heights(median, float(off[worst]), where, share, float(1.0 - known.mean()))


def two_levels(path: F64) -> tuple[float, float, float] | None:
    """(x, y, metres apart) of the place where road positions (n, 3) run farthest above each other; None if nowhere.

    Positions in order of driving, drives one after another, heights of the road and not of sensors.
    """
    pairs = crossings(path)
    if len(pairs) == 0:
        return None
    apart = np.abs(path[pairs[:, 0], 2] - path[pairs[:, 1], 2])
    worst = int(np.argmax(apart))
    x, y = path[pairs[worst, 0], :2]
    return float(x), float(y), float(apart[worst])


def crossings(path: F64) -> I64:
    """(k, 2) indices of road positions (n, 3) of which one runs above the other."""
    pairs = cKDTree(path[:, :2]).query_pairs(_BESIDE_M, output_type="ndarray")
    pairs = pairs[np.abs(pairs[:, 0] - pairs[:, 1]) > _STEPS]
    return np.asarray(pairs[np.abs(path[pairs[:, 0], 2] - path[pairs[:, 1], 2]) > LEVEL_M], dtype=np.int64)
