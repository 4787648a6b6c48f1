"""A map by itself: units, axes, strays and rounding of its points; its ground, holes, frame; layers there twice.

:func:`check_cloud` needs points only, in pieces, and uses no scipy: every verb that reads a map calls it first.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapvote.core.grid import TileIndex
from mapvote.core.kernel import kernel
from mapvote.core.lazy_tiles import LazyTiles
from mapvote.core.point_map import PointMap, all_points
from mapvote.core.sensor_height import check_heights
from mapvote.core.tile import Tile
from mapvote.core.types import F64, I64, MapvoteError
from mapvote.doctor.finding import Finding, in_order
from mapvote.doctor.standing import check_lean, ghost_layer, ghost_shift
from mapvote.formats import read_map, stream_cloud
from mapvote.formats.clean import MAX_BAD_SHARE
from mapvote.formats.geo.projector import frame_of
from mapvote.formats.maps.cloud import Cloud, joined
from mapvote.formats.maps.mapvote_folder import is_map_folder
from mapvote.formats.maps.tiling import to_map
from mapvote.slam.clean_map import lone_points

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
"""Of a street's points .12 to .17 lie on its ground (simulated ones and KITTI); with less, up is unknown."""
_FAR_M = 50_000.0
_SLOPE_DEG = 6.0
_ALOFT_M = 100.0
"""Over the ground hardly anything of a street is so high."""
_SPARSE_M = 0.4
"""Points farther apart make patterns of their own."""
_MOST_LONE = 0.005
"""Of a map's points; a survey's first map has a few in a thousand."""
_MIDDLE_POINTS = 4_000_000
"""Of a map larger than memory so many show its ground and copies."""


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
    which = place[:: max(1, len(near) // 2000)]
    apart = np.empty(len(which))
    _to_nearest(near[order], axis, which, apart)
    return apart


@kernel
def _to_nearest(points: F64, axis: int, which: I64, out: F64) -> None:
    """Into ``out`` (m,) the distance from the points ``which`` (m,) to the nearest other one of the points (n, 3),
    which ascend along ``axis``. A tree would import half of scipy, which takes longer than all of this check."""
    for w in range(len(which)):
        i, best = which[w], np.inf
        for way in (-1, 1):
            j = i + way
            while 0 <= j < len(points) and (points[j, axis] - points[i, axis]) ** 2 < best:
                x, y, z = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1], points[j, 2] - points[i, 2]
                best = min(best, x * x + y * y + z * z)
                j += way
        out[w] = np.sqrt(best)


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
        what = f"points are {apart_m:.2f} m apart (median): too sparse to show what stands there, or not metres"
        return [Finding("warning", what, "a map needs a point every 0.3 m or so")]
    return []


def _axes(some: F64, wide: F64) -> list[Finding]:
    """Which way is up: a street is a sheet of ground with things on it, none below, and not higher than it is wide:
    rows of house fronts behind each other are no ground. ``wide`` (3,): the extent of the points."""
    share = {sign + axis: 0.0 for axis in "xyz" for sign in "+-"}
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


def examine_map(path: Path) -> tuple[list[Finding], PointMap | None]:
    """(findings, errors first; the map, if one can be made of it) of a map in any format."""
    try:
        if not is_map_folder(path):
            return examine_points(str(path), joined(list(stream_cloud(path))))
        point_map = read_map(path)
    except MapvoteError as error:
        return [Finding("error", str(error))], None
    return in_order(check_whole(point_map)), point_map


def examine_points(where: str, cloud: Cloud) -> tuple[list[Finding], PointMap | None]:
    """The same of points as a file has them, of which no map has been made yet. MapvoteError if their coordinates
    cannot be made metres."""
    finite = np.isfinite(cloud.points).all(axis=1)
    found = _not_finite(len(finite) - int(finite.sum()), len(finite))
    if not any(f.severity == "error" for f in found):
        fields = {name: column[finite] for name, column in cloud.fields.items()}
        cloud = replace(cloud, points=cloud.points[finite], fields=fields).in_metres(where)
        found += check_cloud(in_memory(cloud.points))
    if any(f.severity == "error" for f in found):
        return in_order(found), None
    try:
        point_map = to_map(where, cloud)
    except MapvoteError as error:
        return in_order([*found, Finding("error", str(error))]), None
    return in_order(found + check_map(point_map)), point_map


def _not_finite(bad: int, n: int) -> list[Finding]:
    if not bad:
        return []
    what = f"{bad} of {n} points are not finite"
    if bad > MAX_BAD_SHARE * n:
        return [Finding("error", what, "export the file again; of a LAS the header's scales and offsets may be broken")]
    return [Finding("note", f"{what}: import leaves them out")]


def check_whole(point_map: PointMap) -> list[Finding]:
    """All that a map shows by itself."""
    return check_cloud(tile_by_tile(point_map)) + check_map(point_map)


def check_map(point_map: PointMap) -> list[Finding]:
    """Of a map whose ground has been measured. Of one larger than memory, ground and copies are checked around the
    middle."""
    some = _around_the_middle(point_map)
    points = all_points(some)
    height = np.concatenate([_heights(some, index) for index in sorted(some.tiles)])
    found = _ground(some, points, height) + check_ground(point_map) + _missing_tiles(point_map)
    if some is not point_map:
        what = f"ground and copies were checked in {len(some.tiles)} tiles of {len(point_map.tiles)}, in the middle"
        found.append(Finding("note", what))
    found += _lone(some)
    standing = points[(height > 0.5) & (height < 6.0)]
    found += check_lean(standing)
    layer = ghost_layer(height)
    if layer is not None:
        what = f"the road lies there twice, {abs(layer):.2f} m apart in height: a ghost layer"
        found.append(Finding("error", what, "two drives of different height were merged: align them"))
    elif float(np.median(spacing(in_memory(points), points))) < _SPARSE_M:
        shift = ghost_shift(standing)
        if shift is not None:
            x, y = shift
            by = f"{np.hypot(x, y):.1f} m (x {x:+.1f}, y {y:+.1f})"
            what = f"walls and poles are there twice, shifted by {by}: a ghost layer"
            found.append(Finding("error", what, "two drives were merged without alignment: align them"))
    return found + _frame(point_map)


def _lone(point_map: PointMap) -> list[Finding]:
    lone = sum(int(lone_points(tile).sum()) for tile in point_map.tiles.values())
    if lone <= _MOST_LONE * point_map.n_points:
        return []
    what = f"{lone} of {point_map.n_points} points stand above the ground and touch no other"
    return [Finding("note", what, "vehicles will deny them; mapvote import --clean drops them")]


def _around_the_middle(point_map: PointMap) -> PointMap:
    """The map, or of one that is larger than memory the tiles nearest to the middle."""
    if not isinstance(point_map.tiles, LazyTiles):
        return point_map
    row, col = np.median(np.array(list(point_map.tiles)), axis=0)
    nearest = sorted(point_map.tiles, key=lambda index: (np.hypot(index[0] - row, index[1] - col), index))
    chosen: dict[TileIndex, Tile] = {}
    for index in nearest:
        if chosen and sum(len(tile.points) for tile in chosen.values()) > _MIDDLE_POINTS:
            break
        chosen[index] = point_map.tiles[index]
    return replace(point_map, tiles=dict(sorted(chosen.items())))


def _heights(point_map: PointMap, index: tuple[int, int]) -> F64:
    tile = point_map.tiles[index]
    return np.asarray(tile.points_map[:, 2] - tile.ground_z.reshape(-1)[tile.cells])


def _ground(point_map: PointMap, points: F64, height: F64) -> list[Finding]:
    found = []
    known = float(np.isfinite(height).mean())
    if known < 0.5:
        what = f"the ground is known under {known:.0%} of the points only"
        found.append(Finding("warning", what, "is the road missing, cut off below, or is z not up?"))
    below = float((height < -1.0).mean())
    if below > 0.01:
        what = f"{below:.1%} of the points lie more than 1 m below the ground"
        found.append(Finding("warning", what, "reflections, cellars, or a second layer below"))
    above = float((height > _ALOFT_M).mean())
    if above > 0.001:
        what = f"{above:.1%} of the points lie more than {_ALOFT_M:.0f} m above the ground"
        mend = "outliers, or another place's points: cut them off; sound among towers only"
        found.append(Finding("error" if above > 0.01 else "warning", what, mend))
    near = np.abs(height) < 0.15
    if near.sum() < 100:
        return [*found, Finding("warning", "hardly any point lies on the ground", "was the ground cut out of the map?")]
    share_near = float(near.mean())
    if share_near < 0.08:
        what = f"only {share_near:.0%} of the points lie on the ground"
        found.append(Finding("warning", what, "was the ground cut out of the map? Votes need the road"))
    return found + _plane(points[near]) + _thickness(height)


def _plane(ground: F64) -> list[Finding]:
    p = ground[:: max(1, len(ground) // 100_000)]
    centre = p.mean(axis=0)
    plane = np.column_stack([p[:, :2] - centre[:2], np.ones(len(p))])
    slope, *_ = np.linalg.lstsq(plane, p[:, 2] - centre[2], rcond=None)
    slope_deg = float(np.degrees(np.arctan(np.hypot(slope[0], slope[1]))))
    if slope_deg <= _SLOPE_DEG:
        return []
    what = f"the ground as a whole is tilted by {slope_deg:.1f} deg"
    return [Finding("warning", what, "sound on a steep street only; else z is not up: level the map")]


def _thickness(height: F64) -> list[Finding]:
    wide = height[(np.abs(height) < 0.6)]
    rough = 1.4826 * float(np.median(np.abs(wide - np.median(wide))))
    if rough <= 0.12:
        return []
    what = f"the ground is {rough:.2f} m thick"
    return [Finding("warning", what, "scans scatter, or several were merged with bad poses")]


def _missing_tiles(point_map: PointMap) -> list[Finding]:
    tiles = set(point_map.tiles)
    around = {(r + a, c + b) for r, c in tiles for a, b in ((0, 1), (0, -1), (1, 0), (-1, 0))} - tiles
    holes = [
        (r, c)
        for r, c in sorted(around)
        if ((r - 1, c) in tiles and (r + 1, c) in tiles) or ((r, c - 1) in tiles and (r, c + 1) in tiles)
    ]
    if not holes:
        return []
    window = point_map.lattice.tile(holes[0])
    what = f"{len(holes)} tiles are missing between others, the first at ({window.x0:.0f}, {window.y0:.0f})"
    return [Finding("warning", what, "a hole in the map: no vehicle can vote there")]


def _frame(point_map: PointMap) -> list[Finding]:
    frame = frame_of(point_map.georeference)
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for points in tile_by_tile(point_map)():
        low = np.minimum(low, points.min(axis=0, initial=np.inf))
        high = np.maximum(high, points.max(axis=0, initial=-np.inf))
    told = f"x {low[0]:.0f} to {high[0]:.0f}, y {low[1]:.0f} to {high[1]:.0f}, z {low[2]:.0f} to {high[2]:.0f} m"
    if frame.is_local and max(np.abs(low[:2]).max(), np.abs(high[:2]).max()) > _FAR_M:
        what = f"the map does not name its coordinate system ({told})"
        return [Finding("warning", what, "import it with --from-crs EPSG:n, so that GNSS and maps find it")]
    return [Finding("note", f"{told}; {frame.told()}")]


def check_ground(point_map: PointMap) -> list[Finding]:
    """Does the map's ground lie under the paths that it was made of?"""
    complaints = [check_heights(point_map, path).complaint for path in point_map.driven]
    mend = "build the map anew; where drives run above each other it keeps one level, and the other cannot vote there"
    return [Finding("warning", what, mend) for what in complaints if what]
