"""Names of the ROS message types that a drive is read from, in bags and live."""

from __future__ import annotations

CLOUD = "sensor_msgs/msg/PointCloud2"
COMPRESSED = "point_cloud_interfaces/msg/CompressedPointCloud2"
LIVOX = (
    "livox_ros_driver2/msg/CustomMsg",
    "livox_ros_driver/msg/CustomMsg",
    "livox_interfaces/msg/CustomMsg",
)
"""Clouds of Livox's three drivers, all of one definition: decoded points, each with its time."""
CLOUDS = (CLOUD, *LIVOX, COMPRESSED)
"""Types of topics that hold the points of a LiDAR."""
ODOMETRY = "nav_msgs/msg/Odometry"
POSE = "geometry_msgs/msg/PoseStamped"
POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
POSES = (ODOMETRY, POSE_WITH_COVARIANCE, POSE)
"""Types of topics that say where a vehicle is."""
GNSS = "sensor_msgs/msg/NavSatFix"
IMU = "sensor_msgs/msg/Imu"
TF = "tf2_msgs/msg/TFMessage"
CLOCK = "rosgraph_msgs/msg/Clock"
