"""A live vehicle as a service: it waits for sensor and frames, then votes until it is stopped."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from mapvote.config import Settings
from mapvote.core.point_map import PointMap
from mapvote.core.types import F64, MapvoteError
from mapvote.live.drive import FirstSeconds, LiveDrive
from mapvote.live.outbox import Outbox
from mapvote.live.road_map import Maps
from mapvote.live.subscriptions import Cloud, Subscriptions
from mapvote.vehicle import Cuts, Vehicle

log = logging.getLogger("mapvote.live")
_PATIENCE_S = 5.0
"""How long frames and odometry may take to come, after the first clouds."""
_LOOP_S = 0.05


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
    """Whether the first seconds are checked, and an error among them ends the drive."""


Watcher = Callable[[LiveDrive, Subscriptions], None]
"""Called some times a second with the state of the drive."""


def prepare(
    topics: Subscriptions, plan: Plan, ended: Callable[[], bool]
) -> tuple[list[list[Cloud]], list[tuple[int, F64]]]:
    """Take messages until sensor and mounts are known. Returns the scans and poses that arrived meanwhile: none if no
    cloud arrived for the idle time.

    MapvoteError if /tf_static does not say where they are.
    """
    scans: list[list[Cloud]] = []
    poses: list[tuple[int, F64]] = []
    first_s, start = np.inf, time.monotonic()
    while not ended() and (scans or not plan.idle_s or time.monotonic() < start + plan.idle_s):
        topics.network.wait(_LOOP_S)
        poses += topics.take_poses()
        scans += topics.take_scans()
        if scans:
            first_s = min(first_s, time.monotonic())
        lacking = _lacking(topics, plan)
        tracked = topics.chosen.odometry is None or topics.base_frame or poses
        if scans and topics.measure(scans) and not lacking and tracked:
            break
        if time.monotonic() > first_s + _PATIENCE_S and (topics.sensor is not None or not topics.frames[0]):
            if lacking:
                raise MapvoteError(lacking)
            break
    return scans, poses


def _lacking(topics: Subscriptions, plan: Plan) -> str:
    """What does not come of the frames that the drive needs, and how to mend it; "" if all is known."""
    if not topics.frames[0]:
        others = ", ".join(topic.topic for topic in topics.chosen.points[1:])
        return f"no cloud comes from {topics.chosen.points[0].topic}, but from {others}: is it on?"
    if topics.mounts() is None:
        return (
            f"/tf_static does not say where {', '.join(topics.frames[1:])} sit to {topics.frames[0]}: start "
            "robot_state_publisher, or name one LiDAR with --points"
        )
    if plan.T_base_lidar is None and topics.chosen.odometry is not None and topics.T_base_lidar() is None:
        return (
            f"/tf_static does not say where {topics.frames[0]} sits on {topics.base_frame}, which odometry "
            "tracks: start robot_state_publisher, or say --mount"
        )
    return ""


def run(
    plan: Plan,
    topics: Subscriptions,
    maps: Maps,
    outbox: Outbox,
    ended: Callable[[], bool],
    watchers: Sequence[Watcher] = (),
) -> LiveDrive | None:
    """Vote until ``ended``, or until no cloud arrived for the idle time. Returns the drive, whose last ballot has left.
    None if it ended before a cloud arrived. MapvoteError if the first seconds show an error: then nothing leaves."""
    scans, poses = prepare(topics, plan, ended)
    if ended() or not scans or topics.sensor is None:
        return None
    sensor, T = topics.sensor, plan.T_base_lidar

    def make_vehicle(point_map: PointMap) -> Vehicle:
        return Vehicle(plan.vehicle, sensor, point_map, plan.settings)

    live = LiveDrive(
        make_vehicle,
        maps,
        outbox,
        name=plan.name,
        cuts=plan.cuts,
        with_poses=topics.chosen.odometry is not None,
        T_base_lidar=topics.T_base_lidar() if T is None else T,
        first=FirstSeconds(topics.sensor_told) if plan.checked else None,
    )
    last_s = time.monotonic()
    while not ended():
        for pose in poses:
            live.on_pose(*pose)
        for clouds in scans:
            live.on_scan(topics.waiting(clouds))
        stepped = live.step()
        if live.checked_now:
            _check(live, topics)
        if stepped or scans:
            last_s = time.monotonic()
        if plan.idle_s and time.monotonic() > last_s + plan.idle_s:
            break
        for watcher in watchers:
            watcher(live, topics)
        if not stepped:
            topics.network.wait(_LOOP_S)
        poses, scans = topics.take_poses(), topics.take_scans()
    _check(live, topics)
    live.finish()
    return live


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
