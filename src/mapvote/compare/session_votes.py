"""A session's cloud as a voter: its votes on every cell of a map, as one ballot.

The cloud is registered to the map without a prior. It votes occupied where it has points, gone or new as
:mod:`mapvote.compare.cloud_changes` decides it, empty where it has ground and nothing else, and nowhere else. The
map learns free space from a trajectory only: a ray runs from each of its poses to what the cloud shows first in that
direction. Such rays are not measured, so they decide no change. Two rays must pass a voxel to make it free: one may
follow an error of the trajectory. A bent part casts no vote.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mapvote.codec.ballot import Ballot, Planes
from mapvote.codec.planes import Words
from mapvote.compare.cloud_changes import BAND, CellComparison, CloudChange, compare_cells, differences
from mapvote.compare.register import Registered, register_maps
from mapvote.compare.trajectory_rays import with_free_space
from mapvote.config import Settings
from mapvote.core.columns import dilated, rebased
from mapvote.core.geometry import poses_at, transform
from mapvote.core.grid import Grid, Lattice, TileIndex
from mapvote.core.point_map import PointMap, map_from_points
from mapvote.core.reference import reference_window
from mapvote.core.rule import rule_named
from mapvote.core.types import F64, NO_VOTE, U8, U64, CellState, MapvoteError
from mapvote.perception.frontend import DriveReport
from mapvote.rules.voter import Counted, NewPoints
from mapvote.vehicle import write_ballot


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
    observed = [registered.fit.covariance[:3, :3]] * (len(poses) - len(lost))
    return DriveReport([end_ns] * len(poses), lost, observed, list(poses), priors=[None] * len(poses))


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


def _free_words(point_map: PointMap, window: Grid) -> U64:
    free = reference_window(point_map, window).free
    return np.zeros(window.shape, dtype=np.uint64) if free is None else free
