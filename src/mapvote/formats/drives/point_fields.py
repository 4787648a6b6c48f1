"""Points with named fields (scan files, PCD, PointCloud2) as a Scan: positions, intensity, ring, time of each point.

Points that are no measurements are dropped, counted and reported.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapvote.core.brightness import unit_intensity
from mapvote.core.geometry import azimuth
from mapvote.core.kernel import kernel
from mapvote.core.sensors import Sensor
from mapvote.core.types import F32, I32, U16, MapvoteError, Scan
from mapvote.formats.maps.cloud import xyz_view

log = logging.getLogger("mapvote.formats")

MAX_BAD_SHARE = 0.05
"""A scan with more broken points than this is refused: it is damaged, or not the format it claims to be."""
FAR_M = 2000.0
"""No LiDAR of ours measures farther; float64 or integers read as float32 do."""
_BLOCK = 512
TIME_FIELDS = ("t", "time", "timestamp", "time_stamp", "stamp", "offset_time", "point_time_offset")
"""Ouster, Velodyne, Hesai and Livox, Autoware, Livox: what drivers call the time of a point."""
INTENSITY_FIELDS = ("intensity", "reflectivity", "i")
RING_FIELDS = ("ring", "channel", "laser_id", "laser_number", "line", "laserid")
_POINT_FIELD = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""sensor_msgs/PointField's types of numbers."""
_UNITS_NS = {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0}
_DAY_NS = 86_400e9
_TIMES_BLOCK = 8192
"""Points whose times are worked out at once: as float64 they stay in the processor's cache."""


@dataclass(slots=True)
class BadPoints:
    """Running count over one drive. Warns at the 1st, 2nd, 4th, 8th ... scan concerned: noticed, without a flood."""

    where: str
    points: int = 0
    seen: set[int] = field(default_factory=set)

    def count(self, index: int, n: int) -> None:
        if n == 0 or index in self.seen:
            return
        self.seen.add(index)
        self.points += n
        if len(self.seen) & (len(self.seen) - 1) == 0:
            what = "%s: dropped %d points that are not finite or beyond %.0f m, in %d scans so far"
            log.warning(what, self.where, self.points, FAR_M, len(self.seen))


def scan_from_fields(
    where: str,
    index: int,
    stamp_ns: int,
    table: NDArray[np.void],
    *,
    sensor: Sensor,
    bad_points: BadPoints,
    zero_is_no_return: bool = True,
    spinning: bool = False,
) -> Scan:
    """A Scan of the usable points of a structured array (n,), in their order.

    Dropped without a message, as the format defines: rays without return (not finite or exactly at the sensor, if
    ``zero_is_no_return``; else they are defects), and points nearer than the sensor can measure. Dropped and counted:
    not finite, or beyond 2 km. ``spinning``: points without times get them from their azimuth.
    MapvoteError if the counted ones are more than 5 %, or if nothing is left.
    """
    points = xyz_view(where, table).astype(np.float32, copy=False)
    names = table.dtype.names or ()
    intensity, ring, time = (
        next((name for name in known if name in names), None) for known in (INTENSITY_FIELDS, RING_FIELDS, TIME_FIELDS)
    )
    time_s = None if time is None else point_times_s(f"{where}: {time}", table[time], stamp_ns, sensor)
    if time_s is None and spinning:
        time_s = spinning_time_s(points, sensor.rate_hz, clockwise=sensor.clockwise)
    near_m = sensor.min_range_m - 5.0 * sensor.range_sigma_m
    usable, copied = np.empty(len(points), np.int32), np.empty((len(points), 3), np.float32)
    n, measured, bad = _sort_out(points, zero_is_no_return, near_m, FAR_M, usable, copied)
    if bad > MAX_BAD_SHARE * max(measured, 1):
        raise MapvoteError(
            f"{where}: {bad} of {measured} points are not finite or beyond {FAR_M:.0f} m, more than "
            f"{MAX_BAD_SHARE:.0%}: {_likely_cause(points)}"
        )
    bad_points.count(index, bad)
    if n == 0:
        raise MapvoteError(
            f"{where}: no usable point among {len(points)}, all nearer than {near_m:.1f} m: are they metres? "
            "Else leave this scan out with --scans"
        )
    keep = slice(None) if n == len(points) else usable[:n]
    return Scan(
        stamp_ns=stamp_ns,
        points=copied[:n],
        time_s=None if time_s is None else np.ascontiguousarray(time_s[keep], dtype=np.float32),
        intensity=None if intensity is None else unit_intensity(table[intensity][keep]),
        ring=None if ring is None else _ring(table[ring][keep]),
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
            out[start + i] = azimuth(y[i], x[i]) / turn_per_s


def point_cloud_table(where: str, message: Any) -> NDArray[np.void]:
    """The points of a sensor_msgs PointCloud2 as a structured array (n,), little-endian.

    ``message``: rosbags', rclpy's or any object with its fields. MapvoteError if its sizes contradict each other.
    """
    raw = message.data if isinstance(message.data, np.ndarray) else bytes(message.data)  # an array is not copied
    data = np.frombuffer(raw, dtype=np.uint8)
    row = message.width * message.point_step
    if message.height > 1 and message.row_step != row and len(data) == message.height * message.row_step:
        data = np.ascontiguousarray(data.reshape(message.height, message.row_step)[:, :row]).ravel()
    if len(data) != message.height * row or message.point_step <= 0:
        raise MapvoteError(
            f"{where}: {len(data)} bytes, but its header says {message.height * row}: the message is cut off"
        )
    order = ">" if message.is_bigendian else "<"
    try:
        known = [f for f in message.fields if f.datatype in _POINT_FIELD]
        record = np.dtype(
            {
                "names": [f.name for f in known],
                "formats": [(order + _POINT_FIELD[f.datatype], (f.count,) if f.count > 1 else ()) for f in known],
                "offsets": [f.offset for f in known],
                "itemsize": message.point_step,
            }
        )
    except (ValueError, TypeError) as error:
        raise MapvoteError(f"{where}: its fields do not fit its point_step ({error}); is the driver sound?") from error
    table = data.view(record)
    return table.astype(record.newbyteorder("<")) if message.is_bigendian else table


def stamp_of(message: Any) -> int:
    """Nanoseconds of the stamp in a message's header."""
    stamp = message.header.stamp
    return int(getattr(stamp, "sec", 0)) * 10**9 + int(getattr(stamp, "nanosec", 0))


def scan_from_point_cloud2(message: Any, sensor: Sensor) -> Scan:
    """A live sensor_msgs/PointCloud2 as a Scan: of rclpy, rosbags, or any object with its fields.

    Its stamp is the message's; a field of times (``TIME_FIELDS``) makes it be de-skewed, ``intensity`` and ``ring`` are
    kept. MapvoteError if the message is cut off, has no x, y, z, or holds no usable point.
    """
    stamp_ns = stamp_of(message)
    where = f"PointCloud2 in {message.header.frame_id or 'no frame'} at {stamp_ns}"
    table = point_cloud_table(where, message)
    return scan_from_fields(where, 0, stamp_ns, table, sensor=sensor, bad_points=BadPoints(where))


def point_times_s(where: str, raw: NDArray[np.generic], stamp_ns: int, sensor: Sensor) -> F32 | None:
    """Times (n,) relative to ``stamp_ns`` from a field of any unit; None if all are equal: no times were recorded.

    The unit is the one of s, ms, us, ns in which the scan lasts nearest to one revolution; values beyond a day are
    absolute (since 1970), others count from the stamp. MapvoteError if no unit makes a revolution of it.
    """
    raw = known = np.ascontiguousarray(raw)
    start: Any
    start, end = (raw.min(), raw.max()) if len(raw) else (np.nan, np.nan)
    if not np.isfinite(float(end) - float(start)):
        known = raw[np.isfinite(raw.astype(np.float64))]
        start, end = (known.min(), known.max()) if len(known) else (0.0, 0.0)
    if start == end:
        return None
    span = float(end - start)
    revolution_ns = 1e9 / sensor.rate_hz
    unit = min(_UNITS_NS, key=lambda u: abs(np.log(span * _UNITS_NS[u] / revolution_ns)))
    if not revolution_ns / 20 < span * _UNITS_NS[unit] < revolution_ns * 20:
        raise MapvoteError(
            f"{where}: spans {span:g}, which is a revolution in no unit at {sensor.rate_hz:g} Hz; check --rate, "
            f"or drop the field"
        )
    # Exact for 64-bit nanoseconds: the scan's start is subtracted before anything becomes a float.
    start_ns = int(start) if raw.dtype.kind in "iu" and unit == "ns" else round(float(start) * _UNITS_NS[unit])
    offset_ns = start_ns - stamp_ns if abs(start_ns) > _DAY_NS else start_ns
    if abs(offset_ns) > 1e9:
        raise MapvoteError(
            f"{where}: points were measured {offset_ns / 1e9:.3f} s away from their scan's stamp: "
            f"two clocks are mixed; correct the stamps, or drop the field"
        )
    out = np.empty(len(raw), np.float32)
    for k in range(0, len(raw), _TIMES_BLOCK):
        part = (raw[k : k + _TIMES_BLOCK] - start).astype(np.float64)
        part *= _UNITS_NS[unit]
        part += offset_ns
        part *= 1e-9
        out[k : k + _TIMES_BLOCK] = part
    return out
