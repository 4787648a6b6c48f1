"""The input of one vehicle from DDS: clouds of its LiDARs joined to scans, poses of odometry, fixed frames."""

from __future__ import annotations

import logging
import time
from bisect import bisect_left
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from mapvote.core.geometry import inverse
from mapvote.core.sensors import Sensor
from mapvote.core.types import F64, MapvoteError, Scan
from mapvote.formats.drives.point_fields import scan_from_point_cloud2
from mapvote.formats.drives.rosbag import Edges, T_from
from mapvote.formats.drives.sensor_estimate import UNKNOWN, estimate_sensor
from mapvote.live.dds import Chosen, Network
from mapvote.live.drive import WaitingScan
from mapvote.live.messages import CLOUD, ODOMETRY, TF, from_cdr, matrix_of, stamp_ns

log = logging.getLogger("mapvote.live")
_SWEEP = 0.55
"""Revolutions within which the clouds of several LiDARs are one scan, as in a recorded drive."""
_DEPTH = 200
"""Messages that wait in DDS at most: while the process stands still for 20 s none is lost."""
_MEASURED = 10
"""Scans in which a sensor is measured."""
_POSES = 400
"""Poses whose times of sending are kept: four seconds at 100 Hz."""
_OTHER_CLOCK_NS = 10**9
"""Stamps of clouds and poses that come together and differ by more are of two clocks."""
_TOGETHER_NS = 500_000_000
"""Clouds and poses that are sent, or that arrive, within so long come together."""


@dataclass(frozen=True, slots=True)
class Cloud:
    """A PointCloud2 that arrived."""

    lidar: int
    stamp_ns: int
    sent_ns: int
    message: Any


class Sweeps:
    """Joins the clouds that several LiDARs measure within half a revolution to one scan."""

    def __init__(self, lidars: int) -> None:
        self._lidars, self._reach_ns = lidars, 0.55e8
        self._open: list[Cloud] = []
        self._firsts: deque[int] = deque(maxlen=20)
        """Stamps of the first LiDAR, which give its period."""

    def add(self, clouds: Iterable[Cloud]) -> list[list[Cloud]]:
        """Clouds that arrived together, in any order. Returns the scans that are whole by now, each in order of
        LiDARs."""
        out = []
        for cloud in sorted(clouds, key=lambda cloud: cloud.stamp_ns):
            if cloud.lidar == 0:
                self._firsts.append(cloud.stamp_ns)
                if len(self._firsts) > 2:
                    self._reach_ns = _SWEEP * float(np.median(np.diff(sorted(self._firsts))))
            start_ns = min((c.stamp_ns for c in self._open), default=cloud.stamp_ns)
            apart = abs(cloud.stamp_ns - start_ns) > self._reach_ns or cloud.lidar in {c.lidar for c in self._open}
            if self._open and apart:
                out.append(self._closed())
            self._open.append(cloud)
            if len(self._open) == self._lidars:
                out.append(self._closed())
        return out

    def _closed(self) -> list[Cloud]:
        closed, self._open = sorted(self._open, key=lambda c: c.lidar), []
        return closed


class Clocks:
    """Whether odometry and LiDAR share a clock: by the stamps of what they send, or of what arrives, at one time.

    The smaller difference counts. What arrives together was not sent together if the process was busy. What was sent
    at one time by two computers whose own clocks differ was not sent together either.
    """

    def __init__(self) -> None:
        self._poses: deque[tuple[int, int]] = deque(maxlen=_POSES)
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
        if abs(self._poses[near][0] - sent_ns) <= _TOGETHER_NS:
            together.append(self._poses[near][1] - stamp_ns)
        if now_s - self._arrived_s <= 1e-9 * _TOGETHER_NS:
            together.append(self._poses[-1][1] - stamp_ns)
        self.apart_ns = min(together, key=abs, default=self.apart_ns)

    def trouble(self) -> str:
        """What is wrong if they are two clocks, else ""."""
        if abs(self.apart_ns) <= _OTHER_CLOCK_NS:
            return ""
        return (
            f"odometry's stamps are {1e-9 * self.apart_ns:+.1f} s off those of the clouds that come with them: two "
            "clocks. Synchronise them (PTP, or the driver's own time), or choose another --odometry"
        )


class Subscriptions:
    """The topics of one vehicle. Writers may appear and vanish."""

    def __init__(self, network: Network, chosen: Chosen, sensor: Sensor | None) -> None:
        """``sensor``: of the first LiDAR; None: it is measured in the first scans."""
        self.network, self.chosen, self.sensor = network, chosen, sensor
        self.sensor_told = "stated" if sensor is not None else ""
        self.frames: list[str] = [""] * len(chosen.points)
        """The frame of each LiDAR, from its clouds."""
        self.base_frame, self.map_frame = "", ""
        """The frame that odometry tracks, and its parent."""
        self.clocks = Clocks()
        self.clouds = self.unusable = 0
        """Clouds that arrived; messages of any topic that cannot be used."""
        self._edges: Edges = {}
        self._sweeps = Sweeps(len(chosen.points))
        self._points, self._odometry = (
            [network.subscribe(one.topic, one.kind, reliable=one.reliable, depth=_DEPTH) for one in topics]
            for topics in (chosen.points, [] if chosen.odometry is None else [chosen.odometry])
        )
        self._tf = network.subscribe("/tf_static", TF, reliable=True, transient_local=True)

    def take_poses(self) -> list[tuple[int, F64]]:
        """Poses of odometry that arrived: stamps, and T_map_base."""
        out = []
        for sent_ns, data in (received for reader in self._odometry for received in reader.take()):
            with self._some_unusable(ODOMETRY):
                message = from_cdr(ODOMETRY, data)
                T = matrix_of(message.pose.pose.position, message.pose.pose.orientation)
                self.base_frame = message.child_frame_id.strip("/")
                self.map_frame = message.header.frame_id.strip("/")
                out.append((stamp_ns(message.header), T))
                self.clocks.pose(sent_ns, out[-1][0], time.monotonic())
        return out

    @contextmanager
    def _some_unusable(self, kind: str) -> Iterator[None]:
        """Leaves out a message that cannot be used; logs the 1st, 2nd, 4th, 8th ..."""
        try:
            yield
        except MapvoteError as error:
            self.unusable += 1
            if self.unusable & (self.unusable - 1) == 0:
                log.warning("%s is left out: %s (%d messages so far)", kind, error, self.unusable)

    def take_scans(self) -> list[list[Cloud]]:
        """Clouds that arrived, joined to scans."""
        for _, data in self._tf.take():
            with self._some_unusable(TF):
                for transform in from_cdr(TF, data).transforms:
                    self._add_frame(transform)
        clouds: list[Cloud] = []
        for lidar, reader in enumerate(self._points):
            for sent_ns, data in reader.take():
                with self._some_unusable(CLOUD):
                    message = from_cdr(CLOUD, data)
                    self.frames[lidar] = message.header.frame_id.strip("/")
                    clouds.append(Cloud(lidar, stamp_ns(message.header), sent_ns, message))
                    self.clocks.cloud(sent_ns, clouds[-1].stamp_ns, time.monotonic())
        self.clouds += len(clouds)
        return self._sweeps.add(clouds)

    def _add_frame(self, t: Any) -> None:
        """A geometry_msgs/TransformStamped, both ways."""
        parent, child = t.header.frame_id.strip("/"), t.child_frame_id.strip("/")
        T = matrix_of(t.transform.translation, t.transform.rotation)
        for here, there, T_here_there in ((parent, child, T), (child, parent, inverse(T))):
            known = [edge for edge in self._edges.get(here, []) if edge[0] != there]
            self._edges[here] = [*known, (there, T_here_there)]

    def T_base_lidar(self) -> F64 | None:
        """(4, 4) the first LiDAR on what odometry tracks, by /tf_static; the identity if both are one frame, or nobody
        names what odometry tracks. None if /tf_static does not say."""
        if self.base_frame in ("", self.frames[0]):
            return np.eye(4)
        return T_from(self._edges, self.base_frame).get(self.frames[0])

    def mounts(self) -> list[F64] | None:
        """(4, 4) each: T_first_lidar of every LiDAR; None while /tf_static does not say."""
        if len(self.frames) == 1:
            return [np.eye(4)]
        reached = T_from(self._edges, self.frames[0]) if all(self.frames) else {}
        return [reached[frame] for frame in self.frames] if reached.keys() >= set(self.frames) else None

    def measure(self, scans: Sequence[list[Cloud]]) -> bool:
        """Measure the first LiDAR in the first ``scans``, unless it is known; returns whether it is now."""
        firsts = [sweep[0] for sweep in scans if sweep[0].lidar == 0]
        if self.sensor is None and len(firsts) >= _MEASURED:
            steps_ns = np.diff([cloud.stamp_ns for cloud in firsts])
            rate_hz = round(1e9 / float(np.median(steps_ns)), 1)
            read = [scan_from_point_cloud2(cloud.message, UNKNOWN) for cloud in firsts[:_MEASURED]]
            found = estimate_sensor(read, rate_hz)
            self.sensor, self.sensor_told = found.sensor, found.told
        return self.sensor is not None

    def waiting(self, clouds: list[Cloud]) -> WaitingScan:
        """A scan that is read when its turn comes."""
        return WaitingScan(min(c.stamp_ns for c in clouds), max(c.sent_ns for c in clouds), lambda: self._read(clouds))

    def _read(self, clouds: list[Cloud]) -> Scan:
        mounts, sensor = self.mounts(), self.sensor
        assert sensor is not None
        scans = []
        for cloud in clouds:
            scan = scan_from_point_cloud2(cloud.message, sensor)
            if cloud.lidar:
                if mounts is None:
                    raise MapvoteError(f"/tf_static does not say where {self.frames[cloud.lidar]} sits")
                scan = scan.seen_from(mounts[cloud.lidar])
            scans.append(scan)
        return scans[0] if len(clouds) == 1 else Scan.sweep(min(c.stamp_ns for c in clouds), scans)
