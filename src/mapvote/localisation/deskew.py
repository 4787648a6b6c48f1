"""Motion within a scan: what was measured at other moments, moved to the scan's stamp."""

from __future__ import annotations

import numba
import numpy as np

from mapvote.core.geometry import inverse, log
from mapvote.core.types import F32, F64, I64, Scan


@numba.njit(cache=True, nogil=True)
def _deskew(points: F32, time_s: F32, v: F32, w: F32) -> F32:
    out = np.empty_like(points)
    half = np.float32(0.5)
    for i in range(np.uint64(0), np.uint64(len(points))):  # unsigned: an index that cannot be negative vectorises
        t, x, y, z = time_s[i], points[i, 0], points[i, 1], points[i, 2]
        # exp(t * twist) to second order: a first-order rotation would leave centimetres at 50 m in a bend.
        ux, uy, uz = v[0] + w[1] * z - w[2] * y, v[1] + w[2] * x - w[0] * z, v[2] + w[0] * y - w[1] * x
        h = half * t * t
        out[i, 0] = x + t * ux + h * (w[1] * uz - w[2] * uy)
        out[i, 1] = y + t * uy + h * (w[2] * ux - w[0] * uz)
        out[i, 2] = z + t * uz + h * (w[0] * uy - w[1] * ux)
    return out


def deskew(scan: Scan, twist: F64) -> F32:
    """The scan's points (n, 3) in the lidar frame at ``stamp_ns``, given the sensor's (6,) motion per second.

    ``twist`` is (velocity, angular velocity) in the lidar frame. Scans without point times come back as they are.
    """
    return deskewed(scan.points, scan.time_s, twist)


def deskewed(points: F32, time_s: F32 | None, twist: F64) -> F32:
    """:func:`deskew` of points (n, 3) measured at ``time_s`` (n,) from the stamp."""
    if time_s is None:
        return points
    return _deskew(points, time_s, twist[:3].astype(np.float32), twist[3:].astype(np.float32))


def twist_between(T_map_lidar_0: F64, T_map_lidar_1: F64, seconds: float) -> F64:
    """(6,) constant motion per second, in the moving lidar's frame, that leads from one pose to the other."""
    return log(inverse(T_map_lidar_0) @ T_map_lidar_1) / seconds


def motion_at(stamps_ns: I64, T_map_lidar: F64, i: int) -> F64:
    """(6,) motion per second of scan i in its lidar frame, from the poses (n, 4, 4) before and after it."""
    before, after = max(i - 1, 0), min(i + 1, len(stamps_ns) - 1)
    if before == after:
        return np.zeros(6)
    seconds = 1e-9 * float(stamps_ns[after] - stamps_ns[before])
    return twist_between(T_map_lidar[before], T_map_lidar[after], seconds)
