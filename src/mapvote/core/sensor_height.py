"""Height of a vehicle's sensor over the ground of a map: the one figure in which path and ground must agree."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from mapvote.core.point_map import PointMap
from mapvote.core.record import record
from mapvote.core.types import F64, I64


@record()
@dataclass(frozen=True, slots=True)
class PathLevels:
    """Numbers of the comparison of path and ground."""

    level_m: float = 0.3
    """Difference of path and ground beyond which they are two levels, or one of them is wrong."""
    beside_m: float = 0.6
    """Distance of two paths, seen from above, within which they run through the same cells."""
    steps: int = 20
    """Positions of one drive nearer than this in order are one pass, not two."""


PATH_LEVELS = PathLevels()


@dataclass(frozen=True, slots=True)
class Heights:
    """The heights of a path over the ground, metres."""

    median_m: float
    """The sensor's height, if the ground is right. NaN if the ground is unknown all along."""
    worst_off_m: float
    """The largest difference to the median, with its sign: positive where the ground lies too low."""
    worst_xy: tuple[float, float]
    """Place of this difference, map metres."""
    off_share: float
    """Share of the path along which the difference exceeds ``level_m``."""
    unknown_share: float
    """Share of the path along which the map has no ground."""
    level_m: float = PATH_LEVELS.level_m
    """Difference from which path and ground disagree."""

    def __str__(self) -> str:
        if np.isnan(self.median_m):
            return "no ground is known under the path"
        text = f"sensor {self.median_m:.2f} m over the ground (median), off by {abs(self.worst_off_m):.2f} m at most"
        return text if self.unknown_share == 0 else f"{text}; ground unknown under {self.unknown_share:.0%} of the path"

    @property
    def complaint(self) -> str:
        """The disagreement of path and ground in a line; empty without one."""
        if np.isnan(self.median_m):
            return "the map has no ground under the path"
        if self.off_share == 0:
            return ""
        x, y = self.worst_xy
        return (
            f"path and ground disagree by more than {self.level_m} m along {self.off_share:.1%} of the path, "
            f"most by {abs(self.worst_off_m):.2f} m at ({x:.1f}, {y:.1f})"
        )


NO_HEIGHTS = Heights(np.nan, np.nan, (np.nan, np.nan), 0.0, 1.0)


def check_heights(point_map: PointMap, positions: F64, numbers: PathLevels = PATH_LEVELS) -> Heights:
    """The heights of one sensor's path of positions (n, 3), map metres, over the map's ground."""
    heights = positions[:, 2] - point_map.ground_under(positions)
    has_ground = np.isfinite(heights)
    if not has_ground.any():
        return NO_HEIGHTS
    median = float(np.median(heights[has_ground]))
    off = np.where(has_ground, heights - median, 0.0)
    worst = int(np.argmax(np.abs(off)))
    worst_xy = float(positions[worst, 0]), float(positions[worst, 1])
    share = float((np.abs(off[has_ground]) > numbers.level_m).mean())
    return Heights(median, float(off[worst]), worst_xy, share, float(1.0 - has_ground.mean()), numbers.level_m)


def two_levels(path: F64, numbers: PathLevels = PATH_LEVELS) -> tuple[float, float, float] | None:
    """(x, y, metres apart) of the place where road positions (n, 3) run farthest above each other; None if nowhere.

    Positions in order of driving, drives one after another, heights of the road and not of sensors.
    """
    pairs = crossings(path, numbers)
    if len(pairs) == 0:
        return None
    apart = np.abs(path[pairs[:, 0], 2] - path[pairs[:, 1], 2])
    worst = int(np.argmax(apart))
    x, y = path[pairs[worst, 0], :2]
    return float(x), float(y), float(apart[worst])


def crossings(path: F64, numbers: PathLevels = PATH_LEVELS) -> I64:
    """(k, 2) indices of road positions (n, 3) of which one runs above the other."""
    pairs = scipy.spatial.cKDTree(path[:, :2]).query_pairs(numbers.beside_m, output_type="ndarray")
    pairs = pairs[np.abs(pairs[:, 0] - pairs[:, 1]) > numbers.steps]
    return np.asarray(pairs[np.abs(path[pairs[:, 0], 2] - path[pairs[:, 1], 2]) > numbers.level_m], dtype=np.int64)
