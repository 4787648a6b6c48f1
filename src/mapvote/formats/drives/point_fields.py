"""Point clouds with named fields (PCD, PointCloud2) as a scan: positions, intensity, time of each point."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapvote.core.sensors import Sensor
from mapvote.core.types import F32, MapvoteError, Scan
from mapvote.formats.clean import BadPoints, RawScan, clean_scan, spinning_time_s
from mapvote.formats.maps.cloud import xyz_view

TIME_FIELDS = ("t", "time", "timestamp", "time_stamp", "stamp", "offset_time", "point_time_offset")
"""Ouster, Velodyne, Hesai and Livox, Autoware, Livox: what drivers call the time of a point."""
INTENSITY_FIELDS = ("intensity", "reflectivity", "i")
RING_FIELDS = ("ring", "channel", "laser_id", "laser_number", "line", "laserid")
_POINT_FIELD = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""sensor_msgs/PointField's types of numbers."""
_UNITS_NS = {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0}
_DAY_NS = 86_400e9
_BLOCK = 8192
"""Points whose times are worked out at once: as float64 they stay in the processor's cache."""


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
    """A Scan of a structured array (n,). Points not finite or exactly at the sensor are rays without return.

    ``zero_is_no_return`` False: they are defects. ``spinning``: points without times get them from their azimuth.
    """
    points = xyz_view(where, table)
    names = table.dtype.names or ()
    intensity, ring, time = (
        next((name for name in known if name in names), None) for known in (INTENSITY_FIELDS, RING_FIELDS, TIME_FIELDS)
    )
    time_s = None if time is None else point_times_s(f"{where}: {time}", table[time], stamp_ns, sensor)
    points = points.astype(np.float32, copy=False)
    if time_s is None and spinning:
        time_s = spinning_time_s(points, sensor.rate_hz, clockwise=sensor.clockwise)
    raw = RawScan(
        index,
        stamp_ns,
        points,
        intensity=None if intensity is None else table[intensity],
        time_s=time_s,
        ring=None if ring is None else table[ring],
        zero_is_no_return=zero_is_no_return,
    )
    return clean_scan(where, raw, sensor, bad_points)


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


def scan_from_point_cloud2(message: Any, sensor: Sensor) -> Scan:
    """A live sensor_msgs/PointCloud2 as a Scan: of rclpy, rosbags, or any object with its fields.

    Its stamp is the message's; a field of times (``TIME_FIELDS``) makes it be de-skewed, ``intensity`` and ``ring`` are
    kept. MapvoteError if the message is cut off, has no x, y, z, or holds no usable point.
    """
    stamp = message.header.stamp
    stamp_ns = int(getattr(stamp, "sec", 0)) * 10**9 + int(getattr(stamp, "nanosec", 0))
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
    for k in range(0, len(raw), _BLOCK):
        part = (raw[k : k + _BLOCK] - start).astype(np.float64)
        part *= _UNITS_NS[unit]
        part += offset_ns
        part *= 1e-9
        out[k : k + _BLOCK] = part
    return out
