"""Whether a pose can be trusted: what fits there, against what should fit there and what fits elsewhere.

No fixed share of inliers serves all sensors and streets. Two comparisons do. How well the scan fits is divided by how
well a scan from this very place would fit, predicted from the map's own distributions and the sensor's noise. And the
best other place, 2 to 15 m along or across the street or turned about, must fit clearly worse. Both look only at
points that stand above the ground: the road fits itself everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapvote.core.geometry import from_xyz_rpy
from mapvote.core.types import F64, Bool
from mapvote.matching.matcher import SETTLED, LocalMatcher
from mapvote.matching.ndt_voxels import LEVELS
from mapvote.matching.prepare import in_rows

MIN_FIT = 0.6
"""Of what the map leads to expect, from which a pose may be voted with; docs/measurements/localisation.md says how
often wrong poses are trusted."""
MIN_LEAD = 0.05
"""By how much the best other place must fit worse, in the same scale."""
MIN_KNOWN = 0.3
"""Share of the standing points that must lie where the map has been: with fewer, what fits there proves little."""
_POINTS = 1000
"""Points of a scan that are used."""
_NEAR_M, _FAR_M = 2.0, 15.0
"""Other places are tried from here to there, along the street and across it: houses and parked cars repeat so."""
_CELL_M = 3.0
_ABOVE_M = 0.6
"""Points this high above the lowest one around them stand above the ground, on any road that can be driven."""
_SAME_PLACE_M = 1.5
"""Two fixes nearer than this are one place; if the other fits better, the first had not settled."""
_SETTLED_M = 0.2
_REFINED = 3
"""How many of the best other places are refined."""
_QUICK_SETTLED, _QUICK_EVERY = (0.1, 0.1), 3
"""A quick look finds other places to a centimetre, and on the way there by every third point: their fits, .3 to .5 of
the right place's, come out .005 different in the mean and .13 at most, over three drives, for half of the work."""
_STEP_M = 1.0
_COARSE = 300
"""Standing points that rank the places before any is refined."""


def _arms() -> list[F64]:
    """(m, 4, 4) each: steps ahead, back, left, right, and along the street but turned about."""
    away = np.arange(_NEAR_M - _STEP_M, _FAR_M + 0.5 * _STEP_M, _STEP_M)
    ways = (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0), (1.0, 0.0, np.pi)
    steps = [away if yaw == 0.0 else np.concatenate([-away[::-1], away]) for _, _, yaw in ways]
    return [
        np.array([from_xyz_rpy(x * s, y * s, 0.0, 0.0, 0.0, yaw) for s in along])
        for (x, y, yaw), along in zip(ways, steps, strict=True)
    ]


_ARMS = _arms()


@dataclass(frozen=True, slots=True)
class Verdict:
    """The evidence for a pose."""

    fit: float
    """Likelihood of the standing points over what the map leads to expect of them; about 1 at the right place."""
    known: float
    """Share of the standing points that lie where the map has been."""
    lead: float
    """By how much the fit exceeds that of the best other place; below 0 that one is better."""
    T_map_lidar_other: F64 | None
    """The best other place, if there is any."""


class Judge:
    """Looks at one scan at one pose of a map."""

    def __init__(self, range_sigma_m: float, most_points: int = _POINTS) -> None:
        self.range_sigma_m, self.most_points = range_sigma_m, most_points

    def judge(self, around: LocalMatcher, points_lidar: F64, T_map_lidar: F64, quick: bool = False) -> Verdict:
        """``points_lidar`` (n, 3) de-skewed and thinned; a few thousand are plenty. ``quick``: other places are found
        less well, for a third less work; what does not hold then should be judged again."""
        few, standing, expected, known, here = self._here(around, points_lidar, T_map_lidar)
        best, lead = None, here
        for other in self._others(around, few, standing, T_map_lidar, quick):
            ahead = here - self._likelihood(around, standing, other) / expected
            away = float(np.linalg.norm(other[:2, 3] - T_map_lidar[:2, 3]))
            away = away if float(other[:2, 0] @ T_map_lidar[:2, 0]) > 0.0 else np.inf
            if ahead < lead and (away > _SAME_PLACE_M or (ahead < 0.0 and away > _SETTLED_M)):
                best, lead = other, ahead
        return Verdict(here, known, lead, best)

    def fit(self, around: LocalMatcher, points_lidar: F64, T_map_lidar: F64) -> float:
        """The verdict's fit alone; 0 where too little is known."""
        *_, known, here = self._here(around, points_lidar, T_map_lidar)
        return here if known >= MIN_KNOWN else 0.0

    def holds(self, verdict: Verdict) -> bool:
        """Whether the verdict confirms the pose."""
        return verdict.fit >= MIN_FIT and verdict.known >= MIN_KNOWN and verdict.lead >= MIN_LEAD

    def _here(self, around: LocalMatcher, points_lidar: F64, T: F64) -> tuple[F64, F64, float, float, float]:
        """(points that are looked at; those of them that stand; mean likelihood that these should have; share of them
        where the map has been; how well they fit)."""
        few = np.ascontiguousarray(points_lidar[:: max(1, len(points_lidar) // self.most_points)])
        standing = few[stands_above_ground(few, T)]
        points = standing @ T[:3, :3].T + T[:3, 3]
        mapped, near = around.expected(points, self.range_sigma_m)
        expected = 1.0
        known = 0.0
        if near.any():
            known = float(near.mean())
            expected = max((float(mapped.mean()) if len(mapped) else 1.0) * known, 1e-6)
        return few, standing, expected, known, self._likelihood(around, standing, T) / expected

    def _likelihood(self, around: LocalMatcher, standing: F64, T: F64) -> float:
        return float(around.likelihood(in_rows(standing), T[None], -1)[0])

    def _others(self, around: LocalMatcher, few: F64, standing: F64, T: F64, quick: bool) -> list[F64]:
        """Refined poses of the best other places: the coarse peaks along four arms and turned about, and just
        ahead and behind."""
        coarse = in_rows(standing[:: max(1, len(standing) // _COARSE)])
        peaks = []
        for arm in _ARMS:
            guesses = T @ arm
            fits = around.likelihood(coarse, guesses)
            rising = fits[1:] > fits[:-1]
            falling = np.append(fits[1:-1] >= fits[2:], True)
            peaks += [(float(fits[k]), guesses[k]) for k in np.flatnonzero(rising & falling) + 1]
        peaks.sort(key=lambda peak: -peak[0])
        unsettled = [T @ _ARMS[0][0], T @ _ARMS[1][0]]
        on_the_way = in_rows(few[:: _QUICK_EVERY if quick else 1])
        clouds = [*[on_the_way] * (len(LEVELS) - 1), in_rows(few)]
        starts = [*unsettled, *(guess for _, guess in peaks[:_REFINED])]
        settled = _QUICK_SETTLED if quick else SETTLED
        return [around.refine(clouds, start, settled=settled).T_map_lidar for start in starts]


def stands_above_ground(points_lidar: F64, T_map_lidar: F64) -> Bool:
    """(n,) whether each point (n, 3) lies well above the lowest one within a few metres of it, plumb."""
    return height_above_lowest(points_lidar @ T_map_lidar[:3, :3].T) > _ABOVE_M


def height_above_lowest(points: F64) -> F64:
    """(n,) height of each point (n, 3) above the lowest one within 3 to 6 m of it; -inf beyond 120 m."""
    half = 40
    cols, rows = np.floor(points[:, :2].T / _CELL_M).astype(np.int64) + half + 1
    here = np.flatnonzero((rows > 0) & (rows <= 2 * half) & (cols > 0) & (cols <= 2 * half))
    rows, cols, z = rows[here], cols[here], points[here, 2]
    low = np.full((2 * half + 2, 2 * half + 2), np.inf)
    np.minimum.at(low, (rows, cols), z)
    out = np.full(len(points), -np.inf)
    out[here] = z - np.min([low[rows + i, cols + j] for i in (-1, 0, 1) for j in (-1, 0, 1)], axis=0)
    return out
