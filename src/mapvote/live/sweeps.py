"""Clouds as they arrive, joined to scans: packets of one LiDAR to revolutions, clouds of several LiDARs to sweeps."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from mapvote.formats.drives.packets import SWEEP_RULE, Packets, direction_of
from mapvote.formats.drives.point_fields import point_cloud_table


@dataclass(frozen=True, slots=True)
class Cloud:
    """A PointCloud2 that arrived, or the packets of one revolution."""

    lidar: int
    stamp_ns: int
    sent_ns: int
    message: Any
    """Stamp of the first of several packets."""
    packets: tuple[Cloud, ...] = ()
    """The packets in the order of their stamps; () if it came whole."""


class Revolutions:
    """Joins the clouds of one LiDAR to revolutions, if it sends packets."""

    def __init__(self) -> None:
        self._packets: Packets[Cloud] = Packets()

    def add(self, cloud: Cloud, now_s: float = 0.0) -> list[Cloud]:
        """One more cloud, in order of stamps, which arrived at ``now_s`` of any steady clock; the clouds that are whole
        by now."""
        groups = self._packets.add(
            cloud, cloud.stamp_ns, lambda: direction_of(point_cloud_table("a cloud", cloud.message)), now_s
        )
        return [self._whole(group) for group in groups]

    def after_pause(self, now_s: float) -> list[Cloud]:
        """The clouds that wait for the decision, if no other came for a while."""
        return [cloud for group in self._packets.after_pause(now_s) for cloud in group]

    def _whole(self, group: list[Cloud]) -> Cloud:
        if not self._packets.is_packets:
            return group[0]
        first = group[0]
        sent_ns = max(packet.sent_ns for packet in group)
        return Cloud(first.lidar, first.stamp_ns, sent_ns, first.message, tuple(group))


class Sweeps:
    """Joins the clouds that several LiDARs measure within half a revolution to one scan."""

    def __init__(self, lidars: int) -> None:
        self._lidars = lidars
        self._reach_ns = 0.55e8
        self._open: list[Cloud] = []
        self._firsts: deque[int] = deque(maxlen=20)
        """Stamps of the first LiDAR, which give its period."""

    @property
    def step_s(self) -> float | None:
        """Between two clouds of the first LiDAR (median), seconds; None before the third."""
        return float(np.median(np.diff(sorted(self._firsts)))) * 1e-9 if len(self._firsts) > 2 else None

    def add(self, clouds: Iterable[Cloud]) -> list[list[Cloud]]:
        """Clouds that arrived together, in any order. Returns the scans that are whole by now, each in order of
        LiDARs."""
        out = []
        for cloud in sorted(clouds, key=lambda cloud: cloud.stamp_ns):
            if cloud.lidar == 0:
                self._firsts.append(cloud.stamp_ns)
                if len(self._firsts) > 2:
                    self._reach_ns = SWEEP_RULE.revolutions * float(np.median(np.diff(sorted(self._firsts))))
            start_ns = min((c.stamp_ns for c in self._open), default=cloud.stamp_ns)
            apart = abs(cloud.stamp_ns - start_ns) > self._reach_ns or cloud.lidar in {c.lidar for c in self._open}
            if self._open and apart:
                out.append(self._closed())
            self._open.append(cloud)
            if len(self._open) == self._lidars:
                out.append(self._closed())
        return out

    def _closed(self) -> list[Cloud]:
        closed = sorted(self._open, key=lambda c: c.lidar)
        self._open = []
        return closed
