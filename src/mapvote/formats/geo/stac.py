"""A STAC catalogue of a map's versions (STAC 1.1; extensions pointcloud 2.0 and projection 2.0): files in folders.

catalog.json    v1/v1.json    v1/cloud.copc.laz    v2/v2.json    v2/cloud.copc.laz    v2/changes.geojson
"""

from __future__ import annotations

import json
from collections.abc import Sequence
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
    file = folder / "catalog.json"
    if not file.exists():
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
        place = _place(version)
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
    links = [{"rel": rel, "href": "../catalog.json", "type": "application/json"} for rel in ("root", "parent")]
    if version.parent is not None:
        before = name_of_item(version.parent)
        links.append({"rel": "derived_from", "href": f"../{before}/{before}.json", "type": "application/geo+json"})
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


def stac_catalog(map_id: str, numbers: Sequence[int]) -> dict[str, Any]:
    """The catalogue of these versions."""
    links = [{"rel": "root", "href": "./catalog.json", "type": "application/json"}]
    for number in numbers:
        name = name_of_item(number)
        links.append({"rel": "item", "href": f"./{name}/{name}.json", "type": "application/geo+json"})
    about = {"id": map_id, "title": "mapvote", "description": "Versions of a point-cloud map that vehicles keep true"}
    return {"type": "Catalog", "stac_version": _STAC} | about | {"links": links}


def write_item(folder: Path, version: MapVersion) -> None:
    """The item's file, beside its assets."""
    write_whole(file_of_item(folder, version.number), json.dumps(stac_item(version), indent=1) + "\n")


def write_catalog(folder: Path, map_id: str) -> None:
    """The catalogue's file: written last, so that it names every item that is there and no other."""
    write_whole(folder / "catalog.json", json.dumps(stac_catalog(map_id, items_in(folder)), indent=1) + "\n")
