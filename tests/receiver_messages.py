"""Messages of a satellite receiver, an IMU and moving frames, as ROS 2 sends them."""

from __future__ import annotations

import numpy as np

from mapvote.core.geometry import from_xyz_rpy
from mapvote.core.types import F64
from mapvote.formats.drives.ros_types import GNSS, IMU, TF
from mapvote.live.messages import blank_message, header_of, pose_of, to_cdr


def fix_message(ns: int, lonlat: F64, sigma_m: float | None = None, *, status: int = 0) -> bytes:
    """A NavSatFix at ``lonlat`` (3,): longitude, latitude, height. ``sigma_m``: None is not stated."""
    message = blank_message(GNSS, header=header_of(ns, "gnss"))
    message.status.status = status
    message.longitude, message.latitude, message.altitude = lonlat.tolist()
    if sigma_m is not None:
        message.position_covariance = np.diag([sigma_m**2] * 3).ravel()
        message.position_covariance_type = 2
    return to_cdr(GNSS, message)


def imu_message(ns: int, yaw_rad: float, sigma_rad: float | None = None) -> bytes:
    """An Imu with this yaw from east; ``sigma_rad``: None is not stated."""
    message = blank_message(IMU, header=header_of(ns, "imu"))
    message.orientation = pose_of(from_xyz_rpy(0.0, 0.0, 0.0, 0.0, 0.0, yaw_rad)).orientation
    message.orientation_covariance = np.diag([0.0 if sigma_rad is None else sigma_rad**2] * 3).ravel()
    return to_cdr(IMU, message)


def moving_frame(ns: int, parent: str, child: str, T_parent_child: F64) -> bytes:
    """A TFMessage of one frame."""
    pose = pose_of(T_parent_child)
    transform = blank_message("geometry_msgs/msg/Transform", translation=pose.position, rotation=pose.orientation)
    stamped = blank_message(
        "geometry_msgs/msg/TransformStamped", header=header_of(ns, parent), child_frame_id=child, transform=transform
    )
    return to_cdr(TF, blank_message(TF, transforms=[stamped]))
