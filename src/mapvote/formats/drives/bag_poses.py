"""The poses of a bag: topics of poses, moving frames and GNSS fixes, as a live drive would choose them."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from mapvote.core.types import F64, I64, MapvoteError
from mapvote.formats.drives.bag import Bag, frame_id, matrix_in, static_frames
from mapvote.formats.drives.fixes import Fixes, antenna_lever, fixes_of, heading_of_imu
from mapvote.formats.drives.frames import BASE_FRAME, BodyPose, Frames, T_from, is_map_frame
from mapvote.formats.drives.options import DriveOptions, beside, map_frame
from mapvote.formats.drives.point_fields import log, stamp_of
from mapvote.formats.drives.ros_types import GNSS, IMU, POSES, TF
from mapvote.formats.drives.stamp_order import StampOrder, in_order_of_stamps
from mapvote.formats.drives.trajectory import Prior, Trajectory, prior_of
from mapvote.formats.geo.frame import MapFrame, poses_from_gnss, sound_fixes, yaw_from_track


class Poses(NamedTuple):
    """The topic of poses of a bag, as a live drive would choose it."""

    topic: str | None
    """The topic that ``--prior`` names, else the only one."""
    T_base_lidar: F64 | None
    """(4, 4) the first LiDAR on what the topic tracks, by the frames in the bag."""
    in_map: bool
    """Whether the poses are in the map's frame."""
    lidar: str = ""
    """The frame of the first LiDAR."""


def choose_poses(bag: Bag, options: DriveOptions, cloud: str, mount: F64 | None) -> Poses:
    """The poses that ``options`` name, else what ``mapvote drive`` chooses: the only Odometry, else the only other
    topic of poses, else the only one of fixes, else the frames that move. ``mount``: of the options."""
    topic = options.prior
    if topic is None and options.as_live and not (beside(bag.path) / "prior.txt").is_file():
        topic = _only_topic_of_poses(bag)
    if topic in bag.topics(GNSS):
        return _poses_of_fixes(bag, topic, frame_id(bag, cloud), mount)
    if topic in bag.topics(TF):
        return _poses_of_frames(bag, options, topic, frame_id(bag, cloud), mount)
    if topic not in bag.topics(*POSES):
        return Poses(topic, mount, True)
    lidar = frame_id(bag, cloud)
    in_map = is_map_frame(frame_id(bag, topic)) or bool(_ways_to_map(bag, frame_id(bag, topic)))
    if mount is not None or options.mount is not None or options.T_base_lidar is not None:
        return Poses(topic, mount, in_map, lidar)
    tracked = frame_id(bag, topic, child=True)
    frames = static_frames(bag)
    if not tracked and lidar in T_from(frames, BASE_FRAME):
        tracked = BASE_FRAME
    if tracked in ("", lidar):
        return Poses(topic, None, in_map, lidar)
    T_base_lidar = T_from(frames, tracked).get(lidar)
    if T_base_lidar is None:
        problem = f"{bag.path}: no frames of /tf_static join {lidar} to {tracked}, which {topic} tracks"
        if options.prior is None:
            log.warning("%s: no prior is used; name the mount with --mount", problem)
            return Poses(None, None, True)
        log.warning("%s: its poses are taken for the LiDAR's own; name the mount with --mount", problem)
    return Poses(topic, T_base_lidar, in_map, lidar)


def _poses_of_fixes(bag: Bag, topic: str, lidar: str, mount: F64 | None) -> Poses:
    """Fixes are in the map; the LiDAR lies where the frames say from the antenna."""
    if mount is None:
        edges = static_frames(bag)
        mount = antenna_lever(T_from(edges, BASE_FRAME), frame_id(bag, topic), lidar)
    return Poses(topic, mount, True, lidar)


def _poses_of_frames(bag: Bag, options: DriveOptions, topic: str, lidar: str, mount: F64 | None) -> Poses:
    """The body that carries the LiDAR on a topic of moving frames."""
    first = next(_body_poses(bag, topic, lidar), None)
    if first is None:
        problem = f"{bag.path}: no frame that moves on {topic} carries {lidar}"
        if options.prior is not None:
            raise MapvoteError(f"{problem}; choose another --prior, or --prior none")
        log.info("%s: no prior is used", problem)
        return Poses(None, mount, True)
    if mount is None:
        mount = T_from(static_frames(bag), first.body).get(lidar)
    return Poses(topic, mount, is_map_frame(first.root), lidar)


def prior_of_bag(bag: Bag, options: DriveOptions, stamps_ns: I64, poses: Poses) -> Prior:
    """The prior of every scan from a topic or a file."""
    topic = poses.topic
    pose_topics = bag.topics(*POSES, GNSS, TF)
    if topic is not None and topic.startswith("/") and topic not in pose_topics and not Path(topic).is_file():
        raise MapvoteError(f"{bag.path}: no pose topic {topic}; topics with poses: {', '.join(pose_topics) or 'none'}")
    frame = map_frame(options)
    if topic in bag.topics(GNSS) and options.prior is None and frame is None:
        log.warning("%s: %s is not used: the place of the map on Earth is unknown (import --crs)", bag.path, topic)
        return Prior()

    def own() -> Trajectory | None:
        return None if topic is None else _trajectory(bag, topic, frame, poses.lidar)

    files = [bag.path] * len(stamps_ns)
    chosen = msgspec.structs.replace(options, prior=topic)
    try:
        return prior_of(
            bag.path, chosen, files, stamps_ns, own, topic if topic in pose_topics else None, poses.T_base_lidar
        )
    except MapvoteError as error:
        if options.prior is not None:
            raise
        log.warning("%s. No prior is used; --prior TOPIC chooses one", error)
        return Prior()


def _only_topic_of_poses(bag: Bag) -> str | None:
    """The only Odometry that holds messages, else the only other topic of poses, else the only one of fixes, else the
    frames that move; None, and a word, if there are several."""
    own = "/mapvote/pose"  # the pose that a live drive published is no prior
    for kinds in (POSES[:1], POSES[1:], (GNSS,)):
        named = [topic for topic, n in bag.topics(*kinds).items() if n and topic != own]
        if len(named) > 1:
            log.warning("%s: several topics of poses, none is used; --prior chooses: %s", bag.path, ", ".join(named))
        if named:
            return named[0] if len(named) == 1 else None
    return next((topic for topic, n in bag.topics(TF).items() if n and topic.split("/")[-1] == "tf"), None)


def _trajectory(bag: Bag, topic: str, frame: MapFrame | None, lidar: str) -> Trajectory:
    """T_map_base of a topic of poses, of moving frames, or of GNSS fixes in the frame of the map; fixes head where the
    vehicle drives."""
    if topic in bag.topics(GNSS):
        return _fixes(bag, topic, frame)
    stamps: list[int] = []
    received: list[int] = []
    poses: list[F64] = []
    if topic in bag.topics(TF):
        for pose in _body_poses(bag, topic, lidar):
            stamps.append(pose.stamp_ns)
            received.append(pose.stamp_ns)
            poses.append(pose.T_root_body)
    else:
        ways = _ways_to_map(bag, frame_id(bag, topic))
        for received_ns, message in bag.messages(topic):
            pose = message.pose.pose if hasattr(message.pose, "pose") else message.pose
            stamps.append(stamp_of(message))
            received.append(received_ns)
            T = matrix_in(bag, topic, pose.position, pose.orientation)
            poses.append(_way_at(ways, received_ns) @ T if ways else T)
    stacked = np.stack(poses) if poses else np.zeros((0, 4, 4))
    order = _order_of_poses(bag, topic, stamps, received)
    return Trajectory(order.stamps_ns, stacked[order.chosen], of_vehicle=True, frame=MapFrame())


def _body_poses(bag: Bag, topic: str, lidar: str) -> Iterator[BodyPose]:
    """The poses of the body that carries ``lidar`` on a topic of moving frames."""
    frames = _fixed_frames(bag)
    for _, message in bag.messages(topic):
        yield from frames.poses_of_body(message, lidar)


def _fixed_frames(bag: Bag) -> Frames:
    frames = Frames()
    for topic in bag.topics(TF):
        if topic.endswith("tf_static"):
            for _, message in bag.messages(topic):
                for transform in message.transforms:
                    frames.add(transform, fixed=True)
    return frames


def _ways_to_map(bag: Bag, frame: str) -> list[tuple[int, F64]]:
    """(time of receipt, T_map_frame (4, 4)) each time that somebody publishes where ``frame`` lies in the map; empty
    where nobody does, or where ``frame`` is fixed to the Earth itself."""
    if is_map_frame(frame):
        return []
    frames = _fixed_frames(bag)
    fixed = frames.T_map_of(frame)
    ways = [] if fixed is None else [(0, fixed)]
    for topic in bag.topics(TF):
        if topic.endswith("tf_static"):
            continue
        for received_ns, message in bag.messages(topic):
            moved = frames.add_all(message, fixed=False)
            T = frames.T_map_of(frame) if moved else None
            if T is not None and (not ways or not np.array_equal(T, ways[-1][1])):
                ways.append((received_ns, T))
    return ways


def _way_at(ways: list[tuple[int, F64]], received_ns: int) -> F64:
    """The newest of ``ways`` at this time; the first one before it came."""
    after = bisect_right(ways, received_ns, key=lambda way: way[0])
    return ways[max(after - 1, 0)][1]


def _order_of_poses(bag: Bag, topic: str, times_ns: list[int], received_ns: list[int]) -> StampOrder:
    order = in_order_of_stamps(np.array(times_ns, dtype=np.int64), np.array(received_ns, dtype=np.int64))
    for sentence in order.told:
        log.warning("%s: %s %s", bag.path, topic, sentence)
    return order


def _fixes(bag: Bag, topic: str, frame: MapFrame | None) -> Trajectory:
    rows = [
        (stamp_of(m), received_ns, m.longitude, m.latitude, m.altitude, m.status.status, stated_covariance(m))
        for received_ns, m in bag.messages(topic)
    ]
    if not rows:
        raise MapvoteError(f"{bag.path}: {topic} holds no fix; choose another topic, or --prior none")
    table = np.array([row[2:6] for row in rows], dtype=np.float64)
    keep, place = sound_fixes(f"{bag.path}: {topic}", table[:, :3], table[:, 3])
    sound = [row for row, kept in zip(rows, keep.tolist(), strict=True) if kept]
    order = _order_of_poses(bag, topic, [row[0] for row in sound], [row[1] for row in sound])
    place = place[order.chosen]
    T, own_frame = poses_from_gnss(place, np.zeros((len(place), 3)), frame)
    covariances = np.array([row[6] for row in sound])[order.chosen]
    fixes = _with_imu(bag, fixes_of(order.stamps_ns, place, covariances, own_frame))
    track = Trajectory(order.stamps_ns, yaw_from_track(T), of_vehicle=True, frame=own_frame)
    return replace(track, fixes=fixes)


def stated_covariance(fix: Any) -> F64:
    """(9,) the covariance of a NavSatFix, square metres; NaN where its type says that it is unknown."""
    covariance = np.array(fix.position_covariance, dtype=np.float64)
    return np.full(9, np.nan) if fix.position_covariance_type == 0 else covariance


def _with_imu(bag: Bag, fixes: Fixes) -> Fixes:
    """The fixes, with the headings of the only Imu."""
    topics = [topic for topic, n in bag.topics(IMU).items() if n]
    if len(topics) > 1:
        log.warning("%s: several topics of IMUs, none is used: %s", bag.path, ", ".join(topics))
    if len(topics) != 1:
        return fixes
    T_base_imu = T_from(static_frames(bag), BASE_FRAME).get(frame_id(bag, topics[0]), np.eye(4))
    stamps_ns: list[int] = []
    headings: list[tuple[float, float]] = []
    for _, message in bag.messages(topics[0]):
        stamps_ns.append(stamp_of(message))
        headings.append(heading_of_message(message, T_base_imu))
    return fixes.with_headings(stamps_ns, [yaw for yaw, _ in headings], [sigma for _, sigma in headings])


def heading_of_message(message: Any, T_base_imu: F64) -> tuple[float, float]:
    """:func:`mapvote.formats.drives.fixes.heading_of_imu` of a sensor_msgs/Imu."""
    q = message.orientation
    return heading_of_imu([q.x, q.y, q.z, q.w], message.orientation_covariance, T_base_imu)
