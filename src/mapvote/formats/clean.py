"""What every scan passes before it becomes a Scan: points that are no measurements are dropped and counted aloud."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mapvote.core.sensors import Sensor
from mapvote.core.types import F32, I64, MapvoteError, Scan

log = logging.getLogger("mapvote.formats")

MAX_BAD_SHARE = 0.05
"""A scan with more broken points than this is refused: it is damaged, or not the format it claims to be."""
FAR_M = 2000.0
"""No LiDAR of ours measures farther; float64 or integers read as float32 do."""


@dataclass(slots=True)
class BadPoints:
    """Running count over one drive. Warns at the 1st, 2nd, 4th, 8th ... scan concerned: heard, but not a flood."""

    where: str
    scans: int = 0
    points: int = 0
    seen: set[int] = field(default_factory=set)

    def count(self, index: int, n: int) -> None:
        if n == 0 or index in self.seen:
            return
        self.seen.add(index)
        self.scans += 1
        self.points += n
        if self.scans & (self.scans - 1) == 0:
            log.warning(
                "%s: dropped %d points that are not finite or beyond %.0f m, in %d scans so far",
                self.where,
                self.points,
                FAR_M,
                self.scans,
            )


@dataclass(frozen=True, slots=True)
class RawScan:
    """One scan as a file holds it; what a format does not tell is None."""

    index: int
    stamp_ns: int
    points: F32
    """(n, 3), metres in the lidar frame."""
    intensity: F32 | None = None
    time_s: F32 | None = None
    """(n,) relative to the stamp."""
    ring: NDArray[np.number] | None = None
    no_return: NDArray[np.bool_] | None = None
    """(n,) rays that hit nothing."""


def clean_scan(where: str, raw: RawScan, sensor: Sensor, bad_points: BadPoints) -> Scan:
    """A Scan of the usable points, in their order.

    Dropped in silence, because the format says so: rays without return, and points nearer than the sensor can measure.
    Dropped and counted: not finite, or beyond 2 km. MapvoteError if these are more than 5 %, or if nothing is left.
    """
    points = raw.points
    x, y, z = (points[:, axis].astype(np.float64) for axis in range(3))
    distance = np.sqrt(x * x + y * y + z * z)
    measured = np.ones(len(points), dtype=bool) if raw.no_return is None else ~raw.no_return
    good = distance < FAR_M  # False for NaN too
    bad = int((measured & ~good).sum())
    if bad > MAX_BAD_SHARE * max(int(measured.sum()), 1):
        raise MapvoteError(
            f"{where}: {bad} of {int(measured.sum())} points are not finite or beyond {FAR_M:.0f} m, more than "
            f"{MAX_BAD_SHARE:.0%}: {_likely_cause(distance[measured])}"
        )
    bad_points.count(raw.index, bad)
    keep = measured & good & (distance >= sensor.min_range_m - 5.0 * sensor.range_sigma_m)
    if not keep.any():
        raise MapvoteError(f"{where}: no usable point among {len(points)}; leave this scan out with --scans")
    return Scan(
        stamp_ns=raw.stamp_ns,
        points=np.ascontiguousarray(points[keep], dtype=np.float32),
        time_s=None if raw.time_s is None else np.ascontiguousarray(raw.time_s[keep], dtype=np.float32),
        intensity=None if raw.intensity is None else unit_intensity(raw.intensity[keep]),
        ring=None if raw.ring is None else np.clip(np.nan_to_num(raw.ring[keep]), 0, 65535).astype(np.uint16),
    )


def _likely_cause(distance: NDArray[np.float64]) -> str:
    finite = distance[np.isfinite(distance)]
    farthest = float(np.quantile(finite, 0.99)) if len(finite) else 0.0
    if len(finite) > 0.9 * len(distance) and FAR_M < farthest < 300_000.0:
        unit, factor = ("millimetres", 1000) if farthest > 15_000.0 else ("centimetres", 100)
        return f"they look like {unit} (the farthest {farthest:.0f}); divide x, y, z by {factor}"
    return "the file is damaged, or not float32 x, y, z, intensity"


def unit_intensity(intensity: NDArray[np.number]) -> F32:
    """Intensity in [0, 1]: 8-bit values (any above 1) are divided by 255 and cut there; not a number becomes 0."""
    out = np.nan_to_num(intensity.astype(np.float32), nan=0.0, posinf=0.0, neginf=0.0)
    if len(out) and float(out.max()) > 1.0:
        out = out / np.float32(255.0)
    return np.clip(out, 0.0, 1.0)


def spinning_time_s(points: F32, rate_hz: float, *, clockwise: bool = True) -> F32:
    """When each point (n, 3) was measured, relative to the middle of the revolution, by its azimuth.

    The sensor faces forward at the stamp: -azimuth / (2 pi rate) if it turns clockwise seen from above.
    """
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    return ((-azimuth if clockwise else azimuth) / (2.0 * np.pi * rate_hz)).astype(np.float32)


def stamps_from_rate(n: int, rate_hz: float, start_ns: int) -> I64:
    """(n,) stamps of scans taken evenly."""
    return start_ns + np.round(np.arange(n) * (1e9 / rate_hz)).astype(np.int64)
