"""Changes, tiles and passes as collections of features, with what OGC API - Features asks of each: place, time, id.

OGC 17-069r4 (Part 1: Core) and 18-058r1 (Part 2: Coordinate Reference Systems).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from typing import Any

import msgspec
import numpy as np
import shapely
from shapely.geometry import mapping, shape

from mapvote.core.types import F64, MapvoteError
from mapvote.formats.geo.frame import MapFrame, frame_of, read_crs
from mapvote.shapes.geojson import tile_squares
from mapvote_server.errors import BadRequest
from mapvote_server.questions.changes import changes_between
from mapvote_server.questions.coverage import wanted_passes
from mapvote_server.questions.freshness import tiles_seen
from mapvote_server.store.store import Store

CRS84 = "http://www.opengis.net/def/crs/OGC/1.3/CRS84"
"""WGS 84, longitude before latitude: what every client knows."""
Features = list[dict[str, Any]]
"""GeoJSON features in map metres, each with an id."""


@dataclass(frozen=True, slots=True)
class Collection:
    """A kind of features."""

    title: str
    description: str
    features: Callable[[Store, bool, int, int], Features] | None
    """``(store, known, old, new)``: the features, as far as may be ``known``; None: the desk makes them."""
    for_reviewers: bool = False
    """Whether only reviewers and operators see it."""
    of_versions: bool = False
    """Whether it compares two versions."""


def _changes(store: Store, with_names: bool, old: int, new: int) -> Features:
    features: Features = msgspec.to_builtins(changes_between(store, old, new, with_names=with_names).features)
    return features


def _tiles(store: Store, with_names: bool, old: int, new: int) -> Features:
    rows = [asdict(tile) for tile in tiles_seen(store, with_names)]
    squares: Features = msgspec.to_builtins(tile_squares(rows, store.lattice).features)
    return [square | {"id": f"{row['row']},{row['col']}"} for square, row in zip(squares, rows, strict=True)]


def _seen(store: Store, with_names: bool, old: int, new: int) -> Features:
    return [tile for tile in _tiles(store, with_names, old, new) if tile["properties"]["vehicles"]]


def _passes(store: Store, with_names: bool, old: int, new: int) -> Features:
    lines: Features = msgspec.to_builtins(wanted_passes(store).features)
    return [line | {"id": str(number)} for number, line in enumerate(lines, 1)]


COLLECTIONS: Mapping[str, Collection] = {
    "changes": Collection(
        "Changes", "What was built and demolished between two versions (from, to)", _changes, of_versions=True
    ),
    "pending": Collection("Pending changes", "What a publish would change now", None, for_reviewers=True),
    "coverage": Collection("Coverage", "Tiles that vehicles have seen, and when the last did", _seen),
    "passes": Collection(
        "Wanted passes", "Stretches of road where one more pass would decide cells", _passes, for_reviewers=True
    ),
    "tiles": Collection("Tiles", "All tiles of the map", _tiles),
}


@dataclass(frozen=True, slots=True)
class OnEarth:
    """The coordinate systems of a map's features."""

    frame: MapFrame

    @classmethod
    def of(cls, store: Store) -> OnEarth:
        """MapvoteError if nobody knows where on Earth the map lies: clients place features by degrees."""
        frame = frame_of(store.georeference)
        if frame.is_local:
            raise MapvoteError(
                "the map's place on Earth is unknown, so no OGC client can show it: import it with --crs or --projector"
            )
        return cls(frame)

    @property
    def systems(self) -> list[str]:
        """URIs of the systems that can be asked for; the last is the map's own."""
        code = re.fullmatch(r"EPSG:(\d+)", self.frame.crs)
        return [CRS84] if code is None else [CRS84, f"http://www.opengis.net/def/crs/EPSG/0/{code[1]}"]

    def out(self, xy: F64, crs: str) -> F64:
        """(n, 2) coordinates in a system of map metres (n, 2), in the order of its axes."""
        if crs == CRS84:
            return self.frame.plane_to_lonlat(xy)
        return np.round(xy + np.array(self.frame.offset_m)[:2], 3)[:, self._axes]

    def into(self, xy: F64, crs: str) -> F64:
        """(n, 2) map metres of coordinates (n, 2) in a system."""
        if crs == CRS84:
            return self.frame.plane_from_lonlat(xy)
        return xy[:, self._axes] - np.array(self.frame.offset_m)[:2]

    @property
    def _axes(self) -> list[int]:
        """The order of the axes that the map's own system states: north comes first in some."""
        return [1, 0] if read_crs(self.frame.crs).axis_info[0].direction == "north" else [0, 1]


def extent(features: Sequence[Mapping[str, Any]], place: OnEarth) -> list[float] | None:
    """[west, south, east, north] in degrees of all features; None without any."""
    if not features:
        return None
    bounds = shapely.total_bounds(np.array([shape(feature["geometry"]) for feature in features]))
    corners = np.array([[bounds[i], bounds[j]] for i in (0, 2) for j in (1, 3)])
    degrees = place.out(corners, CRS84)
    return [*degrees.min(axis=0).tolist(), *degrees.max(axis=0).tolist()]


def within(features: Sequence[dict[str, Any]], box: Sequence[float], place: OnEarth, crs: str) -> Features:
    """The features that a box meets: (x0, y0, x1, y1) in a system. BadRequest if it is none."""
    if len(box) not in (4, 6) or not np.isfinite(box).all():
        raise BadRequest("bbox needs four numbers, or six with heights")
    x0 = box[0]
    y0 = box[1]
    x1 = box[len(box) // 2]
    y1 = box[len(box) // 2 + 1]
    if y0 > y1 or (x0 > x1 and crs != CRS84):
        raise BadRequest("bbox: the lower corner comes first")
    # The edges of a box are curves in the map: it is cut into short ones.
    edge = shapely.segmentize(shapely.box(x0, y0, x1 if x1 >= x0 else x1 + 360.0, y1), max(abs(y1 - y0), 1e-9) / 8.0)
    metres = shapely.transform(edge, lambda xy: place.into(xy, crs))
    meets = shapely.intersects(metres, np.array([shape(feature["geometry"]) for feature in features], dtype=object))
    return [feature for feature, met in zip(features, np.atleast_1d(meets), strict=True) if met]


def during(features: Sequence[dict[str, Any]], interval: str) -> Features:
    """The features whose time meets an instant or an interval of RFC 3339 ("../..", "a/b"); those without one stay.

    BadRequest if the text is neither.
    """
    ends = interval.split("/")
    if len(ends) > 2:
        raise BadRequest("datetime is an instant or an interval A/B")
    low = _instant(ends[0], datetime.min.replace(tzinfo=UTC))
    high = _instant(ends[-1], datetime.max.replace(tzinfo=UTC))
    if low > high:
        raise BadRequest("datetime: the interval ends before it begins")

    def meets(feature: dict[str, Any]) -> bool:
        last = feature["properties"].get("last_seen")
        first = feature["properties"].get("first_seen") or last
        return last is None or (_instant(str(first), low) <= high and _instant(str(last), high) >= low)

    return [feature for feature in features if meets(feature)]


def _instant(text: str, unbounded: datetime) -> datetime:
    if text in ("", ".."):
        return unbounded
    try:
        moment = datetime.fromisoformat(text)
    except ValueError as error:
        raise BadRequest(f"datetime: {text[:40]!r} is no time of RFC 3339") from error
    return moment if moment.tzinfo else moment.replace(tzinfo=UTC)


def placed(feature: Mapping[str, Any], place: OnEarth, crs: str) -> dict[str, Any]:
    """A feature with its coordinates in a system."""
    geometry = shapely.transform(shape(feature["geometry"]), lambda xy: place.out(xy, crs))
    return dict(feature) | {"geometry": mapping(geometry)}
