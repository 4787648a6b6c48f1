"""A ROS 2 node that votes: clouds and odometry in, a ballot to the server at the end of the drive.

    python ros2_node.py --ros-args -p server:=http://maps.example.org:8000 -p vehicle:=car_7 \\
        -r points:=/sensing/lidar/top/pointcloud -r odometry:=/localization/kinematic_state

The logic is in VotingDrive and knows no ROS; the node at the end only passes messages on.
"""

from __future__ import annotations

import logging
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from mapvote import MapClient, MapvoteError, PointMap, Sensor, Vehicle, scan_from_point_cloud2

log = logging.getLogger("mapvote_node")
MAX_AGE_NS = 200_000_000
"""A pose this much older or newer than a scan is no prior for it."""


class VotingDrive:
    """One drive: give it messages as they come, and at the end send what it says."""

    def __init__(
        self, point_map: PointMap, sensor: Sensor, vehicle: str, drive: str, T_base_lidar: np.ndarray | None = None
    ) -> None:
        """``T_base_lidar`` (4, 4): where the LiDAR sits on the vehicle, whose poses the odometry gives."""
        self.sensor = sensor
        self.vehicle = Vehicle(vehicle, sensor, point_map, drive_id=drive)
        self._T_base_lidar = np.eye(4) if T_base_lidar is None else T_base_lidar
        self._poses: deque[tuple[int, np.ndarray]] = deque(maxlen=50)
        self.refused = 0

    def on_odometry(self, message: Any) -> None:
        """nav_msgs/Odometry in the map's frame."""
        p, q = message.pose.pose.position, message.pose.pose.orientation
        T_map_base = np.eye(4)
        T_map_base[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
        T_map_base[:3, 3] = p.x, p.y, p.z
        stamp = message.header.stamp
        self._poses.append((stamp.sec * 10**9 + stamp.nanosec, T_map_base))

    def on_points(self, message: Any) -> None:
        """sensor_msgs/PointCloud2. A cloud that cannot be used is counted and said, and the drive goes on."""
        try:
            scan = scan_from_point_cloud2(message, self.sensor)
        except MapvoteError as error:
            self.refused += 1
            log.warning("%s", error)
            return
        self.vehicle.observe(scan, self._prior(scan.stamp_ns))

    def _prior(self, stamp_ns: int) -> np.ndarray | None:
        near = min(self._poses, key=lambda pose: abs(pose[0] - stamp_ns), default=None)
        if near is None or abs(near[0] - stamp_ns) > MAX_AGE_NS:
            return None
        return near[1] @ self._T_base_lidar

    def send(self, client: MapClient) -> str:
        """End the drive and send its ballot; it waits in the client's spool if the server is away."""
        self.vehicle.finish()
        return client.send(self.vehicle.ballot())


def main() -> None:
    import rclpy  # comes with ROS 2
    from nav_msgs.msg import Odometry
    from rclpy.node import Node
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import PointCloud2

    rclpy.init()
    node = Node("mapvote")
    server, name, key = (
        node.declare_parameter(parameter, default).value
        for parameter, default in (("server", "http://127.0.0.1:8000"), ("vehicle", "car"), ("key", ""))
    )
    # A model of the LiDAR; `mapvote info DRIVE` measures one from a recording.
    sensor = Sensor("hdl32e", tuple(np.linspace(10.67, -30.67, 32)), 0.16)
    with MapClient(server, home=Path("~/.cache/mapvote").expanduser(), key=key or None) as client:
        drive = VotingDrive(client.fetch(), sensor, name, f"drive_{node.get_clock().now().nanoseconds}")
        node.create_subscription(PointCloud2, "points", drive.on_points, qos_profile_sensor_data)
        node.create_subscription(Odometry, "odometry", drive.on_odometry, 50)
        try:
            rclpy.spin(node)
        except KeyboardInterrupt:
            node.get_logger().info(f"ballot {drive.send(client)}")


if __name__ == "__main__":
    main()
