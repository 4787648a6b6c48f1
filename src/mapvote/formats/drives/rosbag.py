"""ROS 2 bags (sqlite3 and MCAP) and ROS 1 bags through the rosbags library (extra ``ros``): PointCloud2 as a drive."""

from __future__ import annotations

import weakref
from pathlib import Path
from typing import Any

import numpy as np
from pypcd4 import PointCloud
from scipy.spatial.transform import Rotation

from mapvote.core import geometry
from mapvote.core.sensors import Sensor
from mapvote.core.types import F64, I64, Drive, MapvoteError, Scan
from mapvote.formats.clean import BadPoints, log
from mapvote.formats.drives.kitti import read_T_map_lidar
from mapvote.formats.drives.numbered import prior_file
from mapvote.formats.drives.options import DriveFile, DriveOptions, make_drive, read_drive_file, read_mount
from mapvote.formats.drives.point_fields import scan_from_fields
from mapvote.formats.extras import require

CLOUD = "sensor_msgs/msg/PointCloud2"
POSES = ("nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")
MAX_GAP_NS = 500_000_000
"""A prior is not interpolated over a longer hole in its topic, nor beyond its ends."""


def is_rosbag(path: Path) -> bool:
    return (path / "metadata.yaml").is_file() or (path.is_file() and path.suffix in (".bag", ".mcap", ".db3"))


class _Bag:
    """An open bag. Closed when the drive that reads from it is gone."""

    def __init__(self, path: Path) -> None:
        reader = require("rosbags.highlevel", "ros", str(path))
        stores = require("rosbags.typesys", "ros", str(path))
        typestore = stores.get_typestore(stores.Stores.LATEST)
        try:
            self.reader = reader.AnyReader([path], default_typestore=typestore)
            self.reader.open()
        except Exception as error:  # rosbags lets through what its storages raise
            raise MapvoteError(
                f"{path}: not a readable bag ({error}); was the recording stopped properly? Try: ros2 bag reindex"
            ) from error
        weakref.finalize(self, self.reader.close)
        self.path = path

    def topics(self, *types: str) -> dict[str, int]:
        """Topics of these message types, with their number of messages."""
        return {name: t.msgcount for name, t in sorted(self.reader.topics.items()) if t.msgtype in types}

    def messages(self, topic: str, **window: int) -> Any:
        """(receive time ns, message) one by one; ``start``, ``stop`` bound the receive time."""
        connections = [c for c in self.reader.connections if c.topic == topic]
        for connection, time_ns, data in self.reader.messages(connections=connections, **window):
            yield time_ns, self.reader.deserialize(data, connection.msgtype)


def open_rosbag(path: Path, options: DriveOptions) -> Drive:
    """The drive of one PointCloud2 topic. MapvoteError lists the topics if there is none or a choice to make."""
    about = read_drive_file(path) if path.is_dir() else DriveFile()
    bag = _Bag(path)
    topic = _choose_topic(bag, options.topic or about.topic)
    received_ns, stamps_ns = _stamps(bag, topic)
    wanted = options.prior or about.prior
    if wanted in bag.topics(*POSES):
        T_base_lidar = read_mount(options.mount or about.T_base_lidar, str(path))
        T_prior: F64 | None = _poses_at(bag, wanted or "", stamps_ns) @ T_base_lidar
    elif wanted is not None and wanted.startswith("/"):
        listed = ", ".join(bag.topics(*POSES)) or "none"
        raise MapvoteError(f"{path}: no pose topic {wanted}; topics with poses: {listed}")
    else:
        prior = prior_file(path, about, options)
        T_prior = None if prior is None else read_T_map_lidar(prior, path)
        if T_prior is not None and len(T_prior) != len(stamps_ns):
            raise MapvoteError(
                f"{prior}: {len(T_prior)} poses for {len(stamps_ns)} scans of {topic}; one a scan, in order"
            )
    bad_points = BadPoints(str(path))

    def read_scan(i: int, sensor: Sensor) -> Scan:
        start = int(received_ns[i])
        where = f"{path} {topic}, scan {i}"
        for _, message in bag.messages(topic, start=start, stop=start + 1):
            if _stamp_ns(message) in (stamps_ns[i], 0):
                table = _table(where, message)
                return scan_from_fields(where, i, int(stamps_ns[i]), table, sensor=sensor, bad_points=bad_points)
        raise MapvoteError(f"{where}: gone; the bag changed while it was read")

    return make_drive(path, about, options, stamps_ns=stamps_ns, T_map_lidar_prior=T_prior, read_scan=read_scan)


def _choose_topic(bag: _Bag, wanted: str | None) -> str:
    topics = bag.topics(CLOUD)
    listed = ", ".join(f"{name} ({n})" for name, n in topics.items())
    if not topics:
        others = ", ".join(sorted(bag.reader.topics)) or "none"
        raise MapvoteError(f"{bag.path}: no topic of {CLOUD}; topics: {others}")
    if wanted is None and len(topics) > 1:
        raise MapvoteError(f"{bag.path}: several PointCloud2 topics; choose with --topic or drive.toml: {listed}")
    if wanted is not None and wanted not in topics:
        raise MapvoteError(f"{bag.path}: no PointCloud2 topic {wanted}; there are: {listed}")
    topic = wanted or next(iter(topics))
    if topics[topic] == 0:
        raise MapvoteError(f"{bag.path}: {topic} holds no message; record it again")
    return topic


def _stamp_ns(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def _stamps(bag: _Bag, topic: str) -> tuple[I64, I64]:
    """(receive times, header stamps) of every scan; the receive times twice where the driver wrote no stamps."""
    rows = np.array([(time_ns, _stamp_ns(message)) for time_ns, message in bag.messages(topic)], dtype=np.int64)
    if (rows[:, 1] == 0).all():
        log.warning("%s: %s has no stamps in its headers; the times of receipt are used", bag.path, topic)
        return rows[:, 0], rows[:, 0]
    return rows[:, 0], rows[:, 1]


def _table(where: str, message: Any) -> np.ndarray:
    """The points of a PointCloud2 as a structured array (n,); MapvoteError if its sizes contradict each other."""
    expected = message.width * message.height * message.point_step
    data = message.data
    if message.height > 1 and message.row_step != message.width * message.point_step:
        data = data.reshape(message.height, message.row_step)[:, : message.width * message.point_step].ravel()
    if len(data) != expected:
        raise MapvoteError(f"{where}: {len(data)} bytes, but its header says {expected}: the message is cut off")
    message.data = data
    table: np.ndarray = PointCloud.from_msg(message).pc_data
    return table.byteswap().view(table.dtype.newbyteorder()) if message.is_bigendian else table


def _poses_at(bag: _Bag, topic: str, stamps_ns: I64) -> F64:
    """T_map_base (n, 4, 4) at the stamps, from a topic of poses, at constant twist between two messages."""
    times, poses = [], []
    for _, message in bag.messages(topic):
        pose = message.pose.pose if hasattr(message.pose, "pose") else message.pose
        p, q = pose.position, pose.orientation
        T = np.eye(4)
        T[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
        T[:3, 3] = p.x, p.y, p.z
        times.append(_stamp_ns(message))
        poses.append(T)
    order = np.argsort(times, kind="stable")
    t = np.array(times, dtype=np.int64)[order]
    after = np.clip(np.searchsorted(t, stamps_ns), 1, max(len(t) - 1, 1))
    gap = np.maximum(t[np.minimum(after, len(t) - 1)] - t[after - 1], 1) if len(t) > 1 else np.array([MAX_GAP_NS + 1])
    if len(t) < 2 or stamps_ns[0] < t[0] - MAX_GAP_NS or stamps_ns[-1] > t[-1] + MAX_GAP_NS or gap.max() > MAX_GAP_NS:
        raise MapvoteError(
            f"{bag.path}: {topic} ({len(t)} poses) does not cover the scans without holes of {MAX_GAP_NS / 1e9} s; "
            f"choose scans that it covers, or --prior none"
        )
    share = (stamps_ns - t[after - 1]) / gap
    sorted_poses = [poses[i] for i in order]
    pairs = zip(after, share, strict=True)
    return np.stack([geometry.interpolate(sorted_poses[a - 1], sorted_poses[a], float(s)) for a, s in pairs])
