"""A STAC catalogue of a map's versions (STAC 1.1; extensions pointcloud 2.0 and projection 2.0): files in folders.

catalog.json  collection.json  v1/v1.json  v1/cloud.copc.laz  v2/v2.json  v2/cloud.copc.laz  v2/changes.geojson

There is a collection if the map's place on Earth is known: a collection must state its place.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mapvote.core.types import F64, MapvoteError
from mapvote.formats.atomic import write_whole
from mapvote.formats.geo.frame import MapFrame, read_crs
from mapvote.formats.reading import read_whole

_STAC = "1.1.0"
_EXTENSIONS = [
    "https://stac-extensions.github.io/pointcloud/v2.0.0/schema.json",
    "https://stac-extensions.github.io/projection/v2.0.0/schema.json",
]
COLLECTION = "collection.json"
"""Name of the file of the collection."""
CLOUD_ASSET = "cloud.copc.laz"
CHANGES = "changes.geojson"
"""Names of an item's files."""


@dataclass(frozen=True, slots=True)
class MapVersion:
    """A version of a map, as its item tells it."""

    number: int
    created: str
    """RFC 3339, UTC."""
    parent: int | None
    """The version that it was made from, if that is in the catalogue."""
    points: int
    corners: F64
    """(2, 3) lowest and highest coordinates, map metres."""
    frame: MapFrame
    has_changes: bool
    """Whether there is a file of changes from the parent."""
    map_id: str


@dataclass(frozen=True, slots=True)
class Extent:
    """Where and when a map's versions are."""

    bbox: Sequence[float]
    """West, south, east, north, degrees."""
    times: Sequence[str]
    """When each version was made, RFC 3339."""
    crs: str | None
    """The map's system by its code, if it has one."""


def name_of_item(number: int) -> str:
    """Its id, and the name of its folder."""
    return f"v{number}"


def file_of_item(folder: Path, number: int) -> Path:
    """The item's file in the catalogue's folder; its assets lie beside it."""
    name = name_of_item(number)
    return folder / name / f"{name}.json"


def items_in(folder: Path) -> list[int]:
    """Numbers of the versions whose items are in a catalogue's folder, ascending."""
    numbers = [int(item.stem[1:]) for item in folder.glob("v*/v*.json") if item.stem[1:].isdecimal()]
    return sorted(number for number in numbers if file_of_item(folder, number).is_file())


def map_of_catalog(folder: Path) -> str | None:
    """The id of the map whose catalogue is in a folder; None without one. MapvoteError if it cannot be read."""
    files = [folder / name for name in (COLLECTION, "catalog.json")]
    file = next((file for file in files if file.exists()), None)
    if file is None:
        return None
    try:
        return str(json.loads(read_whole(file))["id"])
    except (ValueError, KeyError, TypeError) as error:
        raise MapvoteError(f"{file}: is no STAC catalogue; name a new folder") from error


def is_derived(folder: Path, number: int, parent: int) -> bool:
    """Whether the item of a version in a catalogue names its ``parent``."""
    links = json.loads(read_whole(file_of_item(folder, number)))["links"]
    before = name_of_item(parent)
    return any(link["rel"] == "derived_from" and link["href"].endswith(f"/{before}.json") for link in links)


def stac_item(version: MapVersion) -> dict[str, Any]:
    """The item of a version. One whose place on Earth is unknown has no geometry, as STAC allows."""
    name = name_of_item(version.number)
    frame = version.frame
    properties: dict[str, Any] = {
        "datetime": version.created,
        "title": f"version {version.number}",
        "pc:count": version.points,
        "pc:type": "lidar",
        "proj:code": frame.crs if frame.crs.startswith("EPSG:") else None,
    }
    place: dict[str, Any] = {"geometry": None}
    if not frame.is_local:
        if frame.crs.startswith("EPSG:"):
            low, high = (version.corners + np.array(frame.offset_m)).round(3).tolist()
            properties["proj:bbox"] = [*low, *high]
            properties["proj:wkt2"] = read_crs(frame.crs).to_wkt()
        place = _place(version) | {"collection": version.map_id}
    assets = {
        "cloud": {
            "href": f"./{CLOUD_ASSET}",
            "type": "application/vnd.laszip+copc",
            "title": "all points",
            "roles": ["data"],
        }
    }
    if version.has_changes:
        assets["changes"] = {
            "href": f"./{CHANGES}",
            "type": "application/geo+json",
            "title": f"built and demolished since version {version.parent}",
            "roles": ["metadata"],
        }
    links = [_link("root", "../catalog.json")]
    if frame.is_local:
        links.append(_link("parent", "../catalog.json"))
    else:
        links += [_link(rel, f"../{COLLECTION}") for rel in ("parent", "collection")]
    if version.parent is not None:
        before = name_of_item(version.parent)
        links.append(_link("derived_from", f"../{before}/{before}.json", "application/geo+json"))
    head = {"type": "Feature", "stac_version": _STAC, "stac_extensions": _EXTENSIONS, "id": name}
    return head | place | {"properties": properties, "links": links, "assets": assets}


def _place(version: MapVersion) -> dict[str, Any]:
    """Footprint and box in longitude, latitude and height."""
    (x0, y0, z0), (x1, y1, z1) = version.corners.tolist()
    corners = np.array([[x0, y0, z0], [x1, y0, z0], [x1, y1, z1], [x0, y1, z1], [x0, y0, z0]])
    degrees = version.frame.to_lonlat(corners).round(8)
    low = degrees.min(axis=0).tolist()
    high = degrees.max(axis=0).tolist()
    return {"geometry": {"type": "Polygon", "coordinates": [degrees[:, :2].tolist()]}, "bbox": [*low, *high]}


def stac_catalog(map_id: str, numbers: Sequence[int], extent: Extent | None) -> dict[str, Any]:
    """The catalogue: of the one collection if its ``extent`` is known, else of the items of these versions."""
    links = [_link("root", "./catalog.json")]
    links += [_link("child", f"./{COLLECTION}")] if extent else _item_links(numbers)
    about = {"id": f"{map_id}-catalog" if extent else map_id, "title": "mapvote", "description": "Versions of a map"}
    return {"type": "Catalog", "stac_version": _STAC} | about | {"links": links}


def stac_collection(map_id: str, numbers: Sequence[int], extent: Extent) -> dict[str, Any]:
    """The collection of these versions."""
    times = sorted(extent.times)
    codes = {} if extent.crs is None else {"proj:code": [extent.crs]}
    return {
        "type": "Collection",
        "stac_version": _STAC,
        "stac_extensions": [],
        "id": map_id,
        "title": "Versions of a map",
        "description": "Versions of a point-cloud map that vehicles keep true",
        "license": "other",
        "keywords": ["point cloud", "lidar", "change detection"],
        "extent": {"spatial": {"bbox": [list(extent.bbox)]}, "temporal": {"interval": [[times[0], times[-1]]]}},
        "summaries": {"pc:type": ["lidar"], "datetime": {"minimum": times[0], "maximum": times[-1]}} | codes,
        "links": [_link("root", "./catalog.json"), _link("parent", "./catalog.json"), *_item_links(numbers)],
    }


def _item_links(numbers: Sequence[int]) -> list[dict[str, str]]:
    files = [f"./{name_of_item(number)}/{name_of_item(number)}.json" for number in numbers]
    return [_link("item", file, "application/geo+json") for file in files]


def _link(rel: str, href: str, kind: str = "application/json") -> dict[str, str]:
    return {"rel": rel, "href": href, "type": kind}


def _extent_of(items: Sequence[Mapping[str, Any]]) -> Extent | None:
    """The extent of items; None if the place of one is unknown."""
    if not items or any("bbox" not in item for item in items):
        return None
    boxes = np.array([item["bbox"] for item in items])
    low = boxes[:, :2].min(axis=0).tolist()
    high = boxes[:, 3:5].max(axis=0).tolist()
    about = [item["properties"] for item in items]
    return Extent([*low, *high], [one["datetime"] for one in about], about[-1]["proj:code"])


def write_item(folder: Path, version: MapVersion) -> None:
    """The item's file, beside its assets."""
    write_whole(file_of_item(folder, version.number), json.dumps(stac_item(version), indent=1) + "\n")


def write_catalog(folder: Path, map_id: str) -> None:
    """The files of the catalogue and its collection: written last, so that they name every item that is there."""
    numbers = items_in(folder)
    items = [json.loads(read_whole(file_of_item(folder, number))) for number in numbers]
    extent = _extent_of(items)
    if extent is not None:
        collection = stac_collection(map_id, numbers, extent)
        write_whole(folder / COLLECTION, json.dumps(collection, indent=1) + "\n")
    write_whole(folder / "catalog.json", json.dumps(stac_catalog(map_id, numbers, extent), indent=1) + "\n")
