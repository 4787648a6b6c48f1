"""A map by itself: what its file shows, its ground, layers that are there twice, holes, density, frame."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from mapvote.core.grid import TileIndex
from mapvote.core.lazy_tiles import LazyTiles
from mapvote.core.point_map import PointMap, all_points
from mapvote.core.tile import Tile
from mapvote.core.types import F64, MapvoteError
from mapvote.doctor.clouds import check_cloud, in_memory, spacing, tile_by_tile
from mapvote.doctor.finding import Finding, in_order
from mapvote.doctor.ghosts import ghost_layer, ghost_shift
from mapvote.doctor.on_map import check_ground
from mapvote.formats import read_map, stream_cloud
from mapvote.formats.clean import MAX_BAD_SHARE
from mapvote.formats.geo.frame import frame_of
from mapvote.formats.maps.cloud import Cloud, joined
from mapvote.formats.maps.mapvote_folder import is_map_folder
from mapvote.formats.maps.tiling import to_map

_FAR_M = 50_000.0
_SLOPE_DEG = 6.0
_ALOFT_M = 100.0
"""Over the ground hardly anything of a street is so high."""
_SPARSE_M = 0.4
"""Points farther apart make patterns of their own."""
_MIDDLE_POINTS = 4_000_000
"""Of a map larger than memory so many show its ground and copies."""


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
    """Of a map whose ground has been measured. Of one larger than memory ground and copies are looked at around the
    middle."""
    some = _around_the_middle(point_map)
    points = all_points(some)
    height = np.concatenate([_heights(some, index) for index in sorted(some.tiles)])
    found = _ground(some, points, height) + check_ground(point_map) + _missing_tiles(point_map)
    if some is not point_map:
        what = f"ground and copies were looked at in {len(some.tiles)} tiles of {len(point_map.tiles)}, in the middle"
        found.append(Finding("note", what))
    layer = ghost_layer(height)
    if layer is not None:
        what = f"the road lies there twice, {abs(layer):.2f} m apart in height: a ghost layer"
        found.append(Finding("error", what, "two drives of different height were laid over each other: align them"))
    elif float(np.median(spacing(in_memory(points), points))) < _SPARSE_M:
        shift = ghost_shift(points[(height > 0.5) & (height < 6.0)])
        if shift is not None:
            x, y = shift
            by = f"{np.hypot(x, y):.1f} m (x {x:+.1f}, y {y:+.1f})"
            what = f"walls and poles are there twice, shifted by {by}: a ghost layer"
            found.append(Finding("error", what, "two drives were laid over each other unaligned: align them"))
    return found + _frame(point_map)


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
    return [Finding("warning", what, "scans scatter, or several were laid over each other badly")]


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
    return [Finding("warning", what, "a hole in the map: there nobody can vote")]


def _frame(point_map: PointMap) -> list[Finding]:
    frame = frame_of(point_map.georeference)
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for points in tile_by_tile(point_map)():
        low = np.minimum(low, points.min(axis=0, initial=np.inf))
        high = np.maximum(high, points.max(axis=0, initial=-np.inf))
    told = f"x {low[0]:.0f} to {high[0]:.0f}, y {low[1]:.0f} to {high[1]:.0f}, z {low[2]:.0f} to {high[2]:.0f} m"
    if frame.is_local and max(np.abs(low[:2]).max(), np.abs(high[:2]).max()) > _FAR_M:
        what = f"the map does not say which coordinates it is in ({told})"
        return [Finding("warning", what, "import it with --from-crs EPSG:n, so that GNSS and maps find it")]
    return [Finding("note", f"{told}; {frame.told()}")]
