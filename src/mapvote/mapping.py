"""NDT SLAM: drives become the first reference map (paper I, II; [7], [9]; METHOD 5).

Each scan is registered to the map grown so far, de-skewed with the motion found, and entered without its moving
objects. A precise prior (a survey vehicle's RTK) enters every registration as a factor and holds the map in its
frame; a coarse one only starts the search. Drives are laid one after the other into the same map.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from mapvote.config import MappingSettings, Settings
from mapvote.core.geometry import inverse, rotation_angle, transform
from mapvote.core.grid import Lattice
from mapvote.core.points import thin
from mapvote.core.tiling import map_from_points
from mapvote.core.types import F64, Bool, Drive, MapvoteError, PointMap
from mapvote.core.voxels import VoxelCloud
from mapvote.perception.deskew import twist_between
from mapvote.perception.ndt import NdtMap, PosePrior
from mapvote.perception.tracking import Tracker


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


@dataclass(frozen=True, slots=True)
class BuildReport:
    """What came of building a map."""

    tracks: tuple[DriveTrack, ...]
    voxels: int
    held_by_prior: bool
    """Whether a precise prior fixed the map's frame; otherwise the first scan's prior, or the origin, did."""


def build_map(
    drives: Sequence[Drive], settings: Settings | None = None, *, progress: Callable[[int, int], None] | None = None
) -> tuple[PointMap, BuildReport]:
    """One map of all ``drives``, in the frame of their priors (without any, the first scan's lidar frame).

    ``progress(done, total)`` is called after each scan. Raises MapvoteError if there is nothing to map, or if fewer
    than half of a drive's scans could be registered.
    """
    settings = settings or Settings()
    total = sum(len(drive) for drive in drives)
    if total == 0:
        raise MapvoteError("nothing to map: no drive with at least one scan")
    surveyor = _Surveyor(settings)
    done = 0
    tracks = []
    for drive in drives:

        def step(i: int, before: int = done) -> None:
            if progress:
                progress(before + i, total)

        tracks.append(surveyor.follow(drive, step))
        done += len(drive)
    points, _ = surveyor.cloud.points()
    held = any(_holds(drive, settings.mapping) for drive in drives)
    return map_from_points(points, lattice=surveyor.cloud.lattice), BuildReport(tuple(tracks), len(points), held)


class _Surveyor:
    """The map as it grows: Gaussians to register to, and the voxels that become the product."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.ndt_settings = settings.ndt.model_copy(update={"min_inlier_share": settings.mapping.min_inlier_share})
        self.cloud = VoxelCloud(Lattice())
        self.ndt_map: NdtMap | None = None

    def follow(self, drive: Drive, step: Callable[[int], None]) -> DriveTrack:
        """Register and enter every scan of one drive."""
        tracker = Tracker(self._map_around, self.ndt_settings)
        if drive.T_map_lidar_prior is not None and len(drive) > 1:
            seconds = 1e-9 * float(drive.stamps_ns[1] - drive.stamps_ns[0])
            tracker.twist = twist_between(drive.T_map_lidar_prior[0], drive.T_map_lidar_prior[1], seconds)
        poses, registered = [], []
        for i, scan in enumerate(drive):
            prior = _prior(drive, i)
            if self.ndt_map is None:
                first = np.eye(4) if prior is None else prior.T_map_lidar
                fix = tracker.begin(scan, first)
            else:
                fix = tracker.localise(scan, prior)
            poses.append(fix.registration.T_map_lidar)
            registered.append(fix.trusted)
            if fix.trusted:
                self._enter(transform(fix.registration.T_map_lidar, fix.points), poses[-1][:3, 3])
            step(i + 1)
        if np.mean(registered) < 0.5:
            raise MapvoteError(
                f"{drive.path}: only {int(np.sum(registered))} of {len(drive)} scans could be registered to the map "
                "so far; is the drive in order of time, and its prior in the same frame as the other drives'?"
            )
        return _track(drive, np.array(poses), np.array(registered))

    def _map_around(self, position: F64) -> NdtMap:
        assert self.ndt_map is not None
        if not self.ndt_map.is_central(position):
            self.ndt_map.recentre(position)
        return self.ndt_map

    def _enter(self, points_map: F64, position: F64) -> None:
        self.cloud.add(points_map)
        if self.ndt_map is None:
            self.ndt_map = NdtMap(self.ndt_settings, position)
        spread = thin(points_map - position, self.settings.mapping.ndt_points_m)
        self._map_around(position).add(points_map[spread])


def _prior(drive: Drive, i: int) -> PosePrior | None:
    if drive.T_map_lidar_prior is None:
        return None
    return PosePrior(drive.T_map_lidar_prior[i], drive.prior_sigma_m, float(np.radians(drive.prior_sigma_deg)))


def _holds(drive: Drive, settings: MappingSettings) -> bool:
    return drive.T_map_lidar_prior is not None and drive.prior_sigma_m <= settings.precise_prior_m


def _track(drive: Drive, T_map_lidar: F64, registered: Bool) -> DriveTrack:
    length = float(np.linalg.norm(np.diff(T_map_lidar[:, :3, 3], axis=0), axis=1).sum())
    drift = None
    if drive.T_map_lidar_prior is not None:
        prior = drive.T_map_lidar_prior
        off = np.linalg.norm(T_map_lidar[:, :3, 3] - prior[:, :3, 3], axis=1)
        turn = [rotation_angle(inverse(a) @ b) for a, b in zip(prior, T_map_lidar, strict=True)]
        drift = Drift(float(np.median(off)), float(off.max()), float(off[-1]), float(np.degrees(np.median(turn))))
    return DriveTrack(drive.vehicle, drive.drive_id, T_map_lidar, registered, length, drift)
