"""NDT SLAM: drives become the first reference map (paper I, II; [7], [9]).

Two passes. The first finds where the vehicles were: each scan is registered to the NDT map grown so far, drives
one after the other into the same map; then all poses are settled together: precise priors (a survey vehicle's RTK)
hold the map in their frame, ordinary ones (GNSS) place it where all of them together have it. The second reads the
scans again and adds them at their settled poses: de-skewed, without moving objects, one point per 0.3 m voxel
(survey.clean_map).

Ordinary priors (GNSS) neither guide nor gate a registration that succeeds: they err by more than it does, and alike
for a while, which would bend the map. They help where registration fails, moved into the frame of what was driven so
far. A scan that would jump against the vehicle's motion is not registered; where nothing fits any more the map is
broken, the track begins anew at the prior, and the report names the place.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from mapvote.config import Settings
from mapvote.core.geometry import exp, inverse, transform
from mapvote.core.grid import Lattice
from mapvote.core.mount import Mount
from mapvote.core.point_map import PointMap, lattice_of, map_from_points
from mapvote.core.record import record
from mapvote.core.sensor_height import Heights, check_heights, two_levels
from mapvote.core.times import has_date
from mapvote.core.types import F64, Drive, MapvoteError, PosePrior, Scan
from mapvote.core.voxels import VoxelCloud, thin
from mapvote.formats.drives.upright import upright
from mapvote.matching.ndt_map import NdtMap
from mapvote.matching.ndt_voxels import LEVELS
from mapvote.matching.odometry import Fix, Tracker
from mapvote.matching.prepare import in_rows, twist_between
from mapvote.survey.clean_map import Mapper
from mapvote.survey.driven_road import road_under, wrong_attitude
from mapvote.survey.pose_graph import DriveTrack, carried_along, fit_to_priors, settle_poses

Progress = Callable[[int, int], None]


@record()
@dataclass(frozen=True, slots=True)
class Survey:
    """Numbers of the first pass of a survey."""

    most_off: float = 0.3
    """Share of a path that may lie more than 0.3 m off the ground before the map is refused: a smaller share is a place
    (a bridge over another drive, a stretch without points), a larger one a fault of the drive."""
    min_inlier_share: float = 0.4
    """Share of a scan's points that must agree, the setting of ndt while the map grows: half of a scan may observe
    unmapped places."""
    points_m: float = 0.3
    """Side of the voxels to whose one point scans are thinned in the NDT map: the paper's storage resolution."""
    fine_floor_m: float = 0.03
    """Least standard deviation of the distributions of a last look at each scan, narrower than any vehicle needs."""
    fine_points_m: float = 0.5
    """Side of the voxels to whose one point a scan is thinned for the last look."""
    polish_m: float = 0.1
    """Greatest distance by which the last look moves a scan."""
    jump_m: float = 0.5
    """Distance from the predicted position, beyond braking and swerving, at which a registration is refused."""
    patience: int = 5
    """Scans in turn without a registration before the map counts as broken."""


SURVEY = Survey()


@dataclass(frozen=True, slots=True)
class BuildReport:
    """Facts of a finished build."""

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
    drives: Sequence[Drive],
    settings: Settings | None = None,
    *,
    progress: Progress | None = None,
    numbers: Survey = SURVEY,
) -> tuple[PointMap, BuildReport]:
    """One map of all ``drives``, in the frame of their priors (without any, the first scan's lidar frame, z up).

    ``progress(done, total)`` is called after each scan of each of the two passes. Raises MapvoteError if there is
    nothing to map, or if fewer than half of a drive's scans could be registered.
    """
    settings = settings or Settings()
    scans = sum(len(drive) for drive in drives)
    if scans == 0:
        raise MapvoteError("nothing to map: no drive with at least one scan")
    # Sensors in whatever position are surveyed in axes with x ahead and z up.
    sources = list(drives)
    drives, mounts = zip(*map(upright, sources), strict=True)
    # A precise prior that its scans contradict is used as a coarser one.
    wrong = [wrong_attitude(drive) for drive in drives]
    drives = [
        drive if w is None else replace(drive, prior_sigma_deg=w.sigma_deg)
        for drive, w in zip(drives, wrong, strict=True)
    ]
    # The first pass: the poses.
    surveyor = Surveyor(settings, _lattice_of(drives), all(drive.has_precise_prior for drive in drives), numbers)
    _go_through(chain.from_iterable(map(surveyor.follow, drives)), progress, 0, 2 * scans)
    tracks, bent_m = settle_poses(surveyor.tracks)
    cloud = carried_along(surveyor.draft.points()[0], surveyor.tracks, tracks)
    lattice = surveyor.draft.lattice
    del surveyor  # frees the largest part of the first pass's memory
    # The second pass: the points.
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
        replace(track, heights=_agreed_heights(track, point_map, numbers.most_off), wrong_attitude=error)
        for track, error in zip(tracks, wrong, strict=True)
    ]
    tracks = [_as_mounted(*each) for each in zip(tracks, sources, mounts, strict=True)]
    return point_map, BuildReport(tuple(tracks), point_map.n_points, bent_m, two_levels(road) if len(road) else None)


def _as_mounted(track: DriveTrack, source: Drive, mount: Mount | None) -> DriveTrack:
    """The track of a drive that was turned upright, with the poses of the sensor in its own axes."""
    if mount is None:
        return track
    drive = replace(source, prior_sigma_deg=track.drive.prior_sigma_deg)
    return replace(track, drive=drive, T_map_lidar=np.asarray(track.T_map_lidar @ mount.C))


def _go_through(scans: Iterable[None], progress: Progress | None, done: int, total: int) -> None:
    """Let a pass enter its ``scans`` one by one."""
    for number, _ in enumerate(scans, start=done + 1):
        if progress:
            progress(number, total)


def _place_on_earth(drives: Sequence[Drive]) -> Mapping[str, str]:
    """Where the drives' priors lie. MapvoteError if they lie in different frames: the map could only be in one."""
    frames = [drive.georeference for drive in drives if drive.georeference]
    if any(other != frames[0] for other in frames):
        raise MapvoteError(
            "the drives' priors lie in different frames (each at its own first fix?): give all of them the same origin "
            "in drive.toml"
        )
    return frames[0] if frames else {}


def _last_stamp(drives: Sequence[Drive]) -> int | None:
    """When the last drive ended; None if the clock of one has no date."""
    ends = [int(drive.stamps_ns[-1]) for drive in drives]
    return max(ends) if has_date(min(ends)) else None


def _agreed_heights(track: DriveTrack, point_map: PointMap, most_off: float = SURVEY.most_off) -> Heights:
    """Heights of the driven positions over the ground; MapvoteError if that cannot be the road under them."""
    heights = check_heights(point_map, track.driven)
    if heights.off_share > most_off:
        raise MapvoteError(
            f"{track.drive.path}: {heights.complaint}. Such a map would be wrong: do the drives' heights "
            "agree (one datum, no drift in z), and is z up? `mapvote doctor` checks it; else build the drives apart"
        )
    return heights


def _lattice_of(drives: Sequence[Drive]) -> Lattice:
    """Begins near the first prior, in whose frame the map is built; at (0, 0) where no drive has one."""
    for drive in drives:
        if drive.T_map_lidar_prior is not None:
            positions = drive.T_map_lidar_prior[:, :2, 3]
            positions = positions[np.isfinite(positions).all(axis=1)]
            if len(positions):
                return lattice_of(positions)
    return Lattice()


class Surveyor:
    """The NDT map as it grows, drive after drive."""

    def __init__(
        self, settings: Settings, lattice: Lattice, all_precise: bool = False, numbers: Survey = SURVEY
    ) -> None:
        """``lattice``: of the map. ``all_precise``: only drives with a surveyor's prior will come; they get no final
        check."""
        self._all_precise = all_precise
        self.ndt = settings.ndt.model_copy(update={"min_inlier_share": numbers.min_inlier_share})
        self.numbers = numbers
        self._fine = replace(LEVELS[-1], floor_m=numbers.fine_floor_m, points_m=numbers.fine_points_m)
        self.ndt_map = NdtMap(np.zeros(3))
        self.fine_map: NdtMap | None = None
        """The same points in narrower distributions, of one level."""
        self.draft = VoxelCloud(lattice)
        """A cloud of everything, for the ground and the occupied voxels that the second pass needs."""
        self.tracks: list[DriveTrack] = []
        """Tracks of the drives followed so far, in the frame of the draft."""
        self._registered: list[F64] = []
        """(3,) each: positions of registered scans with a prior ..."""
        self._priors: list[F64] = []
        """... and of these priors: together they determine the frame of the priors."""

    def follow(self, drive: Drive) -> Iterator[None]:
        """Find the trajectory of one drive, a scan a step: each is entered once registered. At the end it is the last
        of ``tracks``. MapvoteError if fewer than half of the scans could be registered."""
        # Each scan is localised in the map so far; a prior is used only where that fails.
        tracker = Tracker(self.ndt_map.around, self.ndt)
        tracker.twist = _first_motion(drive)
        precise = drive.has_precise_prior
        poses = []
        registered = []
        broken = []
        lost = 0
        for i, scan in enumerate(drive):
            prior = PosePrior.of(drive, i)
            fix = self._locate(tracker, scan, prior if precise or not len(self.draft) else None)
            if not fix.trusted and not precise and prior is not None:
                prior = self._in_draft(prior)
                fix = self._locate(tracker, scan, prior)
            # A surveyor enters where no drive has been yet: a precise prior is as good as a registration.
            if not fix.trusted and prior is not None and (precise or lost >= self.numbers.patience):
                fix = tracker.begin(scan, prior.T_map_lidar)
                broken += [] if precise else [i]
            lost = 0 if fix.trusted else lost + 1
            poses.append(fix.registration.T_map_lidar)
            registered.append(fix.trusted)
            if fix.trusted:
                self._enter(fix, drive, i)
            yield
        # A drive that hardly fits the map is refused.
        if np.mean(registered) < 0.5:
            raise MapvoteError(
                f"{drive.path}: only {int(np.sum(registered))} of {len(drive)} scans could be registered to the map "
                "so far; is the drive in order of time, and its prior in the same frame as the other drives'?"
            )
        unknown = np.full(len(poses), np.nan)
        self.tracks.append(DriveTrack(drive, np.array(poses), np.array(registered), tuple(broken), unknown))

    def _locate(self, tracker: Tracker, scan: Scan, prior: PosePrior | None) -> Fix:
        """The scan in the map so far; untrusted if its position would jump."""
        if not len(self.draft):
            return tracker.begin(scan, np.eye(4) if prior is None else prior.T_map_lidar)
        before = tracker.last_pose, tracker.last_stamp_ns, tracker.twist
        moving = tracker.last_pose is not None and bool(tracker.twist.any())
        fix = tracker.localise(scan, prior)
        if not fix.trusted or not moving or before[0] is None:
            return fix
        age = 1e-9 * (scan.stamp_ns - before[1])
        ahead = before[0] @ exp(age * before[2])
        off = float(np.linalg.norm(fix.registration.T_map_lidar[:3, 3] - ahead[:3, 3]))
        if off <= self.numbers.jump_m + 0.5 * tracker.numbers.acceleration_mps2 * age**2:
            return self._polished(tracker, fix, before[0], age) if prior is None else fix
        tracker.move_to(before[0], before[1], before[2], fix.registration.score)
        return replace(fix, trusted=False)

    def _polished(self, tracker: Tracker, fix: Fix, last_pose: F64, age: float) -> Fix:
        """The fix after a last look at the narrower distributions; as it is if they do not agree nearly.

        Wide distributions pull every scan to where the map already is, at 11 m/s by 5 mm and a little nose up; over a
        kilometre such a pull adds up.
        """
        T_map_lidar = fix.registration.T_map_lidar
        if self.fine_map is None:
            return fix
        points = fix.points
        points = in_rows(points[thin(points, self._fine.points_m)])
        polished = self.fine_map.around(T_map_lidar[:3, 3]).refine([points], T_map_lidar)
        moved_m = np.linalg.norm(polished.T_map_lidar[:3, 3] - T_map_lidar[:3, 3])
        if not polished.converged or moved_m > self.numbers.polish_m:
            return fix
        tracker.correct(polished.T_map_lidar, twist_between(last_pose, polished.T_map_lidar, age))
        return replace(fix, registration=replace(fix.registration, T_map_lidar=polished.T_map_lidar))

    def _in_draft(self, prior: PosePrior) -> PosePrior:
        """A prior moved to the frame of the poses so far, as uncertain as the priors proved there."""
        if not self._priors:
            return prior
        positions = np.array(self._registered)
        priors = np.array(self._priors)
        T_prior_draft = fit_to_priors(positions, priors, prior.sigma_m)
        off = np.linalg.norm(positions @ T_prior_draft[:3, :3].T + T_prior_draft[:3, 3] - priors, axis=1)
        T_map_lidar = inverse(T_prior_draft) @ prior.T_map_lidar
        return replace(prior, T_map_lidar=T_map_lidar, sigma_m=max(prior.sigma_m, float(np.median(off))))

    def _enter(self, fix: Fix, drive: Drive, i: int) -> None:
        T_map_lidar = fix.registration.T_map_lidar
        points_map = transform(T_map_lidar, fix.points)
        position = T_map_lidar[:3, 3]
        spread = points_map.take(thin(points_map - position, self.numbers.points_m), axis=0)
        self.ndt_map.around(position).enter(spread)
        if not self._all_precise:
            if self.fine_map is None:
                self.fine_map = NdtMap(position, (self._fine,))
            self.fine_map.enter(spread)
        self.draft.enter(points_map)
        if drive.T_map_lidar_prior is not None:
            self._registered.append(position.copy())
            self._priors.append(drive.T_map_lidar_prior[i, :3, 3])


def _first_motion(drive: Drive) -> F64:
    """(6,) motion per second at the start by the priors: to the next scan, or the middle one of several over a second
    if they are coarse, of which one may be wild."""
    priors = drive.T_map_lidar_prior
    if priors is None or len(drive) < 2:
        return np.zeros(6)
    seconds = 1e-9 * (drive.stamps_ns - drive.stamps_ns[0]).astype(np.float64)
    k = 1 if drive.has_precise_prior else max(1, int(np.searchsorted(seconds, 1.0)))
    k = min(k, len(drive) - 1)
    tries = 1 if drive.has_precise_prior else min(k, len(drive) - k)
    motions = [twist_between(priors[i], priors[i + k], float(seconds[i + k] - seconds[i])) for i in range(tries)]
    return np.asarray(np.median(motions, axis=0))
