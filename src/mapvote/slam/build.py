"""NDT SLAM: drives become the first reference map (paper I, II; [7], [9]).

Two passes. The first finds where the vehicles were: each scan is registered to the NDT map grown so far, drives
one after the other into the same map; then all poses are settled together: precise priors (a survey vehicle's RTK)
hold the map in their frame, ordinary ones (GNSS) place it where all of them together have it. The second reads the
scans again and adds them at their settled poses: de-skewed, without moving objects, one point per 0.3 m voxel
(slam.accumulate).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapvote.config import Settings
from mapvote.core.geometry import inverses, rotation_angles
from mapvote.core.point_map import PointMap, map_from_points
from mapvote.core.sensor_height import Heights, check_heights, two_levels
from mapvote.core.types import F64, Bool, Drive, MapvoteError
from mapvote.slam.accumulate import Layer
from mapvote.slam.attitude import WrongAttitude, as_precise_as_shown
from mapvote.slam.pose_graph import carried_along, settle_poses
from mapvote.slam.road_prior import all_roads, road_under
from mapvote.slam.surveyor import Surveyed, Surveyor, is_precise

Progress = Callable[[int, int], None]
MOST_OFF = 0.3
"""Share of a path that may disagree with the ground by more than 0.3 m before the map is refused: below, it is a place
(a bridge over another drive, a stretch without points); above, something is wrong with the drive."""

_FIRST_DATE_NS = 946_684_800 * 10**9
"""2000. Clocks that count from zero are below it."""


@dataclass(frozen=True, slots=True)
class Drift:
    """How far a drive's poses lie from its prior. With a coarse prior this is mostly the prior's own error."""

    median_m: float
    max_m: float
    end_m: float
    median_deg: float


@dataclass(frozen=True, slots=True)
class DriveTrack:
    """The trajectory of one drive."""

    vehicle: str
    drive_id: str
    T_map_lidar: F64
    """(n, 4, 4) a pose per scan; that of a scan that could not be registered is the best guess."""
    registered: Bool
    """(n,) whether the scan could be registered; the others did not enter the map."""
    length_m: float
    drift: Drift | None
    """Against the prior, where there is one."""
    heights: Heights
    """Of the sensor over the map's ground."""
    broken: tuple[int, ...]
    """Scans at which the track began anew because nothing fitted: there only priors tie the map together."""
    sigma_m: F64
    """(n,) standard deviation of each position in the frame of the priors, NaN without any."""
    wrong_attitude: WrongAttitude | None = None
    """What contradicts the precise attitude that the prior states: the drive was built with a coarser one."""


@dataclass(frozen=True, slots=True)
class BuildReport:
    """What came of building a map."""

    tracks: tuple[DriveTrack, ...]
    points: int
    held_by_prior: bool
    """Whether a precise prior fixed the map's frame; otherwise all priors together, or the first scan, did."""
    bent_m: float
    """How far the priors moved a scan at most, after the whole survey was shifted and turned to fit them; 0 without
    priors."""
    two_levels: tuple[float, float, float] | None
    """(x, y, metres apart) where drives ran above each other, the farthest apart: of the two, each cell keeps the road
    whose path is nearer, below both the lower one. None if nowhere."""


def build_map(
    drives: Sequence[Drive], settings: Settings | None = None, *, progress: Progress | None = None
) -> tuple[PointMap, BuildReport]:
    """One map of all ``drives``, in the frame of their priors (without any, the first scan's lidar frame).

    ``progress(done, total)`` is called after each scan of each of the two passes. Raises MapvoteError if there is
    nothing to map, or if fewer than half of a drive's scans could be registered.
    """
    settings = settings or Settings()
    if sum(len(drive) for drive in drives) == 0:
        raise MapvoteError("nothing to map: no drive with at least one scan")
    shown = [as_precise_as_shown(drive) for drive in drives]
    drives = [drive for drive, _ in shown]
    count = _counter(progress, 2 * sum(len(drive) for drive in drives))
    surveyor = Surveyor(settings, all(is_precise(drive) for drive in drives))
    found = [surveyor.follow(drive, count) for drive in drives]
    settled = settle_poses(drives, found)
    registered, poses = [one.registered for one in found], settled.T_map_lidar
    cloud, lattice = carried_along(surveyor.draft.points()[0], found, poses), surveyor.draft.lattice
    del surveyor  # and with it the largest part of what the first pass took
    roads = [road_under(T, mask, cloud) for T, mask in zip(poses, registered, strict=True)]
    road = all_roads(roads)
    layer = Layer(map_from_points(cloud, lattice=lattice, road=road), settings, road)
    for drive, T_map_lidar, mask in zip(drives, poses, registered, strict=True):
        layer.lay(drive, T_map_lidar, mask, count)
    driven = tuple(T[mask][:, :3, 3] for T, mask in zip(poses, registered, strict=True))
    point_map = replace(layer.finish(), driven=driven, georeference=dict(_place_on_earth(drives)))
    point_map = replace(point_map, surveyed_ns=_last_stamp(drives))
    heights = [_agreed_heights(drive, point_map, path) for drive, path in zip(drives, driven, strict=True)]
    wrong = [wrong for _, wrong in shown]
    tracks = tuple(_track(*each) for each in zip(drives, poses, found, heights, settled.sigma_m, wrong, strict=True))
    held = any(is_precise(drive) for drive in drives)
    points = sum(len(tile.points) for tile in point_map.tiles.values())
    return point_map, BuildReport(tracks, points, held, settled.bent_m, two_levels(road) if len(road) else None)


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


def _agreed_heights(drive: Drive, point_map: PointMap, positions: F64) -> Heights:
    """Heights of a drive's positions (n, 3) over the ground; MapvoteError if that cannot be the road under them."""
    heights = check_heights(point_map, positions)
    if heights.off_share > MOST_OFF:
        raise MapvoteError(
            f"{drive.path}: {heights.complaint}. Such a map would be wrong without a word: do the drives' heights "
            "agree (one datum, no drift in z), and is z up? `mapvote doctor` checks it; else build the drives apart"
        )
    return heights


def _track(
    drive: Drive, T_map_lidar: F64, found: Surveyed, heights: Heights, sigma_m: F64, wrong: WrongAttitude | None
) -> DriveTrack:
    length = float(np.linalg.norm(np.diff(T_map_lidar[:, :3, 3], axis=0), axis=1).sum())
    drift = None
    if drive.T_map_lidar_prior is not None:
        prior = drive.T_map_lidar_prior
        off = np.linalg.norm(T_map_lidar[:, :3, 3] - prior[:, :3, 3], axis=1)
        turn = rotation_angles(inverses(prior) @ T_map_lidar)
        drift = Drift(float(np.median(off)), float(off.max()), float(off[-1]), float(np.degrees(np.median(turn))))
    registered, broken = found.registered, found.broken
    return DriveTrack(
        drive.vehicle, drive.drive_id, T_map_lidar, registered, length, drift, heights, broken, sigma_m, wrong
    )


def _counter(progress: Progress | None, total: int) -> Callable[[], None]:
    done = 0

    def count() -> None:
        nonlocal done
        done += 1
        if progress:
            progress(done, total)

    return count
