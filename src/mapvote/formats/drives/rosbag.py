"""ROS 2 bags (sqlite3 and MCAP) and ROS 1 bags through the rosbags library (extra ``ros``): PointCloud2 as a drive.

Priors are topics of odometry or GNSS fixes; the mounts of a vehicle's LiDARs come from /tf_static.
"""

from __future__ import annotations

import struct
import weakref
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import scipy
from numpy.typing import NDArray

from mapvote.core import geometry
from mapvote.core.extras import require
from mapvote.core.sensors import Sensor
from mapvote.core.types import F64, I64, Drive, MapvoteError, Scan
from mapvote.formats.drives.bag_files import bag_files, is_bag, is_bag_without_metadata, mend_of
from mapvote.formats.drives.options import DriveOptions, beside, make_drive, map_frame, read_mount, step_of
from mapvote.formats.drives.point_fields import PointReader, livox_table, log, point_cloud_table, stamp_of
from mapvote.formats.drives.stamp_order import StampOrder, in_order_of_stamps
from mapvote.formats.drives.trajectory import Trajectory, prior_of
from mapvote.formats.geo.frame import MapFrame, poses_from_gnss, sound_fixes, yaw_from_track
from mapvote.formats.reading import first_line

CLOUD = "sensor_msgs/msg/PointCloud2"
_SWEEP = 0.55
"""Revolutions within which the scans of several LiDARs are one sweep: they may turn at opposite phases."""
LIVOX = "livox_ros_driver2/msg/CustomMsg", "livox_ros_driver/msg/CustomMsg"
"""Clouds of Livox's drivers: decoded points, each with its time."""
CLOUDS = (CLOUD, *LIVOX)
PACKETS = ("Packet", "VelodyneScan", "PandarScan", "HesaiScan", "RslidarScan")
"""Parts of the names of messages in which drivers record what came over the wire."""
POSES = ("nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")
_MAP_FRAMES = {"", "map", "world", "earth", "global", "utm", "enu"}
"""Last parts of the names of frames that are fixed to the Earth, in small letters; "" is no name."""
_BASE = "base_link"
"""The body that poses without a name of what they track are of (REP 105)."""
_OWN_POSES = "/mapvote/pose"
"""What a live drive publishes: no prior."""
GNSS = ("sensor_msgs/msg/NavSatFix",)
_TF = "tf2_msgs/msg/TFMessage"


def is_rosbag(path: Path) -> bool:
    """Whether a bag of any kind lies at ``path``."""
    return is_bag(path) or is_bag_without_metadata(path)


class Bag:
    """An open bag. Closed when the drive that reads from it is gone."""

    def __init__(self, path: Path) -> None:
        reader = require("rosbags.highlevel", "ros", str(path))
        stores = require("rosbags.typesys", "ros", str(path))
        typestore = stores.get_typestore(stores.Stores.LATEST)
        files = bag_files(path)
        try:
            self.reader = reader.AnyReader(files.paths, default_typestore=typestore)
            self.reader.open()
        except Exception as error:  # rosbags lets through what its storages raise
            raise MapvoteError(
                f"{path}: not a readable bag ({first_line(error)}); was the recording stopped properly? Try: "
                f"{mend_of(path)}"
            ) from error
        weakref.finalize(self, self.reader.close)
        self.path = path
        self.mended = files.mended
        """What is wrong with its files, and is read nevertheless."""

    def decode(self, connection: Any, data: bytes) -> Any:
        """A serialised message; MapvoteError if it is damaged."""
        try:
            return self.reader.deserialize(data, connection.msgtype)
        except Exception as error:  # rosbags raises what struct, numpy and its own parsers do
            raise MapvoteError(
                f"{self.path}: {connection.topic}: a message is damaged ({first_line(error)}); copy the bag again"
            ) from error

    def topics(self, *types: str) -> dict[str, int]:
        """Topics of these message types, with their number of messages."""
        return {name: t.msgcount for name, t in sorted(self.reader.topics.items()) if t.msgtype in types}

    def raw(self, topic: str, **window: int) -> Iterator[tuple[Any, int, bytes]]:
        """(connection, receive time ns, bytes) one by one; ``start``, ``stop`` bound the receive time."""
        connections = [c for c in self.reader.connections if c.topic == topic]
        try:
            yield from self.reader.messages(connections=connections, **window)
        except MapvoteError:
            raise
        except Exception as error:  # whatever zstd, lz4, sqlite and struct raise
            raise MapvoteError(
                f"{self.path}: {topic}: damaged ({type(error).__name__}: {first_line(error)}); copy it again"
            ) from error

    def messages(self, topic: str, **window: int) -> Iterator[tuple[int, Any]]:
        """(receive time ns, message) one by one."""
        for connection, time_ns, data in self.raw(topic, **window):
            yield time_ns, self.decode(connection, data)

    def points(self, where: str, connection: Any, data: bytes) -> NDArray[np.void]:
        """The points (n,) of a serialised PointCloud2 or CustomMsg, with their fields."""
        if connection.msgtype in LIVOX:
            return livox_table(where, data, ros2=self.reader.is2)
        return point_cloud_table(where, self.decode(connection, data))

    def frame_id(self, data: bytes) -> str:
        """The frame in the header of a serialised message, without reading the rest."""
        order = "<" if not self.reader.is2 or data[1] & 1 else ">"
        length = struct.unpack_from(f"{order}I", data, 12)[0] if len(data) >= 16 else 0
        return bytes(data[16 : 16 + length]).rstrip(b"\0").decode(errors="replace")

    def stamp_ns(self, data: bytes) -> int:
        """The stamp in the header of a serialised message, without reading the rest."""
        order = "<" if not self.reader.is2 or data[1] & 1 else ">"
        if len(data) < 12:
            raise MapvoteError(f"{self.path}: a message of {len(data)} bytes has no header; copy the bag again")
        seconds, nanoseconds = struct.unpack_from(f"{order}II", data, 4)
        return int(seconds) * 10**9 + int(nanoseconds)


def open_rosbag(path: Path, options: DriveOptions) -> Drive:
    """The drive of one PointCloud2 topic, or of several of one vehicle (--topic /front,/rear).

    What several LiDARs took in one revolution is one scan, at the stamp of the first of them, its points in the frame
    of the first topic's LiDAR, by /tf_static. MapvoteError lists the topics if there is none
    or a choice to make.
    """
    bag = Bag(path)
    for what in bag.mended:
        log.warning("%s", what)
    topics = _choose_topics(bag, options.topic)
    mounts = [np.eye(4), *(T_first_lidar(bag, topics[0], other, options.mounts) for other in topics[1:])]
    own = _mount_in(options.mounts, topics[0], str(path))
    sweeps = _sweeps(bag, topics)
    stamps_ns = np.array([sweep[0].stamp_ns for sweep in sweeps], dtype=np.int64)
    poses = _poses(bag, options, topics[0], own)
    T_prior, frame = _prior(bag, options, stamps_ns, poses)
    readers = [PointReader(f"{path} {topic}", options.time_rules, step_of(stamps_ns)) for topic in topics]

    def read_message(i: int, message: _Message, sensor: Sensor) -> Scan:
        start, topic = message.received_ns, topics[message.topic]
        where = f"{path} {topic}, scan {i}"
        for connection, _, data in bag.raw(topic, start=start, stop=start + 1):
            if bag.stamp_ns(data) == message.header_ns:
                table = bag.points(where, connection, data)
                scan = readers[message.topic].scan(where, i, message.stamp_ns, table, sensor)
                return scan if message.topic == 0 else scan.seen_from(mounts[message.topic])
        raise MapvoteError(f"{where}: gone; the bag changed while it was read")

    def read_scan(i: int, sensor: Sensor) -> Scan:
        scans = [read_message(i, message, sensor) for message in sweeps[i]]
        return scans[0] if len(scans) == 1 else Scan.sweep(int(stamps_ns[i]), scans)

    drive = make_drive(
        path,
        options,
        stamps_ns=stamps_ns,
        T_map_lidar_prior=T_prior,
        read_scan=read_scan,
        frame=frame,
        T_base_lidar=poses.T_base_lidar,
    )
    return replace(drive, prior_in_map=poses.in_map)


def _prior(bag: Bag, options: DriveOptions, stamps_ns: I64, poses: _Poses) -> tuple[F64 | None, MapFrame]:
    """T_map_lidar of every scan (n, 4, 4) from a topic or a file, and the frame it is in."""
    topic = poses.topic
    known = bag.topics(*POSES, *GNSS)
    if topic is not None and topic.startswith("/") and topic not in known and not Path(topic).is_file():
        raise MapvoteError(f"{bag.path}: no pose topic {topic}; topics with poses: {', '.join(known) or 'none'}")

    def own() -> Trajectory | None:
        return None if topic is None else _trajectory(bag, topic, map_frame(options))

    files = [bag.path] * len(stamps_ns)
    chosen = msgspec.structs.replace(options, prior=topic)
    try:
        return prior_of(bag.path, chosen, files, stamps_ns, own, topic if topic in known else None, poses.T_base_lidar)
    except MapvoteError as error:
        if options.prior is not None:
            raise
        log.warning("%s. No prior is used; --prior TOPIC says which one counts", error)
        return None, MapFrame()


class _Poses(NamedTuple):
    """The topic of poses of a bag, as a live drive would choose it."""

    topic: str | None
    """What ``--prior`` says, else the only one."""
    T_base_lidar: F64 | None
    """(4, 4) the first LiDAR on what the topic tracks, by the frames in the bag."""
    in_map: bool
    """Whether the poses are in the map's frame."""


def _poses(bag: Bag, options: DriveOptions, cloud: str, mount: F64 | None) -> _Poses:
    """The poses that ``options`` name, else what ``mapvote drive`` chooses: the only Odometry, else the only other
    topic of poses. ``mount``: of the options."""
    topic = options.prior
    if topic is None and options.as_live and not (beside(bag.path) / "prior.txt").is_file():
        topic = _only_topic_of_poses(bag)
    if topic not in bag.topics(*POSES):
        return _Poses(topic, mount, True)
    in_map = is_map_frame(frame_id(bag, topic))
    if mount is not None or options.mount is not None or options.T_base_lidar is not None:
        return _Poses(topic, mount, in_map)
    lidar = frame_id(bag, cloud)
    tracked = frame_id(bag, topic, child=True)
    frames = static_frames(bag)
    if not tracked and lidar in T_from(frames, _BASE):
        tracked = _BASE
    if tracked in ("", lidar):
        return _Poses(topic, None, in_map)
    T_base_lidar = T_from(frames, tracked).get(lidar)
    if T_base_lidar is None:
        problem = f"{bag.path}: no frames of /tf_static join {lidar} to {tracked}, which {topic} tracks"
        if options.prior is None:
            log.warning("%s: no prior is used; name the mount with --mount", problem)
            return _Poses(None, None, True)
        log.warning("%s: its poses are taken for the LiDAR's own; name the mount with --mount", problem)
    return _Poses(topic, T_base_lidar, in_map)


def is_map_frame(name: str) -> bool:
    """Whether poses in the frame of this name may be taken for poses in the map (REP 105: map and earth are fixed, odom
    is not, and a LiDAR odometry names its first pose)."""
    return name.strip("/").split("/")[-1].lower() in _MAP_FRAMES


def _only_topic_of_poses(bag: Bag) -> str | None:
    """The only Odometry that holds messages, else the only other topic of poses; None, and a word, if there are
    several."""
    for kinds in (POSES[:1], POSES[1:]):
        named = [topic for topic, n in bag.topics(*kinds).items() if n and topic != _OWN_POSES]
        if len(named) > 1:
            log.warning("%s: several topics of poses, none is used; --prior chooses: %s", bag.path, ", ".join(named))
        if named:
            return named[0] if len(named) == 1 else None
    return None


def _choose_topics(bag: Bag, wanted: str | None) -> list[str]:
    topics = bag.topics(*CLOUDS)
    listed = ", ".join(f"{name} ({n})" for name, n in topics.items())
    packets = sorted(
        n for n, t in bag.reader.topics.items() if t.msgtype and any(word in t.msgtype for word in PACKETS)
    )
    if not topics and packets:
        raise MapvoteError(f"{bag.path}: raw packets only ({', '.join(packets)}): decode with your driver first")
    if not topics:
        others = ", ".join(sorted(bag.reader.topics)) or "none"
        raise MapvoteError(f"{bag.path}: no topic of {CLOUD} or Livox's CustomMsg; topics: {others}")
    if wanted is None and len(topics) > 1:
        raise MapvoteError(
            f"{bag.path}: several PointCloud2 topics; choose with --topic or drive.toml, several LiDARs of one vehicle "
            f"with commas: {listed}"
        )
    chosen = [name.strip() for name in wanted.split(",")] if wanted is not None else [next(iter(topics))]
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
    """The stamp in its header, 0 where nobody stamped it."""


def _sweeps(bag: Bag, topics: list[str]) -> list[list[_Message]]:
    """The messages of each scan of the drive, by topic: what several LiDARs took within half a revolution."""
    found = [message for k, topic in enumerate(topics) for message in _messages_of(bag, topic, k)]
    if not found:
        raise MapvoteError(f"{bag.path}: {', '.join(topics)}: no message can be read; {mend_of(bag.path)}")
    if len(topics) == 1:
        return [[message] for message in found]
    first_ns = np.array([message.stamp_ns for message in found if message.topic == 0])
    reach_ns = _SWEEP * float(np.median(np.diff(first_ns))) if len(first_ns) > 1 else 0.0
    sweeps: list[list[_Message]] = []
    for message in sorted(found, key=lambda m: (m.stamp_ns, m.topic)):
        last = sweeps[-1] if sweeps else []
        if last and message.stamp_ns - last[0].stamp_ns <= reach_ns and message.topic not in {m.topic for m in last}:
            last.append(message)
        else:
            sweeps.append([message])
    return [sorted(sweep, key=lambda m: m.topic) for sweep in sweeps]


def _messages_of(bag: Bag, topic: str, k: int) -> list[_Message]:
    """The messages of the ``k``-th topic by their stamps; what is left out is counted and reported."""
    headers, received = stamps_of(bag, topic).T
    order = in_order_of_stamps(headers, received)
    for what in order.told:
        log.warning("%s: %s %s", bag.path, topic, what)
    rows = zip(order.stamps_ns.tolist(), order.chosen.tolist(), strict=True)
    return [_Message(stamp_ns, k, int(received[i]), int(headers[i])) for stamp_ns, i in rows]


def stamps_of(bag: Bag, topic: str) -> I64:
    """(n, 2) the stamp in the header and the time of receipt of every message, nanoseconds, as received."""
    rows = [(bag.stamp_ns(data), received_ns) for _, received_ns, data in bag.raw(topic)]
    return np.array(rows, dtype=np.int64).reshape(-1, 2)


def _trajectory(bag: Bag, topic: str, frame: MapFrame | None) -> Trajectory:
    """T_map_base of a topic of poses, or of GNSS fixes in the frame of the map; fixes head where the vehicle drives."""
    if topic in bag.topics(*GNSS):
        return _fixes(bag, topic, frame)
    times, received, poses = [], [], []
    for received_ns, message in bag.messages(topic):
        pose = message.pose.pose if hasattr(message.pose, "pose") else message.pose
        times.append(stamp_of(message))
        received.append(received_ns)
        poses.append(_matrix(bag, topic, pose.position, pose.orientation))
    stacked = np.stack(poses) if poses else np.zeros((0, 4, 4))
    order = _order_of_poses(bag, topic, times, received)
    return Trajectory(order.stamps_ns, stacked[order.chosen], of_vehicle=True, frame=MapFrame())


def _order_of_poses(bag: Bag, topic: str, times_ns: list[int], received_ns: list[int]) -> StampOrder:
    order = in_order_of_stamps(np.array(times_ns, dtype=np.int64), np.array(received_ns, dtype=np.int64))
    for what in order.told:
        log.warning("%s: %s %s", bag.path, topic, what)
    return order


def _fixes(bag: Bag, topic: str, frame: MapFrame | None) -> Trajectory:
    rows = [
        (stamp_of(m), received_ns, m.longitude, m.latitude, m.altitude, m.status.status)
        for received_ns, m in bag.messages(topic)
    ]
    if not rows:
        raise MapvoteError(f"{bag.path}: {topic} holds no fix; choose another topic, or --prior none")
    table = np.array([row[2:] for row in rows], dtype=np.float64)
    keep, place = sound_fixes(f"{bag.path}: {topic}", table[:, :3], table[:, 3])
    sound = [row for row, kept in zip(rows, keep.tolist(), strict=True) if kept]
    order = _order_of_poses(bag, topic, [row[0] for row in sound], [row[1] for row in sound])
    place = place[order.chosen]
    T, known = poses_from_gnss(place, np.zeros((len(place), 3)), frame)
    return Trajectory(order.stamps_ns, yaw_from_track(T), of_vehicle=True, frame=known)


def _mount_in(mounts: Mapping[str, list[float]], topic: str, where: str) -> F64 | None:
    return read_mount(mounts[topic], f"{where}: mounts: {topic}") if topic in mounts else None


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


Edges = dict[str, list[tuple[str, F64]]]


def static_frames(bag: Bag) -> Edges:
    """From each frame of /tf_static to its neighbours, with T_frame_neighbour (4, 4), both ways."""
    edges: Edges = {}
    for topic in bag.topics(_TF):
        if not topic.endswith("tf_static"):
            continue
        for _, message in bag.messages(topic):
            for t in message.transforms:
                T = _matrix(bag, topic, t.transform.translation, t.transform.rotation)
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
    if child:
        return next((str(getattr(m, "child_frame_id", "")).strip("/") for _, m in bag.messages(topic)), "")
    return next((bag.frame_id(data).strip("/") for _, _, data in bag.raw(topic)), "")


def _matrix(bag: Bag, topic: str, p: Any, q: Any) -> F64:
    if not np.any([q.x, q.y, q.z, q.w]):
        raise MapvoteError(
            f"{bag.path}: {topic} holds a quaternion of zeros, which is no rotation: mend who writes it, or choose "
            f"another topic (poses: --prior TOPIC or --prior none; LiDARs: --topic)"
        )
    return pose_of_message(p, q)


def pose_of_message(position: Any, orientation: Any) -> F64:
    """T (4, 4) of a message's position, metres, and quaternion, which must not be zero."""
    p, q = position, orientation
    rotation = scipy.spatial.transform.Rotation.from_quat([q.x, q.y, q.z, q.w])
    return geometry.poses_at([[p.x, p.y, p.z]], rotation.as_matrix())[0]
