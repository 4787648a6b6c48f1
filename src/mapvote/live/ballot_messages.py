"""A ballot as ROS 2 messages, for RViz and Foxglove: points that come and go, states of cells, and the road driven."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum, StrEnum
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapvote.codec.ballot import Ballot, BallotTile, Planes, unpack_path, unpack_planes
from mapvote.core.columns import column_bits, flat_cells
from mapvote.core.grid import CELL_SIZE, TILE_CELLS, Grid
from mapvote.core.point_map import PointMap
from mapvote.core.record import record
from mapvote.core.reference import reference_window
from mapvote.core.types import F64, I8, U8, CellState
from mapvote.core.voting import plurality
from mapvote.formats.drives.ros_types import CLOUD, POSE
from mapvote.live.mcap import FileMessage
from mapvote.live.messages import MAP_FRAME, blank_message, cloud_of, header_of, to_cdr


class BallotTopic(StrEnum):
    """Topics of a ballot, below the namespace of the vehicle."""

    CHANGES = "mapvote/changes"
    STATES = "mapvote/states"
    ROAD = "mapvote/path"
    MAP = "mapvote/map"

    @property
    def kind(self) -> str:
        """The type of its messages."""
        other = {BallotTopic.STATES: "nav_msgs/msg/OccupancyGrid", BallotTopic.ROAD: "nav_msgs/msg/Path"}
        return other.get(self, CLOUD)


class PointChange(IntEnum):
    """Values of the field ``change`` of a point."""

    COMES = 1
    GOES = 2


@record()
@dataclass(frozen=True, slots=True)
class BallotView:
    """How a ballot is shown."""

    most_cells: int = 16_000_000
    """Cells of a grid at most; a wider ballot is shown in larger cells, of which the most telling state counts."""
    comes_rgb: int = 0xE03C31
    """Colour of points that come."""
    goes_rgb: int = 0x2F6FDE
    """Colour of points that go."""
    near_m: float = 150.0
    """Tiles whose middle is farther from the vehicle are not shown on the road, metres."""


BALLOT_VIEW = BallotView()


class Stamped(NamedTuple):
    """One message, serialised."""

    topic: BallotTopic
    stamp_ns: int
    data: bytes

    @property
    def recorded(self) -> FileMessage:
        """The message for a file."""
        return FileMessage(f"/{self.topic}", self.topic.kind, self.stamp_ns, self.data)

    @classmethod
    def of(cls, topic: BallotTopic, ballot: Ballot, message: Any) -> Stamped:
        """A message at the end of the ballot's drive."""
        return cls(topic, ballot.end_ns, to_cdr(topic.kind, message))


def messages_of_ballot(ballot: Ballot, point_map: PointMap, frame: str = MAP_FRAME) -> Iterator[Stamped]:
    """The changes, the states and the path of a ballot on its map, at the end of its drive. MapvoteError if a plane is
    damaged."""
    yield Stamped.of(BallotTopic.CHANGES, ballot, changes_cloud(ballot, point_map, frame))
    if ballot.tiles:
        yield Stamped.of(BallotTopic.STATES, ballot, states_grid(ballot, point_map, frame))
    if ballot.path is not None:
        yield Stamped.of(BallotTopic.ROAD, ballot, path_message(ballot, point_map, frame))


def changes_cloud(ballot: Ballot, point_map: PointMap, frame: str = MAP_FRAME, view: BallotView = BALLOT_VIEW) -> Any:
    """A PointCloud2 of the points that come and of the map's points that go: x, y, z, rgb, and ``change`` (1 comes, 2
    goes)."""
    comes: list[F64] = []
    goes: list[F64] = []
    for tile in ballot.tiles:
        planes = unpack_planes(tile)
        window = point_map.lattice.tile(tile.tile)
        comes.append(_coming(planes, window))
        goes.append(_going(planes, tile, point_map))
    new = np.concatenate([np.empty((0, 3)), *comes])
    gone = np.concatenate([np.empty((0, 3)), *goes])
    points = np.concatenate([new, gone]).astype(np.float32)
    kinds = np.repeat(np.array([PointChange.COMES, PointChange.GOES], dtype=np.uint16), [len(new), len(gone)])
    colours = np.array([0, view.comes_rgb, view.goes_rgb], dtype=np.uint32)[kinds].view(np.float32)
    columns: dict[str, NDArray[Any]] = {axis: points[:, k] for k, axis in enumerate("xyz")}
    columns |= {"rgb": colours, "change": kinds}
    return cloud_of(columns, ballot.end_ns, frame)


def _states(planes: Planes) -> U8:
    """(256, 256) the state of each cell; of a tally the one with most votes, a tie is undetermined."""
    if planes.states is not None:
        return planes.states
    assert planes.tally is not None
    return plurality(planes.tally.astype(np.int32))


def _coming(planes: Planes, window: Grid) -> F64:
    """(n, 3) new points in cells that are called changed-occupied, map metres."""
    if planes.new_points is None:
        return np.empty((0, 3))
    cells = flat_cells(window, planes.new_points)
    wanted = _states(planes).reshape(-1)[cells] == CellState.CHANGED_OCCUPIED
    return window.to_map(planes.new_points[wanted])


def _going(planes: Planes, tile: BallotTile, point_map: PointMap) -> F64:
    """(n, 3) points of the map that the ballot deletes, map metres."""
    mapped = point_map.tiles.get(tile.tile)
    if mapped is None or not len(mapped.points):
        return np.empty((0, 3))
    window = point_map.lattice.tile(tile.tile)
    base = mapped.base if mapped.has_ground else reference_window(point_map, window).base
    cells = flat_cells(window, mapped.points)
    ground_z = np.asarray(mapped.ground_z).reshape(-1)[cells]
    bit, obstacle = column_bits(mapped.points[:, 2].astype(np.float64), ground_z, base.reshape(-1)[cells])
    if planes.gone is None:
        chosen = obstacle & (_states(planes).reshape(-1)[cells] == CellState.CHANGED_EMPTY)
    else:
        words = np.zeros(TILE_CELLS * TILE_CELLS, dtype=np.uint64)
        words[planes.gone.cells] = planes.gone.words
        chosen = obstacle & ((words[cells] >> bit.astype(np.uint64)) & np.uint64(1)).astype(np.bool_)
    return window.to_map(mapped.points[chosen])


def states_grid(ballot: Ballot, point_map: PointMap, frame: str = MAP_FRAME, view: BallotView = BALLOT_VIEW) -> Any:
    """An OccupancyGrid of the states: 0 empty, 25 became empty, 50 undetermined, 75 became occupied, 100 occupied, -1
    no vote. Its height is that of the lowest ground below it."""
    windows = [point_map.lattice.tile(tile.tile) for tile in ballot.tiles]
    whole = windows[0]
    for window in windows[1:]:
        whole = whole.union(window)
    # Larger cells where the ballot is wide: a power of two, which divides a tile.
    wider = 1
    while whole.rows * whole.cols > view.most_cells * wider * wider and wider < TILE_CELLS:
        wider *= 2
    values = np.full((whole.rows // wider, whole.cols // wider), -1, dtype=np.int8)
    lowest = np.inf
    for tile, window in zip(ballot.tiles, windows, strict=True):
        rows, cols = window.slices_in(whole)
        inside = slice(rows.start // wider, rows.stop // wider), slice(cols.start // wider, cols.stop // wider)
        values[inside] = _coarser(_occupancy()[_states(unpack_planes(tile))], wider)
        mapped = point_map.tiles.get(tile.tile)
        if mapped is not None and np.isfinite(mapped.ground_z).any():
            lowest = min(lowest, float(np.nanmin(mapped.ground_z)))
    message = blank_message(BallotTopic.STATES.kind, header=header_of(ballot.end_ns, frame), data=values.reshape(-1))
    message.info.resolution = CELL_SIZE * wider
    message.info.width = values.shape[1]
    message.info.height = values.shape[0]
    message.info.origin.position.x = whole.x0
    message.info.origin.position.y = whole.y0
    message.info.origin.position.z = lowest if np.isfinite(lowest) else 0.0
    message.info.origin.orientation.w = 1.0
    return message


@cache
def _occupancy() -> I8:
    """(256,) the value of each state in an OccupancyGrid; -1: no vote."""
    values = np.full(256, -1, dtype=np.int8)
    values[CellState.UNCHANGED_EMPTY] = 0
    values[CellState.CHANGED_EMPTY] = 25
    values[CellState.UNDETERMINED] = 50
    values[CellState.CHANGED_OCCUPIED] = 75
    values[CellState.UNCHANGED_OCCUPIED] = 100
    return values


def _coarser(values: I8, wider: int) -> I8:
    """(rows / wider, cols / wider) the most telling value of each block."""
    if wider == 1:
        return values
    ascending = np.array([-1, 0, 50, 100, 25, 75], dtype=np.int8)  # the last one tells most
    ranks = np.zeros(256, dtype=np.uint8)
    ranks[ascending.view(np.uint8)] = np.arange(len(ascending))
    blocks = ranks[values.view(np.uint8)].reshape(len(values) // wider, wider, -1, wider).max(axis=(1, 3))
    return ascending[blocks]


def path_message(ballot: Ballot, point_map: PointMap, frame: str = MAP_FRAME) -> Any:
    """A Path of the road driven, on the map's ground."""
    cells = np.zeros((0, 2), np.int64) if ballot.path is None else unpack_path(ballot.path)
    lattice = point_map.lattice
    x = lattice.x0 + (cells[:, 1] + 0.5) * CELL_SIZE
    y = lattice.y0 + (cells[:, 0] + 0.5) * CELL_SIZE
    places = np.column_stack([x, y, np.zeros(len(x))])
    ground_z = np.nan_to_num(point_map.ground_under(places)) if len(places) else np.zeros(0)
    header = header_of(ballot.end_ns, frame)
    poses = []
    for at, height in zip(places.tolist(), ground_z.tolist(), strict=True):
        pose = blank_message(POSE, header=header)
        pose.pose.position.x = at[0]
        pose.pose.position.y = at[1]
        pose.pose.position.z = height
        pose.pose.orientation.w = 1.0
        poses.append(pose)
    return blank_message(BallotTopic.ROAD.kind, header=header, poses=poses)


def map_cloud(ballot: Ballot, point_map: PointMap, frame: str = MAP_FRAME) -> Stamped:
    """The map's points of the ballot's tiles."""
    mapped = [point_map.tiles[tile.tile].points_map for tile in ballot.tiles if tile.tile in point_map.tiles]
    points = np.concatenate([np.empty((0, 3)), *mapped]).astype(np.float32)
    columns = {axis: points[:, k] for k, axis in enumerate("xyz")}
    return Stamped.of(BallotTopic.MAP, ballot, cloud_of(columns, ballot.end_ns, frame))
