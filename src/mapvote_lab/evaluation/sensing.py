"""The same drive with another sensor, in other weather, or with worse beliefs about where it is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from mapvote.core.geometry import exp, from_xyz_rpy
from mapvote.core.types import F64, Bool, Drive, MapvoteError, Scan
from mapvote_lab.evaluation.real_street import Edit

RAIN = 0.1
"""Share of the rays that end on drops where rain is asked for."""
_DROPS_M = 5.0


def of_points(scan: Scan, keep: Bool) -> Scan:
    """The scan's points of ``keep`` (n,)."""
    return replace(
        scan,
        points=scan.points[keep],
        time_s=None if scan.time_s is None else scan.time_s[keep],
        intensity=None if scan.intensity is None else scan.intensity[keep],
    )


def every_other_beam(drive: Drive) -> Drive:
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


def with_fewer_points(share: float) -> Edit:
    """That share of the points is not there, any of them."""

    def edit(drive: Drive) -> Drive:
        def read_scan(i: int) -> Scan:
            scan = drive.read_scan(i)
            return of_points(scan, np.random.default_rng([i, 3]).random(len(scan.points)) >= share)

        return replace(drive, read_scan=read_scan)

    return edit


def in_rain(share: float) -> Edit:
    """Rain: that share of the rays ends on a drop near the sensor (exponential, 5 m in the mean)."""

    def edit(drive: Drive) -> Drive:
        def read_scan(i: int) -> Scan:
            scan = drive.read_scan(i)
            rng = np.random.default_rng([i, 1])
            reach = np.linalg.norm(scan.points, axis=1)
            drop = drive.sensor.min_range_m + rng.exponential(_DROPS_M, len(reach)).astype(np.float32)
            short = np.where((rng.random(len(reach)) < share) & (drop < reach), drop / np.maximum(reach, 1e-3), 1.0)
            return replace(scan, points=(scan.points * short[:, None]).astype(np.float32))

        return replace(drive, read_scan=read_scan)

    return edit


def believing(change: Callable[[F64, F64], F64]) -> Edit:
    """A prior made of ``change(priors (n, 4, 4), seconds since the first scan (n,)) -> (n, 4, 4)``.

    The stated sigmas stay as they are: the vehicle does not know.
    """

    def edit(drive: Drive) -> Drive:
        at_s = 1e-9 * (drive.stamps_ns - drive.stamps_ns[0])
        return replace(drive, T_map_lidar_prior=change(_prior_of(drive), at_s))

    return edit


def without_prior(drive: Drive) -> Drive:
    """Nobody says where the vehicle is."""
    return replace(drive, T_map_lidar_prior=None)


def late(seconds: float) -> Edit:
    """Where the vehicle was ``seconds`` ago; before the recording it drove on as at its start."""

    def change(T: F64, at_s: F64) -> F64:
        then = at_s - seconds
        out = T[np.abs(at_s[None, :] - then[:, None]).argmin(axis=1)].copy()
        few = min(9, len(T) - 1)
        before = np.minimum(then, 0.0)[:, None] * (T[few] - T[0])[:3, 3] / max(float(at_s[few]), 1e-3)
        out[:, :3, 3] = before + np.column_stack([np.interp(then, at_s, T[:, axis, 3]) for axis in range(3)])
        return out

    return believing(change)


def biased(metres: float) -> Edit:
    """Off by as much all the time, half way between ahead and aside as the drive begins."""
    return believing(lambda T, at_s: _aside(T, np.full(len(T), metres)))


def drifting(metres: float) -> Edit:
    """Right at first, and as far off as that at the end: a heading error that grows."""
    return believing(lambda T, at_s: _aside(T, metres * at_s / max(float(at_s[-1]), 1e-3)))


def of_another_street() -> Edit:
    """The whole track turned by 90 deg about its middle: a street that crosses this one."""

    def change(T: F64, at_s: F64) -> F64:
        x, y, z = T[len(T) // 2, :3, 3].tolist()
        turn = from_xyz_rpy(x, y, z, yaw=0.5 * np.pi) @ from_xyz_rpy(-x, -y, -z)
        return np.asarray(turn @ T)

    return believing(change)


def disturbed(sigma_m: float = 0.5, sigma_deg: float = 2.0) -> Edit:
    """An independent error in every scan, normal in x, y and yaw; the vehicle knows twice as much."""

    def edit(drive: Drive) -> Drive:
        T, rng = _prior_of(drive), np.random.default_rng(0)
        off = np.zeros((len(T), 6))
        off[:, :2] = rng.normal(0.0, sigma_m, (len(T), 2))
        off[:, 5] = rng.normal(0.0, np.radians(sigma_deg), len(T))
        worse = np.array([T_map_lidar @ exp(xi) for T_map_lidar, xi in zip(T, off, strict=True)])
        return replace(drive, T_map_lidar_prior=worse, prior_sigma_m=2 * sigma_m, prior_sigma_deg=2 * sigma_deg)

    return edit


def _prior_of(drive: Drive) -> F64:
    if drive.T_map_lidar_prior is None:
        raise MapvoteError(f"{drive.path}: has no prior to change")
    return drive.T_map_lidar_prior


def _aside(T: F64, metres: F64) -> F64:
    """Poses (n, 4, 4) moved by ``metres`` (n,) half way between ahead and aside as the drive begins."""
    ahead, out = np.arctan2(T[0, 1, 0], T[0, 0, 0]) + 0.25 * np.pi, T.copy()
    out[:, :2, 3] += metres[:, None] * np.array([np.cos(ahead), np.sin(ahead)])
    return out
