"""ROS 2 bags (sqlite3 and MCAP) and ROS 1 bags through the rosbags library (extra ``ros``): PointCloud2 as a drive.

Priors are topics of odometry or GNSS fixes; the mounts of a vehicle's LiDARs come from /tf_static.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapvote.core import geometry
from mapvote.core.sensors import Sensor
from mapvote.core.types import F64, I64, Drive, MapvoteError, Scan
from mapvote.formats.drives.bag import Bag, NextMessages, frame_id, stamps_of, static_frames
from mapvote.formats.drives.bag_files import mend_of
from mapvote.formats.drives.bag_poses import choose_poses, prior_of_bag
from mapvote.formats.drives.compressed_cloud import one_of_each_cloud
from mapvote.formats.drives.frames import T_from, two_frames
from mapvote.formats.drives.options import DriveOptions, make_drive, read_mount, step_of
from mapvote.formats.drives.packets import PACKET_RULE, SWEEP_RULE, Packets, direction_of, scan_of_packets
from mapvote.formats.drives.point_fields import PointReader, log, tell_without_points
from mapvote.formats.drives.ros_types import CLOUD, CLOUDS
from mapvote.formats.drives.stamp_order import in_order_of_stamps


def open_rosbag(path: Path, options: DriveOptions) -> Drive:
    """The drive of one PointCloud2 topic, or of several of one vehicle (--topic /front,/rear).

    The clouds of several LiDARs in one revolution make one scan, at the stamp of the first of them, its points in the
    frame of the first topic's LiDAR, by /tf_static. MapvoteError lists the topics if there is none or a choice to make.
    """
    bag = Bag(path)
    for line in bag.mended:
        log.warning("%s", line)
    topics = _choose_topics(bag, options.topic)
    mounts = [np.eye(4), *(T_first_lidar(bag, topics[0], other, options.mounts) for other in topics[1:])]
    own = _mount_in(options.mounts, topics[0], str(path))
    left_out: list[str] = []
    clouds = NextMessages(bag, topics)
    sweeps = _sweeps(bag, topics, clouds, left_out)
    stamps_ns = np.array([sweep[0].stamp_ns for sweep in sweeps], dtype=np.int64)
    poses = choose_poses(bag, options, topics[0], own)
    prior = prior_of_bag(bag, options, stamps_ns, poses)
    readers = [PointReader(f"{path} {topic}", options.time_rules, step_of(stamps_ns)) for topic in topics]

    def read_cloud(i: int, message: _Message, sensor: Sensor) -> Scan:
        source = f"{path} {topics[message.topic]}, scan {i}"
        table = _points_of(bag, clouds, topics[message.topic], message, source)
        return readers[message.topic].scan(source, i, message.stamp_ns, table, sensor)

    def read_message(i: int, message: _Message, sensor: Sensor) -> Scan:
        if message.packets:
            stamps = [packet.stamp_ns for packet in message.packets]
            scan = scan_of_packets(
                message.stamp_ns,
                stamps,
                readers[message.topic],
                lambda number: read_cloud(i, message.packets[number], sensor),
            )
        else:
            scan = read_cloud(i, message, sensor)
        return scan if message.topic == 0 else scan.seen_from(mounts[message.topic])

    def read_scan(i: int, sensor: Sensor) -> Scan:
        scans = [read_message(i, message, sensor) for message in sweeps[i]]
        return scans[0] if len(scans) == 1 else Scan.sweep(int(stamps_ns[i]), scans)

    drive = make_drive(
        path,
        options,
        stamps_ns=stamps_ns,
        T_map_lidar_prior=prior.T_map_lidar,
        read_scan=read_scan,
        frame=prior.frame,
        T_base_lidar=poses.T_base_lidar,
        prior_sigmas=prior.sigmas,
    )
    return replace(drive, prior_in_map=poses.in_map, left_out=tuple(left_out))


def _choose_topics(bag: Bag, wanted: str | None) -> list[str]:
    topics = bag.topics(*CLOUDS)
    listed = ", ".join(f"{name} ({n})" for name, n in topics.items())
    # Parts of the names of messages in which drivers record what came over the wire.
    words = ("Packet", "VelodyneScan", "PandarScan", "HesaiScan", "RslidarScan")
    packets = sorted(
        name
        for name, topic in bag.reader.topics.items()
        if topic.msgtype and any(word in topic.msgtype for word in words)
    )
    if not topics and packets:
        raise MapvoteError(f"{bag.path}: raw packets only ({', '.join(packets)}): decode with your driver first")
    if not topics:
        others = ", ".join(sorted(bag.reader.topics)) or "none"
        raise MapvoteError(f"{bag.path}: no topic of {CLOUD} or Livox's CustomMsg; topics: {others}")
    clouds = one_of_each_cloud({name: str(bag.reader.topics[name].msgtype) for name in topics})
    if wanted is None and len(clouds) > 1:
        raise MapvoteError(
            f"{bag.path}: several PointCloud2 topics; choose with --topic or drive.toml, several LiDARs of one vehicle "
            f"with commas: {listed}"
        )
    chosen = [name.strip() for name in wanted.split(",")] if wanted is not None else clouds
    for topic in chosen:
        if topic not in topics:
            raise MapvoteError(f"{bag.path}: no PointCloud2 topic {topic}; there are: {listed}")
        if topics[topic] == 0:
            raise MapvoteError(f"{bag.path}: {topic} holds no message; record it again")
    return chosen


@dataclass(frozen=True, slots=True)
class _Message:
    """One PointCloud2 of a bag."""

    stamp_ns: int
    topic: int
    received_ns: int
    header_ns: int
    """The stamp in its header, 0 if it has none."""
    packets: tuple[_Message, ...] = ()
    """The packets of a revolution, of which this is the first; () if it came whole."""


def _sweeps(bag: Bag, topics: list[str], clouds: NextMessages, left_out: list[str]) -> list[list[_Message]]:
    """The messages of each scan of the drive, by topic: what several LiDARs took within half a revolution. Sentences on
    scans without a point are added to ``left_out``."""
    messages: list[_Message] = []
    for k, (topic, stamps) in enumerate(stamps_of(bag, topics).items()):
        messages += _revolutions(bag, topic, clouds, _messages_of(bag, topic, k, clouds, stamps, left_out))
    if not messages:
        raise MapvoteError(f"{bag.path}: {', '.join(topics)}: no message can be read; {mend_of(bag.path)}")
    if len(topics) == 1:
        return [[message] for message in messages]
    first_ns = np.array([message.stamp_ns for message in messages if message.topic == 0])
    reach_ns = SWEEP_RULE.revolutions * float(np.median(np.diff(first_ns))) if len(first_ns) > 1 else 0.0
    sweeps: list[list[_Message]] = []
    for message in sorted(messages, key=lambda m: (m.stamp_ns, m.topic)):
        last = sweeps[-1] if sweeps else []
        if last and message.stamp_ns - last[0].stamp_ns <= reach_ns and message.topic not in {m.topic for m in last}:
            last.append(message)
        else:
            sweeps.append([message])
    return [sorted(sweep, key=lambda m: m.topic) for sweep in sweeps]


def _points_of(bag: Bag, clouds: NextMessages, topic: str, message: _Message, source: str) -> NDArray[np.void]:
    """The points (n,) of one cloud of a topic. MapvoteError if it is not there any more, or damaged."""
    serialised = clouds.read(topic, message.received_ns, message.header_ns)
    if serialised is None:
        raise MapvoteError(f"{source}: gone; the bag changed while it was read")
    frame = bag.frame_id(serialised[1]).strip("/")
    first = clouds.frames.setdefault(topic, frame)
    if frame != first:
        raise MapvoteError(f"{source}: {two_frames(topic, first, frame)}")
    return bag.points(source, *serialised)


def _revolutions(bag: Bag, topic: str, clouds: NextMessages, messages: list[_Message]) -> list[_Message]:
    """The clouds of a topic, or, if each is a part of a revolution, the first of each revolution with its packets. The
    last revolution, whose end nothing shows, is left out, as on the road."""
    packets: Packets[_Message] = Packets()
    for message in messages[: PACKET_RULE.looked_at]:
        with suppress(MapvoteError):  # a damaged cloud is reported when it is read as a scan
            direction = direction_of(_points_of(bag, clouds, topic, message, f"{bag.path} {topic}"))
            packets.add(message, message.stamp_ns, lambda looked=direction: looked)  # type: ignore[misc]
    if not packets.is_packets:
        return messages
    # One pass over the topic gives the direction of each.
    directions = {
        (received_ns, bag.stamp_ns(data)): direction_of(bag.points(f"{bag.path} {topic}", connection, data))
        for connection, received_ns, data in bag.raw(topic)
    }
    packets = Packets()
    out = []
    for message in messages:
        looked = directions[message.received_ns, message.header_ns]
        for group in packets.add(message, message.stamp_ns, lambda looked=looked: looked):  # type: ignore[misc]
            out.append(replace(group[0], packets=tuple(group)))
    log.info("%s: %s: %d packets are joined to %d revolutions", bag.path, topic, len(messages), len(out))
    return out


def _messages_of(
    bag: Bag, topic: str, k: int, clouds: NextMessages, stamps: I64, left_out: list[str]
) -> list[_Message]:
    """The messages of the ``k``-th topic by their stamps; those that are left out are counted and reported. ``stamps``
    (n, 3): as :func:`stamps_of`."""
    headers, received, sizes = stamps.T
    order = in_order_of_stamps(headers, received)
    for line in order.told:
        log.warning("%s: %s %s", bag.path, topic, line)
    rows = zip(order.stamps_ns.tolist(), order.chosen.tolist(), strict=True)
    every = [(_Message(stamp_ns, k, int(received[i]), int(headers[i])), int(sizes[i])) for stamp_ns, i in rows]
    empty = {message.stamp_ns for message, size in every if _is_empty(bag, clouds, topic, message, size)}
    if empty:
        names = [f"{ns / 1e9:.3f} s" for ns in sorted(empty)]
        left_out.append(tell_without_points(f"{bag.path} {topic}", len(every), names))
    return [message for message, _ in every if message.stamp_ns not in empty]


def _is_empty(bag: Bag, clouds: NextMessages, topic: str, message: _Message, size: int) -> bool:
    """Whether a cloud, ``size`` bytes serialised, holds no point, as of a driver that started before its sensor."""
    with suppress(MapvoteError):  # a damaged cloud is reported when it is read as a scan
        return size < SMALL_CLOUD_BYTES and len(_points_of(bag, clouds, topic, message, str(bag.path))) == 0
    return False


SMALL_CLOUD_BYTES = 1_024
"""Smaller messages may be clouds without points; larger ones are not looked at before they are read."""


def _mount_in(mounts: Mapping[str, list[float]], topic: str, source: str) -> F64 | None:
    return read_mount(mounts[topic], f"{source}: mounts: {topic}") if topic in mounts else None


def T_first_lidar(bag: Bag, first: str, other: str, mounts: Mapping[str, list[float]]) -> F64:
    """T_first_other (4, 4) between two PointCloud2 topics, by ``mounts`` if both are in it, else by the frames of
    /tf_static; MapvoteError without."""
    T_base_first, T_base_other = (_mount_in(mounts, topic, str(bag.path)) for topic in (first, other))
    if T_base_first is not None and T_base_other is not None:
        return np.asarray(geometry.inverse(T_base_first) @ T_base_other)
    source, target = (frame_id(bag, topic) for topic in (first, other))
    reached = T_from(static_frames(bag), source)
    if target not in reached:
        raise MapvoteError(
            f"{bag.path}: /tf_static holds no transform from {source} ({first}) to {target} ({other}); record it, "
            f"give both in drive.toml (mounts), or choose one LiDAR with --topic"
        )
    return reached[target]


def T_base_lidars(bag: Bag, topics: Sequence[str], mounts: Mapping[str, list[float]]) -> F64:
    """(n, 4, 4) where the LiDARs of PointCloud2 topics sit on the vehicle: by ``mounts``, else by /tf_static from
    base_link, or from the frame that is nobody's child; MapvoteError if neither says it."""
    own = [_mount_in(mounts, topic, str(bag.path)) for topic in topics]
    if all(T is not None for T in own):
        return np.array(own)
    edges = static_frames(bag)
    frames = [frame_id(bag, topic) for topic in topics]
    base = "base_link" if "base_link" in edges else next(iter(edges), frames[0])
    reached = T_from(edges, base)
    if any(frame not in reached for frame in frames):
        return np.array([np.eye(4), *(T_first_lidar(bag, topics[0], other, mounts) for other in topics[1:])])
    return np.array([reached[frame] for frame in frames])
