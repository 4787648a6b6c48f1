"""Points of the updated map against the truth."""

from __future__ import annotations

import msgspec
import numpy as np
from scipy.spatial import cKDTree

from mapvote.core.point_map import PointMap
from mapvote.core.types import F64, Bool
from mapvote.core.voxels import found_among
from mapvote_lab.evaluation.scoring.cells import ratio


class MapScores(msgspec.Struct, frozen=True, kw_only=True):
    """What the update did to the points (shares of points, or of surface samples for ``new_added``)."""

    stale_deleted: float
    """Old map points of removed surfaces that are gone."""
    stale_apart_deleted: float
    """The same, of points :data:`APART_M` or more from everything that stands: nearer ones share its voxels' reach."""
    valid_deleted: float
    """Old map points of standing surfaces that are gone: the damage done."""
    new_added: float
    """Samples of reachable new surface with a point of the updated map within reach."""
    added_false: float
    """Added points that lie on no surface of the new world."""
    stale_points: int
    valid_points: int
    new_samples: int
    added_points: int


class MapJudge:
    """Compares maps with noise-free surface samples of the two worlds; what the old map is worth is asked once.

    ``old_points`` (n, 3) are the obstacle points of the map before the update. ``kept``, ``added`` and ``removed``
    (m, 3) are surface samples, map metres: standing in both worlds, only in the new one, only in the old one. An old
    point is stale if a removed sample lies within ``reach_m`` and no kept or added one nearer; valid if the nearest
    sample within reach is a kept one. Points near no surface (trails, noise) are neither.
    """

    def __init__(self, old_points: F64, kept: F64, added: F64, removed: F64, *, reach_m: float = 0.3) -> None:
        self._old, self._added, self._reach_m = old_points, added, reach_m
        self._now = cKDTree(np.concatenate([kept, added]))
        to_removed = _distance(old_points, cKDTree(removed))
        to_kept, to_now = _distance(old_points, cKDTree(kept)), _distance(old_points, self._now)
        self.stale = (to_removed <= reach_m) & (to_removed < to_now)
        self.valid = (to_kept <= reach_m) & (to_kept <= to_removed)
        self._apart = self.stale & (to_now >= APART_M)

    def score(self, new_points: F64) -> MapScores:
        """``new_points`` (n, 3): the obstacle points of the updated map; an old one survives if found bit for bit."""
        survived, fresh = same_rows(self._old, new_points)
        reached = _distance(self._added, cKDTree(new_points)) <= self._reach_m
        return MapScores(
            stale_deleted=ratio(np.count_nonzero(self.stale & ~survived), np.count_nonzero(self.stale)),
            stale_apart_deleted=ratio(np.count_nonzero(self._apart & ~survived), np.count_nonzero(self._apart)),
            valid_deleted=ratio(np.count_nonzero(self.valid & ~survived), np.count_nonzero(self.valid)),
            new_added=ratio(np.count_nonzero(reached), len(self._added)),
            added_false=ratio(np.count_nonzero(_distance(fresh, self._now) > self._reach_m), len(fresh)),
            stale_points=int(np.count_nonzero(self.stale)),
            valid_points=int(np.count_nonzero(self.valid)),
            new_samples=len(self._added),
            added_points=len(fresh),
        )


def _distance(points: F64, surface: cKDTree) -> F64:
    """(n,) metres from each point to the nearest sample; inf beyond a metre or where there is none."""
    if not len(points) or not surface.n:
        return np.full(len(points), np.inf)
    distance: F64 = surface.query(points, distance_upper_bound=1.0)[0]
    return distance


def same_rows(old: F64, new: F64) -> tuple[Bool, F64]:
    """(which rows of ``old`` are in ``new``, the rows of ``new`` that are not in ``old``), compared bit for bit."""
    a, b = (np.asarray(points, dtype=np.float64) for points in (old, new))
    return found_among(a, b), new[~found_among(b, a)]


APART_M = 0.6
"""Two cells: a hit speaks for mapped voxels up to one cell away, so within two nobody can tell old from new."""


def map_obstacles(point_map: PointMap) -> F64:
    """The map's points (n, 3) at least GROUND_MARGIN_M above its ground, map metres, tile by tile."""
    clouds = []
    for tile in sorted(point_map.tiles):
        content = point_map.tiles[tile]
        clouds.append(content.points_map[content.columns[1]])
    return np.concatenate(clouds) if clouds else np.zeros((0, 3))
