"""A vehicle that votes while it drives: clouds and odometry come from DDS, ballots leave as they are closed."""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from mapvote.codec.ballot import Ballot
from mapvote.core.types import F64, MapvoteError, Scan
from mapvote.formats.drives.point_fields import scan_from_point_cloud2
from mapvote.formats.drives.trajectory import sorted_trajectory
from mapvote.formats.geo.frame import MapFrame
from mapvote.live.cdr import from_cdr, stamp_ns
from mapvote.live.dds import Network, SentTopic
from mapvote.live.topics import CLOUD, ODOMETRY
from mapvote.vehicle import Cuts, RoadDriven, Vehicle, stretch_name

log = logging.getLogger("mapvote.live")
_POSES = 400
"""Poses of odometry that are kept: four seconds at 100 Hz."""
_PATIENCE_NS = 300_000_000
"""A scan waits so long for a pose later than its own stamp; then the newest ones are extrapolated, or it has none."""
_LATE_SCANS = 20
"""Scans that may wait; of more, every other one is left out, and counted."""


class LiveDrive:
    """Scans and poses as they come, to one :class:`mapvote.vehicle.Vehicle`, whose ballots are closed by ``cuts``."""

    def __init__(
        self, vehicle: Vehicle, cuts: Cuts, send: Callable[[Callable[[], Ballot]], None], T_base_lidar: F64
    ) -> None:
        """``send`` is given what writes each ballot. ``T_base_lidar`` (4, 4): the LiDAR on what odometry tracks."""
        self.vehicle, self.cuts, self.send, self.T_base_lidar = vehicle, cuts, send, T_base_lidar
        self.name, self.closed, self.left_out, self.without_pose = vehicle.drive_id, 0, 0, 0
        vehicle.drive_id = stretch_name(self.name, 1)
        self._road = RoadDriven()
        self._poses: deque[tuple[int, F64]] = deque(maxlen=_POSES)
        self._scans: deque[Scan] = deque()
        self._last_ns = -1

    def on_pose(self, time_ns: int, T_map_base: F64) -> None:
        """One pose of odometry in the map's frame; it may come in any order."""
        self._poses.append((time_ns, T_map_base))

    def on_scan(self, scan: Scan) -> None:
        """One scan; one that is not later than the last is left out and counted."""
        if scan.stamp_ns <= self._last_ns:
            self.left_out += 1
            log.warning("a scan at %d ns is not later than the last one: left out", scan.stamp_ns)
            return
        self._last_ns = scan.stamp_ns
        self._scans.append(scan)
        if len(self._scans) > _LATE_SCANS:
            kept = list(self._scans)[::2]
            self.left_out += len(self._scans) - len(kept)
            self._scans = deque(kept)

    def step(self, with_poses: bool, *, ended: bool = False) -> bool:
        """Vote with the oldest scan that waits, if its pose is known; returns whether there was one."""
        if not self._scans:
            return False
        newest = max((t for t, _ in self._poses), default=0)
        scan = self._scans[0]
        unknown = newest < scan.stamp_ns or len(self._poses) < 2
        if with_poses and not ended and unknown and self._last_ns - scan.stamp_ns < _PATIENCE_NS:
            return False
        self._scans.popleft()
        self.vehicle.observe(scan, self._prior(scan.stamp_ns))
        if self.cuts.due(self.vehicle.report, self.vehicle.done, self._road):
            self.closed, self._road = self.closed + 1, RoadDriven()
            self.send(self.vehicle.cut(stretch_name(self.name, self.closed + 1)))
        return True

    def finish(self) -> None:
        """The drive has ended: what waits votes, and the last ballot leaves."""
        while self.step(True, ended=True):
            pass
        self.vehicle.finish()
        self.send(self.vehicle.ballot)

    def _prior(self, time_ns: int) -> F64 | None:
        if len(self._poses) < 2:
            self.without_pose += 1
            return None
        times, T = zip(*self._poses, strict=True)
        found = sorted_trajectory(np.array(times), np.stack(T), of_vehicle=True, frame=MapFrame())
        try:
            T_map_base = found.at(np.array([time_ns]), "odometry")[0]
        except MapvoteError:
            self.without_pose += 1
            return None
        return np.asarray(T_map_base @ self.T_base_lidar)


@dataclass(frozen=True, slots=True)
class Chosen:
    """The topics of one vehicle."""

    points: SentTopic
    odometry: SentTopic | None


def choose_topics(network: Network, points: str | None, odometry: str | None, patience_s: float) -> Chosen:
    """The topics named, else the only ones of their types. MapvoteError lists what is sent if they do not come."""
    end = time.monotonic() + patience_s
    while True:
        heard = network.heard()
        clouds = [h for h in heard if h.kind == CLOUD and points in (None, h.topic)]
        poses = [h for h in heard if h.kind == ODOMETRY and odometry in (None, h.topic)]
        if clouds and (poses or time.monotonic() > end):
            break
        if time.monotonic() > end:
            listed = ", ".join(f"{h.topic} [{h.kind}]" for h in heard) or "nothing"
            raise MapvoteError(f"no topic {points or CLOUD} in DDS domain {network.domain}; sent there: {listed}")
        network.wait(0.1)
    for found, option in ((clouds, "--points"), (poses, "--odometry")):
        if len(found) > 1:
            raise MapvoteError(f"several topics; choose with {option}: {', '.join(h.topic for h in found)}")
    if odometry is not None and not poses:
        raise MapvoteError(f"no topic {odometry} of {ODOMETRY} in DDS domain {network.domain}")
    return Chosen(clouds[0], poses[0] if poses else None)


def matrix_of(position: Any, orientation: Any) -> F64:
    """T (4, 4) of a message's position and quaternion."""
    import scipy

    T = np.eye(4)
    q = orientation
    T[:3, :3] = scipy.spatial.transform.Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    T[:3, 3] = position.x, position.y, position.z
    return T


def messages(network: Network, chosen: Chosen, sensor: Any, ended: Callable[[], bool]) -> Iterator[tuple[str, Any]]:
    """("pose", (stamp, T)), ("scan", Scan) and ("idle", None) as they come, until ``ended``."""
    clouds = network.subscribe(chosen.points.topic, CLOUD, reliable=chosen.points.reliable)
    odometry = chosen.odometry
    poses = None if odometry is None else network.subscribe(odometry.topic, ODOMETRY, reliable=odometry.reliable)
    while not ended():
        network.wait(0.05)
        for data in [] if poses is None else poses.take():
            message = from_cdr(ODOMETRY, data)
            pose = message.pose.pose
            yield "pose", (stamp_ns(message), matrix_of(pose.position, pose.orientation))
        for data in clouds.take():
            try:
                yield "scan", scan_from_point_cloud2(from_cdr(CLOUD, data), sensor)
            except MapvoteError as error:
                log.warning("%s", error)
        yield "idle", None
