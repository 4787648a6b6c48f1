"""A recorded drive, sent on DDS as a vehicle would send it.

Messages of a ROS 2 bag are sent byte for byte, at the times of their receipt. For any other drive clouds are made of
its scans, odometry of its prior, and /tf_static of its mount.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapvote.core.geometry import inverse
from mapvote.core.points import point_field
from mapvote.core.record import record
from mapvote.core.types import F64, Drive, MapvoteError, Scan
from mapvote.formats import open_drive
from mapvote.formats.drives.bag import Bag, is_rosbag
from mapvote.formats.drives.frames import BASE_FRAME
from mapvote.formats.drives.ros_types import CLOUD, ODOMETRY, TF
from mapvote.live.dds import Network, Publication
from mapvote.live.messages import LIDAR_FRAME, MAP_FRAME, READ, blank_message, cloud_of, header_of, pose_of, to_cdr


@record()
@dataclass(frozen=True, slots=True)
class PlayWaits:
    """Waits of a drive that is played on DDS."""

    discovery_s: float = 0.5
    """Time between the first reader and the first message, seconds: every reader has found every topic by then."""
    delivery_s: float = 30.0
    """Time that a slow reader has for the last messages, seconds."""


PLAY_WAITS = PlayWaits()
POINTS, POSES = "/points", "/odometry"


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
    time.sleep(PLAY_WAITS.discovery_s)
    count = 0
    for _ in range(loops):
        start = time.monotonic()
        first = None
        for message in messages():
            first = message.time_ns if first is None else first
            time.sleep(max(0.0, start + 1e-9 * (message.time_ns - first) / rate - time.monotonic()))
            out[message.topic].send(message.data)
            count += 1
    late = [topic for topic, publication in out.items() if not publication.delivered(PLAY_WAITS.delivery_s)]
    if late:  # a reliable writer that is gone repeats nothing
        raise MapvoteError(
            f"{path}: a reader has not got all of {', '.join(late)} in {PLAY_WAITS.delivery_s:.0f} s; is it too slow?"
        )
    time.sleep(PLAY_WAITS.discovery_s)
    return count


def opened(path: Path) -> tuple[list[tuple[str, str]], Callable[[], Iterator[Message]]]:
    """(topic, type) of what a recorded drive sends, and what gives its messages. MapvoteError if it sends nothing."""
    if not is_rosbag(path):
        drive = open_drive(path)
        poses = [] if drive.T_map_lidar_prior is None else [(POSES, ODOMETRY)]
        return [("/tf_static", TF), *poses, (POINTS, CLOUD)], lambda: _messages_of_drive(drive)
    bag = Bag(path)
    if not bag.reader.is2:
        raise MapvoteError(f"{path}: a ROS 1 bag, whose messages are no CDR; convert it with rosbags-convert")
    connections = [c for c in bag.reader.connections if c.msgtype in READ]
    if not connections:
        raise MapvoteError(f"{path}: no topic of a type that can be played: {', '.join(sorted(READ))}")

    def messages() -> Iterator[Message]:
        for connection, time_ns, data in bag.reader.messages(connections=connections):
            yield Message(time_ns, connection.topic, connection.msgtype, bytes(data))

    return [(c.topic, c.msgtype) for c in connections], messages


def _messages_of_drive(drive: Drive) -> Iterator[Message]:
    """A drive as a vehicle would have sent it: its mount once, then of each scan pose and cloud."""
    start_ns = int(drive.stamps_ns[0])
    yield Message(start_ns, "/tf_static", TF, frames_message(start_ns, {LIDAR_FRAME: drive.T_base_lidar}))
    T_lidar_base = inverse(drive.T_base_lidar)
    for i, scan in enumerate(drive):
        stamp_ns = int(drive.stamps_ns[i])
        if drive.T_map_lidar_prior is not None:
            data = odometry_message(stamp_ns, drive.T_map_lidar_prior[i] @ T_lidar_base)
            yield Message(stamp_ns, POSES, ODOMETRY, data)
        yield Message(stamp_ns, POINTS, CLOUD, cloud_message(scan))


def cloud_message(scan: Scan, frame: str = LIDAR_FRAME) -> bytes:
    """A PointCloud2 of a scan: x, y, z, and what it has of attributes (scaled ones 0 to 255), ring and time (seconds
    from the stamp)."""
    columns: dict[str, NDArray[Any]] = {axis: scan.points[:, k] for k, axis in enumerate("xyz")}
    for name, values in scan.fields.items():
        columns[name] = np.float32(255.0) * values if point_field(name).scaled else values
    if scan.ring is not None:
        columns["ring"] = scan.ring
    if scan.time_s is not None:
        columns["time"] = scan.time_s
    return to_cdr(CLOUD, cloud_of(columns, scan.stamp_ns, frame))


def odometry_message(stamp_ns: int, T_frame_base: F64, frame: str = MAP_FRAME) -> bytes:
    """An Odometry of a pose (4, 4) in ``frame``."""
    message = blank_message(ODOMETRY, header=header_of(stamp_ns, frame), child_frame_id=BASE_FRAME)
    message.pose.pose = pose_of(T_frame_base)
    return to_cdr(ODOMETRY, message)


def frames_message(stamp_ns: int, T_parent_child: Mapping[str, F64], parent: str = BASE_FRAME) -> bytes:
    """A TFMessage of frames on their ``parent``, by their names."""
    transforms = []
    for child, T in T_parent_child.items():
        pose = pose_of(T)
        transform = blank_message("geometry_msgs/msg/Transform")
        transform.translation = pose.position
        transform.rotation = pose.orientation
        header = header_of(stamp_ns, parent)
        transforms.append(
            blank_message(
                "geometry_msgs/msg/TransformStamped", header=header, child_frame_id=child, transform=transform
            )
        )
    return to_cdr(TF, blank_message(TF, transforms=transforms))
