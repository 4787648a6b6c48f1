"""Single scans of a drive in a map: registered from a guess, and judged as the localiser judges a pose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mapvote.core.geometry import from_xyz_rpy
from mapvote.core.types import F32, F64, Scan
from mapvote.doctor.finding import Progress
from mapvote.localisation.map_window import MapWindow
from mapvote.localisation.ndt import LEVELS, NdtMap, fitness, refine, thin_for_levels
from mapvote.localisation.pose_check import MIN_FIT, Judge
from mapvote.localisation.prepare import solid_sample

_OFFSETS_M = np.arange(-6.0, 6.1, 1.0)
_YAWS = np.radians([0.0, -3.0, 3.0])
_RANKED = 3


@dataclass(frozen=True, slots=True)
class Place:
    """One scan at its best pose near a guess."""

    index: int
    T_map_lidar: F64
    fit: float
    """As :class:`mapvote.localisation.pose_check.Verdict` has it; 0 where the map knows too little to say."""
    known: float
    """Share of the scan's points near which the map has anything, at the guess."""
    least: float
    """Fit from which it is the place."""


def fitting(places: Sequence[Place]) -> list[Place]:
    return [p for p in places if p.fit >= p.least]


def total_fit(places: Sequence[Place]) -> float:
    """Of those that fit: tells a few good ones from many."""
    return sum(p.fit for p in fitting(places))


def register_all(
    around: MapWindow,
    scans: Mapping[int, Scan],
    guesses: Mapping[int, Sequence[F64]],
    range_sigma_m: float,
    tell: Progress | None,
) -> list[Place]:
    """Every scan in the map around its guesses."""
    out = []
    for k, (i, scan) in enumerate(scans.items()):
        out.append(place_of(around, i, scan, guesses[i], Judge(range_sigma_m)))
        if tell is not None:
            tell("registering to the map", k + 1, len(scans))
    return out


def place_of(around: MapWindow, i: int, scan: Scan, guesses: Sequence[F64], judge: Judge) -> Place:
    """From the guesses themselves, and from the best of a grid of 6 m and 3 deg around them if none of them fits."""
    clouds = thin_for_levels(scan.points)
    few = solid_sample(scan.points, LEVELS[-1].points_m)
    best = Place(i, guesses[0], 0.0, 0.0, MIN_FIT)
    for guess in guesses:
        ndt_map = around(guess[:3, 3])
        known = _known(ndt_map, clouds[0].T.astype(np.float64), guess)
        if known < 0.1:
            best = max(best, Place(i, guess, 0.0, known, best.least), key=lambda p: p.known)
            continue
        starts = [guess]
        for attempt in range(2):
            for start in starts:
                T = refine(ndt_map, clouds, start).T_map_lidar
                best = max(best, Place(i, T, judge.fit(ndt_map, few, T), known, best.least), key=lambda p: p.fit)
            if best.fit >= best.least or attempt:
                break
            starts = _around(ndt_map, clouds, guess)
    return best


def _around(ndt_map: NdtMap, clouds: list[F32], guess: F64) -> list[F64]:
    sample = [np.ascontiguousarray(clouds[0][:, :: max(1, clouds[0].shape[1] // 500)])]
    grid = [
        from_xyz_rpy(x, y, 0.0) @ guess @ from_xyz_rpy(0, 0, 0, yaw=yaw)
        for x in _OFFSETS_M
        for y in _OFFSETS_M
        for yaw in _YAWS
    ]
    return sorted(grid, key=lambda start: -fitness(ndt_map, sample, start))[:_RANKED]


def _known(ndt_map: NdtMap, points: F64, T: F64) -> float:
    """Share of the points (n, 3) that fall near anything of the map, whatever it is."""
    grid = ndt_map.levels[0]
    placed = points @ T[:3, :3].T + T[:3, 3]
    cells = np.floor(placed / grid.level.voxel_m).astype(np.int64)[:, :2] - grid.window.lowest[:2]
    rows = grid.window.rows
    columns = np.asarray((rows >= 0).any(axis=2))
    inside = ((cells >= 0) & (cells < np.array(columns.shape))).all(axis=1)
    hit = np.zeros(len(cells), dtype=np.bool_)
    hit[inside] = columns[cells[inside, 0], cells[inside, 1]]
    return float(hit.mean())
