"""What Autoware's pointcloud_map_loader answers, from a folder that ``mapvote follow`` keeps; no ROS is needed here.

Autoware's own loader reads its table of tiles once, when it starts, and takes the path of a tile for its identity. But
its clients take, keep and drop whatever ids the service answers. Here an id is a file's name, X_Y_HASH8.pcd, which
changes with the content: so a client that asks again drops the old tile and takes the new one, without a restart.
Read at autoware_core 2d693b8 (2026-08-20) and autoware_msgs 7025d8f (2026-04-27).

:class:`LoaderService` offers the services over DDS as rmw_cyclonedds (master of 2026-08) has them: a request topic and
a reply topic for each. Before the members of a request, and of its reply, stand 16 bytes: the client's number (uint64)
and the number of the request (int64). The reply repeats both; by them a client knows its own.
"""

from __future__ import annotations

import hashlib
import logging
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from mapvote.core.types import MapvoteError
from mapvote.formats.maps.autoware import METADATA, TILES
from mapvote.formats.maps.cloud import joined
from mapvote.formats.maps.pcd import stream_pcd
from mapvote.live.dds import Network, Publication, Subscription
from mapvote.live.messages import MAP_FRAME, blank_message, cloud_of, from_cdr, header_of, to_cdr

log = logging.getLogger("mapvote.live")
_DEPTH = 10
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
_MSG = "autoware_map_msgs/msg/PointCloudMapCell"


@dataclass(frozen=True, slots=True)
class Cell:
    """One tile: its id, and its square in map metres."""

    id: str
    min_x: float
    min_y: float
    max_x: float
    max_y: float

    def is_near(self, x: float, y: float, radius_m: float) -> bool:
        """Whether the loader takes it for touched by the vertical cylinder about (x, y): its square widened by the
        radius holds the centre. At the corners that is a little more than the cylinder; Autoware's own loader has it
        so."""
        r = radius_m
        return self.min_x - r <= x <= self.max_x + r and self.min_y - r <= y <= self.max_y + r

    def message(self, kind: str, **more: Any) -> Any:
        """``kind`` of message with the id and the square of the tile."""
        corners = {name: getattr(self, name) for name in ("min_x", "min_y", "max_x", "max_y")}
        return blank_message(kind, cell_id=self.id, metadata=blank_message(f"{_MSG}MetaData", **corners), **more)


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

    def partial(self, x: float, y: float, radius_m: float) -> list[Cell]:
        """Tiles in the area, by id."""
        return [cell for cell in self.cells.values() if cell.is_near(x, y, radius_m)]

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

    def hash(self) -> str:
        """Of all tiles: SHA-256 over their names, which are hashes; "" without a map."""
        return hashlib.sha256("\n".join(self.cells).encode()).hexdigest() if self.cells else ""

    def answer(self, service: str, request: Any) -> dict[str, Any]:
        """What a service of this type answers: the members of its response by name, clouds as messages of
        :mod:`mapvote.live.messages`. ``request``: any object with the request's members.

        The differential one sends the tiles in the area that are not cached, and names the cached ones that are not in
        it or not of this version."""
        if service == SELECTED:
            cells = self.selected(request.cell_ids)
        else:
            cells = self.partial(request.area.center_x, request.area.center_y, request.area.radius)
        out: dict[str, Any] = {"header": header_of(0, MAP_FRAME)}
        if service == DIFFERENTIAL:
            wanted, held = {cell.id for cell in cells}, list(request.cached_ids)
            cells = [cell for cell in cells if cell.id not in set(held)]
            out["ids_to_remove"] = [name for name in held if name not in wanted]
        out["new_pointcloud_with_ids"] = clouds = []
        for cell in cells:
            try:
                cloud = joined(stream_pcd(self.folder / TILES / cell.id))
            except MapvoteError as error:  # a version was replaced, and its tile deleted, while it was read
                log.warning("%s", error)
                continue
            columns = {axis: cloud.points[:, k] for k, axis in enumerate("xyz")}
            if "intensity" in cloud.fields:
                columns["intensity"] = cloud.fields["intensity"]
            message = cloud_of({name: column.astype(np.float32) for name, column in columns.items()}, 0, MAP_FRAME)
            clouds.append(cell.message(f"{_MSG}WithID", pointcloud=message))
        return out

    def table(self, time_ns: int) -> Any:
        """A PointCloudMapMetaData of all tiles."""
        listed = [cell.message(f"{_MSG}MetaDataWithID") for cell in self.cells.values()]
        return blank_message(TABLE, header=header_of(time_ns, MAP_FRAME), metadata_list=listed)


class LoaderService:
    """The services and topics of a map loader, on one network."""

    def __init__(self, network: Network, loader: MapLoader) -> None:
        self._network, self._loader, self.answered = network, loader, 0
        self._ends: list[tuple[str, Subscription, Publication]] = []
        for kind, name in SERVICES.items():
            requests = network.subscribe(f"rq{name}Request", f"{kind}_Request", reliable=True, depth=_DEPTH)
            replies = network.publish(f"rr{name}Reply", f"{kind}_Response", depth=_DEPTH)
            self._ends.append((kind, requests, replies))
        self._hash = network.publish(HASH_TOPIC, HASH, transient_local=True, depth=1)
        self._table = network.publish(TABLE_TOPIC, TABLE, transient_local=True, depth=1)

    def show(self) -> None:
        """Publish which map this is: its hash and its table, for those who come later, too."""
        self._hash.send(to_cdr(HASH, blank_message(HASH, pcd=self._loader.hash())))
        self._table.send(to_cdr(TABLE, self._loader.table(time.time_ns())))

    def serve(self, seconds: float) -> None:
        """Answer the requests that arrived, or wait so long for one."""
        self._network.wait(seconds)
        for kind, requests, replies in self._ends:
            for _, data in requests.take():
                try:
                    request = from_cdr(f"{kind}_Request", data)
                except MapvoteError as error:
                    log.warning("%s", error)
                    continue
                answer = self._loader.answer(kind, request)
                reply = blank_message(f"{kind}_Response", guid=request.guid, seq=request.seq, **answer)
                replies.send(to_cdr(f"{kind}_Response", reply))
                self.answered += 1
