"""The input of one vehicle from DDS: clouds of its LiDARs joined to scans, poses of odometry, fixed frames."""

from __future__ import annotations

import logging
import time
from bisect import bisect_left
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mapvote.core.mount import Mount, mount_of_base
from mapvote.core.record import record
from mapvote.core.sensors import Sensor
from mapvote.core.types import F64, MapvoteError, Scan
from mapvote.formats.drives.frames import BASE_FRAME, Frames, is_map_frame, matrix_of, two_frames
from mapvote.formats.drives.packets import scan_of_packets
from mapvote.formats.drives.point_fields import PointReader, scan_from_point_cloud2
from mapvote.formats.drives.point_times import TimeRules
from mapvote.formats.drives.ros_types import CLOCK, CLOUD, GNSS, IMU, POSES, TF
from mapvote.formats.drives.sensor_estimate import (
    RING_RULE,
    UNKNOWN_SENSOR,
    estimate_sensor,
    rate_of_first,
    sensor_upright,
)
from mapvote.formats.geo.frame import MapFrame
from mapvote.live.choice import Chosen
from mapvote.live.dds import Network, PublishedTopic, Subscription
from mapvote.live.drive import WaitingScan
from mapvote.live.fix_topics import FixTopics
from mapvote.live.log_lines import Repeated
from mapvote.live.messages import MAP_FRAME, from_cdr, header_of, stamp_ns, time_ns
from mapvote.live.names import RosNames
from mapvote.live.sweeps import Cloud, Revolutions, Sweeps

log = logging.getLogger("mapvote.live")


@record()
@dataclass(frozen=True, slots=True)
class SubscriptionRule:
    """Numbers of a vehicle's subscriptions."""

    depth: int = 200
    """Messages that wait in DDS at most: while the process stands still for 20 s none is lost."""
    poses: int = 400
    """Poses whose times of sending are kept: four seconds at 100 Hz."""
    other_clock_ns: int = 10**9
    """Difference of the stamps of clouds and poses of one moment from which they are of two clocks, nanoseconds."""
    together_ns: int = 500_000_000
    """Time within which clouds and poses are of one moment, nanoseconds."""


SUBSCRIPTION_RULE = SubscriptionRule()


class Clocks:
    """Whether odometry and LiDAR share a clock: by the stamps of what they send, or of what arrives, at one time.

    The smaller difference counts. Messages that arrive together were not sent together if the process was busy. Two
    computers whose own clocks differ stamp messages of one moment differently.
    """

    def __init__(self) -> None:
        self._poses: deque[tuple[int, int]] = deque(maxlen=SUBSCRIPTION_RULE.poses)
        """(time of sending, stamp) of the last poses, nanoseconds."""
        self._arrived_s = -np.inf
        self.apart_ns = 0
        """Stamp of a pose minus that of the last cloud which arrived with it."""

    def pose(self, sent_ns: int, stamp_ns: int, now_s: float) -> None:
        """A pose arrived at ``now_s`` of any steady clock."""
        self._poses.append((sent_ns, stamp_ns))
        self._arrived_s = now_s

    def cloud(self, sent_ns: int, stamp_ns: int, now_s: float) -> None:
        """A cloud arrived. Without a pose of the same time, as after the end of odometry, it has no effect."""
        if not self._poses:
            return
        near = min(bisect_left(self._poses, (sent_ns, 0)), len(self._poses) - 1)
        together = []
        if abs(self._poses[near][0] - sent_ns) <= SUBSCRIPTION_RULE.together_ns:
            together.append(self._poses[near][1] - stamp_ns)
        if now_s - self._arrived_s <= 1e-9 * SUBSCRIPTION_RULE.together_ns:
            together.append(self._poses[-1][1] - stamp_ns)
        self.apart_ns = min(together, key=abs, default=self.apart_ns)

    def trouble(self) -> str:
        """The fault if they are two clocks, else ""."""
        if abs(self.apart_ns) <= SUBSCRIPTION_RULE.other_clock_ns:
            return ""
        return (
            f"odometry's stamps are {1e-9 * self.apart_ns:+.1f} s off those of the clouds that come with them: two "
            "clocks. Synchronise them (PTP, or the driver's own time), or choose another --odometry"
        )


class Headers:
    """Stamps and frames in the headers of one topic."""

    def __init__(self, topic: str) -> None:
        self._topic = topic
        self._has_stamps = False
        self._told = False
        self.frame = ""
        """The frame of its first message."""

    def stamp_ns(self, header_ns: int, sent_ns: int) -> int:
        """The stamp of a message, nanoseconds; the time of sending while the topic had no stamp. MapvoteError for a
        stamp of 0 after others."""
        if header_ns:
            self._has_stamps = True
            return header_ns
        if self._has_stamps:
            raise MapvoteError("its stamp is 0, those before were not")
        if not self._told:
            self._told = True
            log.warning("%s has no stamps in its headers: the times of sending are used", self._topic)
        return sent_ns

    def check_frame(self, frame: str) -> None:
        """MapvoteError for another frame than that of the first message: two LiDARs on one topic."""
        self.frame = self.frame or frame
        if frame != self.frame:
            raise MapvoteError(two_frames(self._topic, self.frame, frame))


class Subscriptions:
    """The topics of one vehicle. Writers may appear and vanish."""

    def __init__(
        self,
        network: Network,
        chosen: Chosen,
        sensor: Sensor | None,
        names: RosNames | None = None,
        *,
        sim_time: bool = False,
        rules: TimeRules = TimeRules(),  # noqa: B008 - frozen
        on_earth: MapFrame = MapFrame(),  # noqa: B008 - frozen
    ) -> None:
        """``sensor``: of the first LiDAR; None: it is measured in the first scans. ``names`` resolves tf, tf_static and
        clock. ``sim_time``: the time is that of the clock's topic. ``rules``: what is stated of the times of points.
        ``on_earth``: how the map lies on Earth, for fixes."""
        self.network, self.chosen, self.sensor = network, chosen, sensor
        self.names = names or RosNames()
        self.sensor_told = "stated" if sensor is not None else ""
        self.lidar_frames: list[str] = [""] * len(chosen.points)
        """The frame of each LiDAR, from its clouds."""
        self.mount: Mount | None = None
        """By which scans are turned to x ahead and z up; None: not at all."""
        self.upright_sensor: Sensor | None = None
        """The first LiDAR in the axes in which scans are given; None: as ``sensor``."""
        self.base_frame, self.map_frame = "", ""
        """The frame that odometry tracks, and its parent."""
        self.clocks = Clocks()
        self.frames = Frames()
        self.receiver = FixTopics(on_earth, self.frames)
        self.odometry_frame = ""
        """The frame in which poses are sent; ``map_frame`` is the one they are brought to."""
        self.ways_begun = 0
        """How often somebody began to publish where that frame lies in the map."""
        self.clouds = self.poses = self.unusable = 0
        """Clouds and poses that arrived; messages of any topic that cannot be used."""
        self.last_unusable = ""
        """Why the last message could not be used."""
        self._unusable_firsts: set[int] = set()
        """Stamps of the first LiDAR's clouds in which its sensor cannot be measured."""
        self._repeated = Repeated(log.warning)
        self._readers = [PointReader(one.topic, rules) for one in chosen.points]
        self._headers = [Headers(one.topic) for one in chosen.points]
        self._pose_headers = Headers("odometry" if chosen.odometry is None else chosen.odometry.topic)
        self._sweeps = Sweeps(len(chosen.points))
        self._revolutions = [Revolutions() for _ in chosen.points]
        self._points = self._subscribed(chosen.points)
        self._odometry = self._subscribed([chosen.odometry])
        self._imu = self._subscribed([chosen.imu])
        self.tf = self._frames_topic("tf")
        self.tf_static = self._frames_topic("tf_static")
        self._tf_static = [
            network.subscribe(self.tf_static, TF, reliable=True, transient_local=True),
            network.subscribe(self.tf_static, TF, reliable=False),  # of a sender that keeps nothing, but repeats it
        ]
        self._tf = network.subscribe(self.tf, TF, reliable=False, depth=SUBSCRIPTION_RULE.depth)
        self._clock = network.subscribe(self.names.resolve("/clock"), CLOCK, reliable=False, depth=1)
        self.sim_time = sim_time
        self._clock_ns = 0

    def _subscribed(self, topics: Sequence[PublishedTopic | None]) -> list[Subscription]:
        return [
            self.network.subscribe(one.topic, one.kind, reliable=one.reliable, depth=SUBSCRIPTION_RULE.depth)
            for one in topics
            if one is not None
        ]

    def _frames_topic(self, name: str) -> str:
        """/tf or /tf_static as remapped, else that of the namespace where somebody sends it, else the global one."""
        remapped = self.names.resolve(f"/{name}")
        own = self.names.resolve(name)
        sent = {one.topic for one in self.network.published()}
        return own if remapped == f"/{name}" and own in sent else remapped

    def now_ns(self) -> int:
        """The time of ROS 2, nanoseconds: that of the clock's topic under sim time (0 before its first message)."""
        if not self.sim_time:
            return time.time_ns()
        for _, data in self._clock.take():
            with self._some_unusable(CLOCK):
                self._clock_ns = time_ns(from_cdr(CLOCK, data).clock)
        return self._clock_ns

    def take_poses(self) -> list[tuple[int, F64]]:
        """Poses that arrived: stamps, and T_map_base. Fixes that arrived go to ``receiver``."""
        kind = "" if self.chosen.odometry is None else self.chosen.odometry.kind
        if kind in POSES and not is_map_frame(self.odometry_frame):
            self._take_moving_frames()
        for _, data in (received for reader in self._imu for received in reader.take()):
            with self._some_unusable(IMU):
                self.receiver.add_imu(from_cdr(IMU, data))
        out: list[tuple[int, F64]] = []
        for sent_ns, data in (received for reader in self._odometry for received in reader.take()):
            with self._some_unusable(kind):
                message = from_cdr(kind, data)
                if kind == GNSS:
                    fix_ns = self._pose_headers.stamp_ns(stamp_ns(message.header), sent_ns)
                    message.header = header_of(fix_ns, message.header.frame_id)
                    self.receiver.add_fix(message)
                    self.map_frame = MAP_FRAME
                    self.poses += 1
                    self.clocks.pose(sent_ns, fix_ns, time.monotonic())
                    continue
                sent = self._poses_of_tf(message) if kind == TF else [self._pose_of(message)]
                poses = [(self._pose_headers.stamp_ns(header_ns, sent_ns), T) for header_ns, T in sent]
                out += poses
                for pose_ns, _ in poses:
                    self.clocks.pose(sent_ns, pose_ns, time.monotonic())
        self.poses += len(out)
        return out

    def _take_moving_frames(self) -> None:
        for _, data in self._tf.take():
            self._add_frames(data, fixed=False)

    def _pose_of(self, message: Any) -> tuple[int, F64]:
        """Stamp and pose of an Odometry, a PoseStamped or a PoseWithCovarianceStamped, in the map where somebody
        publishes where its frame lies there. The last two do not name what they track: it is base_link (REP 105) where
        the LiDAR sits on one."""
        pose = message.pose.pose if hasattr(message.pose, "pose") else message.pose
        T = matrix_of(pose.position, pose.orientation)
        named = getattr(message, "child_frame_id", "").strip("/")
        if not named and self.frames.between(BASE_FRAME, self.lidar_frames[0]) is not None:
            named = BASE_FRAME
        self.base_frame = named
        self.odometry_frame = message.header.frame_id.strip("/")
        way = None if is_map_frame(self.odometry_frame) else self.frames.T_map_of(self.odometry_frame)
        if way is None:
            self.map_frame = self.odometry_frame
            return stamp_ns(message.header), T
        root = self.frames.root(self.odometry_frame)
        self.ways_begun += self.map_frame != root
        self.map_frame = root
        return stamp_ns(message.header), way @ T

    def _poses_of_tf(self, message: Any) -> list[tuple[int, F64]]:
        """The poses of the body that carries the first LiDAR, in the frame at the top of the tree."""
        poses = self.frames.poses_of_body(message, self.lidar_frames[0])
        if poses:
            self.base_frame = poses[-1].body
            self.map_frame = poses[-1].root
        return [(pose.stamp_ns, pose.T_root_body) for pose in poses]

    @contextmanager
    def _some_unusable(self, kind: str) -> Iterator[None]:
        """Leaves out a message that cannot be used; logs the 1st, 2nd, 4th, 8th ..."""
        try:
            yield
        except MapvoteError as error:
            self.unusable += 1
            self.last_unusable = f"{kind}: {error}"
            self._repeated(kind, f"{kind} is left out: {error}")

    def take_scans(self) -> list[list[Cloud]]:
        """Clouds that arrived, joined to scans."""
        for _, data in (received for reader in self._tf_static for received in reader.take()):
            self._add_frames(data, fixed=True)
        if self.mounts() is None or self.T_base_lidar() is None:  # a joint that is fixed, but sent on /tf
            self._take_moving_frames()
        clouds: list[Cloud] = []
        for lidar, (one, reader) in enumerate(zip(self.chosen.points, self._points, strict=True)):
            for sent_ns, data in reader.take():
                with self._some_unusable(CLOUD):
                    message = from_cdr(one.kind, data)
                    if message.width * message.height == 0:
                        raise MapvoteError(f"a cloud of {one.topic} holds no points")
                    headers = self._headers[lidar]
                    headers.check_frame(message.header.frame_id.strip("/"))
                    self.lidar_frames[lidar] = headers.frame
                    cloud_ns = headers.stamp_ns(stamp_ns(message.header), sent_ns)
                    message.header = header_of(cloud_ns, message.header.frame_id)
                    clouds.append(Cloud(lidar, cloud_ns, sent_ns, message))
                    self.clocks.cloud(sent_ns, clouds[-1].stamp_ns, time.monotonic())
        self.clouds += len(clouds)
        now_s = time.monotonic()
        whole: list[Cloud] = []
        for cloud in sorted(clouds, key=lambda cloud: cloud.stamp_ns):
            with self._some_unusable(CLOUD):
                whole += self._revolutions[cloud.lidar].add(cloud, now_s)
        for revolutions in self._revolutions:
            whole += revolutions.after_pause(now_s)
        return self._sweeps.add(whole)

    def _add_frames(self, data: memoryview, *, fixed: bool) -> None:
        with self._some_unusable(TF):
            for transform in from_cdr(TF, data).transforms:
                self.frames.add(transform, fixed=fixed)

    def stand_upright(self, T_base_lidar: F64 | None, scans: Sequence[list[Cloud]]) -> None:
        """From here on scans are given in axes with x ahead and z up, if the first LiDAR sits otherwise on the vehicle:
        as ``T_base_lidar`` (4, 4) states, else as frames tell. Its model is measured anew in the first of ``scans``."""
        T = self.T_base_lidar() if T_base_lidar is None else T_base_lidar
        if T_base_lidar is None and self.chosen.odometry is None:
            T = self.frames.between(BASE_FRAME, self.lidar_frames[0])
        mount = None if T is None else mount_of_base(T)
        read = None if mount is None else self._first_usable(scans)
        if mount is None or read is None or self.sensor is None:
            return
        self.mount = mount.in_steps()
        measured = self.sensor_told.startswith("measured")
        first = self.mount.scan(read).by_lidar()[0][1]
        self.upright_sensor = sensor_upright(self.sensor, measured, first, mount.lean_deg)

    def _first_usable(self, scans: Sequence[list[Cloud]]) -> Scan | None:
        for sweep in scans:
            with self._some_unusable(CLOUD):
                return self._read(sweep)
        return None

    def T_base_lidar(self) -> F64 | None:
        """(4, 4) the first LiDAR on what odometry tracks, or from the antenna of fixes; the identity if both are one
        frame, or nobody names what odometry tracks. None if no frames join the two."""
        if self.chosen.odometry is not None and self.chosen.odometry.kind == GNSS:
            return self.receiver.T_antenna_lidar(self.lidar_frames[0])
        if self.base_frame in ("", self.lidar_frames[0]):
            return np.eye(4)
        return self.frames.between(self.base_frame, self.lidar_frames[0])

    def mounts(self) -> list[F64] | None:
        """(4, 4) each: T_first_lidar of every LiDAR; None while no frames join them."""
        first = self.lidar_frames[0]
        if len(self.lidar_frames) == 1:
            return [np.eye(4)]
        if not all(self.lidar_frames):
            return None
        T_first = [self.frames.between(first, frame) for frame in self.lidar_frames]
        mounts = [T for T in T_first if T is not None]
        return mounts if len(mounts) == len(T_first) else None

    def measure(self, scans: Sequence[list[Cloud]]) -> bool:
        """Measure the first LiDAR in the first ``scans``, unless it is known; returns whether it is now."""
        firsts = [sweep[0] for sweep in scans if sweep[0].lidar == 0 and sweep[0].stamp_ns not in self._unusable_firsts]
        if self.sensor is None and len(firsts) >= RING_RULE.scans:
            del firsts[RING_RULE.scans :]  # how many arrive together does not matter
            rate_hz = rate_of_first(np.array([cloud.stamp_ns for cloud in firsts]))
            model = replace(UNKNOWN_SENSOR, rate_hz=rate_hz)
            read: list[Scan] = []
            for cloud in firsts:
                self._unusable_firsts.add(cloud.stamp_ns)
                with self._some_unusable(CLOUD):
                    read.append(self._scan_of(cloud, model))
                    self._unusable_firsts.discard(cloud.stamp_ns)
            if len(read) < len(firsts):
                return False
            estimate = estimate_sensor(read, rate_hz)
            self.sensor = estimate.sensor
            self.sensor_told = estimate.told
        return self.sensor is not None

    def waiting(self, clouds: list[Cloud]) -> WaitingScan:
        """A scan that is read when its turn comes."""
        return WaitingScan(min(c.stamp_ns for c in clouds), max(c.sent_ns for c in clouds), lambda: self._read(clouds))

    def _read(self, clouds: list[Cloud]) -> Scan:
        mounts = self.mounts()
        sensor = self.sensor
        assert sensor is not None
        scans = []
        for cloud in clouds:
            scan = self._scan_of(cloud, sensor)
            if cloud.lidar:
                if mounts is None:
                    raise MapvoteError(f"no frame says where {self.lidar_frames[cloud.lidar]} sits")
                scan = scan.seen_from(mounts[cloud.lidar])
            scans.append(scan)
        scan = scans[0] if len(clouds) == 1 else Scan.sweep(min(c.stamp_ns for c in clouds), scans)
        return scan if self.mount is None else self.mount.scan(scan)

    def _scan_of(self, cloud: Cloud, sensor: Sensor) -> Scan:
        """The scan of one LiDAR, of its packets where it sends packets: one without a usable point is left out."""
        reader = self._readers[cloud.lidar]
        if not cloud.packets:
            reader.step_s = self._sweeps.step_s
            return scan_from_point_cloud2(cloud.message, sensor, reader)
        stamps_ns = [packet.stamp_ns for packet in cloud.packets]
        messages = [packet.message for packet in cloud.packets]
        return scan_of_packets(
            cloud.stamp_ns, stamps_ns, reader, lambda i: scan_from_point_cloud2(messages[i], sensor, reader)
        )
