"""Clouds, poses and frames as messages of ROS 2, and poses from them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from mapvote.core.types import F64, MapvoteError, Scan
from mapvote.live.cdr import blank_message, header_of, to_cdr

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


def cloud_message(scan: Scan, frame: str = LIDAR_FRAME) -> bytes:
    """A PointCloud2 of a scan: x, y, z, and what it has of intensity (0 to 255), ring and time (seconds from the
    stamp)."""
    columns: dict[str, NDArray[Any]] = {axis: scan.points[:, k] for k, axis in enumerate("xyz")}
    if scan.intensity is not None:
        columns["intensity"] = np.float32(255.0) * scan.intensity
    if scan.ring is not None:
        columns["ring"] = scan.ring
    if scan.time_s is not None:
        columns["time"] = scan.time_s
    return to_cdr(CLOUD, cloud_of(columns, scan.stamp_ns, frame))


def odometry_message(stamp_ns: int, T_map_base: F64) -> bytes:
    """An Odometry of a pose (4, 4)."""
    message = blank_message(ODOMETRY, header=header_of(stamp_ns, MAP_FRAME), child_frame_id=BASE_FRAME)
    message.pose.pose = pose_of(T_map_base)
    return to_cdr(ODOMETRY, message)


def frames_message(stamp_ns: int, T_base_child: Mapping[str, F64]) -> bytes:
    """A TFMessage of frames on BASE_FRAME, by their names."""
    transforms = []
    for child, T in T_base_child.items():
        pose, transform = pose_of(T), blank_message("geometry_msgs/msg/Transform")
        transform.translation, transform.rotation = pose.position, pose.orientation
        header = header_of(stamp_ns, BASE_FRAME)
        transforms.append(
            blank_message(
                "geometry_msgs/msg/TransformStamped", header=header, child_frame_id=child, transform=transform
            )
        )
    return to_cdr(TF, blank_message(TF, transforms=transforms))


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
