"""``export --stac``: each version of a store or a server as an item of a STAC catalogue."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Collection, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mapvote.cli.door import all_changes, api_at, is_store, is_url, map_at
from mapvote.cli.terminal import waiting
from mapvote.core.times import utc
from mapvote.core.types import MapvoteError

if TYPE_CHECKING:
    from mapvote.client.connection import Connection
    from mapvote.core.point_map import PointMap


def export_stac(source: str, folder: Path, key_file: Path | None, version: int | None) -> None:
    """A catalogue in ``folder``: of all versions that are kept, or of one. Items that are there already stay as they
    are, so that the same command adds what is new; one that lacks the link to its parent is written again once the
    parent is there."""
    from mapvote.core.extras import require
    from mapvote.formats.geo.stac import write_catalog

    require("laspy", "las", "export --stac")
    if folder.exists() and any(folder.iterdir()) and not (folder / "catalog.json").is_file():
        raise MapvoteError(f"{folder}: holds other files; name a new folder, or one that export --stac has written")
    if not (is_url(source) or is_store(source)):
        with map_at(source, key_file) as point_map:
            _check_map(folder, point_map.map_id)
            _write(folder, point_map, {"number": 1, "created": utc(time.time_ns()), "parent": None}, has_changes=False)
            write_catalog(folder, point_map.map_id)
        return
    with api_at(source, key_file) as server:
        oldest = server.ask_json("GET", "/v1/info")["oldest_version"]
        versions = [v for v in server.ask_json("GET", "/v1/map/versions")["versions"] if v["number"] >= oldest]
        wanted = {v["number"] for v in versions if version in (None, v["number"])}
        if not wanted:
            raise MapvoteError(
                f"{source}: has no version {version}; it has {versions[0]['number']} to {versions[-1]['number']}"
            )
        map_id = server.ask_json("GET", "/v1/map")["map_id"]
        _check_map(folder, map_id)
        for about in versions:
            if about["number"] in wanted:
                _add(
                    folder, server, about, wanted, lambda number: map_at(source, key_file, number, origins=True), oldest
                )
        write_catalog(folder, map_id)
    print(f"{folder / 'catalog.json'}: {len(wanted)} versions")


def _check_map(folder: Path, map_id: str) -> None:
    """MapvoteError if the folder holds the catalogue of another map."""
    from mapvote.formats.geo.stac import map_of_catalog

    held = map_of_catalog(folder)
    if held not in (None, map_id):
        raise MapvoteError(f"{folder}: is the catalogue of map {held!r}, not of {map_id!r}; name another folder")


def _add(
    folder: Path,
    server: Connection,
    about: Mapping[str, Any],
    wanted: Collection[int],
    open_map: Callable[[int], AbstractContextManager[PointMap]],
    oldest: int,
) -> None:
    """Write the item of a version and its files, unless it is there whole. ``oldest``: the first version that can still
    be compared."""
    from mapvote.formats.geo.stac import CHANGES, file_of_item, is_derived

    number = about["number"]
    item = file_of_item(folder, number)
    parent = about["parent"]
    if parent not in wanted and (parent is None or not file_of_item(folder, parent).is_file()):
        parent = None
    if item.is_file() and (parent is None or is_derived(folder, number, parent)):
        return
    item.parent.mkdir(parents=True, exist_ok=True)
    has_changes = parent is not None and parent >= oldest
    if has_changes:
        changes = all_changes(server, f"from={parent}&to={number}&lonlat=true")
        (item.parent / CHANGES).write_text(json.dumps(changes, indent=1) + "\n")
    with open_map(number) as point_map:
        _write(folder, point_map, dict(about) | {"parent": parent}, has_changes=has_changes)


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
        version = MapVersion(
            about["number"],
            created,
            about["parent"],
            point_map.n_points,
            corners,
            frame,
            has_changes,
            point_map.map_id,
        )
        write_item(folder, version)
