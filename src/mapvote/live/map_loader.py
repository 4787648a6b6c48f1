"""The answers of Autoware's pointcloud_map_loader, from a folder that is kept at the newest version; no ROS is needed.

Autoware's own loader reads its table of tiles once, when it starts, and takes the path of a tile for its identity. But
its clients take, keep and drop whatever ids the service answers. Here an id is a file's name, X_Y_HASH8.pcd, which
changes with the content: so a client that asks again drops the old tile and takes the new one, without a restart.
Read at autoware_core 2d693b8 (2026-08-20) and autoware_msgs 7025d8f (2026-04-27).

A client obeys an answer, and asks again only 20 m later. So the services exist only while there is a table of tiles.
A client drops a tile only for tiles that it has or gets with the same answer: no answer leaves it without a map.

:class:`LoaderService` offers the services over DDS as rmw_cyclonedds (master of 2026-08) has them: a request topic and
a reply topic for each. Before the members of a request, and of its reply, stand 16 bytes: the client's number (uint64)
and the number of the request (int64). The reply repeats both; by them a client knows its own.
"""

from __future__ import annotations

import hashlib
import logging
import struct
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from mapvote.core.record import record
from mapvote.core.types import F32, MapvoteError
from mapvote.formats.drives.ros_types import CLOUD
from mapvote.formats.listing import plain_name
from mapvote.formats.maps.autoware import METADATA, TILES, check_followed
from mapvote.formats.maps.cloud import Cloud, joined
from mapvote.formats.maps.pcd import stream_pcd
from mapvote.formats.reading import first_line, read_yaml
from mapvote.live.dds import Network, Publication, Subscription
from mapvote.live.messages import MAP_FRAME, blank_message, cloud_of, from_cdr, header_of, to_cdr
from mapvote.live.parameters import NodeParameters, Value

log = logging.getLogger("mapvote.live")


@record()
@dataclass(frozen=True, slots=True)
class LoaderWaits:
    """Numbers of the delivery of answers over DDS."""

    depth: int = 10
    """Requests and answers that wait in DDS at most, as ROS 2's services have it."""
    tries: int = 5
    """Deliveries of an answer; after each a reliable reader has a second to take it."""
    delivery_s: float = 5.0
    """Time for the last answers to arrive before the service ends, seconds."""
    most_whole_bytes: int = 100_000_000
    """Size of the files of a map up to which it is published whole: DDS keeps the last one in memory for readers that
    come late. 100 MB are 8 million points."""


LOADER_WAITS = LoaderWaits()
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
NODE, WHOLE_TOPIC = "/map/pointcloud_map_loader", "/map/pointcloud_map"


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
        return blank_message(
            kind,
            cell_id=self.id,
            metadata=blank_message("autoware_map_msgs/msg/PointCloudMapCellMetaData", **corners),
            **more,
        )


class MapLoader:
    """The tiles of the folder's newest version."""

    def __init__(self, folder: Path, waits: LoaderWaits = LOADER_WAITS) -> None:
        """``folder`` as :func:`mapvote.formats.maps.autoware.lay_version` lays it; it may still be empty."""
        self.folder = folder
        self._most_whole_bytes = waits.most_whole_bytes
        self.cells: dict[str, Cell] = {}
        self._read: tuple[int, int, int] | None = None
        """Time of change, inode and size of the table that was read last."""

    def refresh(self) -> bool:
        """Read the table of tiles if it was replaced; returns whether it was. MapvoteError if it is none, or lists no
        tile: the tiles known before stay."""
        file = self.folder / METADATA
        try:
            state = file.stat()
            seen = state.st_mtime_ns, state.st_ino, state.st_size
            if seen == self._read:
                return False
            self._read = seen  # an unreadable table is reported once, and read again after it was replaced
            cells = _read_table(file)
            check_followed(self.folder)
            self.cells = cells
        except FileNotFoundError:
            return False
        except (OSError, KeyError, TypeError, ValueError, AttributeError) as error:
            raise MapvoteError(f"{file}: not Autoware's metadata ({first_line(error)})") from error
        return True

    def partial(self, x: float, y: float, radius_m: float) -> list[Cell]:
        """Tiles in the area, by id."""
        return [cell for cell in self.cells.values() if cell.is_near(x, y, radius_m)]

    def selected(self, ids: Iterable[str]) -> list[Cell]:
        """The tiles of these ids, in their order, each as often as it is asked for; unknown ones are said and left
        out."""
        cells = []
        for name in ids:
            if name in self.cells:
                cells.append(self.cells[name])
            else:
                log.warning("no tile %s in the newest version", name)
        return cells

    def hash(self) -> str:
        """Digest of all tiles: SHA-256 over their names, which are hashes; "" without a map."""
        return hashlib.sha256("\n".join(self.cells).encode()).hexdigest() if self.cells else ""

    def answer(self, service: str, request: Any) -> dict[str, Any]:
        """The answer of a service of this type: the members of its response by name, clouds as messages of
        :mod:`mapvote.live.messages`. ``request``: any object with the request's members. Raises nothing.

        The differential one sends the tiles in the area that are not cached, and names the cached ones to remove: those
        out of the area or not of this version. It names none if the client would have no tile in the area afterwards,
        or if a tile that it lacks cannot be read."""
        if service == SELECTED:
            cells = self.selected(request.cell_ids)
        else:
            cells = self.partial(request.area.center_x, request.area.center_y, request.area.radius)
        held: list[str] = list(request.cached_ids) if service == DIFFERENTIAL else []
        lacking = [cell for cell in cells if cell.id not in set(held)]
        tiles = [self._tile(cell) for cell in lacking]
        out: dict[str, Any] = {"header": header_of(0, MAP_FRAME)}
        out["new_pointcloud_with_ids"] = [tile for tile in tiles if tile is not None]
        if service == DIFFERENTIAL:
            wanted = {cell.id for cell in cells}
            whole = bool(wanted) and None not in tiles
            out["ids_to_remove"] = [name for name in held if name not in wanted] if whole else []
        return out

    def _tile(self, cell: Cell) -> Any | None:
        """The tile as a message; None, and a line in the log, if it cannot be read."""
        try:
            cloud = joined(stream_pcd(self.folder / TILES / cell.id))
        except (MapvoteError, OSError) as error:  # a version was replaced, and its tile deleted, while it was read
            log.warning("%s", error)
            return None
        message = cloud_of(_columns(cloud), 0, MAP_FRAME)
        return cell.message("autoware_map_msgs/msg/PointCloudMapCellWithID", pointcloud=message)

    @property
    def is_whole_small(self) -> bool:
        """Whether the map is published whole, too."""
        sizes = ((self.folder / TILES / name).stat().st_size for name in self.cells)
        with suppress(OSError):
            return sum(sizes) <= self._most_whole_bytes
        return False

    def whole(self, time_ns: int) -> Any | None:
        """The map as one cloud; None where it is too large, or a tile of it cannot be read."""
        if not self.is_whole_small:
            return None
        try:
            tiles = [_columns(joined(stream_pcd(self.folder / TILES / name))) for name in self.cells]
        except (MapvoteError, OSError) as error:
            log.warning("%s; the map is not published whole", error)
            return None
        names = [name for name in tiles[0] if all(name in tile for tile in tiles)]
        return cloud_of({name: np.concatenate([tile[name] for tile in tiles]) for name in names}, time_ns, MAP_FRAME)

    def parameters(self) -> dict[str, Value]:
        """The parameters of Autoware's loader, by which its clients choose how to ask."""
        return {
            "enable_whole_load": self.is_whole_small,
            "enable_downsampled_whole_load": False,
            "enable_partial_load": True,
            "enable_selected_load": True,
            "pcd_paths_or_directory": [str(self.folder / TILES)],
            "pcd_metadata_path": str(self.folder / METADATA),
            "use_sim_time": False,
        }

    def table(self, time_ns: int) -> Any:
        """A PointCloudMapMetaData of all tiles."""
        listed = [cell.message("autoware_map_msgs/msg/PointCloudMapCellMetaDataWithID") for cell in self.cells.values()]
        return blank_message(TABLE, header=header_of(time_ns, MAP_FRAME), metadata_list=listed)


def _columns(cloud: Cloud) -> dict[str, F32]:
    """x, y, z and, where it has it, intensity of a cloud, (n,) each."""
    columns = {axis: cloud.points[:, k] for k, axis in enumerate("xyz")}
    if "intensity" in cloud.fields:
        columns["intensity"] = cloud.fields["intensity"]
    return {name: column.astype(np.float32) for name, column in columns.items()}


def _read_table(file: Path) -> dict[str, Cell]:
    """The tiles in Autoware's metadata, by id. Raises what yaml and the conversions raise if it is none."""
    table = read_yaml(file)
    width = float(table.pop("x_resolution"))
    height = float(table.pop("y_resolution"))
    if not table:
        raise ValueError("it lists no tile")
    return {
        plain_name(name, file): Cell(name, float(x), float(y), float(x) + width, float(y) + height)
        for name, (x, y) in sorted(table.items())
    }


Answer = Callable[[str, Any], dict[str, Any]]
"""(type of service, request) to the members of the response."""


class LoaderService:
    """The services and topics of a map loader, on one network. They exist from the first table of tiles on."""

    def __init__(self, network: Network, loader: MapLoader) -> None:
        self._network = network
        self._loader = loader
        self.answered = 0
        self._ends: list[tuple[str, Answer, Subscription, Publication]] = []
        self._shown: list[tuple[Publication, str, Callable[[], Any | None]]] = []

    @property
    def exists(self) -> bool:
        """Whether the services are offered."""
        return bool(self._ends)

    @property
    def tiles(self) -> int:
        """How many tiles the table lists."""
        return len(self._loader.cells)

    def refresh(self) -> bool:
        """Read the table if it was replaced, offer the services if it is the first one, and publish which map it is;
        returns whether it was replaced. MapvoteError if the new table is none: the one before stays in use."""
        if not self._loader.refresh():
            return False
        if not self._ends:
            self._offer()
        for publication, kind, made in self._shown:
            message = made()
            if message is not None:
                self._send(publication, to_cdr(kind, message))
        return True

    def _offer(self) -> None:
        network = self._network
        loader = self._loader
        hashed = network.publish(HASH_TOPIC, HASH, transient_local=True, depth=1)
        table = network.publish(TABLE_TOPIC, TABLE, transient_local=True, depth=1)
        whole = network.publish(WHOLE_TOPIC, CLOUD, transient_local=True, depth=1)
        self._shown = [
            (hashed, HASH, lambda: blank_message(HASH, pcd=loader.hash())),
            (table, TABLE, lambda: loader.table(time.time_ns())),
            (whole, CLOUD, lambda: loader.whole(time.time_ns())),
        ]
        node = NodeParameters(NODE, loader.parameters)
        offered = [(kind, name, loader.answer) for kind, name in SERVICES.items()]
        offered += [(kind, name, node.answer) for kind, name in node.services().items()]
        for kind, name, answer in offered:
            # Replies first: a client that finds the reader of requests can be answered.
            replies = network.publish(f"rr{name}Reply", f"{kind}_Response", depth=LOADER_WAITS.depth)
            requests = network.subscribe(f"rq{name}Request", f"{kind}_Request", reliable=True, depth=LOADER_WAITS.depth)
            self._ends.append((kind, answer, requests, replies))

    def serve(self, seconds: float) -> None:
        """Answer the requests that arrived, or wait so long for one."""
        self._network.wait(seconds)
        for kind, answer, requests, replies in self._ends:
            for _, data in requests.take():
                self._send(replies, self._reply(kind, data, answer))
                self.answered += 1

    def close(self) -> None:
        """Offer the services no more. Requests that arrived are answered first, and their answers delivered."""
        self.serve(0.0)
        for kind, _, requests, replies in self._ends:
            requests.close()
            if not replies.delivered(LOADER_WAITS.delivery_s):
                log.warning("%s: a client did not take its answer in %.0f s", kind, LOADER_WAITS.delivery_s)
        self._ends = []

    def _reply(self, kind: str, data: memoryview, answered: Answer) -> bytes:
        """The response to a request, in CDR. A request that cannot be read is answered with nothing, by its number."""
        try:
            request = from_cdr(f"{kind}_Request", data)
            answer = answered(kind, request)
        except MapvoteError as error:
            log.warning("%s: answered with nothing", error)
            numbers = (bytes(data[4:20]) + bytes(16))[:16]  # behind the four bytes of the encoding
            guid, seq = struct.unpack("<Qq" if len(data) > 1 and data[1] & 1 else ">Qq", numbers)
            request = SimpleNamespace(guid=guid, seq=seq)
            answer = {"header": header_of(0, MAP_FRAME)} if kind in SERVICES else {}
        reply = blank_message(f"{kind}_Response", guid=request.guid, seq=request.seq, **answer)
        return to_cdr(f"{kind}_Response", reply)

    def _send(self, publication: Publication, data: bytes) -> None:
        """A message that a slow reader does not take is tried again: a client waits for its answer without an end."""
        for tries in range(LOADER_WAITS.tries):
            try:
                publication.send(data)
                return
            except MapvoteError as error:
                log.warning("%s (%d of %d tries)", error, tries + 1, LOADER_WAITS.tries)
