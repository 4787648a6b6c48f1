"""Point clouds with named fields (PCD, PointCloud2) as a scan: positions, intensity, time of each point."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mapvote.core.sensors import Sensor
from mapvote.core.types import F32, F64, MapvoteError, Scan
from mapvote.formats.clean import BadPoints, clean_scan
from mapvote.formats.maps.cloud import xyz

TIME_FIELDS = ("t", "time", "timestamp", "time_stamp", "stamp", "offset_time", "point_time_offset")
"""Ouster, Velodyne, Hesai and Livox, Autoware, Livox: what drivers call the time of a point."""
INTENSITY_FIELDS = ("intensity", "reflectivity")
_UNITS_NS = {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0}
_DAY_NS = 86_400e9


def scan_from_fields(
    where: str, index: int, stamp_ns: int, table: NDArray[np.void], *, sensor: Sensor, bad_points: BadPoints
) -> Scan:
    """A Scan of a structured array (n,). Points not finite or exactly at the sensor are rays without return."""
    points = xyz(where, table)
    names = table.dtype.names or ()
    intensity = next((table[name] for name in INTENSITY_FIELDS if name in names), None)
    time_field = next((name for name in TIME_FIELDS if name in names), None)
    time_s = (
        None if time_field is None else point_times_s(f"{where}: {time_field}", table[time_field], stamp_ns, sensor)
    )
    return clean_scan(
        where,
        index,
        stamp_ns,
        points.astype(np.float32, copy=False),
        sensor=sensor,
        bad_points=bad_points,
        intensity=None if intensity is None else intensity.astype(np.float32),
        time_s=time_s,
        no_return=~np.isfinite(points).all(axis=1) | (points == 0).all(axis=1),
    )


def point_times_s(where: str, raw: NDArray[np.generic], stamp_ns: int, sensor: Sensor) -> F32 | None:
    """Times (n,) relative to ``stamp_ns`` from a field of any unit; None if all are equal: no times were recorded.

    The unit is the one of s, ms, us, ns in which the scan lasts nearest to one revolution; values beyond a day are
    absolute (since 1970), others count from the stamp. MapvoteError if no unit makes a revolution of it.
    """
    known = raw[np.isfinite(raw.astype(np.float64))]
    if len(known) == 0 or known.min() == known.max():
        return None
    start = known.min()
    span = float(known.max() - start)
    revolution_ns = 1e9 / sensor.rate_hz
    unit = min(_UNITS_NS, key=lambda u: abs(np.log(span * _UNITS_NS[u] / revolution_ns)))
    if not revolution_ns / 20 < span * _UNITS_NS[unit] < revolution_ns * 20:
        raise MapvoteError(
            f"{where}: spans {span:g}, which in no unit is a revolution at {sensor.rate_hz:g} Hz; check --rate, "
            f"or drop the field"
        )
    # Exact for 64-bit nanoseconds: the scan's start is subtracted before anything becomes a float.
    since_start_ns = (raw - start).astype(np.float64) * _UNITS_NS[unit]
    start_ns = int(start) if raw.dtype.kind in "iu" and unit == "ns" else round(float(start) * _UNITS_NS[unit])
    offset_ns = start_ns - stamp_ns if abs(start_ns) > _DAY_NS else start_ns
    if abs(offset_ns) > 1e9:
        raise MapvoteError(
            f"{where}: points were measured {offset_ns / 1e9:.3f} s away from their scan's stamp: "
            f"two clocks are mixed; mend the stamps, or drop the field"
        )
    out: F64 = (since_start_ns + offset_ns) * 1e-9
    return out.astype(np.float32)
