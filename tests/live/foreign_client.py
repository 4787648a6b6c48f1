"""A client of Autoware's differential map loader that shares no code with mapvote: its message types are its own.

It obeys as Autoware's NDT does: it takes each tile that comes and drops each id that is named.
"""

import time
from dataclasses import dataclass

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct, types
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic


@dataclass
class Time(IdlStruct, typename="builtin_interfaces.msg.dds_.Time_"):
    sec: types.int32
    nanosec: types.uint32


@dataclass
class Header(IdlStruct, typename="std_msgs.msg.dds_.Header_"):
    stamp: Time
    frame_id: str


@dataclass
class PointField(IdlStruct, typename="sensor_msgs.msg.dds_.PointField_"):
    name: str
    offset: types.uint32
    datatype: types.uint8
    count: types.uint32


@dataclass
class PointCloud2(IdlStruct, typename="sensor_msgs.msg.dds_.PointCloud2_"):
    header: Header
    height: types.uint32
    width: types.uint32
    fields: types.sequence[PointField]
    is_bigendian: bool
    point_step: types.uint32
    row_step: types.uint32
    data: types.sequence[types.uint8]
    is_dense: bool


@dataclass
class Square(IdlStruct, typename="autoware_map_msgs.msg.dds_.PointCloudMapCellMetaData_"):
    min_x: types.float32
    min_y: types.float32
    max_x: types.float32
    max_y: types.float32


@dataclass
class MapTile(IdlStruct, typename="autoware_map_msgs.msg.dds_.PointCloudMapCellWithID_"):
    cell_id: str
    pointcloud: PointCloud2
    metadata: Square


@dataclass
class Area(IdlStruct, typename="autoware_map_msgs.msg.dds_.AreaInfo_"):
    center_x: types.float32
    center_y: types.float32
    radius: types.float32


@dataclass
class Request(IdlStruct, typename="autoware_map_msgs.srv.dds_.GetDifferentialPointCloudMap_Request_"):
    guid: types.uint64
    seq: types.int64
    area: Area
    cached_ids: types.sequence[str]


@dataclass
class Reply(IdlStruct, typename="autoware_map_msgs.srv.dds_.GetDifferentialPointCloudMap_Response_"):
    guid: types.uint64
    seq: types.int64
    header: Header
    new_pointcloud_with_ids: types.sequence[MapTile]
    ids_to_remove: types.sequence[str]


class ForeignClient:
    """One vehicle: the tiles that it holds, by id."""

    def __init__(self, domain: int, held: list[str]) -> None:
        self.held = set(held)
        self.replies = 0
        self._participant = DomainParticipant(domain)
        qos = Qos(Policy.Reliability.Reliable(1_000_000_000), Policy.History.KeepLast(10))
        name = "/map/get_differential_pointcloud_map"
        requests = Topic(self._participant, f"rq{name}Request", Request)
        replies = Topic(self._participant, f"rr{name}Reply", Reply)
        self._writer = DataWriter(self._participant, requests, qos=qos)
        self._reader = DataReader(self._participant, replies, qos=qos)
        self._number = 0

    @property
    def sees_a_service(self) -> bool:
        """As rclcpp's ``service_is_ready``: both ends are matched."""
        return bool(self._writer.get_matched_subscriptions() and self._reader.get_matched_publications())

    def ask(self, x: float, y: float, radius_m: float, patience_s: float) -> bool:
        """Ask for the tiles around a place and obey the answer; returns whether one came in time."""
        self._number += 1
        self._writer.write(Request(0xABCD_0123_4567, self._number, Area(x, y, radius_m), sorted(self.held)))
        end = time.monotonic() + patience_s
        while time.monotonic() < end:
            for reply in self._reader.take(10):
                if not reply.sample_info.valid_data or (reply.guid, reply.seq) != (0xABCD_0123_4567, self._number):
                    continue
                self.held -= set(reply.ids_to_remove)
                self.held |= {tile.cell_id for tile in reply.new_pointcloud_with_ids if tile.pointcloud.width}
                self.replies += 1
                return True
            time.sleep(0.005)
        return False
