"""What every scan passes before it becomes a Scan: points that are no measurements are dropped, counted and
reported."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mapvote.core.azimuth import azimuth_32
from mapvote.core.kernel import kernel
from mapvote.core.sensors import Sensor
from mapvote.core.types import F32, I32, I64, U16, MapvoteError, Scan

log = logging.getLogger("mapvote.formats")

MAX_BAD_SHARE = 0.05
"""A scan with more broken points than this is refused: it is damaged, or not the format it claims to be."""
FAR_M = 2000.0
"""No LiDAR of ours measures farther; float64 or integers read as float32 do."""
_BLOCK = 512


@dataclass(slots=True)
class BadPoints:
    """Running count over one drive. Warns at the 1st, 2nd, 4th, 8th ... scan concerned: noticed, without a flood."""

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
    """One scan as a file holds it; None for what a format lacks."""

    index: int
    stamp_ns: int
    points: F32
    """(n, 3), metres in the lidar frame; it may be a view of a message."""
    intensity: NDArray[np.number] | None = None
    time_s: F32 | None = None
    """(n,) relative to the stamp."""
    ring: NDArray[np.number] | None = None
    zero_is_no_return: bool = False
    """Points that are not finite or (0, 0, 0) are rays that hit nothing."""


def clean_scan(where: str, raw: RawScan, sensor: Sensor, bad_points: BadPoints) -> Scan:
    """A Scan of the usable points, in their order.

    Dropped without a message, as the format defines: rays without return, and points nearer than the sensor can
    measure. Dropped and counted: not finite, or beyond 2 km. MapvoteError if these are more than 5 %, or if nothing is
    left.
    """
    points, near_m = raw.points, sensor.min_range_m - 5.0 * sensor.range_sigma_m
    usable, copied = np.empty(len(points), np.int32), np.empty((len(points), 3), np.float32)
    n, measured, bad = _sort_out(points, raw.zero_is_no_return, near_m, FAR_M, usable, copied)
    kept = usable[:n]
    if bad > MAX_BAD_SHARE * max(measured, 1):
        raise MapvoteError(
            f"{where}: {bad} of {measured} points are not finite or beyond {FAR_M:.0f} m, more than "
            f"{MAX_BAD_SHARE:.0%}: {_likely_cause(points)}"
        )
    bad_points.count(raw.index, bad)
    if len(kept) == 0:
        raise MapvoteError(
            f"{where}: no usable point among {len(points)}, all nearer than {near_m:.1f} m: are they metres? "
            "Else leave this scan out with --scans"
        )
    keep = slice(None) if len(kept) == len(points) else kept
    return Scan(
        stamp_ns=raw.stamp_ns,
        points=copied[:n],
        time_s=None if raw.time_s is None else np.ascontiguousarray(raw.time_s[keep], dtype=np.float32),
        intensity=None if raw.intensity is None else unit_intensity(raw.intensity[keep]),
        ring=None if raw.ring is None else _ring(raw.ring[keep]),
    )


def _ring(values: NDArray[np.number]) -> U16:
    """(n,) beams; a number that uint16 cannot hold becomes the nearest that it can."""
    if values.dtype in (np.uint8, np.uint16):
        return values.astype(np.uint16)
    return np.clip(np.nan_to_num(values), 0, 65535).astype(np.uint16)


@kernel
def _sort_out(
    points: NDArray[np.floating], zero_is_no_return: bool, near_m: float, far_m: float, kept: I32, copied: F32
) -> tuple[int, int, int]:
    """(how many of the points (n, 3) are usable, how many were measured, how many of these are no measurements). The
    indices of the usable ones come into ``kept`` (n,), they themselves into ``copied`` (n, 3)."""
    n, measured, bad = 0, 0, 0
    for i in range(len(points)):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        squared = x * x + y * y + z * z
        if zero_is_no_return and (squared == 0.0 or not np.isfinite(squared)):
            continue
        measured += 1
        if not squared < far_m * far_m:  # True for NaN too
            bad += 1
        elif squared >= near_m * abs(near_m):
            kept[n] = i
            copied[n, 0], copied[n, 1], copied[n, 2] = x, y, z
            n += 1
    return n, measured, bad


def _likely_cause(points: F32) -> str:
    distance = np.linalg.norm(points.astype(np.float64), axis=1)
    finite = distance[np.isfinite(distance)]
    farthest = float(np.quantile(finite, 0.99)) if len(finite) else 0.0
    if len(finite) > 0.9 * len(distance) and FAR_M < farthest < 300_000.0:
        unit, factor = ("millimetres", 1000) if farthest > 15_000.0 else ("centimetres", 100)
        return f"they look like {unit} (the farthest {farthest:.0f}); divide x, y, z by {factor}"
    return "the file is damaged, or not float32 x, y, z, intensity"


def unit_intensity(intensity: NDArray[np.number]) -> F32:
    """Intensity in [0, 1]: 8-bit values (any above 1) are divided by 255 and cut there; not a number becomes 0."""
    values = np.array(intensity, dtype=np.float32)
    values[~np.isfinite(values)] = 0.0
    if values.max(initial=0.0) > 1.0:
        values /= np.float32(255.0)
    return np.clip(values, 0.0, 1.0, out=values)


def spinning_time_s(points: F32, rate_hz: float, *, clockwise: bool = True) -> F32:
    """When each point (n, 3) was measured, relative to the middle of the revolution, by its azimuth.

    The sensor faces forward at the stamp: -azimuth / (2 pi rate) if it turns clockwise seen from above.
    """
    out, (x, y) = np.empty(len(points), np.float32), np.empty((2, _BLOCK), np.float32)
    _spinning_time_s(points, np.float32((-2.0 if clockwise else 2.0) * np.pi * rate_hz), x, y, out)
    return out


@kernel
def _spinning_time_s(points: F32, turn_per_s: np.float32, x: F32, y: F32, out: F32) -> None:
    """:func:`spinning_time_s` into ``out`` (n,), block by block: x and y, which lie three numbers apart in ``points``,
    are copied into ``x`` and ``y`` (_BLOCK,) first, so that the loop vectorises."""
    for start in range(0, len(points), _BLOCK):
        n = min(_BLOCK, len(points) - start)
        for i in range(n):
            x[i], y[i] = points[start + i, 0], points[start + i, 1]
        for i in range(n):
            out[start + i] = azimuth_32(y[i], x[i]) / turn_per_s


def stamps_from_rate(n: int, rate_hz: float, start_ns: int) -> I64:
    """(n,) stamps of scans taken evenly."""
    return start_ns + np.round(np.arange(n) * (1e9 / rate_hz)).astype(np.int64)
