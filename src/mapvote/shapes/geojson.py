"""Change objects and tiles as GeoJSON (RFC 7946), and any list of the server as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Annotated, Any, Literal

import numpy as np
import shapely
from pydantic import Field

from mapvote.core.answers import answer
from mapvote.core.grid import CELL_SIZE, TILE_CELLS, Lattice
from mapvote.core.record import record
from mapvote.core.times import utc
from mapvote.core.types import F64
from mapvote.formats.geo.frame import MapFrame, frame_of
from mapvote.shapes.change_objects import ChangeObject, Kind, Size
from mapvote.shapes.outlines import Ring

Bounds = tuple[float, float, float, float]
"""Lowest x and y, highest x and y, map metres."""


@answer
@dataclass(frozen=True, slots=True)
class Geometry:
    """A geometry of RFC 7946."""

    type: Literal["Point", "LineString", "Polygon", "MultiPolygon"]
    coordinates: list[Any]


@answer
@dataclass(frozen=True, slots=True)
class ChangeFacts:
    """One thing that was built or demolished."""

    kind: Kind
    size: Size
    area_m2: float
    height_m: float
    volume_m3: Annotated[float, Field(description="of its columns")]
    cells: int
    points: int
    votes_min: int
    votes_median: float
    against_median: float
    share_for: float | None
    probability: Annotated[float | None, Field(description="mean over its cells that each of them changed")]
    trimmed: Annotated[
        int, Field(description="of its cells those that stand and lost only some voxels, beside what stays")
    ]
    fell: Annotated[
        int, Field(description="of its cells those whose points fell with the others', because nothing holds them")
    ]
    first_seen: str | None
    last_seen: str | None
    versions: list[int]
    box: list[list[float]]
    near: Annotated[list[str], Field(description="ids of large things within 15 m")]


@answer
@dataclass(frozen=True, slots=True)
class ChangeFeature:
    """GeoJSON."""

    type: Literal["Feature"]
    id: str
    geometry: Geometry
    properties: ChangeFacts


@answer
@dataclass(frozen=True, slots=True)
class ChangeCollection:
    """GeoJSON; ``frame`` says what its coordinates are."""

    type: Literal["FeatureCollection"]
    frame: str
    map_id: str
    georeference: dict[str, str]
    from_version: int | None
    to_version: int | None


@answer
@dataclass(frozen=True, slots=True)
class Changes(ChangeCollection):
    """The differences between two versions."""

    features: list[ChangeFeature]
    numberMatched: int
    """of all that were asked for (OGC API Features)"""
    numberReturned: int
    """of those here"""
    damaged: list[str] | None = None
    """tiles that cannot be read"""


@answer
@dataclass(frozen=True, slots=True)
class PlacedFeature:
    """GeoJSON."""

    type: Literal["Feature"]
    geometry: Geometry
    properties: dict[str, Any]


@answer
@dataclass(frozen=True, slots=True)
class Places:
    """GeoJSON in map metres."""

    type: Literal["FeatureCollection"]
    frame: str
    features: list[PlacedFeature]


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
) -> Changes:
    """The objects as a GeoJSON FeatureCollection (RFC 7946), ready for ``msgspec.json.encode``; its member "frame" says
    where coordinates lie.

    ``lonlat``: longitude and latitude, as the RFC wants them, where the map knows its place on Earth; else map metres.
    ``among``: the list of which the objects are a part, for what is near them; None: they are all.
    """
    frame = frame_of(georeference or {})
    every = objects if among is None else among
    in_degrees = lonlat and not frame.is_local
    near = _neighbours(objects, every)
    features = [
        _feature(change, lattice, beside, frame if in_degrees else None)
        for change, beside in zip(objects, near, strict=True)
    ]
    return Changes(
        type="FeatureCollection",
        frame="WGS 84 longitude, latitude" if in_degrees else f"{MAP_METRES}: {frame.told()}",
        map_id=map_id,
        georeference=dict(georeference or {}),
        from_version=from_version,
        to_version=to_version,
        features=features,
        numberMatched=len(every),
        numberReturned=len(features),
    )


def rings_to_lonlat(polygons: list[list[Any]], frame: MapFrame) -> None:
    """The rings of polygons in map metres to degrees, in place. The sense of the rings stays."""
    for polygon in polygons:
        polygon[:] = [frame.plane_to_lonlat(np.array(ring)).tolist() for ring in polygon]


def as_csv(rows: Sequence[Mapping[str, Any]]) -> str:
    """Rows as CSV with a header; lists joined by spaces. Text that looks like a formula gets a quote."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    names = list(dict.fromkeys(name for row in rows for name in row))
    writer.writerow(names)
    writer.writerows([[_cell(row.get(name)) for name in names] for row in rows])
    return out.getvalue()


def feature_rows(features: Sequence[ChangeFeature]) -> list[dict[str, Any]]:
    """Features without their outlines, for a table."""
    return [{"id": feature.id} | members_of(feature.properties) for feature in features]


def members_of(answer: Any) -> dict[str, Any]:
    """The members of a dataclass by name, none of them copied."""
    return {member.name: getattr(answer, member.name) for member in fields(answer)}


def _cell(value: Any) -> Any:
    if isinstance(value, list | tuple):
        value = " ".join(map(str, value))
    return f"'{value}" if isinstance(value, str) and value[:1] in tuple("=+-@\t\r") else value


def _neighbours(objects: Sequence[ChangeObject], among: Sequence[ChangeObject]) -> list[list[str]]:
    """For each object the ids of other large things whose box is within 15 m, nearest first."""
    large = [other for other in among if other.size == "large"]
    boxes, others = (shapely.box(*np.array([o.box for o in group]).reshape(-1, 4).T) for group in (objects, large))
    here, there = shapely.STRtree(others).query(boxes, predicate="dwithin", distance=NEIGHBOUR_RULE.near_m / CELL_SIZE)
    distance_m = CELL_SIZE * shapely.distance(boxes[here], others[there])
    near: list[list[tuple[float, str]]] = [[] for _ in objects]
    for i, k, metres in zip(here.tolist(), there.tolist(), distance_m.tolist(), strict=True):
        if objects[i].id != large[k].id:
            near[i].append((metres, large[k].id))
    return [[name for _, name in sorted(one)][: NEIGHBOUR_RULE.listed] for one in near]


def _feature(change: ChangeObject, lattice: Lattice, near: list[str], frame: MapFrame | None) -> ChangeFeature:
    """``frame``: of the degrees that its outline is in; None: map metres."""
    polygons = [[_corners(ring, lattice) for ring in polygon] for polygon in change.outline]
    if frame is not None:
        rings_to_lonlat(polygons, frame)
    single = len(polygons) == 1
    outline = Geometry("Polygon", polygons[0]) if single else Geometry("MultiPolygon", polygons)
    return ChangeFeature("Feature", change.id, outline, _facts(change, lattice, near))


def _facts(change: ChangeObject, lattice: Lattice, near: list[str]) -> ChangeFacts:
    here: dict[str, Any] = {
        "first_seen": utc(change.first_seen_ns),
        "last_seen": utc(change.last_seen_ns),
        "box": _corners(np.reshape(change.box, (2, 2)), lattice),
        "near": near,
    }
    own = [member.name for member in fields(ChangeFacts) if member.name not in here]
    return ChangeFacts(**{name: _rounded(name, getattr(change, name)) for name in own}, **here)


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


def tile_squares(tiles: Sequence[Mapping[str, Any]], lattice: Lattice) -> Places:
    """Tiles (each with row and col) as GeoJSON polygons in map metres, with their values as properties."""
    side = TILE_CELLS * CELL_SIZE
    squares = []
    for tile in tiles:
        window = lattice.tile((tile["row"], tile["col"]))
        x, y, x1, y1 = (round(v, 3) for v in (window.x0, window.y0, window.x0 + side, window.y0 + side))
        ring = [[x, y], [x1, y], [x1, y1], [x, y1], [x, y]]
        squares.append(PlacedFeature("Feature", Geometry("Polygon", [ring]), dict(tile)))
    return places(squares)


def places(features: list[PlacedFeature]) -> Places:
    """Features in map metres as GeoJSON."""
    return Places("FeatureCollection", MAP_METRES, features)


def meet(one: Bounds, other: Bounds) -> bool:
    """Whether two boxes share a point."""
    return one[0] <= other[2] and other[0] <= one[2] and one[1] <= other[3] and other[1] <= one[3]


def bounds_of(geometry: Geometry) -> Bounds:
    """The box around a geometry in map metres."""
    corners = geometry.coordinates
    while isinstance(corners[0], list) and isinstance(corners[0][0], list):
        corners = [corner for ring in corners for corner in ring]
    xy = np.reshape(corners, (-1, len(corners[0]) if isinstance(corners[0], list) else len(corners)))[:, :2]
    x0, y0 = xy.min(axis=0).tolist()
    x1, y1 = xy.max(axis=0).tolist()
    return x0, y0, x1, y1
