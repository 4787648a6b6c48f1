"""The road under the driven path: it lies one sensor height below the path, and the map's points give that height.

A driven path is evidence of the ground that no reflection falsifies: where a vehicle drove, there is road. The height
of the sensor follows from the points on the driven track: the road is their densest layer. The mount that a drive
states is not needed.

The same road checks a prior's claim to a precise attitude, which guides every registration
(:mod:`mapvote.survey.build`). If the attitude is pitched by a degree, the road ahead of each scan lies where no other
scan has it, and the ground is wrong. One scan shows the pitch: the road along the driven path runs parallel to that
path. Roll does not show: a road's own crossfall is as large.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import scipy

from mapvote.core.geometry import transform
from mapvote.core.record import record
from mapvote.core.sampling import evenly
from mapvote.core.types import F64, PRECISE_PRIOR, Bool, Drive


@record()
@dataclass(frozen=True, slots=True)
class RoadSearch:
    """Numbers of the search for the road under a path."""

    track_m: float = 0.8
    """Half the width that wheels roll over."""
    step_m: float = 0.15
    """Spacing of the path's positions."""
    jump_m: float = 5.0
    """Distance between two scans from which the path between them counts as unknown."""
    layers_m: tuple[float, float, float] = (0.15, 6.0, 0.05)
    """First, last and height of the layers below the sensor in which the road of a map is searched."""
    near_m: float = 0.15
    """Points this near to the densest layer are the road."""
    min_share: float = 0.3
    """Share of the track along which the road must have been measured where it is expected."""


ROAD_SEARCH = RoadSearch()


@record()
@dataclass(frozen=True, slots=True)
class AttitudeCheck:
    """Numbers of the check of a precise prior's attitude."""

    scans: int = 24
    """Scans measured, evenly through the drive."""
    min_scans: int = 8
    """Scans that must show the road: fewer decide nothing."""
    reach_m: float = 15.0
    """Length of road along the path, before and behind the sensor."""
    spread_m: float = 5.0
    """Length along the path below which a piece of road shows no slope."""
    min_points: int = 30
    """Points of the road below which a scan shows no slope."""
    depths_m: tuple[float, float, float] = (0.3, 5.0, 0.1)
    """First, last and height of the layers below the sensor in which the road of one scan is searched."""
    around_m: float = 0.4
    """Distance from the densest layer within which points may be the road."""
    scatter_m: float = 0.03
    """Scatter of the points of a road."""
    sigmas: float = 3.0
    """Sigmas of the claim that the median pitch must exceed to contradict it."""
    own_deg: float = 0.2
    """Error of this measurement, added to these sigmas."""


ATTITUDE_CHECK = AttitudeCheck()


def road_under(T_map_lidar: F64, registered: Bool, cloud: F64, numbers: RoadSearch = ROAD_SEARCH) -> F64:
    """(k, 3) the road under a drive at poses (n, 4, 4), those ``registered`` (n,), every 0.15 m along the path, from
    the points (m, 3) of the map, all map metres; none if these do not show it."""
    path = _dense(T_map_lidar[:, :3, 3], registered, numbers)
    none = np.zeros((0, 3))
    if len(path) == 0:
        return none
    distance, at = scipy.spatial.cKDTree(path[:, :2]).query(cloud[:, :2], distance_upper_bound=numbers.track_m)
    on_track = np.isfinite(distance)
    at, height = at[on_track], path[at[on_track], 2] - cloud[on_track, 2]
    densest_m = _densest(height, np.arange(*numbers.layers_m))
    if np.isnan(densest_m):
        return none
    road = np.abs(height - densest_m) < numbers.near_m
    near = np.zeros(len(path), dtype=np.bool_)
    near[at[road]] = True
    reach = round(1.0 / numbers.step_m)
    measured = np.convolve(near, np.ones(2 * reach + 1), mode="same") > 0
    return path - [0.0, 0.0, float(np.median(height[road]))] if measured.mean() >= numbers.min_share else none


def _densest(heights: F64, layers: F64) -> float:
    """The middle of the layer between two of ``layers`` (k,) that, with the two beside it, holds the most of the
    ``heights`` (n,); NaN if all are empty."""
    count = np.histogram(heights, layers)[0]
    densest = int(np.argmax(np.convolve(count, np.ones(3), mode="same")))
    return float(layers[densest] + 0.5 * (layers[1] - layers[0])) if count.any() else np.nan


def _dense(positions: F64, registered: Bool, numbers: RoadSearch) -> F64:
    """(m, 3) the path every ``step_m``, without stretches on which no scan was registered."""
    placed = positions[registered]
    if len(placed) < 2:
        return placed
    pieces = [placed[:1]]
    for a, b in pairwise(placed):
        length = float(np.linalg.norm(b - a))
        steps = max(1, round(length / numbers.step_m)) if length <= numbers.jump_m else 1
        pieces.append(a + np.arange(1, steps + 1)[:, None] / steps * (b - a))
    return np.concatenate(pieces)


@dataclass(frozen=True, slots=True)
class WrongAttitude:
    """A precise prior's attitude that the scans contradict."""

    pitch_deg: float
    """Pitch of the prior's attitude against the road along the path, median over scans; nose down is positive."""
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
        """Sigma that the drive should state: at least its pitch, and too coarse for a surveyor's."""
        return max(round(abs(self.pitch_deg) + 0.05, 1), PRECISE_PRIOR.attitude_deg + 0.1)


def wrong_attitude(
    drive: Drive, scans: Sequence[int] | None = None, numbers: AttitudeCheck = ATTITUDE_CHECK
) -> WrongAttitude | None:
    """The error of a precise prior's attitude; None without one, or if the scans do not show the road.

    ``scans``: those that can be read; default: all. A coarser prior is not checked: it guides no registration.
    """
    if not drive.has_precise_prior:
        return None
    chosen = np.arange(len(drive)) if scans is None else np.asarray(scans, dtype=np.int64)
    chosen = chosen[evenly(0, len(chosen) - 1, min(numbers.scans, len(chosen)))]
    pitches = np.array([_pitch_rad(drive, int(i), numbers) for i in chosen])
    pitches = np.degrees(pitches[np.isfinite(pitches)])
    if len(pitches) < numbers.min_scans:
        return None
    pitch_deg = float(np.median(pitches))
    if abs(pitch_deg) <= numbers.sigmas * drive.prior_sigma_deg + numbers.own_deg:
        return None
    return WrongAttitude(pitch_deg, drive.prior_sigma_deg)


def _pitch_rad(drive: Drive, i: int, numbers: AttitudeCheck) -> float:
    """Slope of the road along the path against the path, at scan i by the prior; NaN if the scan does not show it."""
    # The path around the scan: an unbroken run of scans near by, long enough to show a slope.
    assert drive.T_map_lidar_prior is not None
    path = drive.T_map_lidar_prior[:, :3, 3] - drive.T_map_lidar_prior[i, :3, 3]
    near = np.linalg.norm(path[:, :2], axis=1) < numbers.reach_m
    path = path[_run_around(near, i)]
    ahead = path[-1, :2] - path[0, :2]
    length_m = float(np.linalg.norm(ahead))
    if length_m < numbers.spread_m:
        return np.nan
    ahead = ahead / length_m
    side = np.array([-ahead[1], ahead[0]])
    along = path[:, :2] @ ahead
    # Parabolas of the path's height and bends: the prior's own noise of some centimetres is no slope of the path.
    rises = np.polyfit(along, path[:, 2], 2)
    bends = np.polyfit(along, path[:, :2] @ side, 2)
    # The scan's points on the track, and their depth below the path.
    points = transform(drive.T_map_lidar_prior[i], drive.read_scan(i).points) - drive.T_map_lidar_prior[i, :3, 3]
    s = points[:, :2] @ ahead
    beside_m = np.abs(points[:, :2] @ side - np.polyval(bends, s))
    on_track = (s > along.min()) & (s < along.max()) & (beside_m < ROAD_SEARCH.track_m)
    s, depth = s[on_track], np.polyval(rises, s[on_track]) - points[on_track, 2]
    return _slope(s, depth, numbers)


def _run_around(near: Bool, i: int) -> Bool:
    """(n,) the unbroken run of ``near`` that scan i is in: the path may come by again."""
    apart = np.cumsum(~near)
    return np.asarray(near & (apart == apart[i]))


def _slope(along: F64, depth: F64, numbers: AttitudeCheck) -> float:
    """Slope of the road in points (n,) at ``along`` and ``depth``, metres below the path; NaN if they show none."""
    densest_m = _densest(depth, np.arange(*numbers.depths_m))
    road = np.abs(depth - densest_m) < numbers.around_m
    s = along[road]
    d = depth[road]
    if len(s) < numbers.min_points or np.ptp(np.percentile(s, (5, 95))) < numbers.spread_m:
        return np.nan
    line = scipy.optimize.least_squares(
        lambda p: p[0] + p[1] * s - d, np.array([densest_m, 0.0]), loss="soft_l1", f_scale=numbers.scatter_m
    )
    return float(np.arctan(line.x[1]))
