"""Objects that only one of two clouds of one place and frame has: gone, new, and not seen by the other.

An object of one cloud is gone or new where the other cloud has no surface within two cells, and must have seen the
place. A map made of scans knows free space: it saw the place if half of the object's voxels are free in it. A
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
import scipy

from mapvote.compare.register import PATCHES, Registered
from mapvote.core.columns import rebased
from mapvote.core.geometry import transform
from mapvote.core.grid import CELL_SIZE, CELLS, Grid, Lattice, TileIndex
from mapvote.core.groups import widened
from mapvote.core.point_map import SCANS, PointMap, all_points, has_open_ground
from mapvote.core.record import record
from mapvote.core.reference import above_ground_points, reference_window
from mapvote.core.tile import Tile
from mapvote.core.types import F32, F64, I32, I64, U64, Bool, MapvoteError
from mapvote.formats.geo.frame import frame_of
from mapvote.shapes.cutout import cut_out, whole_page
from mapvote.shapes.geojson import MAP_METRES, rings_to_lonlat
from mapvote.shapes.outlines import Ring, group, pieces, rings

Kind = Literal["gone", "new", "not seen"]
BAND = np.uint64(0b1_1111_1100)
"""The voxels 0.6 to 2.7 m above the layer of the ground: lower ones hold kerb, grass or a slope's error."""


@record()
@dataclass(frozen=True, slots=True)
class CloudComparison:
    """Numbers of the comparison of two clouds."""

    reach_cells: int = 2
    """Cells around an object within which the other cloud must have no surface."""
    ground_apart_m: float = 0.4
    """Height difference from which two grounds are not one ground: a roof, a car's floor, a second level."""
    explained_m: float = 0.45
    """Distance from the other cloud, under the motion of a bent patch, within which the bend explains a point."""
    voxels: int = 4
    """Occupied voxels that every object must have, as new objects of a drive must."""
    voxels_a_cell: int = 2
    """Further voxels for each cell of the object: one point a cell is the fringe of a survey or a trail."""
    voxels_enough: int = 80
    """Voxels that are enough for an object of any size."""
    walked_by: float = 8.0
    """Scans that hit a 0.3 m voxel while a walker of 0.5 m passes it at 1 m/s, at 10 Hz. An object whose cells were hit
    less often (median) is not listed; a standing surface in reach is hit by tens."""
    on_page: int = 12
    """Objects drawn on the page."""


CLOUD_COMPARISON = CloudComparison()


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
    """Points of the cloud that has it, in its cells and above the ground."""
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
    """Cells in which only one of two clouds has a surface, (rows, cols)."""

    changed: Bool
    """The other cloud saw the place, and has no surface there."""
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
    has_ground = np.isfinite(here.ground_z)
    beside = (above_ground_points(point_map, window) != 0) & has_ground
    own, has_rays = (np.zeros(window.shape, dtype=np.bool_) for _ in range(2))
    scans = np.full(window.shape, np.inf)
    for index in window.tiles():
        tile = point_map.tiles.get(index)
        if tile is None:
            continue
        common = tile.window.intersection(window)
        into = common.slices_in(window)
        cut = common.slices_in(tile.window)
        has_rays[into] = tile.free is not None and tile.free.any()
        scans[into] = _mean_scans(tile)[cut]
        own[into] = (np.bincount(tile.cells[~tile.columns[1]], minlength=CELLS) > 0).reshape(tile.window.shape)[cut]
    free = np.zeros_like(here.occupied) if here.free is None else here.free
    return CloudPlanes(
        here.ground_z, here.base, here.occupied, here.top_z, here.counts.astype(np.float64), own & has_ground, beside,
        free, has_rays, scans,
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


def compare_cells(
    map_a: PointMap,
    map_b: PointMap,
    registered: Registered | None = None,
    numbers: CloudComparison = CLOUD_COMPARISON,
) -> CellComparison:
    """Maps of one lattice and frame, cell by cell. ``registered``: how b came there; its bent parts are left out.

    MapvoteError if they do not overlap, or if one of them has no ground.
    """
    window = reduce(Grid.union, (map_a.lattice.tile(tile) for tile in sorted({*map_a.tiles, *map_b.tiles})))
    a = planes_of(map_a, window)
    b = planes_of(map_b, window)
    for name, one in (("A", map_a), ("B", map_b)):
        if not has_open_ground(one):
            raise MapvoteError(
                f"{name} has no ground: the places that it saw are unknown, so whether an object is gone, new or not "
                "seen cannot be decided by geometry alone"
            )
    # Cells with two levels of ground (measured, not filled in), and cells in which only one cloud has a surface.
    apart = (np.abs(a.ground_z - b.ground_z) > numbers.ground_apart_m) & a.own_ground & b.own_ground
    alone = [own.low & ~_hangs(own) & ~widened(other.low, numbers.reach_cells) for own, other in ((a, b), (b, a))]
    # Bent parts, and points that the bend explains.
    left_out = np.zeros(window.shape, dtype=np.bool_)
    if registered is not None:
        rows, cols = np.nonzero(alone[0] | alone[1])
        x, y = window.centres()
        left_out[rows, cols] = ~registered.compared(np.column_stack([x[cols], y[rows]]))
        left_out |= _explained(alone, left_out, (map_a, map_b), window, registered, numbers.explained_m)
    # Whether the other cloud saw the place.
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


def _explained(
    alone: list[Bool],
    left_out: Bool,
    maps: tuple[PointMap, PointMap],
    window: Grid,
    registered: Registered,
    explained_m: float,
) -> Bool:
    """(rows, cols) cells of which half of the points fit the other cloud under the motion of a bent patch near them.
    ``alone``: cells of surfaces that only a has, and that only b has."""
    out = np.zeros(window.shape, dtype=np.bool_)
    motions = [] if registered.unbent else registered.other_motions()
    if not motions:
        return out
    clouds = [all_points(one) for one in maps]
    for k, cells in enumerate(alone):
        # The points of one cloud that fit the other one under any of the motions.
        points = clouds[k][window.value_at(cells & ~left_out, clouds[k])]
        fits = np.zeros(len(points), dtype=np.bool_)
        for centre, T in motions:  # T moves b's points
            others = clouds[1 - k][_near(clouds[1 - k], centre)]
            here = np.flatnonzero(_near(points, centre) & ~fits)
            if not len(others) or not len(here):
                continue
            at, others = (points[here], transform(T, others)) if k == 0 else (transform(T, points[here]), others)
            fits[here] = scipy.spatial.KDTree(others).query(at, distance_upper_bound=explained_m)[0] < explained_m
        # The share of them in each cell.
        rows, cols, _ = window.indices_of(points)
        total = np.zeros(window.shape)
        explained = np.zeros(window.shape)
        np.add.at(total, (rows, cols), 1.0)
        np.add.at(explained, (rows[fits], cols[fits]), 1.0)
        out |= (total > 0) & (explained >= 0.5 * total)
    return out


def _near(points: F64, centre: F64) -> Bool:
    return np.asarray((np.abs(points[:, :2] - centre) < PATCHES.side_m).all(axis=1))


def differences(
    compared: CellComparison, min_m2: float = 0.5, numbers: CloudComparison = CLOUD_COMPARISON
) -> list[CloudChange]:
    """Objects of at least ``min_m2`` that only one cloud has: gone and new by area, then those not seen."""
    out = [
        *_objects(compared, "gone", "a", min_m2, numbers),
        *_objects(compared, "new", "b", min_m2, numbers),
        *_objects(compared, "not seen", "a", min_m2, numbers),
        *_objects(compared, "not seen", "b", min_m2, numbers),
    ]
    return sorted(out, key=lambda one: (one.kind == "not seen", -one.area_m2))


def _objects(
    compared: CellComparison, kind: Kind, has: Literal["a", "b"], min_m2: float, numbers: CloudComparison
) -> list[CloudChange]:
    """The objects of one kind that one cloud has."""
    a = compared.a
    b = compared.b
    owner, other, side = (a, b, compared.only_a) if has == "a" else (b, a, compared.only_b)
    cells = side.not_seen if kind == "not seen" else side.changed
    rows, cols = (indices.astype(np.int64) for indices in np.nonzero(cells))
    if not len(rows):
        return []
    window = compared.window
    # Cells that hang together, and their outlines.
    kinds = np.zeros(len(rows), dtype=np.int64)
    hang_together = pieces(rows, cols, kinds)
    things = group(rows, cols, kinds, hang_together.objects)
    outlines = rings(rows + window.row0, cols + window.col0, hang_together.polygons)
    # Each object with enough area, voxels and scans.
    ground = np.where(np.isfinite(owner.ground_z), owner.ground_z, other.ground_z)
    height = (owner.top_z - ground)[rows, cols]
    x, y = (centres - 0.5 * CELL_SIZE for centres in window.centres())
    out = []
    for of_object in np.split(np.argsort(things, kind="stable"), np.cumsum(np.bincount(things))[:-1]):
        area_m2 = len(of_object) * CELL_SIZE**2
        if area_m2 < min_m2 - 1e-9:
            continue
        r = rows[of_object]
        c = cols[of_object]
        voxels = int(np.bitwise_count(owner.words[r, c]).sum())
        needed = min(numbers.voxels + numbers.voxels_a_cell * len(of_object), numbers.voxels_enough)
        if kind != "not seen" and voxels < needed:
            continue
        if kind != "not seen" and np.median(owner.scans[r, c]) < numbers.walked_by:
            continue
        points = int(owner.counts[r, c].sum())
        out.append(
            CloudChange(
                kind,
                [outlines[p] for p in np.unique(hang_together.polygons[of_object])],
                area_m2,
                float(np.nanmax(height[of_object], initial=0.0)),
                points,
                (float(x[c.min()]), float(y[r.min()]), float(x[c.max()] + CELL_SIZE), float(y[r.max()] + CELL_SIZE)),
                float(side.sure[r, c].mean()) if kind != "not seen" else 0.0,
                has,
                (r, c),
            )
        )
    return out


def difference_rows(changes: Sequence[CloudChange]) -> list[dict[str, Any]]:
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
        for number, one in enumerate(changes, 1)
    ]


def difference_geojson(
    changes: Sequence[CloudChange], lattice: Lattice, georeference: Mapping[str, str], registration: Sequence[str]
) -> dict[str, Any]:
    """A FeatureCollection (RFC 7946) of the footprints: in longitude and latitude where map A knows its place on Earth,
    else in A's metres; its member "frame" says which. ``registration``: sentences on it."""
    frame = frame_of(georeference)
    origin = np.array([lattice.x0, lattice.y0])
    features = []
    for row, one in zip(difference_rows(changes), changes, strict=True):
        polygons = [[np.round(ring * CELL_SIZE + origin, 3).tolist() for ring in polygon] for polygon in one.outline]
        if not frame.is_local:
            rings_to_lonlat(polygons, frame)
        geometry = {"type": "MultiPolygon", "coordinates": polygons}
        features.append({"type": "Feature", "id": row.pop("id"), "geometry": geometry, "properties": row})
    return {
        "type": "FeatureCollection",
        "frame": MAP_METRES if frame.is_local else "WGS 84 longitude, latitude",
        "registration": list(registration),
        "features": features,
    }


def difference_page(title: str, changes: Sequence[CloudChange], map_a: PointMap, map_b: PointMap) -> str:
    """HTML of the largest objects that are gone or new, with both clouds around them; a file that needs nothing else.

    Points of B within a voxel of one of A are drawn as A's. ``map_b`` lies in A's frame.
    """
    seen = sorted((one for one in changes if one.kind != "not seen"), key=lambda one: -one.area_m2)
    shown = seen[: CLOUD_COMPARISON.on_page]
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
    return np.asarray(scipy.spatial.KDTree(others).query(points, distance_upper_bound=CELL_SIZE)[0] < CELL_SIZE)
