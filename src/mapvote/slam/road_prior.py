"""The road under the driven path: it lies one sensor height below, all along, and the map's own points say how high.

A vehicle is the one witness of the ground that no reflection deceives: where it drove, there is road. The height of its
sensor is taken from the points on the driven track, of which the road is the densest layer; the mount that a drive
states need not be known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

from mapvote.core.types import F64, Bool

TRACK_M = 0.8
"""Half the width that wheels roll over."""
_STEP_M = 0.15
_JUMP_M = 5.0
"""Between scans; farther apart, nothing is known of the way between them."""
_HEIGHTS_M = (0.15, 6.0)
_LAYER_M = 0.05
_ROAD_M = 0.15
"""Points this near to the densest layer are the road."""
_LEAST_SHARE = 0.3
"""Of the track, along which the road must have been measured where it is expected."""


@dataclass(frozen=True, slots=True)
class RoadUnder:
    """The road under one drive."""

    points_map: F64
    """(n, 3) map metres, every 0.15 m along the path; none if the points do not show it."""
    sensor_height_m: float
    """Of the sensor above it, the drive's median; NaN if unknown."""
    measured_share: float
    """Of the path: where points of the road lie under it."""


def road_under(T_map_lidar: F64, registered: Bool, cloud: F64) -> RoadUnder:
    """The road under a drive at poses (n, 4, 4), those ``registered`` (n,), from the points (m, 3) of the map."""
    path = _dense(T_map_lidar[:, :3, 3], registered)
    none = RoadUnder(np.zeros((0, 3)), np.nan, 0.0)
    if len(path) == 0:
        return none
    distance, at = cKDTree(path[:, :2]).query(cloud[:, :2], distance_upper_bound=TRACK_M)
    on_track = np.isfinite(distance)
    at, height = at[on_track], path[at[on_track], 2] - cloud[on_track, 2]
    layers = np.arange(*_HEIGHTS_M, _LAYER_M)
    count = np.histogram(height, layers)[0].astype(np.float64)
    if count.sum() == 0:
        return none
    densest = int(np.argmax(np.convolve(count, np.ones(3), mode="same")))
    road = np.abs(height - layers[densest] - 0.5 * _LAYER_M) < _ROAD_M
    sensor_height_m = float(np.median(height[road]))
    near = np.zeros(len(path), dtype=np.bool_)
    near[at[road]] = True
    reach = round(1.0 / _STEP_M)
    share = float((np.convolve(near, np.ones(2 * reach + 1), mode="same") > 0).mean())
    if share < _LEAST_SHARE:
        return RoadUnder(np.zeros((0, 3)), sensor_height_m, share)
    return RoadUnder(path - [0.0, 0.0, sensor_height_m], sensor_height_m, share)


def _dense(positions: F64, registered: Bool) -> F64:
    """(m, 3) the path every 0.15 m, but for stretches on which no scan was registered."""
    known = positions[registered]
    if len(known) < 2:
        return known
    pieces = [known[:1]]
    for a, b in pairwise(known):
        length = float(np.linalg.norm(b - a))
        if length <= _JUMP_M:
            share = np.arange(1, max(1, round(length / _STEP_M)) + 1)[:, None] / max(1, round(length / _STEP_M))
            pieces.append(a + share * (b - a))
        else:
            pieces.append(b[None])
    return np.concatenate(pieces)


def all_roads(roads: Sequence[RoadUnder]) -> F64:
    """(n, 3) the road under all drives, map metres."""
    return np.concatenate([road.points_map for road in roads]) if roads else np.zeros((0, 3))
