"""A scan made ready for NDT: de-skewed to its stamp, thinned for each level, without rain, snow and exhaust.

Neighbouring rays hit the same surface; a drop is hit by one ray. Where a tenth of the rays end on drops, a third of the
points are drops once the scan is thinned to a point a voxel, and every right pose would fit worse than any threshold.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapvote.core.geometry import inverse, log
from mapvote.core.kernel import disjoint, kernel
from mapvote.core.record import record
from mapvote.core.types import F32, F64, I64, Scan, read_only
from mapvote.core.voxels import packed_key, slot_of, thin
from mapvote.matching.ndt_voxels import LEVELS


@record(votes=True)
@dataclass(frozen=True, slots=True)
class ScanPreparation:
    """Numbers of the thinning of scans, and of the removal of rain, snow and exhaust."""

    enough: int = 20_000
    """Points that are thinned at least: a dense scan is read by every third, fifth .. point. Odd steps leave no beam
    out where points are stored firing by firing."""
    voxel_m: float = 0.5
    """Side of the voxels in which drops are told from surfaces."""
    reach_m: float = 20.0
    """Distance up to which drops are removed: beyond, sparse surfaces look like drops, and drops are few."""
    share: float = 0.1
    """Share of the rays that a surface across the voxel would catch, below which its points are drops. Drops catch
    about 0.01 where a tenth of all rays end on drops, an open crown 0.1 and more."""
    rays: int = 40_000
    """Rays counted, evenly through the scan."""
    solid_angle_sr: float = 0.5 * 2.0 * float(np.pi)
    """Solid angle that a spinning sensor's rays cover: 29 degrees of elevation all around."""


SCAN_PREPARATION = ScanPreparation()
SIZES_M = sorted({level.points_m for level in LEVELS})
"""Sides of the voxels that scans are thinned by."""


def thin_for_levels(points_lidar: NDArray[np.floating]) -> list[F32]:
    """The scan for each level, (3, m): one point per voxel of the level's ``points_m``."""
    source = np.ascontiguousarray(points_lidar, dtype=np.float32)
    thinned = Thinned(source)
    return [in_rows(source[thinned.by(level.points_m)]) for level in LEVELS]


def in_rows(points_lidar: NDArray[np.floating]) -> F32:
    """(3, n) of points (n, 3): rows of x, y and z, the layout of the kernels."""
    return np.ascontiguousarray(points_lidar.T, dtype=np.float32)


class Thinned:
    """One point of a scan per voxel, for each size of the levels. Those of a size are chosen once they are asked for: a
    track that holds is compared at the finest level alone."""

    def __init__(self, points_lidar: F32, numbers: ScanPreparation = SCAN_PREPARATION) -> None:
        """``points_lidar`` (n, 3)."""
        self._points = points_lidar
        every = max(1, (len(points_lidar) // numbers.enough - 1) | 1)
        self._chosen = [thin(points_lidar, SIZES_M[0], every)]

    def by(self, size_m: float) -> I64:
        """(m,) ascending indices, for voxels of side ``size_m``."""
        k = SIZES_M.index(size_m)
        while len(self._chosen) <= k:
            few = self._chosen[-1]
            self._chosen.append(few[thin(self._points.take(few, axis=0), SIZES_M[len(self._chosen)])])
        return self._chosen[k]


@disjoint
def _deskew(points: F32, time_s: F32, motion: F32, turn: F32, rows: F32) -> None:
    """:func:`deskew_into` of ``points`` (3 n,): of a width that the compiler knows, so that the loop vectorises.
    ``motion``: rows of the offset, the velocity and the angular velocity."""
    v = motion[1, 0], motion[1, 1], motion[1, 2]
    w = motion[2, 0], motion[2, 1], motion[2, 2]
    first = rows[0]
    second = rows[1]
    third = rows[2]
    for i in range(np.uint64(0), np.uint64(len(time_s))):  # unsigned: an index that cannot be negative vectorises
        k = np.uint64(3) * i
        t = time_s[i]
        x = points[k]
        y = points[k + np.uint64(1)]
        z = points[k + np.uint64(2)]
        # exp(t * twist) to second order: a first-order rotation would leave centimetres at 50 m in a bend.
        ux = v[0] + w[1] * z - w[2] * y
        uy = v[1] + w[2] * x - w[0] * z
        uz = v[2] + w[0] * y - w[1] * x
        h = np.float32(0.5) * t * t
        x += t * ux + h * (w[1] * uz - w[2] * uy)
        y += t * uy + h * (w[2] * ux - w[0] * uz)
        z += t * uz + h * (w[0] * uy - w[1] * ux)
        first[i] = turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z + motion[0, 0]
        second[i] = turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z + motion[0, 1]
        third[i] = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z + motion[0, 2]


def deskew_into(points: F32, time_s: F32 | None, twist: F64, R: F64, t: F64) -> F32:
    """(3, n) rows x, y, z of points (n, 3) measured at ``time_s`` (n,) from the stamp, de-skewed as by :func:`deskew`
    and moved by the rotation R (3, 3), then by t (3,), into another frame. Float32: t is to be short."""
    if time_s is None:
        time_s = np.zeros(len(points), np.float32)
    motion = np.concatenate([t, twist]).astype(np.float32).reshape(3, 3)
    rows = np.empty((3, len(points)), np.float32)
    flat = read_only(np.ascontiguousarray(points)).reshape(-1)
    _deskew(flat, read_only(np.ascontiguousarray(time_s)), motion, R.astype(np.float32), rows)
    return rows


def deskew(scan: Scan, twist: F64) -> F32:
    """The scan's points (n, 3) in the lidar frame at ``stamp_ns``, given the sensor's (6,) motion per second.

    ``twist`` is (velocity, angular velocity) in the lidar frame. Scans without point times come back as they are.
    """
    if scan.time_s is None:
        return scan.points
    return np.ascontiguousarray(deskewed_rows(scan.points, scan.time_s, twist).T)


def deskewed_rows(points: F32, time_s: F32 | None, twist: F64) -> F32:
    """(3, n) :func:`deskew` of points (n, 3) measured at ``time_s`` (n,) from the stamp."""
    return in_rows(points) if time_s is None else deskew_into(points, time_s, twist, np.eye(3), np.zeros(3))


def twist_between(T_map_lidar_0: F64, T_map_lidar_1: F64, seconds: float) -> F64:
    """(6,) constant motion per second, in the moving lidar's frame, that leads from one pose to the other."""
    return log(inverse(T_map_lidar_0) @ T_map_lidar_1) / seconds


def motion_at(stamps_ns: I64, T_map_lidar: F64, i: int) -> F64:
    """(6,) motion per second of scan i in its lidar frame, from the poses (n, 4, 4) before and after it."""
    before = max(i - 1, 0)
    after = min(i + 1, len(stamps_ns) - 1)
    if before == after:
        return np.zeros(6)
    seconds = 1e-9 * float(stamps_ns[after] - stamps_ns[before])
    return twist_between(T_map_lidar[before], T_map_lidar[after], seconds)


def solid_sample(points_lidar: NDArray[np.floating], size: float) -> F64:
    """(m, 3) one point in each voxel of side ``size``, without drops in the air.

    ``points_lidar`` (n, 3) is a whole scan, metres from the sensor, de-skewed or not.
    """
    points = np.ascontiguousarray(points_lidar, dtype=np.float32)
    return points.take(solid_of(points, thin(points, size)), axis=0).astype(np.float64)


def solid_of(points: F32, chosen: I64, numbers: ScanPreparation = SCAN_PREPARATION) -> I64:
    """Those of the ``chosen`` (m,) of a scan's points (n, 3) that are no drops in the air."""
    few = points.take(chosen, axis=0)
    every = -(-len(points) // numbers.rays) or 1
    range2 = np.einsum("ij,ij->i", few, few)
    near = np.flatnonzero(range2 <= numbers.reach_m**2)
    rays = -(-len(points) // every)
    expected = rays / numbers.solid_angle_sr * numbers.voxel_m**2 / np.maximum(range2[near], numbers.voxel_m**2)
    table = np.zeros((2, max(1024, 1 << (4 * len(near) - 1).bit_length())), dtype=np.int64)
    hits = np.empty(len(near), dtype=np.int64)
    far2 = (numbers.reach_m + 2.0 * numbers.voxel_m) ** 2
    _hits_around(read_only(points), every, few.take(near, axis=0), numbers.voxel_m, far2, table[0], table[1], hits)
    left = np.ones(len(chosen), dtype=np.bool_)
    left[near] = hits > numbers.share * expected
    return chosen[left]


@kernel
def _hits_around(
    points: F32, every: int, few: F32, voxel_m: float, far2: float, keys: I64, counts: I64, at: I64
) -> None:
    """Enter into ``at`` (m,) how many of every ``every``-th of ``points`` (n, 3) end in the voxel, of side ``voxel_m``,
    of each of ``few``. Points whose squared distance exceeds ``far2`` are left out.

    The table (``keys``, ``counts``; zeros) holds these voxels alone, and at most a quarter of it: rays that end
    elsewhere leave it as it is.
    """
    each = 1.0 / voxel_m
    middle = float(1 << 20)  # added first: cutting off is then rounding down, and quicker than floor
    for i in range(len(few)):
        ix = np.int64(few[i, 0] * each + middle)
        iy = np.int64(few[i, 1] * each + middle)
        key = packed_key(ix, iy, np.int64(few[i, 2] * each + middle))
        at[i] = slot_of(key, keys)
        keys[at[i]] = key
    for i in range(0, len(points), every):
        x = points[i, 0]
        y = points[i, 1]
        z = points[i, 2]
        if x * x + y * y + z * z > far2:
            continue
        key = packed_key(np.int64(x * each + middle), np.int64(y * each + middle), np.int64(z * each + middle))
        slot = slot_of(key, keys)
        counts[slot] += 1 if keys[slot] == key else 0
    for i in range(len(few)):
        at[i] = counts[at[i]]


class Sample:
    """The points of one scan that each level compares with the map."""

    def __init__(self, scan: Scan) -> None:
        self._scan = scan
        self._thinned = Thinned(scan.points)

    def clouds(self, twist: F64, first_level: int = 0) -> list[F32]:
        """(3, m) of ``first_level`` and each finer one, at the scan's stamp if the sensor's motion per second was
        ``twist`` (6,)."""
        sizes_m = [level.points_m for level in LEVELS[first_level:]]
        clouds = {size_m: self._cloud(size_m, twist) for size_m in set(sizes_m)}
        return [clouds[size_m] for size_m in sizes_m]

    def coarse(self, twist: F64) -> list[F32]:
        """The clouds of the fewest points at every level: to try many guesses."""
        return [self._cloud(SIZES_M[-1], twist)] * len(LEVELS)

    def solid(self, twist: F64) -> F64:
        """(m, 3) the finest cloud without drops in the air."""
        chosen = solid_of(self._scan.points, self._thinned.by(SIZES_M[0]))
        return self._moved(chosen, twist).T.astype(np.float64, order="C")

    def _cloud(self, size_m: float, twist: F64) -> F32:
        return self._moved(self._thinned.by(size_m), twist)

    def _moved(self, chosen: I64, twist: F64) -> F32:
        time_s = None if self._scan.time_s is None else self._scan.time_s.take(chosen)
        return deskewed_rows(self._scan.points.take(chosen, axis=0), time_s, twist)
