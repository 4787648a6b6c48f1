"""A live vehicle as a service: it waits for sensor and frames, then votes until it is stopped."""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from mapvote.config import Settings
from mapvote.core.point_map import PointMap
from mapvote.core.record import record
from mapvote.core.types import F64, MapvoteError
from mapvote.formats.drives.frames import is_map_frame
from mapvote.formats.drives.ros_types import TF
from mapvote.live.choice import Voice
from mapvote.live.doubt import DoubtKeeper
from mapvote.live.drive import Counts, FirstSeconds, LiveDrive
from mapvote.live.outbox import Outbox
from mapvote.live.road_map import Maps
from mapvote.live.subscriptions import Subscriptions
from mapvote.live.sweeps import Cloud
from mapvote.vehicle import Cuts, Vehicle

log = logging.getLogger("mapvote.live")
_NO_PLACE = "no scan is localised: is this the map of this road? mapvote doctor tells more"


@record()
@dataclass(frozen=True, slots=True)
class LoopTimes:
    """Numbers of the loop of a live vehicle."""

    loop_s: float = 0.05
    """Time of one round, seconds."""
    silent_s: float = 10.0
    """Time without a message after which a topic on the road is silent, seconds."""
    judged: int = 50
    """Scans after which it is judged whether they find map and place."""
    kept_scans: int = 50
    """Scans that wait until sensor and frames are known; the oldest are dropped."""
    kept_poses: int = 5000
    """Poses that wait until sensor and frames are known; the oldest are dropped."""


LOOP_TIMES = LoopTimes()


@dataclass(frozen=True, slots=True)
class Plan:
    """The settings of a live drive."""

    vehicle: str
    name: str
    settings: Settings
    cuts: Cuts = field(default_factory=Cuts)
    T_base_lidar: F64 | None = None
    """(4, 4) the first LiDAR on what odometry tracks; None: from /tf_static."""
    idle_s: float = 0.0
    """End after so long without a cloud; 0: never."""
    checked: bool = True
    """Whether the first seconds are checked, and an error among them ends the drive; and whether a ballot leaves only
    if the vehicle knew where it was."""
    doubt: DoubtKeeper | None = None
    """Keeps the clouds around doubtful changes."""


Watcher = Callable[[LiveDrive, Subscriptions], None]
"""Called some times a second with the state of the drive."""


def prepare(
    topics: Subscriptions, plan: Plan, ended: Callable[[], bool], voice: Voice | None = None
) -> tuple[list[list[Cloud]], list[tuple[int, F64]]]:
    """Take messages until sensor and mounts are known. Returns the scans and poses that arrived meanwhile: none if no
    cloud arrived for the idle time.

    ``voice`` reports missing topics. MapvoteError if frames or odometry's mount are missing for the idle time.
    """
    voice = voice or Voice(log.warning)
    scans: deque[list[Cloud]] = deque(maxlen=LOOP_TIMES.kept_scans)
    poses: deque[tuple[int, F64]] = deque(maxlen=LOOP_TIMES.kept_poses)
    start_s = time.monotonic()
    first_s = np.inf
    while not ended():
        topics.network.wait(LOOP_TIMES.loop_s)
        begun = topics.ways_begun
        came = topics.take_poses()
        if topics.ways_begun != begun:  # the poses before are in another frame
            poses.clear()
        poses += came
        scans += topics.take_scans()
        now_s = time.monotonic()
        if scans:
            first_s = min(first_s, now_s)
        elif plan.idle_s and now_s >= start_s + plan.idle_s:
            break
        lack = _lack(topics, plan)
        measured = bool(scans) and topics.measure(scans)
        tracked = topics.chosen.odometry is None or topics.poses > 0 or now_s > first_s + voice.patience.odometry_s
        if measured and tracked and not lack:
            break
        if lack and plan.idle_s and now_s > max(start_s, first_s) + plan.idle_s:
            raise MapvoteError(lack)
        voice.lacks(lack or ("" if tracked else _no_pose(topics)))
    if topics.chosen.odometry is not None and not topics.poses and scans:
        log.warning("%s. The drive begins without it: the whole map is searched", _no_pose(topics))
    return list(scans), list(poses)


def _no_pose(topics: Subscriptions) -> str:
    """Why no pose comes of the chosen topic, and what to type."""
    assert topics.chosen.odometry is not None
    topic = topics.chosen.odometry.topic
    if topics.chosen.odometry.kind == TF:
        frames = ", ".join(topics.frames.names) or "none"
        return (
            f"no frame that moves on {topic} carries {topics.lidar_frames[0]}; frames: {frames}; type --odometry TOPIC"
        )
    if topics.last_unusable:
        return f"{topic} sends nothing that can be used ({topics.last_unusable}); mend its sender, or type --odometry"
    return f"{topic} is announced but sends nothing: start the odometry, or type --odometry TOPIC"


def _lack(topics: Subscriptions, plan: Plan) -> str:
    """The missing clouds and frames that the drive needs, and the option to type; "" if all is known."""
    silent = [one.topic for one, frame in zip(topics.chosen.points, topics.lidar_frames, strict=True) if not frame]
    if silent and topics.clouds == 0 and topics.last_unusable:
        return f"{silent[0]} sends nothing that can be used: {topics.last_unusable}"
    if silent:
        heard = ", ".join(one.topic for one in topics.chosen.points if one.topic not in silent)
        instead = f"; {heard} sends: type --points {heard}" if heard else ""
        return f"{', '.join(silent)} is announced but sends no cloud: is the LiDAR on{instead}?"
    first = topics.lidar_frames[0]
    frames = ", ".join(topics.frames.names) or _no_frames(topics)
    if topics.mounts() is None:
        others = ", ".join(topics.lidar_frames[1:])
        return (
            f"no frames join {others} to {first}: start robot_state_publisher, or name one LiDAR with --points. Frames "
            f"heard: {frames}"
        )
    if plan.T_base_lidar is None and topics.chosen.odometry is not None and topics.T_base_lidar() is None:
        return (
            f"no frames join {first} to {topics.base_frame}, which odometry tracks: start robot_state_publisher, or "
            f"type --mount x,y,z,roll,pitch,yaw. Frames heard: {frames}"
        )
    return ""


def _no_frames(topics: Subscriptions) -> str:
    """That no frames are heard, and what to type or to mend."""
    keeps_nothing = [
        one for one in topics.network.published() if one.topic == topics.tf_static and not one.transient_local
    ]
    if keeps_nothing:
        return f"none, {topics.tf_static} is not sent as transient local: start its sender again after this drive"
    return f"none, is {topics.tf_static} sent? (--tf-static TOPIC)"


def run(
    plan: Plan,
    topics: Subscriptions,
    maps: Maps,
    outbox: Outbox,
    ended: Callable[[], bool],
    watchers: Sequence[Watcher] = (),
    voice: Voice | None = None,
) -> LiveDrive | None:
    """Vote until ``ended``, or until no cloud arrived for the idle time. Returns the drive, whose last ballot has left.
    None if it ended before a cloud arrived. MapvoteError if the first seconds show an error: then nothing leaves."""
    voice = voice or Voice(log.warning)
    scans, poses = prepare(topics, plan, ended, voice)
    if ended() or not scans or topics.sensor is None:
        return None
    topics.stand_upright(plan.T_base_lidar, scans)
    live = _live_drive(plan, topics, maps, outbox)
    needs = Needs(plan, maps)
    last_s = time.monotonic()
    while not ended():
        if _mounted(live, topics, plan):
            for pose in poses:
                live.on_pose(*pose)
            live.on_fixes(topics.receiver.fixes())
        for clouds in scans:
            live.on_scan(topics.waiting(clouds))
        stepped = live.step()
        if live.checked_now:
            _check(live, topics)
        if stepped or scans:
            last_s = time.monotonic()
        if plan.idle_s and time.monotonic() > last_s + plan.idle_s:
            break
        voice.lacks(needs.lack(live, topics, time.monotonic() - last_s))
        for watcher in watchers:
            watcher(live, topics)
        if not stepped:
            topics.network.wait(LOOP_TIMES.loop_s)
        poses = topics.take_poses()
        scans = topics.take_scans()
    live.end()  # a drive of a few seconds is checked by all of its scans
    _check(live, topics)
    live.finish()
    return live


def _live_drive(plan: Plan, topics: Subscriptions, maps: Maps, outbox: Outbox) -> LiveDrive:
    sensor = topics.upright_sensor or topics.sensor
    assert sensor is not None

    def make_vehicle(point_map: PointMap) -> Vehicle:
        return Vehicle(plan.vehicle, sensor, point_map, plan.settings)

    live = LiveDrive(
        make_vehicle,
        maps,
        outbox,
        name=plan.name,
        cuts=plan.cuts,
        with_poses=topics.chosen.odometry is not None,
        T_base_lidar=plan.T_base_lidar,
        first=FirstSeconds(topics.sensor_told) if plan.checked else None,
    )
    live.mount = topics.mount
    live.doubt = plan.doubt
    return live


def _mounted(live: LiveDrive, topics: Subscriptions, plan: Plan) -> bool:
    """Give the drive the mount that frames tell, and the frame of the poses, which odometry that begins late may
    change; returns whether the mount is known: poses of a body that the LiDAR is not joined to are of no use."""
    if live.prior_in_map and not is_map_frame(topics.map_frame):
        log.info("poses are in frame %s: where it lies in the map is learnt from the scans", topics.map_frame)
        live.expect_own_frame()
    if plan.T_base_lidar is not None:
        return True
    T = topics.T_base_lidar()
    if T is not None:
        live.T_base_lidar = T
    return T is not None


class Needs:
    """Topics that a drive on the road lacks."""

    def __init__(self, plan: Plan, maps: Maps) -> None:
        self._plan = plan
        self._maps = maps
        self._poses = 0
        self._pose_s = time.monotonic()
        """When the last pose arrived."""
        self._before = Counts()
        """The counts some scans ago."""
        self._lacking_place = ""

    def lack(self, live: LiveDrive, topics: Subscriptions, silent_s: float) -> str:
        """The first thing that is missing, and what to do; "" if nothing is. ``silent_s``: since the last cloud."""
        now_s = time.monotonic()
        if topics.poses != self._poses:
            self._poses = topics.poses
            self._pose_s = now_s
        if topics.clocks.trouble():
            return topics.clocks.trouble()
        if silent_s > LOOP_TIMES.silent_s:
            return "no cloud comes any more: is the LiDAR on, and the network up?"
        if topics.chosen.odometry is not None:
            if self._plan.T_base_lidar is None and topics.T_base_lidar() is None:
                return f"{_lack(topics, self._plan)}. The drive goes on without odometry"
            if now_s - self._pose_s > LOOP_TIMES.silent_s:
                return f"no pose comes from {topics.chosen.odometry.topic}: the drive goes on without odometry"
        missed = _NO_PLACE if live.counts.observed and not live.counts.localised else ""
        return self._lack_of_place(live.counts) or missed

    def _lack_of_place(self, counts: Counts) -> str:
        """Whether scans find the map and a place on it, judged each few seconds."""
        before = self._before
        without_map = counts.without_map - before.without_map
        decided = counts.localised + counts.lost - before.localised - before.lost
        if without_map + decided >= LOOP_TIMES.judged:
            self._lacking_place = ""
            if without_map > decided:
                away = getattr(self._maps, "away", "") or "the map has none there: is this the map of this road?"
                self._lacking_place = f"tiles around the vehicle are not here: {away}"
            elif counts.localised == before.localised:
                self._lacking_place = _NO_PLACE
            self._before = replace(counts)
        return self._lacking_place


def _check(live: LiveDrive, topics: Subscriptions) -> None:
    """Log the findings of the first seconds. MapvoteError if one is an error: the drive is useless, nothing leaves."""
    wrong = topics.clocks.trouble() if live.first is not None else ""
    for finding in [] if wrong else live.first_findings():
        if finding.severity == "error":
            wrong = f"{finding.what}. {finding.mend}"
            break
        level = logging.WARNING if finding.severity == "warning" else logging.INFO
        log.log(level, "%s. %s", finding.what, finding.mend)
    if wrong:
        live.discard()
        raise MapvoteError(f"the first seconds: {wrong} (--unchecked votes all the same)")
