"""The same drive with another sensor, in other weather, or with worse beliefs about where it is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from mapvote.core.geometry import exp, from_xyz_rpy
from mapvote.core.types import F64, I64, Bool, Drive, MapvoteError, Scan
from mapvote.evaluation.experiments.real.street import Edit
from mapvote.formats import open_drive

_DROPS_M = 5.0


def of_points(scan: Scan, keep: Bool) -> Scan:
    """The scan's points of ``keep`` (n,)."""
    return replace(
        scan,
        points=scan.points[keep],
        time_s=None if scan.time_s is None else scan.time_s[keep],
        intensity=None if scan.intensity is None else scan.intensity[keep],
    )


def every_other_beam(drive: Drive, scans: I64) -> Drive:
    """The drive as a sensor with half the beams would have seen it; points are matched to the nearest beam."""
    elevations = np.sort(np.asarray(drive.sensor.elevations_deg))
    sensor = replace(drive.sensor, elevations_deg=tuple(elevations[::-1][::2].tolist()))

    def read_scan(i: int) -> Scan:
        scan = drive.read_scan(i)
        flat = np.hypot(scan.points[:, 0], scan.points[:, 1])
        elevation = np.degrees(np.arctan2(scan.points[:, 2], flat))
        above = np.searchsorted(elevations, elevation).clip(1, len(elevations) - 1)
        nearest = above - (elevation - elevations[above - 1] < elevations[above] - elevation)
        return of_points(scan, (len(elevations) - 1 - nearest) % 2 == 0)

    return replace(drive, sensor=sensor, read_scan=read_scan)


def in_rain(share: float) -> Edit:
    """Rain: that share of the rays ends on a drop near the sensor (exponential, 5 m in the mean)."""

    def edit(drive: Drive, scans: I64) -> Drive:
        def read_scan(i: int) -> Scan:
            scan = drive.read_scan(i)
            rng = np.random.default_rng([int(scans[i]), 1])
            reach = np.linalg.norm(scan.points, axis=1)
            drop = drive.sensor.min_range_m + rng.exponential(_DROPS_M, len(reach)).astype(np.float32)
            short = np.where((rng.random(len(reach)) < share) & (drop < reach), drop / np.maximum(reach, 1e-3), 1.0)
            return replace(scan, points=(scan.points * short[:, None]).astype(np.float32))

        return replace(drive, read_scan=read_scan)

    return edit


def believing(change: Callable[[F64, F64, F64], F64]) -> Edit:
    """A prior made of ``change(all priors (m, 4, 4), all stamps (m,), stamps of the drive (n,)) -> (n, 4, 4)``.

    All: of the whole recording; stamps in seconds. The stated sigmas stay as they are: the vehicle does not know.
    """

    def edit(drive: Drive, scans: I64) -> Drive:
        whole = open_drive(drive.path)
        if whole.T_map_lidar_prior is None:
            raise MapvoteError(f"{drive.path}: has no prior to change")
        start = whole.stamps_ns[0]
        all_s, own_s = 1e-9 * (whole.stamps_ns - start), 1e-9 * (drive.stamps_ns - start)
        return replace(drive, T_map_lidar_prior=change(whole.T_map_lidar_prior, all_s, own_s))

    return edit


def late(seconds: float) -> Edit:
    """Where the vehicle was ``seconds`` ago; before the recording it drove on as at its start."""

    def change(T: F64, all_s: F64, own_s: F64) -> F64:
        nearest = np.abs(all_s[None, :] - (own_s - seconds)[:, None]).argmin(axis=1)
        out = T[nearest].copy()
        speed = (T[-1, :3, 3] - T[0, :3, 3]) / max(all_s[-1], 1e-3) if len(T) < 10 else (T[9] - T[0])[:3, 3] / all_s[9]
        for axis in range(3):
            before = np.minimum(own_s - seconds - all_s[0], 0.0) * speed[axis]
            out[:, axis, 3] = np.interp(own_s - seconds, all_s, T[:, axis, 3]) + before
        return out

    return believing(change)


def biased(metres: float) -> Edit:
    """Off by as much all the time, half way between ahead and aside as the drive begins."""

    def change(T: F64, all_s: F64, own_s: F64) -> F64:
        out = _at(T, all_s, own_s)
        ahead = np.arctan2(T[0, 1, 0], T[0, 0, 0]) + 0.25 * np.pi
        out[:, :2, 3] += metres * np.array([np.cos(ahead), np.sin(ahead)])
        return out

    return believing(change)


def drifting(metres: float) -> Edit:
    """Right at first, and as far off as that at the end: a heading error that grows."""

    def change(T: F64, all_s: F64, own_s: F64) -> F64:
        out = _at(T, all_s, own_s)
        ahead = np.arctan2(T[0, 1, 0], T[0, 0, 0]) + 0.25 * np.pi
        grown = metres * (own_s - all_s[0]) / max(all_s[-1] - all_s[0], 1e-3)
        out[:, :2, 3] += grown[:, None] * np.array([np.cos(ahead), np.sin(ahead)])
        return out

    return believing(change)


def of_another_street() -> Edit:
    """The whole track turned by 90 deg about its middle: a street that crosses this one."""

    def change(T: F64, all_s: F64, own_s: F64) -> F64:
        x, y, z = T[len(T) // 2, :3, 3].tolist()
        turn = from_xyz_rpy(x, y, z, yaw=0.5 * np.pi) @ from_xyz_rpy(-x, -y, -z)
        return np.asarray(turn @ _at(T, all_s, own_s))

    return believing(change)


def disturbed(sigma_m: float = 0.5, sigma_deg: float = 2.0) -> Edit:
    """An independent error in every scan, normal in x, y and yaw; the vehicle knows twice as much."""

    def edit(drive: Drive, scans: I64) -> Drive:
        if drive.T_map_lidar_prior is None:
            raise MapvoteError(f"{drive.path}: has no prior to disturb")
        rng = np.random.default_rng([0, *drive.vehicle.encode()])
        off = np.zeros((len(drive), 6))
        off[:, :2] = rng.normal(0.0, sigma_m, (len(drive), 2))
        off[:, 5] = rng.normal(0.0, np.radians(sigma_deg), len(drive))
        worse = np.array([T @ exp(xi) for T, xi in zip(drive.T_map_lidar_prior, off, strict=True)])
        return replace(drive, T_map_lidar_prior=worse, prior_sigma_m=2 * sigma_m, prior_sigma_deg=2 * sigma_deg)

    return edit


def _at(T: F64, all_s: F64, own_s: F64) -> F64:
    return T[np.searchsorted(all_s, own_s - 1e-6).clip(0, len(T) - 1)].copy()
