"""Differences between two clouds as rows, GeoJSON and a page with both clouds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from mapvote.comparison.cloud_changes import CloudChange
from mapvote.core.grid import CELL_SIZE, Lattice, TileIndex
from mapvote.core.point_map import PointMap
from mapvote.core.tile import Tile
from mapvote.core.types import F64, Bool
from mapvote.formats.geo.frame import frame_of
from mapvote.server.views.cutout import cut_out, whole_page
from mapvote.server.views.geojson import MAP_METRES, rings_to_lonlat

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
