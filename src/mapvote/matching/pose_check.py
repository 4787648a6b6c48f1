"""Trust in a pose: the fit of the scan there, against the fit to be expected there and the fit elsewhere.

No fixed share of inliers serves all sensors and streets. Two comparisons do. The likelihood of the scan is divided by
the likelihood of a scan from this very place, predicted from the map's distributions and the sensor's noise. And the
best other place, 2 to 15 m along or across the street or turned about, must fit clearly worse. Both look only at
points that stand above the ground: the road fits itself everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapvote.core.geometry import from_xyz_rpy
from mapvote.core.record import record
from mapvote.core.types import F64, Bool
from mapvote.matching.matcher import CONVERGENCE, LocalMatcher, likelihood_at
from mapvote.matching.ndt_voxels import LEVELS
from mapvote.matching.prepare import in_rows


@record(votes=True)
@dataclass(frozen=True, slots=True)
class PoseCheck:
    """Numbers of the check of a pose; docs/measurements/localisation.md says how often wrong poses are trusted."""

    min_fit: float = 0.6
    """Share of the expected likelihood from which a pose may be voted with."""
    min_lead: float = 0.05
    """Difference, in the same scale, by which the best other place must fit worse."""
    min_known: float = 0.3
    """Share of the standing points that must lie where the map has been: with fewer, their fit proves little."""
    points: int = 1000
    """Points of a scan that are used."""
    near_m: float = 2.0
    """Nearest of the other places tried along the street and across it: houses and parked cars repeat so."""
    far_m: float = 15.0
    """Farthest of these places."""
    step_m: float = 1.0
    """Spacing of these places."""
    same_place_m: float = 1.5
    """Distance within which two fixes are one place; if the other fits better, the first had not settled."""
    settled_m: float = 0.2
    """Distance beyond which a better fit shows that the first had not settled."""
    refined: int = 3
    """Best other places that are refined."""
    quick_settled: tuple[float, float] = (0.1, 0.1)
    """Step, of a centimetre, at which a quick check stops: fits of other places, 0.3 to 0.5 of the right place's, come
    out 0.005 different in the mean and 0.13 at most, over three drives, for half of the work."""
    quick_every: int = 3
    """A quick check finds other places by one point of so many."""
    quick_rival: float = 0.75
    """Share of the coarse likelihood here below which a quick check refines no other place. On three drives such places
    ended at a fit of 0.42 of that here at most; on a street of equal houses none is below."""
    coarse: int = 300
    """Standing points that rank the places before any is refined."""
    above_m: float = 0.6
    """Height above the lowest point around it from which a point stands, on any road that can be driven."""
    lowest_cell_m: float = 3.0
    """Side of the cells in which the lowest point is taken."""


POSE_CHECK = PoseCheck()


def _arms(check: PoseCheck) -> list[F64]:
    """(m, 4, 4) each: steps ahead, back, left, right, and along the street but turned about."""
    away = np.arange(check.near_m - check.step_m, check.far_m + 0.5 * check.step_m, check.step_m)
    ways = (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0), (1.0, 0.0, np.pi)
    steps = [away if yaw == 0.0 else np.concatenate([-away[::-1], away]) for _, _, yaw in ways]
    return [
        np.array([from_xyz_rpy(x * s, y * s, 0.0, 0.0, 0.0, yaw) for s in along])
        for (x, y, yaw), along in zip(ways, steps, strict=True)
    ]


@dataclass(frozen=True, slots=True)
class Verdict:
    """The evidence for a pose."""

    fit: float
    """Likelihood of the standing points over the expected one; about 1 at the right place."""
    known: float
    """Share of the standing points that lie where the map has been."""
    lead: float
    """Difference of the fit from that of the best other place; below 0 that one is better."""
    T_map_lidar_other: F64 | None
    """The best other place; None without one."""


class Judge:
    """Looks at one scan at one pose of a map."""

    def __init__(self, range_sigma_m: float, check: PoseCheck = POSE_CHECK) -> None:
        self.range_sigma_m = range_sigma_m
        self.check = check
        self._arms = _arms(check)

    def judge(self, around: LocalMatcher, points_lidar: F64, T_map_lidar: F64, quick: bool = False) -> Verdict:
        """``points_lidar`` (n, 3) de-skewed and thinned; a few thousand are plenty. ``quick``: other places are found
        less well, for a third less work; a pose that does not hold should be judged again."""
        few, standing, expected, known, here = self._here(around, points_lidar, T_map_lidar)
        best = None
        lead = here
        for other in self._others(around, few, standing, T_map_lidar, quick):
            ahead = here - self._likelihood(around, standing, other) / expected
            away = float(np.linalg.norm(other[:2, 3] - T_map_lidar[:2, 3]))
            away = away if float(other[:2, 0] @ T_map_lidar[:2, 0]) > 0.0 else np.inf
            if ahead < lead and (away > self.check.same_place_m or (ahead < 0.0 and away > self.check.settled_m)):
                best = other
                lead = ahead
        return Verdict(here, known, lead, best)

    def fit(self, around: LocalMatcher, points_lidar: F64, T_map_lidar: F64) -> float:
        """The verdict's fit alone; 0 where too little is known."""
        *_, known, here = self._here(around, points_lidar, T_map_lidar)
        return here if known >= self.check.min_known else 0.0

    def holds(self, verdict: Verdict) -> bool:
        """Whether the verdict confirms the pose."""
        return (
            verdict.fit >= self.check.min_fit
            and verdict.known >= self.check.min_known
            and verdict.lead >= self.check.min_lead
        )

    def _here(self, around: LocalMatcher, points_lidar: F64, T: F64) -> tuple[F64, F64, float, float, float]:
        """(points that are used; those of them that stand; mean likelihood to be expected of these; share of them where
        the map has been; their fit)."""
        few = np.ascontiguousarray(points_lidar[:: max(1, len(points_lidar) // self.check.points)])
        standing = few[stands_above_ground(few, T, self.check)]
        points = standing @ T[:3, :3].T + T[:3, 3]
        mapped, near = around.expected(points, self.range_sigma_m)
        expected = 1.0
        known = 0.0
        if near.any():
            known = float(near.mean())
            expected = max((float(mapped.mean()) if len(mapped) else 1.0) * known, 1e-6)
        return few, standing, expected, known, self._likelihood(around, standing, T) / expected

    def _likelihood(self, around: LocalMatcher, standing: F64, T: F64) -> float:
        return likelihood_at(around, in_rows(standing), T, -1)

    def _others(self, around: LocalMatcher, few: F64, standing: F64, T: F64, quick: bool) -> list[F64]:
        """Refined poses of the best other places: the coarse peaks along four arms and turned about, and just
        ahead and behind."""
        coarse = in_rows(standing[:: max(1, len(standing) // self.check.coarse)])
        arms = [T @ arm for arm in self._arms]
        fit_here, *fits_there = np.split(
            around.likelihood(coarse, np.concatenate([T[None], *arms])), np.cumsum([1, *map(len, arms[:-1])])
        )
        peaks = []
        for guesses, fits in zip(arms, fits_there, strict=True):
            rising = fits[1:] > fits[:-1]
            falling = np.append(fits[1:-1] >= fits[2:], True)
            peaks += [(float(fits[k]), guesses[k]) for k in np.flatnonzero(rising & falling) + 1]
        peaks.sort(key=lambda peak: -peak[0])
        if quick:  # the pose itself was held lately: only what comes near to its fit can be a rival
            least = self.check.quick_rival * float(fit_here[0])
            peaks = [peak for peak in peaks if peak[0] >= least]
        unsettled = [T @ self._arms[0][0], T @ self._arms[1][0]]
        on_the_way = in_rows(few[:: self.check.quick_every if quick else 1])
        clouds = [*[on_the_way] * (len(LEVELS) - 1), in_rows(few)]
        starts = [*unsettled, *(guess for _, guess in peaks[: self.check.refined])]
        settled = self.check.quick_settled if quick else CONVERGENCE.settled
        return [around.refine(clouds, start, settled=settled).T_map_lidar for start in starts]


def stands_above_ground(points_lidar: F64, T_map_lidar: F64, check: PoseCheck = POSE_CHECK) -> Bool:
    """(n,) whether each point (n, 3) lies well above the lowest one within a few metres of it, plumb."""
    return height_above_lowest(points_lidar @ T_map_lidar[:3, :3].T, check) > check.above_m


def height_above_lowest(points: F64, check: PoseCheck = POSE_CHECK) -> F64:
    """(n,) height of each point (n, 3) above the lowest one within 3 to 6 m of it; -inf beyond 120 m."""
    half = 40
    cols, rows = np.floor(points[:, :2].T / check.lowest_cell_m).astype(np.int64) + half + 1
    here = np.flatnonzero((rows > 0) & (rows <= 2 * half) & (cols > 0) & (cols <= 2 * half))
    rows = rows[here]
    cols = cols[here]
    z = points[here, 2]
    low = np.full((2 * half + 2, 2 * half + 2), np.inf)
    np.minimum.at(low, (rows, cols), z)
    three = np.minimum(np.minimum(low[:-2], low[1:-1]), low[2:])
    nine = np.minimum(np.minimum(three[:, :-2], three[:, 1:-1]), three[:, 2:])
    out = np.full(len(points), -np.inf)
    out[here] = z - nine[rows - 1, cols - 1]
    return out
