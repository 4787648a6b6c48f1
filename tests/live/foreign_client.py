"""A client of Autoware's differential map loader that shares no code with mapvote: its message types are its own.

It obeys as Autoware's NDT does: it takes each tile that comes and drops each id that is named.
"""

import time
from typing import Any

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import make_idl_struct, types
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic


def _struct(package: str, name: str, /, **members: Any) -> Any:
    """A message type as an IDL compiler would make it."""
    return make_idl_struct(name, f"{package}.dds_.{name}_", members)


_U8 = types.sequence[types.uint8]
Time = _struct("builtin_interfaces.msg", "Time", sec=types.int32, nanosec=types.uint32)
Header = _struct("std_msgs.msg", "Header", stamp=Time, frame_id=str)
PointField = _struct(
    "sensor_msgs.msg", "PointField", name=str, offset=types.uint32, datatype=types.uint8, count=types.uint32
)
PointCloud2 = _struct(
    "sensor_msgs.msg",
    "PointCloud2",
    header=Header,
    height=types.uint32,
    width=types.uint32,
    fields=types.sequence[PointField],
    is_bigendian=bool,
    point_step=types.uint32,
    row_step=types.uint32,
    data=_U8,
    is_dense=bool,
)
_CORNERS = dict.fromkeys(("min_x", "min_y", "max_x", "max_y"), types.float32)
Square = _struct("autoware_map_msgs.msg", "PointCloudMapCellMetaData", **_CORNERS)
MapTile = _struct(
    "autoware_map_msgs.msg", "PointCloudMapCellWithID", cell_id=str, pointcloud=PointCloud2, metadata=Square
)
Area = _struct("autoware_map_msgs.msg", "AreaInfo", **dict.fromkeys(("center_x", "center_y", "radius"), types.float32))
_NUMBERS = {"guid": types.uint64, "seq": types.int64}
_SERVICE = "GetDifferentialPointCloudMap"
Request = _struct("autoware_map_msgs.srv", f"{_SERVICE}_Request", **_NUMBERS, area=Area, cached_ids=types.sequence[str])
Reply = _struct(
    "autoware_map_msgs.srv",
    f"{_SERVICE}_Response",
    **_NUMBERS,
    header=Header,
    new_pointcloud_with_ids=types.sequence[MapTile],
    ids_to_remove=types.sequence[str],
)


_SEQUENCES = {
    f"{name}_array_value": types.sequence[of]
    for name, of in (
        ("byte", types.byte),
        ("bool", bool),
        ("integer", types.int64),
        ("double", types.float64),
        ("string", str),
    )
}
ParameterValue = _struct(
    "rcl_interfaces.msg",
    "ParameterValue",
    type=types.uint8,
    bool_value=bool,
    integer_value=types.int64,
    double_value=types.float64,
    string_value=str,
    **_SEQUENCES,
)
AskParameters = _struct("rcl_interfaces.srv", "GetParameters_Request", **_NUMBERS, names=types.sequence[str])
ToldParameters = _struct(
    "rcl_interfaces.srv", "GetParameters_Response", **_NUMBERS, values=types.sequence[ParameterValue]
)
_GUID = 0xABCD_0123_4567
_QOS = Qos(Policy.Reliability.Reliable(1_000_000_000), Policy.History.KeepLast(10))


class HeightFitter:
    """Asks as Autoware's map_height_fitter does when it starts: a parameter of the map loader, and the whole map."""

    def __init__(self, domain: int) -> None:
        self._participant = DomainParticipant(domain)
        name = "/map/pointcloud_map_loader/get_parameters"
        self._writer = DataWriter(self._participant, Topic(self._participant, f"rq{name}Request", AskParameters), _QOS)
        self._reader = DataReader(self._participant, Topic(self._participant, f"rr{name}Reply", ToldParameters), _QOS)
        latched = Qos(
            Policy.Reliability.Reliable(1_000_000_000), Policy.Durability.TransientLocal, Policy.History.KeepLast(1)
        )
        self._maps = DataReader(
            self._participant, Topic(self._participant, "rt/map/pointcloud_map", PointCloud2), latched
        )
        self._asked = False

    def partial_load(self) -> list[bool]:
        """The answer to ``enable_partial_load``, once it is there."""
        matched = self._writer.get_matched_subscriptions() and self._reader.get_matched_publications()
        if matched and not self._asked:
            self._asked = True
            self._writer.write(AskParameters(guid=_GUID, seq=1, names=["enable_partial_load"]))
        replies = [r for r in self._reader.take(10) if r.sample_info.valid_data and (r.guid, r.seq) == (_GUID, 1)]
        return [value.type == 1 and value.bool_value for reply in replies for value in reply.values]

    def whole_maps(self) -> list[int]:
        """Points of the whole maps that came."""
        return [map_.width for map_ in self._maps.take(10) if map_.sample_info.valid_data]


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
        """The check of rclcpp's ``service_is_ready``: both ends are matched."""
        return bool(self._writer.get_matched_subscriptions() and self._reader.get_matched_publications())

    def ask(self, x: float, y: float, radius_m: float, patience_s: float) -> bool:
        """Ask for the tiles around a place and obey the answer; returns whether one came in time."""
        self._number += 1
        area = Area(center_x=x, center_y=y, radius=radius_m)
        request = Request(guid=_GUID, seq=self._number, area=area, cached_ids=sorted(self.held))
        self._writer.write(request)
        end = time.monotonic() + patience_s
        while time.monotonic() < end:
            for reply in self._reader.take(10):
                if not reply.sample_info.valid_data or (reply.guid, reply.seq) != (_GUID, self._number):
                    continue
                self.held -= set(reply.ids_to_remove)
                self.held |= {tile.cell_id for tile in reply.new_pointcloud_with_ids if tile.pointcloud.width}
                self.replies += 1
                return True
            time.sleep(0.005)
        return False
