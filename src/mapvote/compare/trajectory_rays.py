"""Free space of a session's cloud: rays from the positions of its sensor to what the cloud shows first."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy

from mapvote.core.geometry import rows_from
from mapvote.core.grid import Grid, TileIndex, window_around
from mapvote.core.point_map import PointMap, all_points
from mapvote.core.record import record
from mapvote.core.reference import reference_window
from mapvote.core.types import F64, I32, U64
from mapvote.perception.fans import follow_rays, gather_rays, mark_passed
from mapvote.perception.raycast import CLEARANCE_M


@record(votes=True)
@dataclass(frozen=True, slots=True)
class TrajectoryRays:
    """Numbers of the free space that a session's trajectory gives."""

    range_m: float = 30.0
    """Half of the side of the square around a position within which rays are followed."""
    bin_rad: float = float(np.radians(1.0))
    """Width of a direction with one ray."""
    pose_step_m: float = 1.0
    """Spacing of the positions."""


TRAJECTORY_RAYS = TrajectoryRays()


def with_free_space(session_map: PointMap, driven: F64, numbers: TrajectoryRays = TRAJECTORY_RAYS) -> PointMap:
    """The map with the voxels free that rays from the positions ``driven`` (n, 3), map metres, pass on their way to
    the first surface."""
    # Positions that lie apart.
    points = all_points(session_map)
    spacing_m = _spacing(points)
    kept = [driven[0]]
    for position in driven[1:]:
        if np.linalg.norm(position - kept[-1]) >= numbers.pose_step_m:
            kept.append(position)
    # Voxels that rays of one position passed, and of two.
    once: dict[TileIndex, U64] = {}
    twice: dict[TileIndex, U64] = {}
    for origin in kept:
        window = window_around(session_map.lattice, origin[0], origin[1], 2 * numbers.range_m)
        base = np.ascontiguousarray(reference_window(session_map, window).base)
        passed = _passed(points, origin, base, window, spacing_m, numbers)
        for tile in window.tiles():
            if tile in session_map.tiles:
                common = session_map.lattice.tile(tile).intersection(window)
                into = common.slices_in(session_map.lattice.tile(tile))
                seen = passed[common.slices_in(window)]
                first = once.setdefault(tile, np.zeros(session_map.tiles[tile].window.shape, np.uint64))
                second = twice.setdefault(tile, np.zeros_like(first))
                second[into] |= first[into] & seen
                first[into] |= seen
    tiles = {
        index: replace(tile, free=twice[index] & ~tile.obstacle_words) if index in twice else tile
        for index, tile in session_map.tiles.items()
    }
    return replace(session_map, tiles=tiles)


def _passed(points: F64, origin: F64, base: I32, window: Grid, spacing_m: float, numbers: TrajectoryRays) -> U64:
    """(rows, cols) column words that rays from ``origin`` pass: one ray for each direction of a degree, to the nearest
    point there. Near points are as wide as the spacing of the cloud: no ray passes between two of one surface."""
    # The range image of one return for each direction.
    away = points - origin
    away = away[(np.abs(away[:, :2]) < numbers.range_m).all(axis=1)]
    reach = np.linalg.norm(away, axis=1)
    away = away[reach > 1.0]
    reach = reach[reach > 1.0]
    col = np.floor((np.arctan2(away[:, 1], away[:, 0]) + np.pi) / numbers.bin_rad).astype(np.int64) % 360
    row = np.floor((np.arcsin(away[:, 2] / reach) + np.pi / 2) / numbers.bin_rad).astype(np.int64)
    image = np.full((181, 360), np.inf)
    np.minimum.at(image, (row, col), reach)
    # Near points widen over the directions that their surface covers.
    nearest = image.copy()
    for wide in (1, 2, 4, 8):
        near = np.where(image * numbers.bin_rad * wide < 1.5 * spacing_m, image, np.inf)
        nearest = np.minimum(nearest, scipy.ndimage.minimum_filter(near, 2 * wide + 1, mode=("nearest", "wrap")))
    # The rays to the first surface.
    first = (reach <= image[row, col]) & (reach <= nearest[row, col] + CLEARANCE_M)
    words = np.zeros(window.shape, dtype=np.uint64)
    rays = follow_rays(rows_from(away[first] + origin, origin), CLEARANCE_M)
    mark_passed(gather_rays(rays), origin, (window.x0, window.y0), base, words.ravel())
    return words


def _spacing(points: F64) -> float:
    """Median distance to the nearest neighbour of a sample of (n, 3) points, metres."""
    sample = points[np.random.default_rng(0).permutation(len(points))[:2000]]
    return float(np.median(scipy.spatial.KDTree(points).query(sample, k=2)[0][:, 1]))
