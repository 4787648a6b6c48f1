"""Change objects and tiles as GeoJSON, and any list of the server as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely

from mapvote.core.grid import CELL_SIZE, TILE_CELLS, Lattice
from mapvote.core.record import record
from mapvote.core.times import utc
from mapvote.core.types import F64
from mapvote.formats.geo.frame import MapFrame, frame_of
from mapvote.shapes.change_objects import ChangeObject
from mapvote.shapes.outlines import Ring


def to_geojson(
    objects: Sequence[ChangeObject],
    lattice: Lattice,
    *,
    map_id: str,
    from_version: int | None = None,
    to_version: int | None = None,
    georeference: Mapping[str, str] | None = None,
    lonlat: bool = False,
    among: Sequence[ChangeObject] | None = None,
) -> dict[str, Any]:
    """The objects as a GeoJSON FeatureCollection (RFC 7946), ready for ``json.dumps``; its member "frame" says where
    coordinates lie.

    ``lonlat``: longitude and latitude, as the RFC wants them, where the map knows its place on Earth; else map metres.
    ``among``: the list of which the objects are a part, for what is near them; None: they are all.
    """
    frame = frame_of(georeference or {})
    near = _neighbours(objects, objects if among is None else among)
    features = [_feature(change, lattice, beside) for change, beside in zip(objects, near, strict=True)]
    if lonlat and not frame.is_local:
        for feature in features:
            rings_to_lonlat(feature["geometry"], frame)
    return {
        "type": "FeatureCollection",
        "frame": "WGS 84 longitude, latitude" if lonlat and not frame.is_local else f"{MAP_METRES}: {frame.told()}",
        "map_id": map_id,
        "georeference": dict(georeference or {}),
        "from_version": from_version,
        "to_version": to_version,
        "features": features,
    }


def rings_to_lonlat(geometry: dict[str, Any], frame: MapFrame) -> None:
    """Rings in map metres to degrees, in place. The sense of the rings stays."""
    polygons = [geometry["coordinates"]] if geometry["type"] == "Polygon" else geometry["coordinates"]
    for polygon in polygons:
        for i, ring in enumerate(polygon):
            polygon[i] = frame.plane_to_lonlat(np.array(ring)).tolist()


def as_csv(rows: Sequence[Mapping[str, Any]]) -> str:
    """Rows as CSV with a header; lists joined by spaces. Text that looks like a formula gets a quote."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    names = list(dict.fromkeys(name for row in rows for name in row))
    writer.writerow(names)
    writer.writerows([[_cell(row.get(name)) for name in names] for row in rows])
    return out.getvalue()


def feature_rows(collection: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The features of :func:`to_geojson` without their outlines, for a table."""
    return [{"id": f["id"]} | f["properties"] for f in collection["features"]]


def _cell(value: Any) -> Any:
    if isinstance(value, list | tuple):
        value = " ".join(map(str, value))
    return f"'{value}" if isinstance(value, str) and value[:1] in tuple("=+-@\t\r") else value


def _neighbours(objects: Sequence[ChangeObject], among: Sequence[ChangeObject]) -> list[list[str]]:
    """For each object the ids of other large things whose box is within 15 m, nearest first."""
    large = [other for other in among if other.size == "large"]
    boxes, others = (shapely.box(*np.array([o.box for o in some]).reshape(-1, 4).T) for some in (objects, large))
    here, there = shapely.STRtree(others).query(boxes, predicate="dwithin", distance=NEIGHBOUR_RULE.near_m / CELL_SIZE)
    distance_m = CELL_SIZE * shapely.distance(boxes[here], others[there])
    near: list[list[tuple[float, str]]] = [[] for _ in objects]
    for i, k, metres in zip(here.tolist(), there.tolist(), distance_m.tolist(), strict=True):
        if objects[i].id != large[k].id:
            near[i].append((metres, large[k].id))
    return [[name for _, name in sorted(one)][: NEIGHBOUR_RULE.listed] for one in near]


def _feature(change: ChangeObject, lattice: Lattice, near: list[str]) -> dict[str, Any]:
    polygons = [[_corners(ring, lattice) for ring in polygon] for polygon in change.outline]
    single = len(polygons) == 1
    facts = (
        *("kind", "size", "area_m2", "height_m", "volume_m3", "cells", "points", "votes_min", "votes_median"),
        *("against_median", "share_for", "probability", "trimmed", "fell"),
    )
    return {
        "type": "Feature",
        "id": change.id,
        "geometry": {
            "type": "Polygon" if single else "MultiPolygon",
            "coordinates": polygons[0] if single else polygons,
        },
        "properties": {name: _rounded(name, getattr(change, name)) for name in facts}
        | {
            "first_seen": utc(change.first_seen_ns),
            "last_seen": utc(change.last_seen_ns),
            "versions": change.versions,
            "box": _corners(np.reshape(change.box, (2, 2)), lattice),
            "near": near,
        },
    }


def _rounded(name: str, value: Any) -> Any:
    digits = {"area_m2": 2, "height_m": 2, "volume_m3": 2, "share_for": 3, "probability": 3}
    return value if value is None or name not in digits else round(value, digits[name])


def _corners(ring: Ring | F64, lattice: Lattice) -> list[list[float]]:
    metres = np.round(ring * CELL_SIZE + np.array([lattice.x0, lattice.y0]), 3) + 0.0  # + 0.0: no "-0.0" in the file
    corners: list[list[float]] = metres.tolist()
    return corners


@record()
@dataclass(frozen=True, slots=True)
class NeighbourRule:
    """Numbers of the neighbours that a change names."""

    near_m: float = 15.0
    """Distance up to which a change is a neighbour, metres."""
    listed: int = 5
    """Neighbours that are listed at most."""


NEIGHBOUR_RULE = NeighbourRule()
MAP_METRES = "map metres, not the longitude and latitude of RFC 7946"


def tile_squares(tiles: Sequence[Mapping[str, Any]], lattice: Lattice) -> dict[str, Any]:
    """Tiles (each with row and col) as GeoJSON polygons in map metres, with their values as properties."""
    side = TILE_CELLS * CELL_SIZE
    squares = []
    for tile in tiles:
        window = lattice.tile((tile["row"], tile["col"]))
        x, y, x1, y1 = (round(v, 3) for v in (window.x0, window.y0, window.x0 + side, window.y0 + side))
        ring = [[x, y], [x1, y], [x1, y1], [x, y1], [x, y]]
        squares.append(({"type": "Polygon", "coordinates": [ring]}, dict(tile)))
    return collection(squares)


def collection(things: Sequence[tuple[dict[str, Any], dict[str, Any]]]) -> dict[str, Any]:
    """Things in map metres, each (geometry, properties), as GeoJSON."""
    features = [{"type": "Feature", "geometry": geometry, "properties": properties} for geometry, properties in things]
    return {"type": "FeatureCollection", "frame": MAP_METRES, "features": features}
