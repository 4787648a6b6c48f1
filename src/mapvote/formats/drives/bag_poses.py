"""Poses in a bag: odometry, GNSS fixes, and where the LiDARs of one vehicle sit (/tf_static)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import scipy

from mapvote.core import geometry
from mapvote.core.types import F64, MapvoteError
from mapvote.formats.drives.trajectory import Trajectory, sorted_trajectory
from mapvote.formats.geo.frame import MapFrame
from mapvote.formats.geo.gnss import poses_from_gnss, yaw_from_track

if TYPE_CHECKING:
    from mapvote.formats.drives.rosbag import Bag

POSES = ("nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")
GNSS = ("sensor_msgs/msg/NavSatFix",)
_TF = "tf2_msgs/msg/TFMessage"


def bag_trajectory(bag: Bag, topic: str, frame: MapFrame | None) -> Trajectory:
    """T_map_base of a topic of poses, or of GNSS fixes in the frame of the map; fixes head where the vehicle drives."""
    if topic in bag.topics(*GNSS):
        return _fixes(bag, topic, frame)
    times, poses = [], []
    for _, message in bag.messages(topic):
        pose = message.pose.pose if hasattr(message.pose, "pose") else message.pose
        times.append(_stamp_ns(message))
        poses.append(_matrix(pose.position, pose.orientation))
    stacked = np.stack(poses) if poses else np.zeros((0, 4, 4))
    return sorted_trajectory(np.array(times, dtype=np.int64), stacked, of_vehicle=True, frame=MapFrame())


def _fixes(bag: Bag, topic: str, frame: MapFrame | None) -> Trajectory:
    rows = [
        (_stamp_ns(m), m.longitude, m.latitude, m.altitude)
        for _, m in bag.messages(topic)
        if m.status.status >= 0 and np.isfinite([m.longitude, m.latitude]).all()
    ]
    if not rows:
        raise MapvoteError(f"{bag.path}: {topic} holds no valid fix; choose another topic, or --prior none")
    place = np.nan_to_num(np.array([row[1:] for row in rows], dtype=np.float64))
    T, known = poses_from_gnss(place, np.zeros((len(rows), 3)), frame)
    times = np.array([row[0] for row in rows], dtype=np.int64)
    return sorted_trajectory(times, yaw_from_track(T), of_vehicle=True, frame=known)


def T_first_lidar(bag: Bag, first: str, other: str) -> F64:
    """T_first_other (4, 4) between the frames of two PointCloud2 topics, by /tf_static; MapvoteError without."""
    source, target = (frame_id(bag, topic) for topic in (first, other))
    reached = T_from(static_frames(bag), source)
    if target not in reached:
        raise MapvoteError(
            f"{bag.path}: /tf_static does not say where {target} ({other}) sits to {source} ({first}); record it, or "
            f"choose one LiDAR with --topic"
        )
    return reached[target]


Edges = dict[str, list[tuple[str, F64]]]


def static_frames(bag: Bag) -> Edges:
    """From each frame of /tf_static to its neighbours, with T_frame_neighbour (4, 4), both ways."""
    edges: Edges = {}
    for topic in bag.topics(_TF):
        if not topic.endswith("tf_static"):
            continue
        for _, message in bag.messages(topic):
            for t in message.transforms:
                T = _matrix(t.transform.translation, t.transform.rotation)
                parent, child = t.header.frame_id.strip("/"), t.child_frame_id.strip("/")
                edges.setdefault(parent, []).append((child, T))
                edges.setdefault(child, []).append((parent, geometry.inverse(T)))
    return edges


def T_from(edges: Edges, source: str) -> dict[str, F64]:
    """T_source_frame (4, 4) of every frame that can be reached."""
    reached, waiting = {source: np.eye(4)}, [source]
    while waiting:
        here = waiting.pop()
        for there, T in edges.get(here, []):
            if there not in reached:
                reached[there] = reached[here] @ T
                waiting.append(there)
    return reached


def frame_id(bag: Bag, topic: str, *, child: bool = False) -> str:
    """The frame of a topic's first message; ``child``: what an Odometry tracks, "" where the message does not say."""
    for _, message in bag.messages(topic):
        name = getattr(message, "child_frame_id", "") if child else message.header.frame_id
        return str(name).strip("/")
    return ""


def _stamp_ns(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def _matrix(p: Any, q: Any) -> F64:
    T = np.eye(4)
    T[:3, :3] = scipy.spatial.transform.Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    T[:3, 3] = p.x, p.y, p.z
    return T
