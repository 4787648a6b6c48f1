"""Changes, tiles and passes as collections of features, with what OGC API - Features asks of each: place, time, id.

OGC 17-069r4 (Part 1: Core) and 18-058r1 (Part 2: Coordinate Reference Systems).
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, date, datetime, time
from typing import Any

import msgspec
import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import mapping, shape

from mapvote.codec.ballot import tile_key
from mapvote.core.grid import CELL_SIZE, TILE_CELLS, Lattice
from mapvote.core.types import F64, MapvoteError
from mapvote.formats.geo.frame import MapFrame, frame_of, read_crs
from mapvote.shapes.geojson import tile_squares
from mapvote_server.errors import BadRequest
from mapvote_server.questions.changes import changes_between
from mapvote_server.questions.coverage import wanted_passes
from mapvote_server.questions.freshness import CoveredTile, tiles_seen
from mapvote_server.store.store import Store

CRS84 = "http://www.opengis.net/def/crs/OGC/1.3/CRS84"
"""WGS 84, longitude before latitude: what every client knows."""
Shapes = NDArray[np.object_]
"""Shapely geometries."""
Features = list[dict[str, Any]]
"""GeoJSON features in map metres, each with an id."""


class Source(ABC):
    """All features of a collection in their order, of which only those of a page are made."""

    @abstractmethod
    def __len__(self) -> int:
        """Number of features."""

    @abstractmethod
    def shapes(self) -> Shapes:
        """(n,) their shapes, map metres."""

    @abstractmethod
    def times(self, position: int) -> tuple[str | None, str | None]:
        """When the feature at a position was first and last seen; None where unknown."""

    @abstractmethod
    def made(self, positions: Sequence[int]) -> Features:
        """The features at some positions."""

    @abstractmethod
    def named(self, feature_id: str) -> Features:
        """The feature of this id, as the only one; none without it."""


@dataclass(frozen=True, slots=True)
class Whole(Source):
    """Features that are there already: a question makes all of them at once, and keeps them."""

    features: Features

    def __len__(self) -> int:
        return len(self.features)

    def shapes(self) -> Shapes:
        return np.array([shape(feature["geometry"]) for feature in self.features], dtype=object)

    def times(self, position: int) -> tuple[str | None, str | None]:
        about = self.features[position]["properties"]
        return about.get("first_seen"), about.get("last_seen")

    def made(self, positions: Sequence[int]) -> Features:
        return [self.features[position] for position in positions]

    def named(self, feature_id: str) -> Features:
        return [feature for feature in self.features if feature["id"] == feature_id]


@dataclass(frozen=True, slots=True)
class TileSquares(Source):
    """Tiles in ascending order: of a city's 28,000 a page shows some."""

    tiles: Sequence[CoveredTile]
    lattice: Lattice

    def __len__(self) -> int:
        return len(self.tiles)

    def shapes(self) -> Shapes:
        side_m = TILE_CELLS * CELL_SIZE
        places = np.array([(tile.col, tile.row) for tile in self.tiles], dtype=np.float64).reshape(-1, 2)
        low = places * side_m + (self.lattice.x0, self.lattice.y0)
        squares: Shapes = shapely.box(*low.T, *(low + side_m).T)
        return squares

    def times(self, position: int) -> tuple[str | None, str | None]:
        return None, self.tiles[position].last_seen

    def made(self, positions: Sequence[int]) -> Features:
        rows = [asdict(self.tiles[position]) for position in positions]
        squares: Features = msgspec.to_builtins(tile_squares(rows, self.lattice).features)
        return [square | {"id": tile_key((row["row"], row["col"]))} for square, row in zip(squares, rows, strict=True)]

    def named(self, feature_id: str) -> Features:
        if not re.fullmatch(r"-?\d{1,9},-?\d{1,9}", feature_id, re.ASCII):
            return []
        row, col = map(int, feature_id.split(","))
        at = bisect_left(self.tiles, (row, col), key=lambda tile: (tile.row, tile.col))
        return [feature for feature in self.made(range(at, min(at + 1, len(self)))) if feature["id"] == feature_id]


@dataclass(frozen=True, slots=True)
class Collection:
    """A kind of features."""

    title: str
    description: str
    features: Callable[[Store, bool, int, int], Source] | None
    """``(store, known, old, new)``: the features, as far as may be ``known``; None: the desk makes them."""
    for_reviewers: bool = False
    """Whether only reviewers and operators see it."""
    of_versions: bool = False
    """Whether it compares two versions."""
    on_tiles: bool = True
    """Whether every feature lies on tiles of the map or of ballots."""


def _changes(store: Store, with_names: bool, old: int, new: int) -> Source:
    return Whole(msgspec.to_builtins(changes_between(store, old, new, with_names=with_names).features))


def _tiles(store: Store, with_names: bool, old: int, new: int) -> Source:
    return TileSquares(tiles_seen(store, with_names), store.lattice)


def _seen(store: Store, with_names: bool, old: int, new: int) -> Source:
    return TileSquares([tile for tile in tiles_seen(store, with_names) if tile.vehicles], store.lattice)


def _passes(store: Store, with_names: bool, old: int, new: int) -> Source:
    lines: Features = msgspec.to_builtins(wanted_passes(store).features)
    return Whole([line | {"id": str(number)} for number, line in enumerate(lines, 1)])


COLLECTIONS: Mapping[str, Collection] = {
    "changes": Collection(
        "Changes", "What was built and demolished between two versions (from, to)", _changes, of_versions=True
    ),
    "pending": Collection("Pending changes", "What a publish would change now", None, for_reviewers=True),
    "coverage": Collection("Coverage", "Tiles that vehicles have seen, and when the last did", _seen),
    "passes": Collection(
        "Wanted passes",
        "Stretches of road where one more pass would decide cells",
        _passes,
        for_reviewers=True,
        on_tiles=False,
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


def extent_of(store: Store, place: OnEarth) -> list[float]:
    """[west, south, east, north] in degrees of all tiles, west > east over the date line."""
    tiles = TileSquares(tiles_seen(store, False), store.lattice)
    west, south, east, north = _bounds_in(shapely.total_bounds(tiles.shapes()), place, CRS84).round(8).tolist()
    return [(west + 180.0) % 360.0 - 180.0, south, (east + 180.0) % 360.0 - 180.0, north]


def within(source: Source, box: Sequence[float], place: OnEarth, crs: str) -> list[int]:
    """Positions of the features that a box meets: (x0, y0, x1, y1) in a system. BadRequest if it is none."""
    if len(box) not in (4, 6) or not np.isfinite(box).all():
        raise BadRequest("bbox needs four numbers, or six with heights")
    half = len(box) // 2
    low = np.array(box[:half])
    high = np.array(box[half:])
    over_date_line = crs == CRS84 and low[0] > high[0]
    if (low > high)[1 if over_date_line else 0 :].any():
        raise BadRequest("bbox: the lower corner comes first")
    if not len(source):
        return []
    high[0] += 360.0 if over_date_line else 0.0
    shapes = source.shapes()
    bounds = _bounds_in(shapely.total_bounds(shapes), place, crs)
    area = _area(np.array([low[:2], high[:2]]), bounds, place, crs)
    shapely.prepare(area)
    positions: list[int] = np.flatnonzero(shapely.intersects(area, shapes)).tolist()
    return positions


def _bounds_in(bounds_m: F64, place: OnEarth, crs: str) -> F64:
    """(4,) [x0, y0, x1, y1] in a system around a box (4,) of map metres. Longitudes are continuous: over the date line
    they go on above 180 degrees."""
    xy = place.out(shapely.get_coordinates(_box(bounds_m[:2], bounds_m[2:])), crs)
    if crs == CRS84:
        xy[:, 0] = (xy[:, 0] - xy[0, 0] + 180.0) % 360.0 - 180.0 + xy[0, 0]
    return np.array([*xy.min(axis=0), *xy.max(axis=0)])


def _area(corners: F64, bounds: F64, place: OnEarth, crs: str) -> shapely.Geometry:
    """The part of a box with these corners (2, 2) that lies near ``bounds`` (4,), both in a system, in map metres: far
    away a projection knows no coordinates. Its edges are curves in the map, so they are cut into short ones."""
    margin = 0.1 * (bounds[2:] - bounds[:2]) + 1e-6
    parts = []
    for turn in (-360.0, 0.0, 360.0) if crs == CRS84 else (0.0,):
        low = np.maximum(corners[0] + (turn, 0.0), bounds[:2] - margin)
        high = np.minimum(corners[1] + (turn, 0.0), bounds[2:] + margin)
        if (low <= high).all():
            parts.append(_box(low, high))
    return shapely.transform(shapely.union_all(parts), lambda xy: place.into(xy, crs))


def _box(low: F64, high: F64) -> shapely.Geometry:
    """The box between two corners (2,), its edges in pieces; a line or a point if it has no area."""
    corners = [low, (low[0], high[1]), high, (high[0], low[1])]
    return shapely.segmentize(shapely.convex_hull(shapely.multipoints(corners)), max(*(high - low), 1e-9) / 8.0)


def during(source: Source, positions: Sequence[int], interval: str) -> list[int]:
    """Those ``positions`` whose feature's time meets an instant or an interval of RFC 3339 ("../..", "a/b"); features
    without one stay. A date alone is its whole day.

    BadRequest if the text is neither.
    """
    ends = interval.split("/")
    if len(ends) > 2 or not interval:
        raise BadRequest("datetime is an instant or an interval A/B")
    open_end = "" if len(ends) == 1 else ".."
    low = datetime.min.replace(tzinfo=UTC) if ends[0] in ("", open_end) else _instant(ends[0], time.min)
    high = datetime.max.replace(tzinfo=UTC) if ends[-1] in ("", open_end) else _instant(ends[-1], time.max)
    if low > high:
        raise BadRequest("datetime: the interval ends before it begins")

    def meets(position: int) -> bool:
        first, last = source.times(position)
        return last is None or (datetime.fromisoformat(first or last) <= high and datetime.fromisoformat(last) >= low)

    return [position for position in positions if meets(position)]


_TIME = re.compile(
    r"([0-9]{4}-[0-9]{2}-[0-9]{2})(?:(T[0-9]{2}:[0-9]{2}:)([0-9]{2})(\.[0-9]+)?(Z|[+-][0-9]{2}:[0-9]{2}))?"
)


def _instant(text: str, time_of_day: time) -> datetime:
    """A time of RFC 3339, a leap second as the end of the second before; of a date alone, that ``time_of_day``, UTC."""
    parts = _TIME.fullmatch(text.upper())
    try:
        day, hours, seconds, fraction, zone = parts.groups("") if parts else ("", "", "", "", "")
        if not hours:
            return datetime.combine(date.fromisoformat(day), time_of_day, UTC)
        if seconds == "60":
            seconds = "59"
            fraction = ".999999"
        return datetime.fromisoformat(f"{day}{hours}{seconds}{fraction}{zone}")
    except ValueError as error:
        raise BadRequest(f"datetime: {text[:40]!r} is no time of RFC 3339, such as 2026-11-27T12:00:00Z") from error


def placed(feature: Mapping[str, Any], place: OnEarth, crs: str) -> dict[str, Any]:
    """A feature with its coordinates in a system."""
    counterclockwise = shapely.orient_polygons(shape(feature["geometry"]))  # RFC 7946, 3.1.6
    geometry = shapely.transform(counterclockwise, lambda xy: place.out(xy, crs))
    return dict(feature) | {"geometry": mapping(geometry)}
