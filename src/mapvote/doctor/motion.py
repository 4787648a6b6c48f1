"""How the sensor moved, by its scans alone: runs of consecutive scans, each registered to those before it.

Nothing of the prior is used, not even as a guess, so that whatever is wrong with it can be measured against this. A run
is some twenty metres of driving: long enough for a few centimetres of error to be a fraction of a per cent.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mapvote.core.geometry import exp, from_xyz_rpy, inverse, log, transform
from mapvote.core.types import F32, F64, I64, Bool, Registration
from mapvote.doctor.road import UPS, Road
from mapvote.localisation.ndt import NdtMap, fitness, refine, thin_for_levels

_HALF_WINDOW_M = 60.0
"""Of the NDT map of a run: its scans reach 50 m."""
RUNS = 8
_ACROSS = 2
SCANS = 11
_STEP_M = 2.5
"""Scans are left out of a run while consecutive ones stay this near."""
_MOST_STEP = 5
_SPEEDS_M = (0.0, 0.8, 1.6, 2.6, 3.6, 4.6)
_REACH_M = 50.0
_GOOD_FIT = 0.7
_STANDS_M = 0.4
_REFINED = 4


@dataclass(frozen=True, slots=True)
class Run:
    """Scans of a few seconds, and where the sensor was in the frame of the first."""

    indices: I64
    """(m,) scans of the drive, ascending."""
    T_first_lidar: F64
    """(m, 4, 4)."""
    fit: F64
    """(m,) share of each scan's points that agree with the scans before it; 1 for the first."""

    @property
    def end(self) -> F64:
        """(4, 4) pose of the last scan in the frame of the first."""
        return self.T_first_lidar[-1]

    @property
    def length_m(self) -> float:
        return float(np.linalg.norm(np.diff(self.T_first_lidar[:, :3, 3], axis=0), axis=1).sum())


def starts_across(leaps: F64, n: int) -> I64:
    """First scans of runs across the places where scans differ most from the one before, by ``leaps`` (n - 1,).

    They show whether the scans are in order; chosen for being odd, they are no measure of the prior.
    """
    most = np.argsort(leaps, kind="stable")[-_ACROSS:] - SCANS // 2
    return np.unique(np.clip(most, 0, max(0, n - SCANS)))


def starts_of_runs(n: int, T_map_lidar: F64 | None) -> I64:
    """First scans of the runs of a drive of n scans: spread evenly, half of them where the prior turns most."""
    span = SCANS + 2 * _MOST_STEP
    if n <= span:
        return np.zeros(1, dtype=np.int64)
    even = np.linspace(0, n - span, min(RUNS, max(1, n // SCANS))).astype(np.int64)
    if T_map_lidar is None or len(even) < RUNS:
        return np.unique(even)
    candidates = np.arange(0, n - span, max(1, span // 2))
    turned = [-np.trace(T_map_lidar[i, :3, :3].T @ T_map_lidar[i + span, :3, :3]) for i in candidates]
    most = candidates[np.argsort(np.array(turned), kind="stable")[::-1][: RUNS // 2]]
    return np.unique(np.concatenate([most, even[::2]]))


def follow(read: Callable[[int], F32], start: int, n: int, road: Road, scans: int = SCANS) -> Run:
    """The run that begins at scan ``start`` of n. ``read`` gives a scan's points (m, 3); ``road`` is what they show.
    No more than ``scans`` are registered."""
    first = read(start)
    ndt_map = NdtMap(np.zeros(3), half_window_m=_HALF_WINDOW_M)
    ndt_map.enter(_near(first))
    indices, poses, fits = [start], [np.eye(4)], [1.0]
    i, step = start, 1
    while len(indices) < scans and i + step < n:
        i += step
        clouds = thin_for_levels(_near(read(i)))
        found = _registered(ndt_map, clouds, _guesses(indices, poses, i, UPS[road.up]), road)
        indices.append(i)
        poses.append(found.T_map_lidar)
        fits.append(found.inlier_share)
        position = found.T_map_lidar[:3, 3]
        if not ndt_map.is_central(position):
            ndt_map.recentre(position)
        ndt_map.enter(transform(found.T_map_lidar, clouds[-1].T))
        a_scan_m = float(np.linalg.norm((inverse(poses[-2]) @ poses[-1])[:3, 3])) / (indices[-1] - indices[-2])
        step = 1 if len(indices) < 3 else int(np.clip(_STEP_M / max(a_scan_m, 0.01), 1, _MOST_STEP))
    return Run(np.array(indices), np.array(poses), np.array(fits))


def _near(points: F32) -> F32:
    squared = np.einsum("ij,ij->i", points, points)
    middle = np.median(points, axis=0) if np.median(squared) > _REACH_M**2 else np.zeros(3, dtype=np.float32)
    offset = points - middle
    near: F32 = points[np.einsum("ij,ij->i", offset, offset) < _REACH_M**2]
    return near


def _registered(ndt_map: NdtMap, clouds: list[F32], guesses: list[F64], road: Road) -> Registration:
    """From the first guess, if that fits well; else the best of it and the likeliest of all of them.

    Only what stands on the road tells guesses apart: the sensor's rings on it fit best where nothing has moved.
    """
    found = refine(ndt_map, clouds, guesses[0])
    if len(guesses) == 2 and found.inlier_share >= _GOOD_FIT:
        return found
    stands = [np.abs(road.normal @ cloud + road.depth_m) > _STANDS_M for cloud in clouds]
    standing = [np.ascontiguousarray(cloud[:, high]) for cloud, high in zip(clouds, stands, strict=True)]
    coarse = [np.ascontiguousarray(standing[0][:, :: max(1, standing[0].shape[1] // 800)])]
    likeliest = sorted(guesses, key=lambda guess: -fitness(ndt_map, coarse, guess))[:_REFINED]
    tried = [found, *(refine(ndt_map, clouds, guess) for guess in likeliest)]
    last = len(clouds) - 1
    return max(tried, key=lambda one: fitness(ndt_map, standing, one.T_map_lidar, last))


def _guesses(indices: list[int], poses: list[F64], i: int, up: F64) -> list[F64]:
    """As the last ones moved; at the start of a run, every way and speed that a vehicle may have."""
    last = poses[-1]
    if len(poses) > 1:
        a_scan = log(inverse(poses[-2]) @ last) / (indices[-1] - indices[-2])
        return [last @ exp((i - indices[-1]) * a_scan), last]
    across = np.linalg.svd(up[None, :])[2][1:]
    angles = np.arange(16) * (np.pi / 8.0)
    ways = np.cos(angles)[:, None] * across[0] + np.sin(angles)[:, None] * across[1]
    return [from_xyz_rpy(*(speed * way)) for speed in _SPEEDS_M for way in ways]


def agree_with_time(run: Run, stamps_ns: I64, most_mps2: float = 8.0) -> Bool:
    """(m - 2,) whether the steps of a run follow each other as a vehicle can: no leap of its speed."""
    seconds = np.diff(stamps_ns[run.indices]) * 1e-9
    velocity = (
        np.array(
            [
                run.T_first_lidar[k, :3, :3] @ (inverse(run.T_first_lidar[k]) @ run.T_first_lidar[k + 1])[:3, 3]
                for k in range(len(seconds))
            ]
        )
        / seconds[:, None]
    )
    change = np.linalg.norm(np.diff(velocity, axis=0), axis=1)
    out: Bool = change < 1.0 + most_mps2 * 0.5 * (seconds[1:] + seconds[:-1])
    return out
