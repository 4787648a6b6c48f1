"""NDT SLAM: drives become the first reference map (paper I, II; [7], [9]).

Two passes. The first finds where the vehicles were: each scan is registered to the NDT map grown so far, drives
one after the other into the same map; then all poses are settled together: precise priors (a survey vehicle's RTK)
hold the map in their frame, ordinary ones (GNSS) place it where all of them together have it. The second reads the
scans again and adds them at their settled poses: de-skewed, without moving objects, one point per 0.3 m voxel
(slam.clean_map).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from mapvote.config import Settings
from mapvote.core.point_map import PointMap, map_from_points
from mapvote.core.sensor_height import Heights, check_heights, two_levels
from mapvote.core.types import Drive, MapvoteError
from mapvote.slam.clean_map import Mapper
from mapvote.slam.driven_road import road_under, wrong_attitude
from mapvote.slam.pose_graph import DriveTrack, carried_along, settle_poses
from mapvote.slam.surveyor import Surveyor

Progress = Callable[[int, int], None]
MOST_OFF = 0.3
"""Share of a path that may disagree with the ground by more than 0.3 m before the map is refused: below, it is a place
(a bridge over another drive, a stretch without points); above, something is wrong with the drive."""

_FIRST_DATE_NS = 946_684_800 * 10**9
"""2000. Clocks that count from zero are below it."""


@dataclass(frozen=True, slots=True)
class BuildReport:
    """What came of building a map."""

    tracks: tuple[DriveTrack, ...]
    points: int
    bent_m: float
    """How far the priors moved a scan at most, after the whole survey was shifted and turned to fit them; 0 without
    priors."""
    two_levels: tuple[float, float, float] | None
    """(x, y, metres apart) where drives ran above each other, the farthest apart: of the two, each cell keeps the road
    whose path is nearer, below both the lower one. None if nowhere."""

    @property
    def held_by_prior(self) -> bool:
        """Whether a precise prior fixed the map's frame; otherwise all priors together, or the first scan, did."""
        return any(track.drive.has_precise_prior for track in self.tracks)


def build_map(
    drives: Sequence[Drive], settings: Settings | None = None, *, progress: Progress | None = None
) -> tuple[PointMap, BuildReport]:
    """One map of all ``drives``, in the frame of their priors (without any, the first scan's lidar frame).

    ``progress(done, total)`` is called after each scan of each of the two passes. Raises MapvoteError if there is
    nothing to map, or if fewer than half of a drive's scans could be registered.
    """
    settings = settings or Settings()
    scans = sum(len(drive) for drive in drives)
    if scans == 0:
        raise MapvoteError("nothing to map: no drive with at least one scan")
    wrong = [wrong_attitude(drive) for drive in drives]
    drives = [
        drive if w is None else replace(drive, prior_sigma_deg=w.sigma_deg)
        for drive, w in zip(drives, wrong, strict=True)
    ]
    surveyor = Surveyor(settings, all(drive.has_precise_prior for drive in drives))
    _go_through(chain.from_iterable(map(surveyor.follow, drives)), progress, 0, 2 * scans)
    tracks, bent_m = settle_poses(surveyor.tracks)
    cloud, lattice = carried_along(surveyor.draft.points()[0], surveyor.tracks, tracks), surveyor.draft.lattice
    del surveyor  # and with it the largest part of what the first pass took
    road = np.concatenate([road_under(track.T_map_lidar, track.registered, cloud) for track in tracks])
    mapper = Mapper(map_from_points(cloud, lattice=lattice, road=road), settings, road)
    _go_through(chain.from_iterable(map(mapper.enter, tracks)), progress, scans, 2 * scans)
    point_map = replace(
        mapper.finish(),
        driven=tuple(track.driven for track in tracks),
        georeference=dict(_place_on_earth(drives)),
        surveyed_ns=_last_stamp(drives),
    )
    tracks = [
        replace(track, heights=_agreed_heights(track, point_map), wrong_attitude=found)
        for track, found in zip(tracks, wrong, strict=True)
    ]
    return point_map, BuildReport(tuple(tracks), point_map.n_points, bent_m, two_levels(road) if len(road) else None)


def _go_through(scans: Iterable[None], progress: Progress | None, done: int, total: int) -> None:
    """Let a pass enter its ``scans`` one by one."""
    for number, _ in enumerate(scans, start=done + 1):
        if progress:
            progress(number, total)


def _place_on_earth(drives: Sequence[Drive]) -> Mapping[str, str]:
    """Where the drives' priors lie. MapvoteError if they lie in different frames: the map could only be in one."""
    known = [drive.georeference for drive in drives if drive.georeference]
    if any(other != known[0] for other in known):
        raise MapvoteError(
            "the drives' priors lie in different frames (each at its own first fix?): give all of them the same origin "
            "in drive.toml"
        )
    return known[0] if known else {}


def _last_stamp(drives: Sequence[Drive]) -> int | None:
    """When the last drive ended; None if the clock of one has no date."""
    ends = [int(drive.stamps_ns[-1]) for drive in drives]
    return max(ends) if min(ends) > _FIRST_DATE_NS else None


def _agreed_heights(track: DriveTrack, point_map: PointMap) -> Heights:
    """Heights of the driven positions over the ground; MapvoteError if that cannot be the road under them."""
    heights = check_heights(point_map, track.driven)
    if heights.off_share > MOST_OFF:
        raise MapvoteError(
            f"{track.drive.path}: {heights.complaint}. Such a map would be wrong: do the drives' heights "
            "agree (one datum, no drift in z), and is z up? `mapvote doctor` checks it; else build the drives apart"
        )
    return heights
