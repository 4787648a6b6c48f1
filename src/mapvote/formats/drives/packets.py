"""Packets, each a part of a revolution of one LiDAR, joined to revolutions: live and from bags."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from mapvote.core.geometry import wrapped
from mapvote.core.record import record
from mapvote.core.types import MapvoteError, Scan
from mapvote.formats.drives.point_fields import PointReader
from mapvote.formats.maps.cloud import xyz

Cloud = TypeVar("Cloud")


@record()
@dataclass(frozen=True, slots=True)
class PacketRule:
    """Numbers by which packets are distinguished from whole scans."""

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
    bins: int = 36
    """Parts of the circle in which points are looked for."""
    sampled: int = 400
    """Points of a cloud whose directions are looked at."""


PACKET_RULE = PacketRule()


@record()
@dataclass(frozen=True, slots=True)
class SweepRule:
    """How the clouds of several LiDARs are joined to one scan."""

    revolutions: float = 0.55
    """Revolutions within which they are one scan, live and recorded: the LiDARs may turn at opposite phases."""


SWEEP_RULE = SweepRule()


@dataclass(frozen=True, slots=True)
class _Packet(Generic[Cloud]):
    """One cloud, and where it looks."""

    cloud: Cloud
    stamp_ns: int
    middle_rad: float


class Packets(Generic[Cloud]):
    """Joins the packets of one LiDAR to revolutions, if it sends packets. Until that is known its clouds wait."""

    def __init__(self, rule: PacketRule = PACKET_RULE) -> None:
        self._rule = rule
        self.is_packets: bool | None = None
        """None until it is known."""
        self._held: list[_Packet[Cloud]] = []
        self._came_s = 0.0
        self._open: list[_Packet[Cloud]] = []
        self._turned_rad = 0.0
        """From the first packet of the open revolution to the last."""
        self._step_rad = 0.0
        """Usual turn between two packets, with its sign."""

    def after_pause(self, now_s: float) -> list[list[Cloud]]:
        """The clouds that wait for the decision, each by itself, if no other came for a while: packets come without a
        pause."""
        if not self._held or now_s - self._came_s < self._rule.pause_s:
            return []
        held = self._held
        self._held = []
        return [[packet.cloud] for packet in held]

    def add(
        self, cloud: Cloud, stamp_ns: int, look: Callable[[], tuple[float, float]], now_s: float = 0.0
    ) -> list[list[Cloud]]:
        """One more cloud, in order of stamps, which arrived at ``now_s`` of any steady clock. Returns what is whole by
        now: the packets of each revolution, or each cloud by itself. ``look`` gives its :func:`direction_of`."""
        self._came_s = now_s
        if self.is_packets is False:
            return [[cloud]]
        middle_rad, coverage = look()
        packet = _Packet(cloud, stamp_ns, middle_rad)
        return self._decide(packet, coverage) if self.is_packets is None else self._join(packet)

    def _decide(self, packet: _Packet[Cloud], coverage: float) -> list[list[Cloud]]:
        rule = self._rule
        self._held.append(packet)
        whole = coverage > rule.most_coverage
        if not whole and len(self._held) < rule.looked_at:
            return []
        # Packets turn on, by much the same angle each.
        turns = wrapped(np.diff([one.middle_rad for one in self._held]))
        step_rad = float(np.median(turns)) if len(turns) else 0.0
        one_way = float((np.sign(turns) == np.sign(step_rad)).mean()) if len(turns) else 0.0
        self.is_packets = not whole and abs(step_rad) >= rule.least_turn_rad and one_way >= rule.same_way
        held = self._held
        self._held = []
        if not self.is_packets:
            return [[one.cloud] for one in held]
        self._step_rad = step_rad
        return [revolution for one in held for revolution in self._join(one)]

    def _join(self, packet: _Packet[Cloud]) -> list[list[Cloud]]:
        """The revolution that is whole before this packet, if it is."""
        out: list[list[Cloud]] = []
        if self._open:
            turn = float(wrapped(np.array([packet.middle_rad - self._open[-1].middle_rad]))[0])
            self._turned_rad += abs(turn) if turn * self._step_rad > 0.0 else 0.0
            full = self._turned_rad >= 2.0 * np.pi - 0.5 * abs(self._step_rad)
            if full or packet.stamp_ns - self._open[0].stamp_ns > self._rule.longest_ns:
                out.append([one.cloud for one in self._open])
                self._open = []
                self._turned_rad = 0.0
        self._open.append(packet)
        return out


def direction_of(table: NDArray[np.void], rule: PacketRule = PACKET_RULE) -> tuple[float, float]:
    """The azimuth of the middle of points (n,) with x, y and z, radians, and the share of the circle in which there are
    any. MapvoteError as :func:`mapvote.formats.maps.cloud.xyz`."""
    few = table[:: max(1, len(table) // rule.sampled)]
    with np.errstate(invalid="ignore"):  # damaged numbers
        x, y, _ = xyz("a cloud", few).astype(np.float64).T
    seen = np.isfinite(x) & np.isfinite(y) & (np.hypot(x, y) > 0.0)
    azimuth = np.arctan2(y[seen], x[seen])
    if not len(azimuth):
        return 0.0, 0.0
    bins = np.unique(np.floor((azimuth + np.pi) / (2.0 * np.pi) * rule.bins).astype(np.int64) % rule.bins)
    return float(np.arctan2(np.sin(azimuth).mean(), np.cos(azimuth).mean())), len(bins) / rule.bins


def scan_of_packets(stamp_ns: int, stamps_ns: Sequence[int], reader: PointReader, read: Callable[[int], Scan]) -> Scan:
    """The scan at ``stamp_ns`` of the packets of one revolution at ``stamps_ns``. ``read`` gives the scan of each by
    its number, through ``reader``. A packet without a usable point is left out; MapvoteError if all are."""
    reader.step_s = float(np.median(np.diff(stamps_ns))) * 1e-9 if len(stamps_ns) > 1 else None
    scans: list[Scan] = []
    for number in range(len(stamps_ns)):
        try:
            scans.append(read(number))
        except MapvoteError:
            if number + 1 == len(stamps_ns) and not scans:
                raise
    return replace(Scan.sweep(stamp_ns, scans), others=())
