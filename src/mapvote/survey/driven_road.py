"""The road under the driven path: it lies one sensor height below, all along, and points say how high.

A vehicle is the one witness of the ground that no reflection deceives: where it drove, there is road. The height of its
sensor is taken from the points on the driven track, of which the road is the densest layer; the mount that a drive
states need not be known.

The same road checks a prior's claim to a precise attitude, which guides every registration
(:mod:`mapvote.survey.build`). If that is pitched by a degree, the road ahead of each scan lies where no other scan has
it, and the ground is wrong. One scan shows the pitch: the road along the driven path runs parallel to that path. Roll
does not show: a road's own crossfall is as large.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import scipy

from mapvote.core.geometry import transform
from mapvote.core.types import F64, PRECISE_PRIOR_DEG, Bool, Drive

TRACK_M = 0.8
"""Half the width that wheels roll over."""
_STEP_M = 0.15
_JUMP_M = 5.0
"""Between scans; farther apart, nothing is known of the way between them."""
_LAYERS_M = np.arange(0.15, 6.0, 0.05)
"""Below the sensor, where the road of a map is looked for."""
_ROAD_M = 0.15
"""Points this near to the densest layer are the road."""
_LEAST_SHARE = 0.3
"""Of the track, along which the road must have been measured where it is expected."""


def road_under(T_map_lidar: F64, registered: Bool, cloud: F64) -> F64:
    """(k, 3) the road under a drive at poses (n, 4, 4), those ``registered`` (n,), every 0.15 m along the path, from
    the points (m, 3) of the map, all map metres; none if these do not show it."""
    path, none = _dense(T_map_lidar[:, :3, 3], registered), np.zeros((0, 3))
    if len(path) == 0:
        return none
    distance, at = scipy.spatial.cKDTree(path[:, :2]).query(cloud[:, :2], distance_upper_bound=TRACK_M)
    on_track = np.isfinite(distance)
    at, height = at[on_track], path[at[on_track], 2] - cloud[on_track, 2]
    densest_m = _densest(height, _LAYERS_M)
    if np.isnan(densest_m):
        return none
    road = np.abs(height - densest_m) < _ROAD_M
    near = np.zeros(len(path), dtype=np.bool_)
    near[at[road]] = True
    reach = round(1.0 / _STEP_M)
    measured = np.convolve(near, np.ones(2 * reach + 1), mode="same") > 0
    return path - [0.0, 0.0, float(np.median(height[road]))] if measured.mean() >= _LEAST_SHARE else none


def _densest(heights: F64, layers: F64) -> float:
    """The middle of the layer between two of ``layers`` (k,) that, with the two beside it, holds the most of the
    ``heights`` (n,); NaN if all are empty."""
    count = np.histogram(heights, layers)[0]
    densest = int(np.argmax(np.convolve(count, np.ones(3), mode="same")))
    return float(layers[densest] + 0.5 * (layers[1] - layers[0])) if count.any() else np.nan


def _dense(positions: F64, registered: Bool) -> F64:
    """(m, 3) the path every 0.15 m, but for stretches on which no scan was registered."""
    known = positions[registered]
    if len(known) < 2:
        return known
    pieces = [known[:1]]
    for a, b in pairwise(known):
        length = float(np.linalg.norm(b - a))
        steps = max(1, round(length / _STEP_M)) if length <= _JUMP_M else 1
        pieces.append(a + np.arange(1, steps + 1)[:, None] / steps * (b - a))
    return np.concatenate(pieces)


_SCANS, _LEAST_SCANS = 24, 8
_REACH_M = 15.0
"""Of the road along the path, before and behind the sensor."""
_SPREAD_M = 5.0
"""Along the path: a shorter piece of road shows no slope."""
_LEAST_POINTS = 30
_DEPTHS_M, _AROUND_M = np.arange(0.3, 5.0, 0.1), 0.4
"""Below the sensor: where the road of one scan is looked for, in layers, and how far from the densest it may reach."""
_SCATTER_M = 0.03
"""Of points of a road."""
_SIGMAS, _OWN_DEG = 3.0, 0.2
"""The claim is contradicted by a median pitch of more than 3 of its sigmas and what this measurement may err by."""


@dataclass(frozen=True, slots=True)
class WrongAttitude:
    """A precise prior's attitude that the scans contradict."""

    pitch_deg: float
    """Of the prior's attitude against the road along the path, median over scans; nose down is positive."""
    claimed_deg: float
    """prior_sigma_deg as stated."""

    @property
    def what(self) -> str:
        return (
            f"the prior's attitude is pitched by {self.pitch_deg:+.2f} deg against the road along the driven path, but "
            f"prior_sigma_deg says {self.claimed_deg:g}"
        )

    @property
    def mend(self) -> str:
        return f"correct the pitch of the prior or of T_base_lidar, or state prior_sigma_deg = {self.sigma_deg:g}"

    @property
    def sigma_deg(self) -> float:
        """What the drive is to state: at least its pitch, and too coarse to be a surveyor's."""
        return max(round(abs(self.pitch_deg) + 0.05, 1), PRECISE_PRIOR_DEG + 0.1)


def wrong_attitude(drive: Drive, scans: Sequence[int] | None = None) -> WrongAttitude | None:
    """What is wrong with the attitude of a precise prior; None if nothing is, or if the road does not show.

    ``scans``: those that can be read; all unless given. A coarser prior is not looked at: it guides no registration.
    """
    if not drive.has_precise_prior:
        return None
    chosen = np.arange(len(drive)) if scans is None else np.asarray(scans, dtype=np.int64)
    chosen = chosen[np.unique(np.linspace(0, len(chosen) - 1, min(_SCANS, len(chosen))).astype(np.int64))]
    pitches = np.array([_pitch_rad(drive, int(i)) for i in chosen])
    pitches = np.degrees(pitches[np.isfinite(pitches)])
    if len(pitches) < _LEAST_SCANS:
        return None
    pitch_deg = float(np.median(pitches))
    if abs(pitch_deg) <= _SIGMAS * drive.prior_sigma_deg + _OWN_DEG:
        return None
    return WrongAttitude(pitch_deg, drive.prior_sigma_deg)


def _pitch_rad(drive: Drive, i: int) -> float:
    """Slope of the road along the path against the path, at scan i by the prior; NaN if the scan does not show it."""
    assert drive.T_map_lidar_prior is not None
    path = drive.T_map_lidar_prior[:, :3, 3] - drive.T_map_lidar_prior[i, :3, 3]
    near = np.linalg.norm(path[:, :2], axis=1) < _REACH_M
    path = path[_run_around(near, i)]
    ahead = path[-1, :2] - path[0, :2]
    length_m = float(np.linalg.norm(ahead))
    if length_m < _SPREAD_M:
        return np.nan
    ahead = ahead / length_m
    side = np.array([-ahead[1], ahead[0]])
    along = path[:, :2] @ ahead
    # The prior's own noise of some centimetres is no slope of the path.
    rises = np.polyfit(along, path[:, 2], 2)
    bends = np.polyfit(along, path[:, :2] @ side, 2)
    points = transform(drive.T_map_lidar_prior[i], drive.read_scan(i).points) - drive.T_map_lidar_prior[i, :3, 3]
    s = points[:, :2] @ ahead
    on_track = (s > along.min()) & (s < along.max()) & (np.abs(points[:, :2] @ side - np.polyval(bends, s)) < TRACK_M)
    s, depth = s[on_track], np.polyval(rises, s[on_track]) - points[on_track, 2]
    return _slope(s, depth)


def _run_around(near: Bool, i: int) -> Bool:
    """(n,) the unbroken run of ``near`` that scan i is in: the path may come by again."""
    apart = np.cumsum(~near)
    return np.asarray(near & (apart == apart[i]))


def _slope(along: F64, depth: F64) -> float:
    """Slope of the road in points (n,) at ``along`` and ``depth``, metres below the path; NaN if they show none."""
    densest_m = _densest(depth, _DEPTHS_M)
    road = np.abs(depth - densest_m) < _AROUND_M
    s, d = along[road], depth[road]
    if len(s) < _LEAST_POINTS or np.ptp(np.percentile(s, (5, 95))) < _SPREAD_M:
        return np.nan
    found = scipy.optimize.least_squares(
        lambda p: p[0] + p[1] * s - d, np.array([densest_m, 0.0]), loss="soft_l1", f_scale=_SCATTER_M
    )
    return float(np.arctan(found.x[1]))
