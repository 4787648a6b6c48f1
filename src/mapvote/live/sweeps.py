"""Clouds as they arrive, joined to scans: packets of one LiDAR to revolutions, clouds of several LiDARs to sweeps."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from mapvote.core.record import record
from mapvote.core.types import F64
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


@dataclass(frozen=True, slots=True)
class PacketRule:
    """How packets are told from whole scans."""

    looked_at: int = 8
    """Clouds that are looked at before it is decided."""
    most_coverage: float = 0.6
    """Share of the circle that a packet covers at most; a cloud that covers more is whole."""
    least_turn_rad: float = float(np.radians(5.0))
    """Turn of the middle from one packet to the next at least, radians: that of a LiDAR that looks ahead stays."""
    same_way: float = 0.8
    """Share of the turns that go the same way at least."""
    pause_s: float = 0.3
    """Clouds that wait for the decision are released as whole ones after a pause of so long, seconds."""
    longest_ns: int = 500_000_000
    """A revolution that takes longer is closed: packets are missing, nanoseconds."""


RULE = PacketRule()


@record()
@dataclass(frozen=True, slots=True)
class SweepRule:
    """Numbers by which clouds are joined to a revolution."""

    revolutions: float = 0.55
    """Revolutions within which the clouds of several LiDARs are one scan, as in a recorded drive."""
    bins: int = 36
    """Bins of directions of a turn."""
    sampled: int = 400
    """Points of a cloud whose directions are examined."""


SWEEP_RULE = SweepRule()


class Packets:
    """Joins the packets of one LiDAR to revolutions, if it sends packets. Until that is known the clouds wait."""

    def __init__(self, rule: PacketRule = RULE) -> None:
        self._rule = rule
        self.is_packets: bool | None = None
        """None until it is known."""
        self._held: list[Cloud] = []
        self._came_s = 0.0
        self._middles: list[float] = []
        self._open: list[Cloud] = []
        self._turned = 0.0
        """Radians from the first packet of the open revolution to the last."""
        self._step = 0.0
        """Usual turn between two packets, radians, with its sign."""
        self._last = 0.0

    def after_pause(self, now_s: float) -> list[Cloud]:
        """The clouds that wait for the decision, if no other came for a while: packets come without a pause."""
        if not self._held or now_s - self._came_s < self._rule.pause_s:
            return []
        held = self._held
        self._held = []
        self._middles = []
        return held

    def add(self, cloud: Cloud, now_s: float = 0.0) -> list[Cloud]:
        """One more cloud, in order of stamps, which arrived at ``now_s`` of any steady clock; the clouds that are whole
        by now."""
        self._came_s = now_s
        if self.is_packets is False:
            return [cloud]
        middle, coverage = direction_of(cloud.message)
        if self.is_packets is None:
            return self._decide(cloud, middle, coverage)
        return self._join(cloud, middle)

    def _decide(self, cloud: Cloud, middle: float, coverage: float) -> list[Cloud]:
        self._held.append(cloud)
        self._middles.append(middle)
        whole = coverage > self._rule.most_coverage
        if not whole and len(self._held) < self._rule.looked_at:
            return []
        turns = _wrapped(np.diff(self._middles))
        step = float(np.median(turns)) if len(turns) else 0.0
        one_way = float((np.sign(turns) == np.sign(step)).mean()) if len(turns) else 0.0
        self.is_packets = not whole and abs(step) >= self._rule.least_turn_rad and one_way >= self._rule.same_way
        held = self._held
        middles = self._middles
        self._held = []
        self._middles = []
        if not self.is_packets:
            return held
        self._step = step
        return [out for one, at in zip(held, middles, strict=True) for out in self._join(one, at)]

    def _join(self, cloud: Cloud, middle: float) -> list[Cloud]:
        """The revolution that is whole before this packet, if it is."""
        out: list[Cloud] = []
        if self._open:
            turn = float(_wrapped(np.array([middle - self._last]))[0])
            self._turned += abs(turn) if turn * self._step > 0.0 else 0.0
            full = self._turned >= 2.0 * np.pi - 0.5 * abs(self._step)
            late = cloud.stamp_ns - self._open[0].stamp_ns > self._rule.longest_ns
            if full or late:
                first = self._open[0]
                sent_ns = max(packet.sent_ns for packet in self._open)
                out.append(Cloud(first.lidar, first.stamp_ns, sent_ns, first.message, tuple(self._open)))
                self._open = []
                self._turned = 0.0
        self._open.append(cloud)
        self._last = middle
        return out


def direction_of(message: Any) -> tuple[float, float]:
    """The azimuth of the middle of a PointCloud2, radians, and the share of the circle in which it has points."""
    table = point_cloud_table("a cloud", message)
    some = table[:: max(1, len(table) // SWEEP_RULE.sampled)]
    x = some["x"].astype(np.float64)
    y = some["y"].astype(np.float64)
    seen = np.isfinite(x) & np.isfinite(y) & (np.hypot(x, y) > 0.0)
    azimuth = np.arctan2(y[seen], x[seen])
    if not len(azimuth):
        return 0.0, 0.0
    bins = np.unique(np.floor((azimuth + np.pi) / (2.0 * np.pi) * SWEEP_RULE.bins).astype(np.int64) % SWEEP_RULE.bins)
    return float(np.arctan2(np.sin(azimuth).mean(), np.cos(azimuth).mean())), len(bins) / SWEEP_RULE.bins


def _wrapped(angles: F64) -> F64:
    """Angles between -pi and pi."""
    return np.asarray((angles + np.pi) % (2.0 * np.pi) - np.pi)


class Sweeps:
    """Joins the clouds that several LiDARs measure within half a revolution to one scan."""

    def __init__(self, lidars: int) -> None:
        self._lidars, self._reach_ns = lidars, 0.55e8
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
        closed, self._open = sorted(self._open, key=lambda c: c.lidar), []
        return closed
