"""Where in the whole map was this scan taken? A search without any prior, over every place that can be driven on.

Exhaustive correlation (Olson, Real-time correlative scan matching, 2009) with a column word for every metre of map:
what stands in the scan, by its height above the ground, is looked up at every drivable place and heading. Heights
above the ground need no roll, pitch or altitude. The best peaks are refined by NDT and judged like any other pose.
One km2 of streets has some 10^7 places and headings: seconds, so no branching and bounding.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mapvote.config import NdtSettings
from mapvote.core.geometry import inverse
from mapvote.core.point_map import PointMap, all_points, has_open_ground
from mapvote.core.types import F64, U32, Scan
from mapvote.localisation.coarse_search import LEAST_LEAD, place_without_prior
from mapvote.localisation.correlation import (
    CELL_M,
    HIGH_M,
    LAYER_M,
    LOW_M,
    MARGIN,
    CoarseMap,
    apart,
    correlate,
    highest,
    laid_out,
    sharpened,
)
from mapvote.localisation.map_window import MapWindow
from mapvote.localisation.ndt import LEVELS, refine, thin_for_levels
from mapvote.localisation.odometry import Tracker
from mapvote.localisation.pose_check import MIN_FIT, MIN_KNOWN, MIN_LEAD, Judge, height_above_lowest
from mapvote.localisation.prepare import deskew, solid_sample

_REACH_M = 45.0
_POINTS = 200
_FIRST = 48
"""Points after which a hopeless place is given up."""
_YAWS = 120
_SPREAD_M, _SPREAD_RAD = 3.0, np.radians(15.0)
"""Peaks nearer to each other than this are one."""
_PEAKS, _REFINED, _JUDGED = 60, 12, 3
_LEAST_SCORE = 0.4
"""Mean likelihood of what stands in a scan, of a map without ground."""


@dataclass(frozen=True, slots=True)
class Found:
    """The best place in the map."""

    T_map_lidar: F64
    fit: float
    """As :class:`mapvote.localisation.pose_check.Verdict` has it."""
    lead: float
    """By how much it fits better than the best place elsewhere."""


class GlobalSearch:
    """The whole map, laid out for searching when first asked."""

    def __init__(self, point_map: PointMap, ndt: NdtSettings, range_sigma_m: float) -> None:
        self.point_map, self.ndt = point_map, ndt
        self.map_around = MapWindow(point_map)
        self.judge = Judge(range_sigma_m)

    def in_map(self, point_map: PointMap) -> GlobalSearch:
        """The same search in another version of the map."""
        other = GlobalSearch(point_map, self.ndt, 0.0)
        other.judge = self.judge
        return other

    @cached_property
    def _has_ground(self) -> bool:
        return has_open_ground(self.point_map)

    @cached_property
    def _points(self) -> F64:
        return all_points(self.point_map)

    @cached_property
    def _layout(self) -> CoarseMap:
        return laid_out(self.point_map)

    def __call__(self, scan: Scan) -> F64 | None:
        """The pose (4, 4) of the scan, or None if no place holds or another fits as well.

        In a map without ground nobody knows where one could drive, nor heights above it: there every shift and yaw of
        the scan is tried (localisation/coarse_search.py), which takes some seconds for each square kilometre.
        """
        if not self._has_ground:
            placed = place_without_prior(self._points, scan.points.astype(np.float64))
            return placed.T_a_b if placed.lead >= LEAST_LEAD and placed.score >= _LEAST_SCORE else None
        found = self.find(scan)
        if found is None or found.fit < MIN_FIT or found.lead < MIN_LEAD:
            return None
        return found.T_map_lidar

    def find(self, scan: Scan) -> Found | None:
        """The best place, however good it is; None if nothing stands in the scan or nothing in the map is like it."""
        few = solid_sample(scan.points, 1.0)
        height = height_above_lowest(few)
        near = few[:, 0] ** 2 + few[:, 1] ** 2 < _REACH_M**2
        sample = few[near & (height > LOW_M) & (height < HIGH_M)]
        if len(sample) < _FIRST:
            return None
        bits = np.floor(height[near & (height > LOW_M) & (height < HIGH_M)] / LAYER_M).astype(np.uint32)
        order = np.random.default_rng(0).permutation(len(sample))[:_POINTS]  # any will do, the same each time
        xy, bits = sample[order, :2], bits[order]
        below = few[few[:, 0] ** 2 + few[:, 1] ** 2 < 36.0, 2]
        sensor_m = -float(np.quantile(below, 0.05)) if len(below) else 1.8
        best = sorted(self._peaks(xy, bits), key=lambda peak: -peak[0])[:_REFINED]
        return self._choose(scan, [self._pose(peak, sensor_m) for peak in best])

    def _peaks(self, xy: F64, bits: U32) -> list[tuple[float, float, float, float]]:
        """(share, x, y, yaw) of the best places, sharpened on single cells."""
        lay = self._layout
        yaws = np.arange(_YAWS) * (2.0 * np.pi / _YAWS)
        hopeless = int(0.5 * MIN_FIT * MIN_KNOWN * _FIRST)
        scores = correlate(lay.wide, lay.spans, lay.cols // 2 + MARGIN, xy, bits, yaws, hopeless, _FIRST)
        likely = highest(scores.ravel(), 400 * _PEAKS)
        place, heading = likely // _YAWS, likely % _YAWS
        x, y = lay.cols[place] + 0.5, lay.rows[place] + 0.5
        kept = apart(x * CELL_M, y * CELL_M, yaws[heading], _PEAKS, _SPREAD_M, _SPREAD_RAD)
        return [sharpened(lay.words, x[k], y[k], yaws[heading[k]], xy, bits) for k in kept]

    def _pose(self, peak: tuple[float, float, float, float], sensor_m: float) -> F64:
        """(4, 4) on the map's ground at a peak, level with it."""
        lay, (_, x, y, yaw) = self._layout, peak
        row, col = int(y), int(x)
        low_r, low_c = max(row - 5, 0), max(col - 5, 0)
        patch = lay.ground_z[low_r : row + 6, low_c : col + 6]
        r, c = np.nonzero(np.isfinite(patch))
        A = np.column_stack([c + low_c + 0.5 - x, r + low_r + 0.5 - y, np.ones(len(r))])
        (gx, gy, z), *_ = np.linalg.lstsq(A, patch[r, c], rcond=None)
        up = np.array([-gx, -gy, 1.0]) / np.sqrt(gx * gx + gy * gy + 1.0)
        ahead = np.array([np.cos(yaw), np.sin(yaw), gx * np.cos(yaw) + gy * np.sin(yaw)])
        ahead /= np.linalg.norm(ahead)
        T = np.eye(4)
        T[:3, 0], T[:3, 1], T[:3, 2] = ahead, np.cross(up, ahead), up
        T[:3, 3] = np.array([lay.x0 + x * CELL_M, lay.y0 + y * CELL_M, z]) + sensor_m * up
        return T

    def _choose(self, scan: Scan, guesses: list[F64]) -> Found | None:
        """Refine all, judge the best few with the motion that suits them, and compare."""
        guesses.sort(key=lambda T: (round(T[0, 3] / 40.0), round(T[1, 3] / 40.0)))  # neighbours share a window
        clouds = thin_for_levels(scan.points)
        clouds = [np.ascontiguousarray(cloud[:, :: max(1, cloud.shape[1] // 2000)]) for cloud in clouds]
        refined = [refine(self.map_around(guess[:3, 3]), clouds, guess) for guess in guesses]
        refined.sort(key=lambda result: -result.score)
        judged = [self._judged(scan, T) for T in _distinct([r.T_map_lidar for r in refined])[:_JUDGED]]
        if not judged:
            return None
        judged.sort(key=lambda one: -one[0])
        rival = max((fit for fit, T in judged[1:] if _differ(T, judged[0][1])), default=0.0)
        return Found(judged[0][1], judged[0][0], judged[0][0] - rival)

    def _judged(self, scan: Scan, T: F64) -> tuple[float, F64]:
        ndt_map = self.map_around(T[:3, 3])
        points = scan.points
        if scan.time_s is not None:
            points = deskew(scan, Tracker(self.map_around, self.ndt).guess_motion(ndt_map, scan, T, None))
        T = refine(ndt_map, thin_for_levels(points), T).T_map_lidar
        few = solid_sample(points, LEVELS[-1].points_m)
        return self.judge.fit(ndt_map, few, T), T


def _differ(T: F64, other: F64) -> bool:
    between = inverse(T) @ other
    return bool(np.linalg.norm(between[:2, 3]) > 1.5 or between[0, 0] < np.cos(_SPREAD_RAD))


def _distinct(poses: list[F64]) -> list[F64]:
    out: list[F64] = []
    for T in poses:
        if all(_differ(T, other) for other in out):
            out.append(T)
    return out
