"""What Autoware's pointcloud_map_loader answers, from a folder that ``mapvote follow`` keeps; no ROS is needed here.

Autoware's own loader reads its table of tiles once, when it starts, and takes the path of a tile for its identity. But
its clients take, keep and drop whatever ids the service answers. Here an id is a file's name, X_Y_HASH8.pcd, which
changes with the content: so a client that asks again drops the old tile and takes the new one, without a restart.
Read at autoware_core 2d693b8 (2026-08-20) and autoware_msgs 7025d8f (2026-04-27).
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from mapvote.core.types import MapvoteError
from mapvote.formats.maps.autoware import METADATA, TILES
from mapvote.formats.maps.cloud import Cloud
from mapvote.formats.maps.pcd import read_pcd
from mapvote.live.cdr import blank_message, define, header_of

log = logging.getLogger("mapvote.live")
FRAME = "map"
DIFFERENTIAL, PARTIAL, SELECTED = (
    f"autoware_map_msgs/srv/{name}"
    for name in ("GetDifferentialPointCloudMap", "GetPartialPointCloudMap", "GetSelectedPointCloudMap")
)
SERVICES = {
    DIFFERENTIAL: "/map/get_differential_pointcloud_map",
    PARTIAL: "/map/get_partial_pointcloud_map",
    SELECTED: "/map/get_selected_pointcloud_map",
}
"""Where Autoware's launch files have them."""
HASH, HASH_TOPIC = "tier4_external_api_msgs/msg/MapHash", "/api/autoware/get/map/info/hash"
TABLE, TABLE_TOPIC = "autoware_map_msgs/msg/PointCloudMapMetaData", "/map/pointcloud_map_metadata"
_CELL = "autoware_map_msgs/msg/PointCloudMapCellWithID"
define("""
autoware_map_msgs/msg/AreaInfo: float32 center_x, float32 center_y, float32 radius
autoware_map_msgs/msg/PointCloudMapCellMetaData: float32 min_x, float32 min_y, float32 max_x, float32 max_y
autoware_map_msgs/msg/PointCloudMapCellMetaDataWithID: string cell_id, PointCloudMapCellMetaData metadata
autoware_map_msgs/msg/PointCloudMapCellWithID: string cell_id, PointCloud2 pointcloud,
    PointCloudMapCellMetaData metadata
autoware_map_msgs/msg/PointCloudMapMetaData: Header header, PointCloudMapCellMetaDataWithID[] metadata_list
autoware_map_msgs/srv/GetDifferentialPointCloudMap_Request: uint64 guid, int64 seq, AreaInfo area, string[] cached_ids
autoware_map_msgs/srv/GetDifferentialPointCloudMap_Response: uint64 guid, int64 seq, Header header,
    PointCloudMapCellWithID[] new_pointcloud_with_ids, string[] ids_to_remove
autoware_map_msgs/srv/GetPartialPointCloudMap_Request: uint64 guid, int64 seq, AreaInfo area
autoware_map_msgs/srv/GetPartialPointCloudMap_Response: uint64 guid, int64 seq, Header header,
    PointCloudMapCellWithID[] new_pointcloud_with_ids
autoware_map_msgs/srv/GetSelectedPointCloudMap_Request: uint64 guid, int64 seq, string[] cell_ids
autoware_map_msgs/srv/GetSelectedPointCloudMap_Response: uint64 guid, int64 seq, Header header,
    PointCloudMapCellWithID[] new_pointcloud_with_ids
tier4_external_api_msgs/msg/MapHash: string lanelet, string pcd
""")


@dataclass(frozen=True, slots=True)
class Area:
    """A vertical cylinder, map metres."""

    x: float
    y: float
    radius_m: float


@dataclass(frozen=True, slots=True)
class Cell:
    """One tile: its id, and its square in map metres."""

    id: str
    min_x: float
    min_y: float
    max_x: float
    max_y: float

    def is_near(self, area: Area) -> bool:
        """Whether the loader takes it for touched by ``area``: its square widened by the radius holds the centre. At
        the corners that is a little more than the cylinder; Autoware's own loader has it so."""
        r = area.radius_m
        return self.min_x - r <= area.x <= self.max_x + r and self.min_y - r <= area.y <= self.max_y + r


class MapLoader:
    """The tiles of the folder's newest version."""

    def __init__(self, folder: Path) -> None:
        """``folder`` as :func:`mapvote.formats.maps.autoware.lay_version` lays it; it may still be empty."""
        self.folder = folder
        self.cells: dict[str, Cell] = {}
        self._read_ns = 0

    def refresh(self) -> bool:
        """Read the table of tiles if it was replaced; returns whether it was. MapvoteError if it is none."""
        file = self.folder / METADATA
        try:
            changed_ns = file.stat().st_mtime_ns
            if changed_ns == self._read_ns:
                return False
            table = yaml.safe_load(file.read_text())
            width, height = float(table.pop("x_resolution")), float(table.pop("y_resolution"))
            cells = {
                name: Cell(name, float(x), float(y), float(x) + width, float(y) + height)
                for name, (x, y) in sorted(table.items())
            }
        except FileNotFoundError:
            return False
        except (OSError, yaml.YAMLError, KeyError, TypeError, ValueError, AttributeError) as error:
            raise MapvoteError(f"{file}: not Autoware's metadata ({error})") from error
        self.cells, self._read_ns = cells, changed_ns
        return True

    def differential(self, area: Area, cached: Iterable[str]) -> tuple[list[Cell], list[str]]:
        """(tiles in the area that are not ``cached``, ids of the cached ones that are not in it or not of this
        version)."""
        near = self.partial(area)
        wanted, held = {cell.id for cell in near}, list(cached)
        return [cell for cell in near if cell.id not in set(held)], [name for name in held if name not in wanted]

    def partial(self, area: Area) -> list[Cell]:
        """Tiles in the area, by id."""
        return [cell for cell in self.cells.values() if cell.is_near(area)]

    def selected(self, ids: Iterable[str]) -> list[Cell]:
        """The tiles of these ids, in their order, each as often as it is asked for; unknown ones are said and left
        out."""
        found = []
        for name in ids:
            if name in self.cells:
                found.append(self.cells[name])
            else:
                log.warning("no tile %s in the newest version", name)
        return found

    def points(self, cell: Cell) -> Cloud:
        """The points of a tile, map metres. MapvoteError if its file cannot be read."""
        return read_pcd(self.folder / TILES / cell.id)

    def hash(self) -> str:
        """Of all tiles: SHA-256 over their names, which are hashes; "" without a map."""
        return hashlib.sha256("\n".join(self.cells).encode()).hexdigest() if self.cells else ""

    def answer(self, service: str, request: Any) -> dict[str, Any]:
        """What a service of this type answers: the members of its response by name, clouds as messages of
        :mod:`mapvote.live.cdr`. ``request``: any object with the request's members."""
        removed: list[str] | None = None
        if service == SELECTED:
            cells = self.selected(request.cell_ids)
        else:
            area = Area(request.area.center_x, request.area.center_y, request.area.radius)
            if service == PARTIAL:
                cells = self.partial(area)
            else:
                cells, removed = self.differential(area, request.cached_ids)
        out: dict[str, Any] = {"header": header_of(0, FRAME), "new_pointcloud_with_ids": self._with_points(cells)}
        return out if removed is None else out | {"ids_to_remove": removed}

    def _with_points(self, cells: list[Cell]) -> list[Any]:
        out = []
        for cell in cells:
            try:
                cloud = cloud_message_of(self.points(cell))
            except MapvoteError as error:  # a version was replaced, and its tile deleted, while it was read
                log.warning("%s", error)
                continue
            out.append(blank_message(_CELL, cell_id=cell.id, pointcloud=cloud, metadata=_square(cell)))
        return out

    def table(self, time_ns: int) -> Any:
        """A PointCloudMapMetaData of all tiles."""
        listed = [
            blank_message(
                "autoware_map_msgs/msg/PointCloudMapCellMetaDataWithID", cell_id=cell.id, metadata=_square(cell)
            )
            for cell in self.cells.values()
        ]
        return blank_message(TABLE, header=header_of(time_ns, FRAME), metadata_list=listed)


def _square(cell: Cell) -> Any:
    return blank_message(
        "autoware_map_msgs/msg/PointCloudMapCellMetaData",
        min_x=cell.min_x,
        min_y=cell.min_y,
        max_x=cell.max_x,
        max_y=cell.max_y,
    )


def cloud_message_of(cloud: Cloud) -> Any:
    """A PointCloud2 of map points: x, y, z, and intensity where there is one."""
    columns = {axis: cloud.points[:, k] for k, axis in enumerate("xyz")}
    columns |= {name: column for name, column in cloud.fields.items() if name == "intensity"}
    table = np.column_stack([column.astype("<f4") for column in columns.values()])
    fields = [
        blank_message("sensor_msgs/msg/PointField", name=name, offset=4 * k, datatype=7, count=1)
        for k, name in enumerate(columns)
    ]
    n, step = len(table), 4 * len(columns)
    return blank_message(
        "sensor_msgs/msg/PointCloud2",
        header=header_of(0, FRAME),
        height=1,
        width=n,
        fields=fields,
        point_step=step,
        row_step=step * n,
        data=np.ascontiguousarray(table).view(np.uint8).ravel(),
        is_dense=True,
    )
