"""NDT SLAM: drives become the first reference map (paper I, II; [7], [9]).

Two passes. The first finds where the vehicles were: each scan is registered to the NDT map grown so far, drives
one after the other into the same map; then all poses are settled together, so that precise priors (a survey
vehicle's RTK) hold the map in their frame and coarse ones only start the search. The second reads the scans again and
lays them at their settled poses: de-skewed, without moving objects, one point per 0.3 m voxel (slam.accumulate).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from mapvote.config import MappingSettings, Settings
from mapvote.core.geometry import inverse, rotation_angle, transform
from mapvote.core.grid import Lattice
from mapvote.core.heights import Heights, check_heights, two_levels
from mapvote.core.point_map import PointMap, map_from_points
from mapvote.core.types import F64, I64, Bool, Drive, MapvoteError
from mapvote.core.voxels import VoxelCloud, thin
from mapvote.localisation.deskew import twist_between
from mapvote.localisation.ndt import NdtMap, PosePrior
from mapvote.localisation.tracker import Tracker
from mapvote.slam.accumulate import Layer
from mapvote.slam.pose_graph import Anchors, Links, optimise
from mapvote.slam.road import all_roads, road_under

Progress = Callable[[int, int], None]
MOST_OFF = 0.3
"""Share of a path that may disagree with the ground by more than 0.3 m before the map is refused: below, it is a place
(a bridge over another drive, a stretch without points); above, something is wrong with the drive."""


@dataclass(frozen=True, slots=True)
class Drift:
    """How far a drive's poses lie from its prior. With a coarse prior this is mostly the prior's own error."""

    median_m: float
    max_m: float
    end_m: float
    median_deg: float


@dataclass(frozen=True, slots=True)
class DriveTrack:
    """Where one drive went."""

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


@dataclass(frozen=True, slots=True)
class BuildReport:
    """What came of building a map."""

    tracks: tuple[DriveTrack, ...]
    points: int
    held_by_prior: bool
    """Whether a precise prior fixed the map's frame; otherwise the first scan's prior, or the origin, did."""
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
    count = _counter(progress, 2 * sum(len(drive) for drive in drives))
    surveyor = _Surveyor(settings)
    found = [surveyor.follow(drive, count) for drive in drives]
    registered = [mask for _, mask in found]
    poses = settle_poses(drives, [T for T, _ in found], registered, settings.mapping)
    cloud = surveyor.draft.points()[0]
    roads = [road_under(T, mask, cloud) for T, mask in zip(poses, registered, strict=True)]
    road = all_roads(roads)
    layer = Layer(map_from_points(cloud, lattice=surveyor.draft.lattice, road=road), settings, road)
    for drive, T_map_lidar, mask in zip(drives, poses, registered, strict=True):
        layer.lay(drive, T_map_lidar, mask, count)
    driven = tuple(T[mask][:, :3, 3] for T, mask in zip(poses, registered, strict=True))
    point_map = replace(layer.finish(), driven=driven, georeference=dict(_place_on_earth(drives)))
    heights = [_agreed_heights(drive, point_map, path) for drive, path in zip(drives, driven, strict=True)]
    tracks = tuple(_track(*each) for each in zip(drives, poses, registered, heights, strict=True))
    held = any(_is_precise(drive, settings.mapping) for drive in drives)
    points = sum(len(tile.points) for tile in point_map.tiles.values())
    return point_map, BuildReport(tracks, points, held, two_levels(road) if len(road) else None)


def _place_on_earth(drives: Sequence[Drive]) -> Mapping[str, str]:
    """Where the drives' priors lie. MapvoteError if they lie in different frames: the map could only be in one."""
    known = [drive.georeference for drive in drives if drive.georeference]
    if any(other != known[0] for other in known):
        raise MapvoteError(
            "the drives' priors lie in different frames (each at its own first fix?): give all of them the same origin "
            "in drive.toml"
        )
    return known[0] if known else {}


class _Surveyor:
    """The first pass: the NDT map as it grows."""

    def __init__(self, settings: Settings) -> None:
        self.mapping = settings.mapping
        self.ndt = settings.ndt.model_copy(update={"min_inlier_share": settings.mapping.min_inlier_share})
        self.ndt_map: NdtMap | None = None
        self.draft = VoxelCloud(Lattice())
        """A cloud of everything, for the ground and the occupied voxels that the second pass needs."""

    def follow(self, drive: Drive, count: Callable[[], None]) -> tuple[F64, Bool]:
        """(poses (n, 4, 4), registered (n,)) of one drive, each scan entered once it is registered."""
        tracker = Tracker(self._map_around, self.ndt)
        tracker.twist = _first_motion(drive, self.mapping)
        poses, registered = [], []
        for i, scan in enumerate(drive):
            prior = PosePrior.of(drive, i)
            fix = None if self.ndt_map is None else tracker.localise(scan, prior)
            if fix is None:
                fix = tracker.begin(scan, np.eye(4) if prior is None else prior.T_map_lidar)
            elif prior is not None and not fix.trusted and _is_precise(drive, self.mapping):
                # A surveyor enters where no drive has been yet: a precise prior is as good as a registration.
                fix = tracker.begin(scan, prior.T_map_lidar)
            poses.append(fix.registration.T_map_lidar)
            registered.append(fix.trusted)
            if fix.trusted:
                self._enter(transform(poses[-1], fix.points), poses[-1][:3, 3])
            count()
        if np.mean(registered) < 0.5:
            raise MapvoteError(
                f"{drive.path}: only {int(np.sum(registered))} of {len(drive)} scans could be registered to the map "
                "so far; is the drive in order of time, and its prior in the same frame as the other drives'?"
            )
        return np.array(poses), np.array(registered)

    def _map_around(self, position: F64) -> NdtMap:
        if self.ndt_map is None:
            self.ndt_map = NdtMap(self.ndt, position)
        if not self.ndt_map.is_central(position):
            self.ndt_map.recentre(position)
        return self.ndt_map

    def _enter(self, points_map: F64, position: F64) -> None:
        spread = thin(points_map - position, self.mapping.ndt_points_m)
        self._map_around(position).enter(points_map[spread])
        self.draft.enter(points_map)


def settle_poses(
    drives: Sequence[Drive], poses: list[F64], registered: list[Bool], settings: MappingSettings
) -> list[F64]:
    """Poses of all drives that agree with each other's motion and with the precise priors; as given if there are none.

    Links are the motion from scan to scan, and from each scan to the nearest much older one near by: it was
    registered to the map that the older one made.
    """
    if not any(_is_precise(drive, settings) for drive in drives):
        return poses
    starts = np.cumsum([0] + [len(T) for T in poses])
    T = np.concatenate(poses)
    known = np.flatnonzero(np.concatenate(registered))
    drive_of = np.repeat(np.arange(len(drives)), np.diff(starts))
    order = np.concatenate([np.asarray(drive.stamps_ns) for drive in drives])

    consecutive = drive_of[known[:-1]] == drive_of[known[1:]]
    pairs = [(known[:-1][consecutive], known[1:][consecutive])]
    tree = cKDTree(T[known, :3, 3])
    first, second = [], []
    for j, near in zip(known, tree.query_ball_point(T[known, :3, 3], settings.revisit_m), strict=True):
        older = [
            i for i in known[near] if i < j and (drive_of[i] != drive_of[j] or _apart(order, int(i), int(j), settings))
        ]
        if older:
            first.append(min(older, key=lambda i: (float(np.linalg.norm(T[i, :3, 3] - T[j, :3, 3])), i)))
            second.append(j)
    pairs.append((np.array(first, dtype=np.int64), np.array(second, dtype=np.int64)))
    sigma_m, sigma_rad = settings.link_sigma_m, float(np.radians(settings.link_sigma_deg))
    links = [
        Links(a, b, np.array([inverse(T[i]) @ T[j] for i, j in zip(a, b, strict=True)]), sigma_m, sigma_rad)
        for a, b in pairs
    ]
    anchors = [
        Anchors(
            np.arange(start, start + len(drive)),
            drive.T_map_lidar_prior,
            settings.prior_slack * drive.prior_sigma_m,
            settings.prior_slack * float(np.radians(drive.prior_sigma_deg)),
        )
        for start, drive in zip(starts, drives, strict=False)
        if drive.T_map_lidar_prior is not None and _is_precise(drive, settings)
    ]
    return np.split(optimise(T, links, anchors), starts[1:-1])


def _apart(stamps_ns: I64, i: int, j: int, settings: MappingSettings) -> bool:
    return bool(abs(int(stamps_ns[j]) - int(stamps_ns[i])) > 1e9 * settings.revisit_s)


def _first_motion(drive: Drive, settings: MappingSettings) -> F64:
    """(6,) motion per second of the first scan by the prior: to the next scan, or over a second if it is coarse."""
    if drive.T_map_lidar_prior is None or len(drive) < 2:
        return np.zeros(6)
    seconds = 1e-9 * (drive.stamps_ns - drive.stamps_ns[0]).astype(np.float64)
    k = 1 if _is_precise(drive, settings) else max(1, int(np.searchsorted(seconds, 1.0)))
    k = min(k, len(drive) - 1)
    return twist_between(drive.T_map_lidar_prior[0], drive.T_map_lidar_prior[k], float(seconds[k]))


def _is_precise(drive: Drive, settings: MappingSettings) -> bool:
    return drive.T_map_lidar_prior is not None and drive.prior_sigma_m <= settings.precise_prior_m


def _agreed_heights(drive: Drive, point_map: PointMap, positions: F64) -> Heights:
    """Heights of a drive's positions (n, 3) over the ground; MapvoteError if that cannot be the road under them."""
    heights = check_heights(point_map, positions)
    if heights.off_share > MOST_OFF:
        raise MapvoteError(
            f"{drive.path}: {heights.complaint}. Such a map would be wrong without a word: do the drives' heights "
            "agree (one datum, no drift in z), and is z up? `mapvote doctor` tells; else build the drives apart"
        )
    return heights


def _track(drive: Drive, T_map_lidar: F64, registered: Bool, heights: Heights) -> DriveTrack:
    length = float(np.linalg.norm(np.diff(T_map_lidar[:, :3, 3], axis=0), axis=1).sum())
    drift = None
    if drive.T_map_lidar_prior is not None:
        prior = drive.T_map_lidar_prior
        off = np.linalg.norm(T_map_lidar[:, :3, 3] - prior[:, :3, 3], axis=1)
        turn = [rotation_angle(inverse(a) @ b) for a, b in zip(prior, T_map_lidar, strict=True)]
        drift = Drift(float(np.median(off)), float(off.max()), float(off[-1]), float(np.degrees(np.median(turn))))
    return DriveTrack(drive.vehicle, drive.drive_id, T_map_lidar, registered, length, drift, heights)


def _counter(progress: Progress | None, total: int) -> Callable[[], None]:
    done = 0

    def count() -> None:
        nonlocal done
        done += 1
        if progress:
            progress(done, total)

    return count
