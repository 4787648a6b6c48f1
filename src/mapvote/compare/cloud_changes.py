"""What differs between two clouds of one place that lie in one frame: gone, new, and not seen by the other.

An object of one cloud is gone or new where the other cloud has nothing that stands within two cells, and must have
seen the place. A map made of scans knows free space: it saw the place if half of the object's voxels are free in it. A
bare cloud knows no rays: it saw the place if it has ground there. Rays to the ground pass below what hangs, and through
gaps they show ground behind a house. So the ground does not decide where free space is known.

Only what stands in the lowest 2.7 m is compared: crowns, wires and roofs are in range of one survey and out of range of
the next. If rays of the same map passed below a point, that point does not stand: it hangs, or something moved there.
A map that counts scans shows what walked by: few scans hit it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any, Literal

import numpy as np
from scipy import ndimage
from scipy.spatial import KDTree

from mapvote.compare.register import SIDE_M, Registered
from mapvote.core.columns import rebased
from mapvote.core.geometry import transform
from mapvote.core.grid import CELL_SIZE, CELLS, Grid, Lattice, TileIndex
from mapvote.core.point_map import SCANS, PointMap, all_points, has_open_ground
from mapvote.core.reference import above_ground_points, reference_window
from mapvote.core.tile import Tile
from mapvote.core.types import F32, F64, I32, I64, U64, Bool, MapvoteError
from mapvote.formats.geo.frame import frame_of
from mapvote.shapes.cutout import cut_out, whole_page
from mapvote.shapes.geojson import MAP_METRES, rings_to_lonlat
from mapvote.shapes.outlines import Ring, group, pieces, rings

Kind = Literal["gone", "new", "not seen"]
BAND = np.uint64(0b1_1111_1100)
"""The voxels .6 to 2.7 m above the layer of the ground: what is lower is kerb, grass or a slope's error."""
REACH_CELLS = 2
GROUND_APART_M = 0.4
"""Grounds that lie farther apart are not one ground: a roof, a car's floor, a second level."""
_EXPLAINED_M = 0.45
"""A point so near to the other cloud under the motion of a bent patch is explained by the bend."""
_VOXELS, _VOXELS_A_CELL, _VOXELS_ENOUGH = 4, 2, 80
"""Occupied voxels that an object of A cells must have: 4 + 2 A, or 80, much as new objects of a drive must.
What is thinner, one point a cell, is the fringe of a survey or the trail of something that moved."""
_WALKED_BY = 8.0
"""Scans that hit a voxel (0.3 m) while a walker of 0.5 m passes it at 1 m/s, at 10 Hz. What stands in reach of a survey
is hit by tens. An object whose cells were hit less often (median), in a map that counts scans, is not listed."""


@dataclass(frozen=True, slots=True)
class CloudChange:
    """An object that only one of two clouds has."""

    kind: Kind
    """gone: a has it. new: b has it. not seen: one has it, and it is unknown whether the other should."""
    outline: list[list[Ring]]
    """Polygons, each an outer ring and its holes, in lattice corners (col, row)."""
    area_m2: float
    height_m: float
    """Its highest point above the ground."""
    points: int
    """Of the cloud that has it, in its cells and above the ground."""
    box: tuple[float, float, float, float]
    """x0, y0, x1, y1 in a's frame, metres."""
    confidence: float
    """How surely the other cloud saw the place: mean over its cells of ``OneSided.sure``."""
    has: Literal["a", "b"]
    cells: tuple[I64, I64]
    """(rows, cols) of its cells in the window of the comparison."""


@dataclass(frozen=True, slots=True)
class CloudPlanes:
    """A map over one window, (rows, cols)."""

    ground_z: F32
    base: I32
    words: U64
    """Column words of what stands, at any height above the ground."""
    top_z: F32
    counts: F64
    own_ground: Bool
    """The cell itself has a point of the ground."""
    seen: Bool
    """It or one of the eight beside it has."""
    free: U64
    """Column words known to be free; 0 where the map has none."""
    has_rays: Bool
    """The tile knows free space."""
    scans: F64
    """Mean of SCANS of the points above the ground in each cell; infinite where one of them is not counted."""

    @property
    def low(self) -> Bool:
        """A point lies in BAND."""
        return np.asarray(self.words & BAND != 0)

    @property
    def stands(self) -> Bool:
        return np.asarray(self.words != 0)


@dataclass(frozen=True, slots=True)
class OneSided:
    """What only one of two clouds has, (rows, cols)."""

    changed: Bool
    """The other cloud saw the place, and has nothing there."""
    not_seen: Bool
    """The other cloud does not show it, and may not have seen it."""
    sure: F64
    """How surely the other cloud saw it: the share of its voxels in BAND that are free there; where that knows no free
    space, 1 if it has ground in the cell itself, else 0."""


@dataclass(frozen=True, slots=True)
class CellComparison:
    """Two clouds cell by cell: planes (rows, cols) of ``window``."""

    window: Grid
    a: CloudPlanes
    b: CloudPlanes
    only_a: OneSided
    only_b: OneSided
    left_out: Bool
    """In a bent part, or explained by its motion."""


def planes_of(point_map: PointMap, window: Grid) -> CloudPlanes:
    """The planes of a map that :func:`compare_cells` looks at."""
    here = reference_window(point_map, window)
    known = np.isfinite(here.ground_z)
    beside = (above_ground_points(point_map, window) != 0) & known
    own, has_rays = (np.zeros(window.shape, dtype=np.bool_) for _ in range(2))
    scans = np.full(window.shape, np.inf)
    for index in window.tiles():
        tile = point_map.tiles.get(index)
        if tile is None:
            continue
        common = tile.window.intersection(window)
        into, cut = common.slices_in(window), common.slices_in(tile.window)
        has_rays[into] = tile.free is not None and tile.free.any()
        scans[into] = _mean_scans(tile)[cut]
        own[into] = (np.bincount(tile.cells[~tile.columns[1]], minlength=CELLS) > 0).reshape(tile.window.shape)[cut]
    free = np.zeros_like(here.occupied) if here.free is None else here.free
    return CloudPlanes(
        here.ground_z, here.base, here.occupied, here.top_z, here.counts.astype(np.float64), own & known, beside, free,
        has_rays, scans,
    )  # fmt: skip


def _mean_scans(tile: Tile) -> F64:
    """(256, 256) ``CloudPlanes.scans`` of a tile."""
    if SCANS not in tile.fields:
        return np.full(tile.window.shape, np.inf)
    counts = tile.fields[SCANS].astype(np.float64)
    standing = tile.columns[1]
    weights = np.where(counts > 0, counts, np.inf)[standing]
    number = np.bincount(tile.cells[standing], minlength=CELLS)
    total = np.bincount(tile.cells[standing], weights=weights, minlength=CELLS)
    return np.asarray((total / np.maximum(number, 1)).reshape(tile.window.shape))


def compare_cells(map_a: PointMap, map_b: PointMap, registered: Registered | None = None) -> CellComparison:
    """Maps of one lattice and frame, cell by cell. ``registered``: how b came there; its bent parts are left out.

    MapvoteError if they do not overlap, or if one of them has no ground.
    """
    window = reduce(Grid.union, (map_a.lattice.tile(tile) for tile in sorted({*map_a.tiles, *map_b.tiles})))
    a, b = planes_of(map_a, window), planes_of(map_b, window)
    for name, one in (("A", map_a), ("B", map_b)):
        if not has_open_ground(one):
            raise MapvoteError(
                f"{name} has no ground: the places that it saw are unknown, so whether an object is gone, new or not "
                "seen cannot be decided by geometry alone"
            )
    apart = (np.abs(a.ground_z - b.ground_z) > GROUND_APART_M) & a.own_ground & b.own_ground  # measured, not filled in
    alone = [own.low & ~_hangs(own) & ~_around(other.low, REACH_CELLS) for own, other in ((a, b), (b, a))]
    left_out = np.zeros(window.shape, dtype=np.bool_)
    if registered is not None:
        rows, cols = np.nonzero(alone[0] | alone[1])
        x, y = window.centres()
        left_out[rows, cols] = ~registered.compared(np.column_stack([x[cols], y[rows]]))
        left_out |= _explained(alone, left_out, (map_a, map_b), window, registered)
    sides = []
    for only, own, other in zip(alone, (a, b), (b, a), strict=True):
        low = own.words & BAND
        free = np.bitwise_count(low & rebased(other.free, other.base - own.base))
        share = np.asarray(free / np.maximum(np.bitwise_count(low), 1))
        seen = np.where(other.has_rays, share >= 0.5, other.seen & ~apart)
        sure = np.where(other.has_rays, share, other.own_ground)
        sides.append(OneSided(only & seen & ~left_out, only & ~seen & ~left_out, sure))
    return CellComparison(window, a, b, sides[0], sides[1], left_out)


def _hangs(planes: CloudPlanes) -> Bool:
    """(rows, cols) where rays of the map itself passed in BAND below its highest point there."""
    below = planes.words & BAND
    for layers in (1, 2, 4):
        below |= below >> np.uint64(layers)
    return np.asarray(below & BAND & planes.free & ~planes.words != 0)


def _around(cells: Bool, reach: int) -> Bool:
    return np.asarray(ndimage.maximum_filter(cells, 2 * reach + 1, mode="constant"))


def _explained(
    alone: list[Bool], left_out: Bool, maps: tuple[PointMap, PointMap], window: Grid, registered: Registered
) -> Bool:
    """(rows, cols) cells of which half of the points fit the other cloud under the motion of a bent patch near them.
    ``alone``: what only a has, and what only b has."""
    out = np.zeros(window.shape, dtype=np.bool_)
    motions = [] if registered.unbent else registered.other_motions()
    if not motions:
        return out
    clouds = [all_points(one) for one in maps]
    for k, cells in enumerate(alone):
        mine = clouds[k][window.value_at(cells & ~left_out, clouds[k])]
        fits = np.zeros(len(mine), dtype=np.bool_)
        for centre, T in motions:  # T moves b's points
            others = clouds[1 - k][_near(clouds[1 - k], centre)]
            here = np.flatnonzero(_near(mine, centre) & ~fits)
            if not len(others) or not len(here):
                continue
            at, others = (mine[here], transform(T, others)) if k == 0 else (transform(T, mine[here]), others)
            fits[here] = KDTree(others).query(at, distance_upper_bound=_EXPLAINED_M)[0] < _EXPLAINED_M
        rows, cols, _ = window.indices_of(mine)
        total, explained = np.zeros(window.shape), np.zeros(window.shape)
        np.add.at(total, (rows, cols), 1.0)
        np.add.at(explained, (rows[fits], cols[fits]), 1.0)
        out |= (total > 0) & (explained >= 0.5 * total)
    return out


def _near(points: F64, centre: F64) -> Bool:
    return np.asarray((np.abs(points[:, :2] - centre) < SIDE_M).all(axis=1))


def differences(found: CellComparison, min_m2: float = 0.5) -> list[CloudChange]:
    """Objects of at least ``min_m2`` that only one cloud has: gone and new by area, then what was not seen."""
    out = [
        *_objects(found, "gone", "a", min_m2),
        *_objects(found, "new", "b", min_m2),
        *_objects(found, "not seen", "a", min_m2),
        *_objects(found, "not seen", "b", min_m2),
    ]
    return sorted(out, key=lambda one: (one.kind == "not seen", -one.area_m2))


def _objects(found: CellComparison, kind: Kind, has: Literal["a", "b"], min_m2: float) -> list[CloudChange]:
    owner, other, side = (found.a, found.b, found.only_a) if has == "a" else (found.b, found.a, found.only_b)
    cells = side.not_seen if kind == "not seen" else side.changed
    rows, cols = (found_at.astype(np.int64) for found_at in np.nonzero(cells))
    if not len(rows):
        return []
    window = found.window
    kinds = np.zeros(len(rows), dtype=np.int64)
    hang_together = pieces(rows, cols, kinds)
    things = group(rows, cols, kinds, hang_together.objects)
    outlines = rings(rows + window.row0, cols + window.col0, hang_together.polygons)
    ground = np.where(np.isfinite(owner.ground_z), owner.ground_z, other.ground_z)
    height = (owner.top_z - ground)[rows, cols]
    x, y = (centres - 0.5 * CELL_SIZE for centres in window.centres())
    out = []
    for mine in np.split(np.argsort(things, kind="stable"), np.cumsum(np.bincount(things))[:-1]):
        area_m2 = len(mine) * CELL_SIZE**2
        if area_m2 < min_m2 - 1e-9:
            continue
        r, c = rows[mine], cols[mine]
        voxels = int(np.bitwise_count(owner.words[r, c]).sum())
        if kind != "not seen" and voxels < min(_VOXELS + _VOXELS_A_CELL * len(mine), _VOXELS_ENOUGH):
            continue
        if kind != "not seen" and np.median(owner.scans[r, c]) < _WALKED_BY:
            continue
        points = int(owner.counts[r, c].sum())
        out.append(
            CloudChange(
                kind,
                [outlines[p] for p in np.unique(hang_together.polygons[mine])],
                area_m2,
                float(np.nanmax(height[mine], initial=0.0)),
                points,
                (float(x[c.min()]), float(y[r.min()]), float(x[c.max()] + CELL_SIZE), float(y[r.max()] + CELL_SIZE)),
                float(side.sure[r, c].mean()) if kind != "not seen" else 0.0,
                has,
                (r, c),
            )
        )
    return out


_ON_PAGE = 12


def difference_rows(found: Sequence[CloudChange]) -> list[dict[str, Any]]:
    """One row per object, numbered as listed."""
    return [
        {
            "id": number,
            "kind": one.kind,
            "in": one.has.upper(),
            "x": round(0.5 * (one.box[0] + one.box[2]), 2),
            "y": round(0.5 * (one.box[1] + one.box[3]), 2),
            "box": [round(value, 2) for value in one.box],
            "area_m2": round(one.area_m2, 2),
            "height_m": round(one.height_m, 2),
            "points": one.points,
            "confidence": round(one.confidence, 2),
        }
        for number, one in enumerate(found, 1)
    ]


def difference_geojson(
    found: Sequence[CloudChange], lattice: Lattice, georeference: Mapping[str, str], told: Sequence[str]
) -> dict[str, Any]:
    """A FeatureCollection (RFC 7946) of the footprints: in longitude and latitude where map A knows its place on Earth,
    else in A's metres; its member "frame" says which. ``told``: sentences on the registration."""
    frame = frame_of(georeference)
    origin = np.array([lattice.x0, lattice.y0])
    features = []
    for row, one in zip(difference_rows(found), found, strict=True):
        polygons = [[np.round(ring * CELL_SIZE + origin, 3).tolist() for ring in polygon] for polygon in one.outline]
        geometry = {"type": "MultiPolygon", "coordinates": polygons}
        if not frame.is_local:
            rings_to_lonlat(geometry, frame)
        features.append({"type": "Feature", "id": row.pop("id"), "geometry": geometry, "properties": row})
    return {
        "type": "FeatureCollection",
        "frame": MAP_METRES if frame.is_local else "WGS 84 longitude, latitude",
        "registration": list(told),
        "features": features,
    }


def difference_page(title: str, found: Sequence[CloudChange], map_a: PointMap, map_b: PointMap) -> str:
    """HTML of the largest things that are gone or new, with both clouds around them; a file that needs nothing else.

    What both clouds have (a point of B within a voxel of one of A) is drawn as A's. ``map_b`` lies in A's frame.
    """
    shown = sorted((one for one in found if one.kind != "not seen"), key=lambda one: -one.area_m2)[:_ON_PAGE]
    after: dict[TileIndex, Tile] = {}

    def tile_after(index: TileIndex) -> Tile:
        if index not in after:
            after[index] = _both(map_a.tile(index), map_b.tile(index))
        return after[index]

    cutouts = [
        cut_out(
            f"{one.kind} at {0.5 * (one.box[0] + one.box[2]):.0f}, {0.5 * (one.box[1] + one.box[3]):.0f}",
            f"{one.area_m2:.1f} m², {one.height_m:.1f} m high, {one.points} points; confidence {one.confidence:.2f}",
            one.box,
            one.height_m,
            (map_a.tile, tile_after),
            map_a.lattice,
        )
        for one in shown
    ]
    return whole_page(title, cutouts)


def _both(before: Tile, after: Tile) -> Tile:
    """The tile of b with a's points in place of those that a has as well."""
    if not len(before.points) or not len(after.points):
        return replace(after, fields={})
    kept = _has_near(before.points.astype(np.float64), after.points.astype(np.float64))
    own = ~_has_near(after.points.astype(np.float64), before.points.astype(np.float64))
    return replace(after, points=np.concatenate([before.points[kept], after.points[own]]), fields={})


def _has_near(points: F64, others: F64) -> Bool:
    return np.asarray(KDTree(others).query(points, distance_upper_bound=CELL_SIZE)[0] < CELL_SIZE)
