"""Clouds, poses and frames as messages of ROS 2, and poses from them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from mapvote.core.types import F64, MapvoteError
from mapvote.live.cdr import blank_message, header_of

CLOUD, ODOMETRY, TF = "sensor_msgs/msg/PointCloud2", "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage"
MAP_FRAME, BASE_FRAME, LIDAR_FRAME = "map", "base_link", "lidar"
_DATATYPES = {"<f4": 7, "<u2": 4}
"""Of a sensor_msgs/PointField."""


def cloud_of(columns: Mapping[str, NDArray[Any]], stamp_ns: int, frame: str) -> Any:
    """A PointCloud2 whose fields are the (n,) columns, of float32 or uint16."""
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


def matrix_of(position: Any, orientation: Any) -> F64:
    """T (4, 4) of a message's position and quaternion. MapvoteError if they are no pose."""
    T, q = np.eye(4), orientation
    length = float(np.linalg.norm([q.x, q.y, q.z, q.w]))
    if not np.isfinite([length, position.x, position.y, position.z]).all() or length < 0.5:
        raise MapvoteError("numbers that are not finite, or a quaternion of zeros")
    T[:3, :3] = scipy.spatial.transform.Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    T[:3, 3] = position.x, position.y, position.z
    return T
