"""Topics of a satellite receiver: sensor_msgs/NavSatFix, and the headings of a sensor_msgs/Imu beside it."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np

from mapvote.core.record import record
from mapvote.core.types import F64, MapvoteError
from mapvote.formats.drives.bag_poses import heading_of_message, stated_covariance
from mapvote.formats.drives.fixes import Fixes, antenna_lever, fixes_of
from mapvote.formats.drives.frames import BASE_FRAME, Frames
from mapvote.formats.geo.frame import MapFrame, have_place
from mapvote.live.messages import stamp_ns


@record()
@dataclass(frozen=True, slots=True)
class FixMemory:
    """Which messages of a receiver are kept."""

    fixes: int = 1000
    """Fixes that are kept: 50 s at 20 Hz."""
    headings: int = 6000
    """Headings of an IMU that are kept: 30 s at 200 Hz."""


FIX_MEMORY = FixMemory()


class FixTopics:
    """The last fixes of a vehicle, in the frame of the map."""

    def __init__(self, map_frame: MapFrame, frames: Frames, memory: FixMemory = FIX_MEMORY) -> None:
        """``map_frame``: how the map lies on Earth. ``frames``: of the vehicle."""
        self._map_frame = map_frame
        self._frames = frames
        self._memory = memory
        self._fixes = Fixes()
        self._are_newest = True
        """Whether the headings that came are in ``_fixes``."""
        self._headings: deque[tuple[int, float, float]] = deque(maxlen=memory.headings)
        self._height_m = 0.0
        self.antenna = ""
        """The frame of the antenna."""

    def add_fix(self, message: Any) -> None:
        """One NavSatFix. MapvoteError if it is none, or if the place of the map on Earth is unknown."""
        self.antenna = message.header.frame_id.strip("/")
        height_m = message.altitude if np.isfinite(message.altitude) else self._height_m
        lonlat = np.array([[message.longitude, message.latitude, height_m]])
        if message.status.status < 0:
            raise MapvoteError("a fix whose status is NO_FIX: the receiver finds no satellites")
        if not have_place(lonlat)[0]:
            raise MapvoteError("a fix without a place (not a number, or latitude 0, longitude 0)")
        self._height_m = float(height_m)
        times_ns = np.array([stamp_ns(message.header)], dtype=np.int64)
        fix = fixes_of(times_ns, lonlat, stated_covariance(message)[None], self._map_frame)
        self._fixes = self._fixes.with_fixes(fix, self._memory.fixes)

    def add_imu(self, message: Any) -> None:
        """One Imu: its heading, where it states one."""
        T_base_imu = self._frames.between(BASE_FRAME, message.header.frame_id.strip("/"))
        yaw_rad, sigma_rad = heading_of_message(message, np.eye(4) if T_base_imu is None else T_base_imu)
        self._headings.append((stamp_ns(message.header), yaw_rad, sigma_rad))
        self._are_newest = False

    def fixes(self) -> Fixes:
        """The last fixes with the last headings."""
        if not self._are_newest:
            times_ns, yaw_rad, sigma_rad = zip(*self._headings, strict=True)
            self._fixes = self._fixes.with_headings(times_ns, yaw_rad, sigma_rad)
            self._are_newest = True
        return self._fixes

    def T_antenna_lidar(self, lidar: str) -> F64:
        """(4, 4) the LiDAR from the antenna, by the frames that came."""
        joined = {name: self._frames.between(BASE_FRAME, name) for name in (self.antenna, lidar)}
        return antenna_lever({name: T for name, T in joined.items() if T is not None}, self.antenna, lidar)
