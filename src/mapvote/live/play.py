"""A recorded drive, sent on DDS as a vehicle would send it.

Of a ROS 2 bag the bytes of its messages go out as they were recorded, at the times of their receipt. Of any other drive
clouds are made of its scans, odometry of its prior, and /tf_static of its mount.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy

from mapvote.core.geometry import inverse
from mapvote.core.types import F64, Drive, MapvoteError, Scan
from mapvote.formats import open_drive
from mapvote.formats.drives.rosbag import Bag, is_rosbag
from mapvote.live.cdr import TYPES, blank_message, header_of, to_cdr
from mapvote.live.dds import Network, Publication
from mapvote.live.topics import CLOUD, ODOMETRY, TF

_SEEN_S = 0.5
"""Between the first reader and the first message, so that every reader has found every topic."""
_REPEATED_S = 30.0
"""How long a slow reader may take for what was sent last."""
POINTS, POSES = "/points", "/odometry"
MAP_FRAME, BASE_FRAME, LIDAR_FRAME = "map", "base_link", "lidar"


class Message(NamedTuple):
    """One message on its way."""

    time_ns: int
    topic: str
    kind: str
    data: bytes


def play(path: Path, network: Network, *, rate: float = 1.0, wait_s: float = 0.0, loops: int = 1) -> int:
    """Send a recorded drive; returns how many messages.

    ``rate``: times as fast as recorded. ``wait_s``: wait so long for a reader at most. ``loops``: so many times, with
    the stamps of the recording each time. MapvoteError if there is nothing that can be sent, or not all was received.
    """
    topics, messages = opened(path)
    out: dict[str, Publication] = {}
    for topic, kind in topics:
        durable = topic.endswith("tf_static")
        out[topic] = out.get(topic) or network.publish(topic, kind, transient_local=durable)
    end = time.monotonic() + wait_s
    while time.monotonic() < end and not any(publication.readers for publication in out.values()):
        time.sleep(0.05)
    time.sleep(_SEEN_S)
    count = 0
    for _ in range(loops):
        start, first = time.monotonic(), None
        for message in messages():
            first = message.time_ns if first is None else first
            time.sleep(max(0.0, start + 1e-9 * (message.time_ns - first) / rate - time.monotonic()))
            out[message.topic].send(message.data)
            count += 1
    late = [topic for topic, publication in out.items() if not publication.delivered(_REPEATED_S)]
    if late:  # a reliable writer that is gone repeats nothing
        raise MapvoteError(
            f"{path}: a reader has not got all of {', '.join(late)} in {_REPEATED_S:.0f} s; is it too slow?"
        )
    time.sleep(_SEEN_S)
    return count


def opened(path: Path) -> tuple[list[tuple[str, str]], Callable[[], Iterator[Message]]]:
    """(topic, type) of what a recorded drive sends, and what gives its messages. MapvoteError if it sends nothing."""
    if is_rosbag(path):
        bag = Bag(path)
        return topics_of_bag(bag), lambda: messages_of_bag(bag)
    drive = open_drive(path)
    return topics_of_drive(drive), lambda: messages_of_drive(drive)


def topics_of_bag(bag: Bag) -> list[tuple[str, str]]:
    """(topic, type) of what can be sent of a bag. MapvoteError if it is of ROS 1 or has nothing."""
    if not bag.reader.is2:
        raise MapvoteError(f"{bag.path}: a ROS 1 bag, whose messages are no CDR; convert it with rosbags-convert")
    found = [(c.topic, c.msgtype) for c in bag.reader.connections if c.msgtype in TYPES]
    if not found:
        raise MapvoteError(f"{bag.path}: no topic of a type that can be played: {', '.join(sorted(TYPES))}")
    return found


def messages_of_bag(bag: Bag) -> Iterator[Message]:
    """What a bag holds of the known types, as it was recorded."""
    connections = [c for c in bag.reader.connections if c.msgtype in TYPES]
    for connection, time_ns, data in bag.reader.messages(connections=connections):
        yield Message(time_ns, connection.topic, connection.msgtype, bytes(data))


def topics_of_drive(drive: Drive) -> list[tuple[str, str]]:
    """(topic, type) of what is made of a drive."""
    poses = [] if drive.T_map_lidar_prior is None else [(POSES, ODOMETRY)]
    return [("/tf_static", TF), *poses, (POINTS, CLOUD)]


def messages_of_drive(drive: Drive) -> Iterator[Message]:
    """A drive as a vehicle would have sent it: its mount once, then of each scan pose and cloud."""
    start_ns = int(drive.stamps_ns[0])
    mount = transform_message(start_ns, BASE_FRAME, LIDAR_FRAME, drive.T_base_lidar)
    yield Message(start_ns, "/tf_static", TF, to_cdr(TF, blank_message(TF, transforms=[mount])))
    T_lidar_base = inverse(drive.T_base_lidar)
    for i, scan in enumerate(drive):
        stamp_ns = int(drive.stamps_ns[i])
        if drive.T_map_lidar_prior is not None:
            data = odometry_message(stamp_ns, drive.T_map_lidar_prior[i] @ T_lidar_base)
            yield Message(stamp_ns, POSES, ODOMETRY, data)
        yield Message(stamp_ns, POINTS, CLOUD, cloud_message(scan))


def cloud_message(scan: Scan, frame: str = LIDAR_FRAME) -> bytes:
    """A PointCloud2 of a scan: x, y, z, and what it has of intensity (0 to 255), ring and time (seconds from the
    stamp)."""
    columns: list[tuple[str, str, int, Any]] = [(axis, "<f4", 7, scan.points[:, k]) for k, axis in enumerate("xyz")]
    if scan.intensity is not None:
        columns.append(("intensity", "<f4", 7, 255.0 * scan.intensity))
    if scan.ring is not None:
        columns.append(("ring", "<u2", 4, scan.ring))
    if scan.time_s is not None:
        columns.append(("time", "<f4", 7, scan.time_s))
    table = np.empty(len(scan.points), [(name, kind) for name, kind, _, _ in columns])
    fields, at = [], 0
    for name, kind, code, values in columns:
        table[name] = values
        fields.append(blank_message("sensor_msgs/msg/PointField", name=name, offset=at, datatype=code, count=1))
        at += np.dtype(kind).itemsize
    n, header = len(table), header_of(scan.stamp_ns, frame)
    message = blank_message(CLOUD, header=header, height=1, width=n, fields=fields, point_step=at, row_step=at * n)
    message.data, message.is_dense = table.tobytes(), True
    return to_cdr(CLOUD, message)


def odometry_message(stamp_ns: int, T_map_base: F64) -> bytes:
    """An Odometry of a pose (4, 4)."""
    message = blank_message(ODOMETRY, header=header_of(stamp_ns, MAP_FRAME), child_frame_id=BASE_FRAME)
    message.pose.pose = pose_of(T_map_base)
    return to_cdr(ODOMETRY, message)


def pose_of(T: F64) -> Any:
    """A geometry_msgs/Pose of T (4, 4)."""
    return blank_message(
        "geometry_msgs/msg/Pose",
        position=_xyz("geometry_msgs/msg/Point", T),
        orientation=_quaternion(T),
    )


def _xyz(kind: str, T: F64) -> Any:
    x, y, z = T[:3, 3].tolist()
    return blank_message(kind, x=x, y=y, z=z)


def _quaternion(T: F64) -> Any:
    x, y, z, w = scipy.spatial.transform.Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
    return blank_message("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)


def transform_message(stamp_ns: int, parent: str, child: str, T_parent_child: F64) -> Any:
    """A geometry_msgs/TransformStamped of T (4, 4)."""
    transform = blank_message(
        "geometry_msgs/msg/Transform",
        translation=_xyz("geometry_msgs/msg/Vector3", T_parent_child),
        rotation=_quaternion(T_parent_child),
    )
    header = header_of(stamp_ns, parent)
    return blank_message("geometry_msgs/msg/TransformStamped", header=header, child_frame_id=child, transform=transform)
