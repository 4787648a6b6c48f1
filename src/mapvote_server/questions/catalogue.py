"""The STAC catalogue of a store: the items that ``export --stac`` writes, with assets that the server serves."""

from __future__ import annotations

from typing import Any
from urllib.parse import urljoin

import numpy as np
import sqlalchemy as sa

from mapvote.codec.manifest import TileHashes
from mapvote.codec.tile_planes import unpack_points_plane
from mapvote.core.geometry import corners
from mapvote.core.grid import TileIndex
from mapvote.core.times import utc
from mapvote.core.types import F32, F64, MapvoteError
from mapvote.formats.geo.frame import frame_of
from mapvote.formats.geo.stac import Extent, MapVersion, stac_catalog, stac_collection, stac_item
from mapvote_server.errors import NotFound
from mapvote_server.questions.features import OnEarth, extent_of
from mapvote_server.store.queries import load_blob, points_of, tiles_of, version_of
from mapvote_server.store.store import PerStore, Store
from mapvote_server.work import check_time


def catalogue_at(store: Store, url: str) -> dict[str, Any]:
    """The catalogue of all versions that are kept, as if ``url`` were its address; all links are absolute."""
    numbers, extent = _kept(store)
    return _absolute(stac_catalog(store.map_id, numbers, extent), url)


def collection_at(store: Store, url: str) -> dict[str, Any]:
    """Its collection. NotFound if the map's place on Earth is unknown."""
    numbers, extent = _kept(store)
    if extent is None:
        raise NotFound("the map's place on Earth is unknown, so there is no collection: the catalogue lists the items")
    return _absolute(stac_collection(store.map_id, numbers, extent), url)


def _kept(store: Store) -> tuple[list[int], Extent | None]:
    """(versions that are kept, their extent)."""
    kept = [version for version in store.versions() if version.cleared_seq is None]
    numbers = [version.number for version in kept]
    frame = frame_of(store.georeference)
    if frame.is_local:
        return numbers, None
    crs = frame.crs if frame.crs.startswith("EPSG:") else None
    return numbers, Extent(extent_of(store, OnEarth(frame)), [utc(version.created_ns) for version in kept], crs)


def item_at(store: Store, number: int, url: str) -> dict[str, Any]:
    """The item of a version in the catalogue at ``url``. NotFound if there is no such version, MapvoteError if it has
    no points. TooSlow if the box of its points takes too long; the next request goes on from there."""
    with store.database.reading() as connection:
        version = version_of(connection, number)
        parent = None if version.parent is None else version_of(connection, version.parent, cleared=True)
        tiles = tiles_of(connection, number)
        counts = points_of(connection, tiles)
        corners = _corners(store, connection, tiles)
    before = None if parent is None or parent.cleared_seq is not None else parent.number
    frame = frame_of(store.georeference)
    about = MapVersion(
        number,
        utc(version.created_ns),
        before,
        sum(counts.values()),
        corners,
        frame,
        has_changes=before is not None,
        map_id=store.map_id,
    )
    item = stac_item(about)
    item["assets"]["cloud"]["href"] = f"../../v1/map/versions/{number}/cloud.copc.laz"
    if before is not None:
        item["assets"]["changes"]["href"] = f"../../v1/changes?from={before}&to={number}&lonlat=true&limit=10000"
    return _absolute(item, urljoin(url, f"{item['id']}/{item['id']}.json"))


def _absolute(content: dict[str, Any], url: str) -> dict[str, Any]:
    """The same with links from ``url``, and a link to itself."""
    links = [link | {"href": urljoin(url, link["href"])} for link in content["links"]]
    kind = "application/geo+json" if content["type"] == "Feature" else "application/json"
    links.append({"rel": "self", "href": url, "type": kind})
    assets = {name: asset | {"href": urljoin(url, asset["href"])} for name, asset in content.get("assets", {}).items()}
    return content | {"links": links} | ({"assets": assets} if assets else {})


_boxes: PerStore[dict[str, F32]] = PerStore(dict)
"""(2, 3) lowest and highest point of a plane, from the tile's corner, by the plane's hash: planes never change."""


def _corners(store: Store, connection: sa.Connection, tiles: dict[TileIndex, TileHashes]) -> F64:
    """(2, 3) lowest and highest coordinates, map metres."""
    boxes = _boxes.of(store)
    boxes_map = []
    for index, hashes in tiles.items():
        box = boxes.get(hashes.points)
        if box is None:
            check_time()
            points = unpack_points_plane(load_blob(connection, hashes.points), hashes.points)
            box = (corners(points) if len(points) else points).astype(np.float32)
            boxes[hashes.points] = box
        if len(box):
            boxes_map.append(store.lattice.tile(index).to_map(box))
    if not boxes_map:
        raise MapvoteError("the map holds no points, so the catalogue has no place for it")
    return np.asarray(corners(np.concatenate(boxes_map)), dtype=np.float64)
