"""``export --stac``: each version of a store or a server as an item of a STAC catalogue."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mapvote.cli.door import all_changes, api_at, is_store, is_url, map_at
from mapvote.cli.terminal import waiting
from mapvote.core.times import utc
from mapvote.core.types import MapvoteError

if TYPE_CHECKING:
    from mapvote.core.point_map import PointMap


def export_stac(source: str, folder: Path, key_file: Path | None, version: int | None) -> None:
    """A catalogue in ``folder``: of all versions that are kept, or of one. Items that are there already stay as they
    are, so that the same command adds what is new."""
    from mapvote.core.extras import require
    from mapvote.formats.geo.stac import CHANGES, file_of_item, write_catalog

    require("laspy", "las", "export --stac")
    if folder.exists() and any(folder.iterdir()) and not (folder / "catalog.json").is_file():
        raise MapvoteError(f"{folder}: holds other files; name a new folder, or one that export --stac has written")
    if not (is_url(source) or is_store(source)):
        with map_at(source, key_file) as point_map:
            _write(folder, point_map, {"number": 1, "created": utc(time.time_ns()), "parent": None}, has_changes=False)
            write_catalog(folder, point_map.map_id, [1])
        return
    with api_at(source, key_file) as server:
        oldest = server.ask_json("GET", "/v1/info")["oldest_version"]
        versions = [v for v in server.ask_json("GET", "/v1/map/versions")["versions"] if v["number"] >= oldest]
        numbers = [v["number"] for v in versions if version in (None, v["number"])]
        if not numbers:
            raise MapvoteError(
                f"{source}: has no version {version}; it has {versions[0]['number']} to {versions[-1]['number']}"
            )
        map_id = server.ask_json("GET", "/v1/map")["map_id"]
        for about in versions:
            number = about["number"]
            parent = about["parent"] if about["parent"] in numbers else None
            item = file_of_item(folder, number)
            if number not in numbers or item.is_file():
                continue
            item.parent.mkdir(parents=True, exist_ok=True)
            if parent is not None:
                changes = all_changes(server, f"from={parent}&to={number}&lonlat=true")
                (item.parent / CHANGES).write_text(json.dumps(changes, indent=1) + "\n")
            with map_at(source, key_file, number, origins=True) as point_map:
                _write(folder, point_map, dict(about) | {"parent": parent}, has_changes=parent is not None)
        write_catalog(folder, map_id, numbers)
    print(f"{folder / 'catalog.json'}: {len(numbers)} versions")


def _write(folder: Path, point_map: PointMap, about: Mapping[str, Any], *, has_changes: bool) -> None:
    """The cloud and the item of one version."""
    from mapvote.formats import box_of, export_map
    from mapvote.formats.geo.frame import frame_of
    from mapvote.formats.geo.stac import CLOUD_ASSET, MapVersion, file_of_item, write_item

    home = file_of_item(folder, about["number"]).parent
    home.mkdir(parents=True, exist_ok=True)
    with waiting(f"writing version {about['number']}"):
        export_map(point_map, home / CLOUD_ASSET)
        corners = box_of(home, point_map)
        frame = frame_of(point_map.georeference)
        created = about["created"]
        version = MapVersion(about["number"], created, about["parent"], point_map.n_points, corners, frame, has_changes)
        write_item(folder, version)
