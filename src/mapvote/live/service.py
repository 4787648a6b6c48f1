"""A live vehicle as a service: it waits for sensor and frames, votes until it is stopped, and reports its status."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from mapvote.config import Settings
from mapvote.core.point_map import PointMap
from mapvote.core.types import F64, MapvoteError
from mapvote.live.drive import LiveDrive, Maps
from mapvote.live.first_seconds import FirstSeconds
from mapvote.live.hearing import Cloud, Hearing
from mapvote.live.outbox import Outbox
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


Watcher = Callable[["LiveDrive", Hearing], None]
"""Called some times a second with the state of the drive."""


def prepare(hearing: Hearing, plan: Plan, ended: Callable[[], bool]) -> tuple[list[list[Cloud]], list[tuple[int, F64]]]:
    """Read topics until sensor and mounts are known. Returns the scans and poses that arrived meanwhile: none if no
    cloud arrived for the idle time.

    MapvoteError if /tf_static does not say where they are.
    """
    scans: list[list[Cloud]] = []
    poses: list[tuple[int, F64]] = []
    first_s, start = np.inf, time.monotonic()
    while not ended() and (scans or not plan.idle_s or time.monotonic() < start + plan.idle_s):
        hearing.network.wait(_LOOP_S)
        poses += hearing.poses()
        scans += hearing.scans()
        if scans:
            first_s = min(first_s, time.monotonic())
        mounted = hearing.mounts() is not None or len(hearing.frames) == 1
        based = plan.T_base_lidar is not None or hearing.chosen.odometry is None or hearing.T_base_lidar() is not None
        told = hearing.chosen.odometry is None or hearing.base_frame or poses
        if scans and hearing.measure(scans) and mounted and based and told:
            break
        if time.monotonic() > first_s + _PATIENCE_S and not hearing.frames[0]:
            others = ", ".join(topic.topic for topic in hearing.chosen.points[1:])
            raise MapvoteError(f"no cloud comes from {hearing.chosen.points[0].topic}, but from {others}: is it on?")
        if time.monotonic() > first_s + _PATIENCE_S and hearing.sensor is not None:
            if not mounted:
                raise MapvoteError(
                    f"/tf_static does not say where {', '.join(hearing.frames[1:])} sit to {hearing.frames[0]}: start "
                    "robot_state_publisher, or name one LiDAR with --points"
                )
            if not based:
                raise MapvoteError(
                    f"/tf_static does not say where {hearing.frames[0]} sits on {hearing.base_frame}, which odometry "
                    "tracks: start robot_state_publisher, or say --mount"
                )
            break
    return scans, poses


def run(
    plan: Plan,
    hearing: Hearing,
    maps: Maps,
    outbox: Outbox,
    ended: Callable[[], bool],
    watchers: Sequence[Watcher] = (),
) -> LiveDrive | None:
    """Vote until ``ended``, or until no cloud arrived for the idle time. Returns the drive, whose last ballot has left.
    None if it ended before a cloud arrived. MapvoteError if the first seconds show an error: then nothing leaves."""
    scans, poses = prepare(hearing, plan, ended)
    if ended() or not scans or hearing.sensor is None:
        return None
    sensor, T = hearing.sensor, plan.T_base_lidar
    first = FirstSeconds(hearing.sensor_told) if plan.checked else None

    def make_vehicle(point_map: PointMap) -> Vehicle:
        return Vehicle(plan.vehicle, sensor, point_map, plan.settings)

    live = LiveDrive(
        make_vehicle,
        maps,
        outbox,
        name=plan.name,
        cuts=plan.cuts,
        with_poses=hearing.chosen.odometry is not None,
        T_base_lidar=hearing.T_base_lidar() if T is None else T,
        first=first,
    )
    last_s = time.monotonic()
    while not ended():
        for pose in poses:
            live.on_pose(*pose)
        for clouds in scans:
            live.on_scan(hearing.waiting(clouds))
        stepped = live.step()
        if live.checked_now:
            _check(live, hearing)
        if stepped or scans:
            last_s = time.monotonic()
        if plan.idle_s and time.monotonic() > last_s + plan.idle_s:
            break
        for watcher in watchers:
            watcher(live, hearing)
        if not stepped:
            hearing.network.wait(_LOOP_S)
        poses, scans = hearing.poses(), hearing.scans()
    _check(live, hearing)
    live.finish()
    return live


def _check(live: LiveDrive, hearing: Hearing) -> None:
    """Log the findings of the first seconds. MapvoteError if one is an error: the drive is useless, nothing leaves."""
    clocks = hearing.clocks.trouble() if live.unchecked else ""
    if clocks:
        live.discard()
        raise MapvoteError(f"the first seconds: {clocks} (--unchecked votes all the same)")
    for finding in live.first_findings():
        if finding.severity == "error":
            live.discard()
            raise MapvoteError(f"the first seconds: {finding.what}. {finding.mend} (--unchecked votes all the same)")
        log.log(
            logging.WARNING if finding.severity == "warning" else logging.INFO, "%s. %s", finding.what, finding.mend
        )
