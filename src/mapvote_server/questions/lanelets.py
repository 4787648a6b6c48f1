"""The parts of a lanelet2 map near changes, for the page and for editors of HD maps."""

from __future__ import annotations

import io
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import shapely
from shapely.geometry import shape

from mapvote.formats.geo.frame import frame_of
from mapvote.formats.geo.lanelet2 import read_lanelets
from mapvote.shapes.affected import ChangedPlaces, affected_parts, affected_rows
from mapvote.shapes.geojson import MAP_METRES, Changes, Geometry, PlacedFeature, Places


def lanelets_near(changes: Changes, osm: bytes, within_m: float) -> Places:
    """The parts of a lanelet2 file within ``within_m`` of ``changes`` in map metres, as GeoJSON in map metres.

    Properties as :func:`mapvote.shapes.affected.affected_rows`. MapvoteError if it is no lanelet2 map, or has no
    coordinates in the map's frame.
    """
    frame = frame_of(changes.georeference)
    ids = [feature.id for feature in changes.features]
    kinds = [feature.properties.kind for feature in changes.features]
    shapes = [shape(asdict(feature.geometry)) for feature in changes.features]
    places = ChangedPlaces(ids, [str(kind) for kind in kinds], shapes, frame)
    parts = read_lanelets(Path("lanelet2 map"), frame, io.BytesIO(osm)).parts
    near = affected_parts(parts, places, within_m)
    features = []
    for one, row in zip(near, affected_rows(near, places), strict=True):
        geometry = json.loads(shapely.to_geojson(_drawn(one.part.shape)))
        features.append(PlacedFeature("Feature", Geometry(geometry["type"], geometry["coordinates"]), row))
    return Places("FeatureCollection", f"{MAP_METRES}: {frame.told()}", features)


def _drawn(part: Any) -> Any:
    """A shape as a geometry of one kind: of a lanelet that crosses itself, its areas."""
    pieces = shapely.get_parts(part)
    areas = [piece for piece in pieces if piece.area > 0.0]
    return shapely.union_all(areas) if areas else pieces[0]
