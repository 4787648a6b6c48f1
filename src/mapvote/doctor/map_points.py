"""The points of a map by themselves, in pieces: units, axes, strays, rounding. No ground is needed, and no scipy: every
verb that reads a map makes these checks first.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapvote.core.neighbours import nearest
from mapvote.core.record import record
from mapvote.core.types import F64
from mapvote.doctor import Finding
from mapvote.doctor.which_way_up import which_way_up
from mapvote.formats.maps.tiling import Pieces


@record()
@dataclass(frozen=True, slots=True)
class MapPointCheck:
    """Numbers of the checks of a map's points."""

    checked_points: int = 400_000
    """Points of a map that are checked for its unit, its axes and lone points."""
    neighbour_points: int = 100_000
    """Points around the middle of a map whose neighbours are searched."""
    few_points: int = 1000
    """Points below which a map shows nothing."""
    stray_m: float = 300.0
    """Distance from the other points beyond which a point is a stray, metres; a nearer one is a reflection."""
    highest_m: float = 3000.0
    """Largest difference of heights of a map of streets, metres."""


MAP_POINT_CHECK = MapPointCheck()


def in_memory(points: NDArray[np.floating]) -> Pieces:
    """One piece."""
    return lambda: iter([points])


def check_cloud(pieces: Pieces, ground: Pieces | None = None) -> list[Finding]:
    """Findings on points in map metres, as a file holds them. ``ground``: the points that it classifies as ground."""
    n = sum(map(len, pieces()))
    if n < MAP_POINT_CHECK.few_points:
        return [Finding("warning", f"the map holds only {n} points", "is the file cut off, or the wrong one?")]
    sample = _every(pieces, max(1, n // MAP_POINT_CHECK.checked_points))
    low, high = np.quantile(sample, (0.001, 0.999), axis=0)
    apart_m = spacing(pieces, sample)
    units = list(_units(high - low, apart_m))
    findings = [*_strays(pieces, n, low, high), *units]
    if not units:
        classified = np.empty((0, 3)) if ground is None else _every(ground, max(1, n // MAP_POINT_CHECK.checked_points))
        findings += which_way_up(sample, high - low, classified)
    twice = float((apart_m < 1e-6).mean())
    if twice >= 0.05:
        findings.append(Finding("warning", f"{twice:.0%} of the points occur twice", "was the map merged with itself?"))
    return [*findings, *_rounded(sample)]


def _every(pieces: Pieces, step: int) -> F64:
    """(m, 3) every ``step``-th point."""
    parts = []
    skip = 0
    for points in pieces():
        parts.append(points[skip::step].astype(np.float64))
        skip = (skip - len(points)) % step
    return np.concatenate(parts)


def _strays(pieces: Pieces, n: int, low: F64, high: F64) -> Iterator[Finding]:
    wide = high - low
    strays = 0
    far_m = 0.0
    for points in pieces():
        outside = np.zeros(len(points), np.bool_)
        for axis in range(3):  # three columns are read faster than rows of three
            along = points[:, axis]
            outside |= (along < (low - wide - 20.0)[axis]) | (along > (high + wide + 20.0)[axis])
        strays += int(outside.sum())
        far_m = max(far_m, float(np.abs(points[outside] - 0.5 * (low + high)).max(initial=0.0)))
    if strays:
        problem = f"{strays} of {n} points lie far off all others, up to {far_m:.0f} m"
        mend = "strays, or another place's points: cut them off"
        yield Finding("warning" if far_m > MAP_POINT_CHECK.stray_m else "note", problem, mend)


def spacing(pieces: Pieces, sample: F64) -> F64:
    """(m,) distance of points to their nearest neighbour, of all points around one place, the middle of ``sample``."""
    centre = np.median(sample[:: max(1, len(sample) // 1000)], axis=0)
    near = np.empty((0, 3))
    away = np.empty(0)
    for points in pieces():
        distance = np.maximum(np.abs(points[:, 0] - centre[0]), np.abs(points[:, 1] - centre[1]))
        close = distance <= (away.max() if len(away) == MAP_POINT_CHECK.neighbour_points else np.inf)
        if not close.any():
            continue
        near = np.concatenate([near, points[close]])
        away = np.concatenate([away, distance[close]])
        if len(near) > MAP_POINT_CHECK.neighbour_points:
            chosen = np.sort(
                np.argpartition(away, MAP_POINT_CHECK.neighbour_points - 1)[: MAP_POINT_CHECK.neighbour_points]
            )
            near = near[chosen]
            away = away[chosen]
    itself_and_next, _ = nearest(near, near[:: max(1, len(near) // 2000)], 2)
    return itself_and_next[:, 1]


def _units(wide: F64, apart: F64) -> Iterator[Finding]:
    apart_m = float(np.median(apart))
    mend = "give the points in metres"
    if wide.max() < 5.0:
        problem = f"the map is {wide[0]:.3g} by {wide[1]:.3g} by {wide[2]:.3g} m small: kilometres, or degrees?"
        yield Finding("error", problem, mend)
    elif wide[2] < 0.05:
        yield Finding("error", "all points lie at one height: the map is flat", "is the column order x, y, z?")
    elif wide[2] > MAP_POINT_CHECK.highest_m or (apart_m > 2.0 and wide[2] > 0.2 * MAP_POINT_CHECK.highest_m):
        problem = f"points are {apart_m:.2g} m apart, the map is {wide[2]:.0f} m high: millimetres, or centimetres?"
        yield Finding("error", problem, mend)
    elif apart_m > 0.5:
        problem = f"points are {apart_m:.2f} m apart (median): too sparse to show what stands there, or not metres"
        yield Finding("warning", problem, "a map needs a point every 0.3 m or so")


def _rounded(sample: F64) -> Iterator[Finding]:
    sample = sample[:: max(1, len(sample) // 20_000)]
    for axis, name in enumerate("xyz"):
        for quantum in (1.0, 0.5, 0.25, 0.125):
            steps = sample[:, axis] / quantum
            if (np.abs(steps - np.round(steps)) < 1e-3).mean() > 0.95 and np.ptp(sample[:, axis]) > 0.05:
                problem = f"{name} is rounded to {quantum:g} m in the map"
                mend = "float32 of large coordinates? Subtract an offset before writing them"
                yield Finding("error", problem, mend)
                return
