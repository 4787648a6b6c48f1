"""What a map's points show before anything is made of them: units, axes, strays, copies, rounding."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numba
import numpy as np
from numpy.typing import NDArray

from mapvote.core.point_map import PointMap
from mapvote.core.types import F64, I64
from mapvote.doctor.finding import Finding
from mapvote.doctor.road import UPS

Pieces = Callable[[], Iterator[NDArray[np.floating]]]
"""The points (n, 3) of a map from the start, piece by piece: as often as it is called."""
_SOME, _NEAR = 400_000, 100_000
_FEW = 1000
"""Fewer points show nothing."""
_COLUMN_M = 2.0
_SHEET_M = 0.2
_STRAY_M = 300.0
"""Farther off they make the map larger than it is; nearer ones are reflections."""
_HIGHEST_M = 3000.0
"""No map of streets is higher."""
_SLENDER = 2.0
"""Times as high as it is wide a street may be."""
_LEAST_SHEET = 0.09
"""Of a street's points .12 to .17 lie on its ground (simulated ones and KITTI); with less nothing says what is up."""


def in_memory(points: NDArray[np.floating]) -> Pieces:
    """One piece."""
    return lambda: iter([points])


def tile_by_tile(point_map: PointMap) -> Pieces:
    """The points of a map."""
    return lambda: (point_map.tiles[index].points_map for index in sorted(point_map.tiles))


def check_cloud(pieces: Pieces) -> list[Finding]:
    """Of points in map metres, as somebody's file holds them."""
    n = sum(map(len, pieces()))
    if n < _FEW:
        return [Finding("warning", f"the map holds {n} points only", "is the file cut off, or the wrong one?")]
    some = _every(pieces, max(1, n // _SOME))
    low, high = np.quantile(some, (0.001, 0.999), axis=0)
    found = _strays(pieces, n, low, high)
    apart_m = spacing(pieces, some)
    return found + (_units(high - low, apart_m) or _axes(some, high - low)) + _copies(apart_m) + _rounded(some)


def _every(pieces: Pieces, step: int) -> F64:
    """(m, 3) every ``step``-th point."""
    parts, skip = [], 0
    for points in pieces():
        parts.append(points[skip::step].astype(np.float64))
        skip = (skip - len(points)) % step
    return np.concatenate(parts)


def _strays(pieces: Pieces, n: int, low: F64, high: F64) -> list[Finding]:
    wide, strays, far_m = high - low, 0, 0.0
    for points in pieces():
        outside = np.zeros(len(points), np.bool_)
        for axis in range(3):  # three columns are read faster than rows of three
            along = points[:, axis]
            outside |= (along < (low - wide - 20.0)[axis]) | (along > (high + wide + 20.0)[axis])
        strays += int(outside.sum())
        far_m = max(far_m, float(np.abs(points[outside] - 0.5 * (low + high)).max(initial=0.0)))
    if not strays:
        return []
    what = f"{strays} of {n} points lie far off all others, up to {far_m:.0f} m"
    mend = "strays, or another place's points: cut them off"
    return [Finding("warning" if far_m > _STRAY_M else "note", what, mend)]


def spacing(pieces: Pieces, some: F64) -> F64:
    """(m,) distance of points to their nearest neighbour, of all points around one place, the middle of ``some``."""
    centre = np.median(some[:: max(1, len(some) // 1000)], axis=0)
    near, away = np.empty((0, 3)), np.empty(0)
    for points in pieces():
        distance = np.maximum(np.abs(points[:, 0] - centre[0]), np.abs(points[:, 1] - centre[1]))
        close = distance <= (away.max() if len(away) == _NEAR else np.inf)
        if not close.any():
            continue
        near, away = np.concatenate([near, points[close]]), np.concatenate([away, distance[close]])
        if len(near) > _NEAR:
            chosen = np.sort(np.argpartition(away, _NEAR - 1)[:_NEAR])
            near, away = near[chosen], away[chosen]
    axis = int(np.argmax(np.ptp(near, axis=0)))
    order = np.argsort(near[:, axis])
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    return _to_nearest(near[order], axis, place[:: max(1, len(near) // 2000)])


@numba.njit(cache=True, nogil=True)
def _to_nearest(points: F64, axis: int, which: I64) -> F64:
    """(m,) from those of the points (n, 3), which ascend along ``axis``, to the nearest other one: a tree would ask for
    half of scipy, whose import takes longer than all of the look."""
    out = np.full(len(which), np.inf)
    for w in range(len(which)):
        i, best = which[w], np.inf
        for way in (-1, 1):
            j = i + way
            while 0 <= j < len(points) and (points[j, axis] - points[i, axis]) ** 2 < best:
                x, y, z = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1], points[j, 2] - points[i, 2]
                best = min(best, x * x + y * y + z * z)
                j += way
        out[w] = np.sqrt(best)
    return out


def _units(wide: F64, apart: F64) -> list[Finding]:
    apart_m, mend = float(np.median(apart)), "give the points in metres"
    if wide.max() < 5.0:
        what = f"the map is {wide[0]:.3g} by {wide[1]:.3g} by {wide[2]:.3g} m small: kilometres, or degrees?"
        return [Finding("error", what, mend)]
    if wide[2] < 0.05:
        return [Finding("error", "all points lie at one height: the map is flat", "is the column order x, y, z?")]
    if wide[2] > _HIGHEST_M or (apart_m > 2.0 and wide[2] > 0.2 * _HIGHEST_M):
        what = f"points are {apart_m:.2g} m apart, the map is {wide[2]:.0f} m high: millimetres, or centimetres?"
        return [Finding("error", what, mend)]
    if apart_m > 0.5:
        what = f"points are {apart_m:.2f} m apart (median): too sparse to tell what stands there, or not metres"
        return [Finding("warning", what, "a map needs a point every 0.3 m or so")]
    return []


def _axes(some: F64, wide: F64) -> list[Finding]:
    """Which way is up: a street is a sheet of ground with things on it, none below, and not higher than it is wide:
    rows of house fronts behind each other are no ground. ``wide`` (3,): the extent of the points."""
    share = dict.fromkeys(UPS, 0.0)
    for axis, name in enumerate("xyz"):
        if wide[axis] <= _SLENDER * wide[2]:
            share["+" + name], share["-" + name] = _sheet_shares(some, axis)
    best = max(share, key=lambda name: share[name])
    opposite = ("-" if best[0] == "+" else "+") + best[1]
    # Between two walls, as much lies at one end of an axis as at the other: that is no ground.
    if best == "+z" or share[best] < max(_LEAST_SHEET, 1.3 * share["+z"], 1.3 * share[opposite]):
        return []
    if best == "-z":
        what = "the map is upside down: things hang below the ground"
        return [Finding("error", what, "negate y and z of every point (only z, if right and left are right already)")]
    what = f"the map's axis {best} points up, not z"
    return [Finding("error", what, "turn the points so that z is up (x east, y north)")]


def _sheet_shares(points: F64, axis: int) -> tuple[float, float]:
    """Share of the points that lie within 0.2 m of the lowest of their column of 2 m along ``axis``; and of the highest
    one, the lowest along its opposite."""
    others = [a for a in range(3) if a != axis]
    cells = np.floor((points[:, others] - points[:, others].min(axis=0)) / _COLUMN_M).astype(np.int64)
    key = cells[:, 0] * (cells[:, 1].max() + 1) + cells[:, 1]
    order = np.argsort(points[:, axis])
    key = key[order]  # short numbers are sorted without comparing them
    columns = np.argsort(key.astype(np.uint16) if key.max() < 1 << 16 else key, kind="stable")
    key, height = key[columns], points[order[columns], axis]
    starts = np.flatnonzero(np.diff(key, prepend=-1))
    counts = np.diff(np.append(starts, len(key)))
    ends = starts + counts - 1
    tall = np.repeat(height[ends] - height[starts] > 1.5, counts)

    def share(sheet: F64) -> float:
        return float(((np.abs(height - np.repeat(sheet, counts)) < _SHEET_M) & tall).mean())

    return share(height[starts + counts // 20]), share(height[ends - counts // 20])


def _copies(apart_m: F64) -> list[Finding]:
    twice = float((apart_m < 1e-6).mean())
    if twice < 0.05:
        return []
    return [Finding("warning", f"{twice:.0%} of the points are there twice", "the map was joined with itself?")]


def _rounded(some: F64) -> list[Finding]:
    some = some[:: max(1, len(some) // 20_000)]
    for axis, name in enumerate("xyz"):
        for quantum in (1.0, 0.5, 0.25, 0.125):
            steps = some[:, axis] / quantum
            if (np.abs(steps - np.round(steps)) < 1e-3).mean() > 0.95 and np.ptp(some[:, axis]) > 0.05:
                what = f"{name} is rounded to {quantum:g} m in the map"
                return [Finding("error", what, "float32 of large coordinates? Subtract an offset before writing them")]
    return []
