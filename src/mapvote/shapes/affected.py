"""Lanelets, stop lines and signs near changes: the list of what an editor of an HD map has to look at."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import shapely
from shapely.geometry import shape

from mapvote.core.types import MapvoteError
from mapvote.formats.geo.frame import MapFrame, frame_of, utm_of
from mapvote.formats.geo.lanelet2 import MapPart
from mapvote.formats.reading import read_text
from mapvote.shapes.geojson import MAP_METRES

TAG = "mapvote:changes"
"""The tag of an affected part in the marked copy of a lanelet2 file."""


@dataclass(frozen=True, slots=True)
class ChangedPlaces:
    """The footprints of a GeoJSON file of changes, in the metres of ``frame``."""

    ids: list[str]
    kinds: list[str]
    shapes: list[Any]
    """shapely geometries, seen from above."""
    frame: MapFrame


@dataclass(frozen=True, slots=True)
class Affected:
    """A part of a lanelet2 map that lies near changes."""

    part: MapPart
    changes: list[int]
    """Indices of these changes, nearest first."""
    distance_m: float
    """Distance to the nearest one; 0 where it lies on the part."""


def read_changes(file: Path, frame: MapFrame | None = None) -> ChangedPlaces:
    """The footprints in the GeoJSON file that ``diff --out``, ``log`` and the server's ``/v1/changes`` write.

    ``frame``: the frame of the map, if the file does not state it; a local one measures map metres as they are. Changes
    in degrees without any frame are measured in their zone of UTM. MapvoteError if the file holds no changes.
    """
    try:
        collection = json.loads(read_text(file))
        features = collection["features"]
        shapes = [shape(feature["geometry"]) for feature in features]
        ids = [str(feature.get("id", number)) for number, feature in enumerate(features, 1)]
        kinds = [str((feature.get("properties") or {}).get("kind", "change")) for feature in features]
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError, shapely.errors.ShapelyError) as error:
        raise MapvoteError(f"{file}: no GeoJSON of changes ({error}); `mapvote diff --out` writes one") from error
    metres = str(collection.get("frame", "")).startswith(MAP_METRES)
    stated = frame_of(collection.get("georeference") or {})
    local_x_wanted = metres and frame is not None and frame.is_local
    frame = frame if frame is not None and (stated.is_local or local_x_wanted) else stated
    if metres:
        return ChangedPlaces(ids, kinds, shapes, frame)
    if shapes and frame.is_local:
        longitude, latitude = shapely.get_coordinates(shapes[0])[0].tolist()
        frame = MapFrame(utm_of(longitude, latitude))
    return ChangedPlaces(ids, kinds, [shapely.transform(one, frame.plane_from_lonlat) for one in shapes], frame)


def affected_parts(parts: Sequence[MapPart], changes: ChangedPlaces, within_m: float) -> list[Affected]:
    """The parts within ``within_m`` of a change, seen from above: by kind and distance."""
    part_of, change_of = shapely.STRtree(changes.shapes).query(
        [part.shape for part in parts], predicate="dwithin", distance=within_m
    )
    near: dict[int, list[tuple[float, int]]] = {}
    for k, i in zip(part_of.tolist(), change_of.tolist(), strict=True):
        near.setdefault(k, []).append((float(shapely.distance(parts[k].shape, changes.shapes[i])), i))
    affected = []
    for k, pairs in near.items():
        pairs.sort()
        affected.append(Affected(parts[k], [i for _, i in pairs], pairs[0][0]))
    return sorted(affected, key=lambda one: (one.part.kind, one.distance_m, one.part.id))


def affected_rows(affected: Sequence[Affected], changes: ChangedPlaces) -> list[dict[str, Any]]:
    """A row of a table for each part."""
    return [
        {
            "kind": one.part.kind,
            "subtype": one.part.subtype,
            "id": one.part.id,
            "distance_m": round(one.distance_m, 2),
            "changes": [changes.ids[i] for i in one.changes],
            "kinds": sorted({changes.kinds[i] for i in one.changes}),
        }
        for one in affected
    ]


def affected_geojson(affected: Sequence[Affected], changes: ChangedPlaces) -> dict[str, Any]:
    """The parts as a FeatureCollection (RFC 7946): longitude and latitude where the frame knows them, else metres."""
    frame = changes.frame
    features = []
    for one, row in zip(affected, affected_rows(affected, changes), strict=True):
        metres = one.part.shape
        geometry = metres if frame.is_local else shapely.transform(metres, frame.plane_to_lonlat)
        about = {"type": "Feature", "id": row.pop("id"), "geometry": json.loads(shapely.to_geojson(geometry))}
        features.append(about | {"properties": row})
    lies = f"{MAP_METRES}: {frame.told()}" if frame.is_local else "WGS 84 longitude, latitude"
    return {"type": "FeatureCollection", "frame": lies, "features": features}


def marked_osm(
    tree: ElementTree.ElementTree[ElementTree.Element], affected: Sequence[Affected], changes: ChangedPlaces
) -> str:
    """The lanelet2 file with a tag ``mapvote:changes`` on each affected part, and on no other: for JOSM or Vector Map
    Builder. The elements of ``tree`` are altered in place."""
    most_named = 8
    most_signs = 255  # of the value of a tag in OSM
    root = tree.getroot()
    for element in root.iter():
        for tag in [tag for tag in element.findall("tag") if tag.get("k") == TAG]:
            element.remove(tag)
    for one, row in zip(affected, affected_rows(affected, changes), strict=True):
        words = [f"{changes.kinds[i]} {changes.ids[i]}" for i in one.changes[:most_named]]
        more = [f"{len(one.changes) - most_named} more"] if len(one.changes) > most_named else []
        value = f"{row['distance_m']} m: " + ", ".join(words + more)
        ElementTree.SubElement(one.part.element, "tag", {"k": TAG, "v": value[:most_signs]})
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def summary(affected: Sequence[Affected]) -> str:
    """How many parts of each kind are affected."""
    counts = Counter(one.part.kind for one in affected)
    return ", ".join(f"{count} {kind}" for kind, count in counts.items())
