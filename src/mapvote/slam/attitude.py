"""A precise prior's claim to an attitude, against the road that its own scans show.

A prior within .1 m and .2 deg guides every registration (:mod:`mapvote.slam.surveyor`). If its attitude is pitched by a
degree, the road ahead of each scan lies where no other scan has it, and the ground is wrong. One scan shows the pitch:
the road along the driven path runs parallel to that path. Roll does not show: a road's own crossfall is as large.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from mapvote.core.geometry import transform
from mapvote.core.types import F64, Bool, Drive
from mapvote.slam.road_prior import TRACK_M
from mapvote.slam.surveyor import PRECISE_PRIOR_DEG, is_precise

_SCANS, _LEAST_SCANS = 24, 8
_REACH_M = 15.0
"""Of the road along the path, before and behind the sensor."""
_SPREAD_M = 5.0
"""Along the path: a shorter piece of road shows no slope."""
_LEAST_POINTS = 30
_DEPTH_M, _LAYER_M, _ROAD_M = (0.3, 5.0), 0.1, 0.4
"""Below the sensor: where the road is looked for, in layers, and how far from the fullest one it may reach."""
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
    if not is_precise(drive):
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


def as_precise_as_shown(drive: Drive) -> tuple[Drive, WrongAttitude | None]:
    """(the drive, with the standard deviation of its attitude that the scans show; what contradicts its own)."""
    wrong = wrong_attitude(drive)
    return (drive, None) if wrong is None else (replace(drive, prior_sigma_deg=wrong.sigma_deg), wrong)


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
    layers = np.arange(*_DEPTH_M, _LAYER_M)
    count = np.histogram(depth, layers)[0]
    fullest = layers[int(np.argmax(np.convolve(count, np.ones(3), mode="same")))] + 0.5 * _LAYER_M
    road = np.abs(depth - fullest) < _ROAD_M
    s, d = along[road], depth[road]
    if len(s) < _LEAST_POINTS or np.ptp(np.percentile(s, (5, 95))) < _SPREAD_M:
        return np.nan
    found = scipy.optimize.least_squares(
        lambda p: p[0] + p[1] * s - d, np.array([fullest, 0.0]), loss="soft_l1", f_scale=_SCATTER_M
    )
    return float(np.arctan(found.x[1]))
