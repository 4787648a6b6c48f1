"""Messages of ROS 2 as DDS carries them: CDR bytes, read and written by rosbags (extra ``ros2``); clouds and poses.

A message has its members as attributes. Sequences of numbers are views of the bytes: the points of a cloud are not
copied.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from mapvote.core.extras import require
from mapvote.core.types import F64, MapvoteError
from mapvote.formats.drives.point_fields import livox_table, serialised_frame, serialised_stamp_ns
from mapvote.formats.drives.ros_types import CLOCK, CLOUD, CLOUDS, GNSS, IMU, LIVOX, ODOMETRY, TF
from mapvote.formats.reading import first_line
from mapvote.live.message_types import lacking_types

POSE_TOPIC = "mapvote/pose"
"""Where a vehicle publishes its own pose, below its namespace."""
READ = {*CLOUDS, ODOMETRY, TF, IMU, GNSS, "std_msgs/msg/Header", CLOCK}
READ |= {f"diagnostic_msgs/msg/Diagnostic{name}" for name in ("Array", "Status")}
READ |= {
    f"geometry_msgs/msg/{name}{stamped}"
    for name in ("Point", "Pose", "PoseWithCovariance", "Quaternion", "Transform", "Twist", "Vector3")
    for stamped in ("", "Stamped")
}
"""Types of the topics that are counted and played."""
MAP_FRAME = "map"
LIDAR_FRAME = "lidar"
_DATATYPES = {"<f4": 7, "<u4": 6, "<u2": 4, "|u1": 2}
"""Types of a sensor_msgs/PointField."""


@cache
def typestore() -> Any:
    """Every message type, by its full name such as sensor_msgs/msg/PointCloud2."""
    types = require("rosbags.typesys", "ros2", "messages of ROS 2")
    store = types.get_typestore(types.Stores.LATEST)
    for name, definition in lacking_types().items():
        (registered,) = types.get_types_from_msg(definition, name).values()
        store.register({name: registered})
    return store


def blank_message(kind: str, **members: Any) -> Any:
    """A message of this type: zeros and empty strings, but for ``members``."""
    store = typestore()
    return store.types[kind](**{name: _blank(*of) for name, of in store.fielddefs[kind][1]} | members)


def _blank(shape: Any, of: Any) -> Any:
    if shape.name == "BASE":
        return "" if of[0] == "string" else 0
    if shape.name == "NAME":
        return blank_message(of)
    (inner, base), length = of
    return np.zeros(length, base[0]) if inner.name == "BASE" and base[0] != "string" else []


def from_cdr(kind: str, data: bytes | memoryview) -> Any:
    """The message, its members as attributes; numbers of a sequence as an array that is a view of ``data``. A cloud of
    Livox's drivers as a PointCloud2.

    MapvoteError if the bytes end too early or are in an encoding that ROS 2 does not use.
    """
    try:
        if kind in LIVOX:
            return _cloud_of_livox(kind, data)
        return typestore().deserialize_cdr(memoryview(data), kind)
    except MapvoteError:
        raise
    except Exception as error:  # rosbags raises the exceptions of struct, numpy and its own parsers
        raise MapvoteError(
            f"{kind}: a message of {len(data)} bytes is cut off, damaged or no plain CDR ({first_line(error)})"
        ) from error


def _cloud_of_livox(kind: str, data: bytes | memoryview) -> Any:
    """The PointCloud2 of a CustomMsg. rosbags would make an object of each point."""
    table = livox_table(kind, data, ros2=True)
    columns = {name: table[name] for name in table.dtype.names or ()}
    return cloud_of(columns, serialised_stamp_ns(kind, data, ros2=True), serialised_frame(data, ros2=True))


def to_cdr(kind: str, message: Any) -> bytes:
    """The message in little-endian CDR. Sequences of numbers are given as arrays."""
    return bytes(typestore().serialize_cdr(message, kind, little_endian=True))


def stamp_ns(header: Any) -> int:
    """The time in a std_msgs/Header, nanoseconds."""
    return time_ns(header.stamp)


def time_ns(time: Any) -> int:
    """A builtin_interfaces/Time, nanoseconds."""
    return int(time.sec) * 10**9 + int(time.nanosec)


def header_of(time_ns: int, frame_id: str) -> Any:
    """A std_msgs/Header."""
    time = blank_message("builtin_interfaces/msg/Time", sec=time_ns // 10**9, nanosec=time_ns % 10**9)
    return blank_message("std_msgs/msg/Header", stamp=time, frame_id=frame_id)


def cloud_of(columns: Mapping[str, NDArray[Any]], stamp_ns: int, frame: str) -> Any:
    """A PointCloud2 whose fields are the (n,) columns, of float32, uint8, uint16 or uint32."""
    types = {name: column.dtype.newbyteorder("<").str for name, column in columns.items()}
    table = np.empty(len(next(iter(columns.values()))), list(types.items()))
    fields = []
    for name, column in columns.items():
        table[name] = column
        _, offset = table.dtype.fields[name]  # type: ignore[index, misc]
        code = _DATATYPES[types[name]]
        fields.append(blank_message("sensor_msgs/msg/PointField", name=name, offset=offset, datatype=code, count=1))
    return blank_message(
        CLOUD,
        header=header_of(stamp_ns, frame),
        height=1,
        width=len(table),
        fields=fields,
        point_step=table.itemsize,
        row_step=table.nbytes,
        data=table.view(np.uint8),
        is_dense=True,
    )


def pose_of(T: F64) -> Any:
    """A geometry_msgs/Pose of T (4, 4)."""
    message = blank_message("geometry_msgs/msg/Pose")
    message.position.x, message.position.y, message.position.z = T[:3, 3].tolist()
    q = message.orientation
    q.x, q.y, q.z, q.w = scipy.spatial.transform.Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
    return message
