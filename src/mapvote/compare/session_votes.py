"""A session's cloud as a voter: its votes on every cell of a map, as one ballot.

The cloud is registered to the map without a prior. It votes occupied where it has points, gone or new as
:mod:`mapvote.compare.cloud_changes` decides it, empty where it has ground and nothing else, and nowhere else. The
map learns free space from a trajectory only: a ray runs from each of its poses to what the cloud shows first in that
direction. Such rays are not measured, so they decide no change. Two rays must pass a voxel to make it free: one may
follow an error of the trajectory. A bent part casts no vote.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import scipy

from mapvote.codec.ballot import Ballot, Planes
from mapvote.codec.planes import Words
from mapvote.compare.cloud_changes import BAND, CellComparison, CloudChange, compare_cells, differences
from mapvote.compare.register import Registered, register_maps
from mapvote.config import Settings
from mapvote.core.columns import dilated, rebased
from mapvote.core.geometry import poses_at, rows_from, transform
from mapvote.core.grid import Grid, Lattice, TileIndex, window_around
from mapvote.core.point_map import PointMap, all_points, map_from_points
from mapvote.core.record import record
from mapvote.core.reference import reference_window
from mapvote.core.rule import rule_named
from mapvote.core.types import F64, I32, NO_VOTE, U8, U64, CellState, MapvoteError
from mapvote.perception.fans import follow_rays, gather_rays, mark_passed
from mapvote.perception.frontend import DriveReport
from mapvote.perception.raycast import CLEARANCE_M
from mapvote.rules.voter import Counted, NewPoints
from mapvote.vehicle import write_ballot


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


@dataclass(frozen=True, slots=True)
class SessionVote:
    """The ballot of a session's cloud, with its registration and its changes."""

    ballot: Ballot
    registered: Registered
    changes: list[CloudChange]
    by_trajectory: bool
    """Whether rays of a trajectory gave free space."""


def vote_of_session(
    vehicle: str,
    session: str,
    point_map: PointMap,
    cloud: PointMap,
    settings: Settings,
    *,
    end_ns: int,
    trajectory: F64 | None = None,
) -> SessionVote:
    """One ballot of a session's ``cloud`` (a map in any frame) on ``point_map``.

    ``trajectory`` (n, 3): where the sensor was, in the cloud's frame; default: the driven path that the cloud brings.
    ``end_ns``: when the session ended. MapvoteError if the rule is the paper's, if the cloud cannot be registered, or
    if map or cloud has no ground.
    """
    if not rule_named(settings.voting.method).takes_clouds:
        mend = "use surfaces"
        raise MapvoteError(f"the rule {settings.voting.method!r} counts scans, and a cloud has none: {mend}")
    registered = register_maps(point_map, cloud)
    session_map = map_from_points(registered.points, lattice=point_map.lattice)
    if trajectory is None and cloud.driven:
        trajectory = np.concatenate(cloud.driven)
    compared = compare_cells(point_map, session_map, registered)
    changes = differences(compared)
    driven = None
    free = np.zeros_like(compared.b.words)
    if trajectory is not None:
        driven = transform(registered.T_a_b, trajectory)
        free = _free_words(with_free_space(session_map, driven), compared.window)
    votes = _votes(point_map.lattice, compared, free, changes, registered)
    offered = NewPoints(point_map.lattice)
    offered.offer(registered.points)
    report = _report(registered, driven, end_ns)
    ballot = write_ballot(vehicle, session, point_map, settings, report, votes, offered)
    return SessionVote(ballot, registered, changes, driven is not None)


def _report(registered: Registered, driven: F64 | None, end_ns: int) -> DriveReport:
    """The session as a drive: its "scans" are the patches that were compared, those that do not agree are lost. With a
    trajectory they are its positions."""
    shown = registered.patches.compared
    poses = registered.patches.T_a_patch[shown]
    lost = np.flatnonzero(~registered.fit.agree[shown]).tolist()
    if driven is not None:
        poses = poses_at(driven)
        lost = []
    sigmas_m = [registered.fit.sigma_m] * (len(poses) - len(lost))
    return DriveReport([end_ns] * len(poses), lost, sigmas_m, list(poses), priors=[None] * len(poses))


def _votes(
    lattice: Lattice, compared: CellComparison, session_free: U64, changes: list[CloudChange], registered: Registered
) -> Iterator[tuple[TileIndex, Counted]]:
    """Tile by tile; ``session_free`` (rows, cols): column words of the session's free space over the window of the
    comparison. Only where a part of the session lies that one motion registers to the map."""
    own = compared.a
    other = compared.b
    x, y = compared.window.centres()
    xy = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    covered = registered.compared(xy).reshape(compared.window.shape) & ~compared.left_out
    # Cells that agree with the map: empty, or occupied where both have voxels.
    there = rebased(other.words, other.base - own.base)
    near = dilated(there, own.base, 1)
    states = np.full(own.low.shape, NO_VOTE, dtype=np.uint8)
    states[other.own_ground & ~other.stands & ~own.stands] = CellState.UNCHANGED_EMPTY
    states[own.words & near != 0] = CellState.UNCHANGED_OCCUPIED
    # Cells of the changes.
    gone = np.zeros_like(own.words)
    new = np.zeros_like(own.words)
    for change in changes:
        if change.kind == "gone":
            gone[change.cells] = _hanging_together(own.words[change.cells]) & ~near[change.cells]
            states[change.cells] = np.where(gone[change.cells] != 0, np.uint8(CellState.CHANGED_EMPTY), NO_VOTE)
        elif change.kind == "new":
            new[change.cells] = there[change.cells] & ~own.words[change.cells]
            states[change.cells] = CellState.CHANGED_OCCUPIED
    states[~covered] = NO_VOTE
    # The votes of each tile.
    free = rebased(session_free, other.base - own.base) & ~near & ~own.words
    for tile in compared.window.tiles():
        cut = lattice.tile(tile).slices_in(compared.window)
        if (states[cut] != NO_VOTE).any():
            yield tile, _counted(states[cut], gone[cut], new[cut], free[cut] if free.any() else None)


def _counted(states: U8, gone: U64, new: U64, free: U64 | None) -> Counted:
    states = np.ascontiguousarray(states)
    deleted = Words.of(np.where(states == CellState.CHANGED_EMPTY, gone, np.uint64(0)))
    planes = Planes(states=states, gone=deleted, free=None if free is None else Words.of(free))
    return Counted(planes, np.ascontiguousarray(new))


def _hanging_together(words: U64) -> U64:
    """(n,) the lowest voxels of each column, and those above them without a gap of two: a car, not the crown of the
    tree that it stood under."""
    out = words & (np.uint64(0b11) | BAND)
    while True:
        more = words & ((out << np.uint64(1)) | (out << np.uint64(2)))
        if not (more & ~out).any():
            return out
        out |= more


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


def _free_words(point_map: PointMap, window: Grid) -> U64:
    free = reference_window(point_map, window).free
    return np.zeros(window.shape, dtype=np.uint64) if free is None else free


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
