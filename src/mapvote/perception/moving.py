"""Removal of moving objects on an occupancy grid in the world frame (paper II, [9]).

A voxel that is occupied only briefly belongs to a moving object, and connected cells move together.
"Briefly" is a ratio of what could be observed, never a number of scans: each voxel of a scan is looked at
from the other scans of a short window; those that saw through it (free) are weighed against
those that saw something in it (hit), and those that could not see it do not count. Structure that has only
just come into view was never seen through, so it is not called moving.

Whether a scan saw through a voxel is one look-up in that scan's range image. The voxel is free only if every ray
close to it, to all sides, went on behind it, so thin things, edges and foliage stay; and only if, over the window,
rays went through both just below and just above the place, because a ray over a roof says nothing about the roof.
It needs no map, only poses, so it serves SLAM and voting alike.

Online: a scan is decided after at most ``lookahead_s`` (1 s), because what a vehicle ahead of
us hides is seen through only once it has driven on. Nothing older than ``past_s`` before it is used.

What it cannot tell: a car that waits through the whole window is static, one farther than ``reach_m`` is never called
moving, and what only the sky lies behind is judged by the cells it is connected to (rays without return are unknown).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from itertools import zip_longest

import numba
import numpy as np
from numpy.typing import NDArray

from mapvote.config import MovingSettings
from mapvote.core.grid import CELL_SIZE
from mapvote.core.sensors import Sensor
from mapvote.core.types import F32, F64, I32, I64, Bool

NOTHING = np.float32(np.inf)


@dataclass(frozen=True, slots=True)
class _Scan:
    """What the window keeps of one scan."""

    stamp_ns: int
    origin_map: F64
    nearest: F32
    """(azimuths, slopes) horizontal range of the nearest return around each direction, +inf where there is none."""
    voxel_of: I32
    """(n,) index into ``samples`` of each point, -1 for points that cannot be moving (ground, out of reach)."""
    samples: F64
    """(m, 3) one obstacle point per voxel, map metres."""


@numba.njit(cache=True, nogil=True, inline="always")
def _turn(x: float, y: float) -> float:
    """Azimuth of (x, y) in [0, 1): within 1e-5 turns, several times faster than atan2 (Abramowitz-Stegun 4.4.49)."""
    ax, ay = abs(x), abs(y)
    big = max(ax, ay)
    if big == 0.0:
        return 0.0
    q = min(ax, ay) / big
    s = q * q
    a = q * (0.9998660 + s * (-0.3302995 + s * (0.1801410 + s * (-0.0851330 + s * 0.0208351)))) * 0.15915494309189535
    if ay > ax:
        a = 0.25 - a
    if x < 0.0:
        a = 0.5 - a
    if y < 0.0:
        a = 1.0 - a
    return 0.0 if a >= 1.0 else a


@numba.njit(cache=True, nogil=True)
def _range_image(points: F64, origin: F64, turns: int, slopes: int, slope_min: float, slope_step: float) -> F32:
    """(turns, slopes) nearest horizontal range among the returns in each direction and to its left and right."""
    out = np.full((turns, slopes), NOTHING, dtype=np.float32)
    per_slope = 1.0 / slope_step
    for i in range(len(points)):
        x, y, z = points[i, 0] - origin[0], points[i, 1] - origin[1], points[i, 2] - origin[2]
        rho = np.float32(np.sqrt(x * x + y * y))
        if rho < 0.5:
            continue
        row = (z / rho - slope_min) * per_slope
        if row < 0.0 or row >= slopes:
            continue
        b = int(row)
        a = min(int(_turn(x, y) * turns), turns - 1)
        left = a - 1 if a > 0 else turns - 1
        right = a + 1 if a + 1 < turns else 0
        out[left, b] = min(out[left, b], rho)
        out[a, b] = min(out[a, b], rho)
        out[right, b] = min(out[right, b], rho)
    return out


@numba.njit(cache=True, nogil=True)
def _voxels(points: F64, obstacle: Bool, origin: F64, reach: float, cell: float) -> tuple[I32, I64]:
    """(voxel_of (n,), first point of each voxel (m,)), voxels in order of their first points; -1 for no voxel."""
    n = len(points)
    size = 1024
    while size < 2 * obstacle.sum():
        size *= 2
    table = np.full(size, -1, dtype=np.int32)
    keys = np.empty(n, dtype=np.int64)
    first = np.empty(n, dtype=np.int64)
    voxel_of = np.full(n, -1, dtype=np.int32)
    per_cell = 1.0 / cell
    m = 0
    for i in range(n):
        if not obstacle[i]:
            continue
        x, y = points[i, 0] - origin[0], points[i, 1] - origin[1]
        if x * x + y * y > reach * reach:
            continue
        ix = int(np.floor(points[i, 0] * per_cell)) + (1 << 20)
        iy = int(np.floor(points[i, 1] * per_cell)) + (1 << 20)
        iz = int(np.floor(points[i, 2] * per_cell)) + (1 << 20)
        key = (ix << 42) | (iy << 21) | iz
        slot = (ix + 389 * iy + 7919 * iz) & (size - 1)
        while table[slot] >= 0 and keys[table[slot]] != key:
            slot = (slot + 1) & (size - 1)
        if table[slot] < 0:
            table[slot] = m
            keys[m] = key
            first[m] = i
            m += 1
        voxel_of[i] = table[slot]
    return voxel_of, first[:m].copy()


@numba.njit(cache=True, nogil=True)
def _look(
    samples: F64,
    nearest: F32,
    origin: F64,
    slope_min: float,
    slope_step: float,
    margin: float,
    height: float,
    enough: int,
    free: I32,
    hit: I32,
    sides: NDArray[np.uint8],
    waiting: I32,
) -> int:
    """Ask one scan about the ``waiting`` samples: did it see through, did it hit, or neither? Counts go up in place.

    Rays within ``height`` above and below the sample bear witness. ``sides`` keeps whether a ray went through
    below (1) and above (2): a ray that only ever passes over a roof proves nothing about the roof. A sample of which
    ``enough`` scans said the same, and none the contrary, waits no longer; ``waiting`` is compacted in place
    and its new length returned.
    """
    turns, slopes = nearest.shape
    per_slope = 1.0 / slope_step
    left = 0
    for w in range(len(waiting)):
        i = waiting[w]
        waiting[left] = i
        left += 1
        x, y, z = samples[i, 0] - origin[0], samples[i, 1] - origin[1], samples[i, 2] - origin[2]
        rho = np.sqrt(x * x + y * y)
        if rho < 0.5:
            continue
        row = (z / rho - slope_min) * per_slope
        around = min(max(int(height / rho * per_slope), 2), 8)
        b = int(np.floor(row))
        if b < around or b + around >= slopes:
            continue
        a = min(int(_turn(x, y) * turns), turns - 1)
        below, above = NOTHING, NOTHING
        for k in range(1, around + 1):
            if nearest[a, b - k] < below:
                below = nearest[a, b - k]
            if nearest[a, b + k] < above:
                above = nearest[a, b + k]
        r = min(nearest[a, b], min(below, above))
        if r == NOTHING or r < rho - margin:
            continue
        if r > rho + margin:
            free[i] += 1
            if below < NOTHING:
                sides[i] |= 1
            if above < NOTHING:
                sides[i] |= 2
        else:
            hit[i] += 1
        if (free[i] == 0 and hit[i] >= enough) or (hit[i] == 0 and free[i] >= enough and sides[i] == 3):
            left -= 1
    return left


@numba.njit(cache=True, nogil=True)
def _flood(cells: I64, wanted: Bool, side: int) -> I32:
    """Label of each cell (m,) by 8-connected component of the wanted ones, from 0; -1 for the unwanted.

    ``cells`` (m,) are distinct indices row * side + col with 0 < row, col < side - 1.
    """
    plane = np.full(side * side, -1, dtype=np.int32)
    for k in range(len(cells)):
        if wanted[k]:
            plane[cells[k]] = k
    label = np.full(len(cells), -1, dtype=np.int32)
    stack = np.empty(len(cells), dtype=np.int32)
    count = 0
    for seed in range(len(cells)):
        if not wanted[seed] or label[seed] >= 0:
            continue
        label[seed] = count
        stack[0] = seed
        top = 1
        while top > 0:
            top -= 1
            at = cells[stack[top]]
            for dr in range(-1, 2):
                for dc in range(-1, 2):
                    k = plane[at + dr * side + dc]
                    if k >= 0 and label[k] < 0:
                        label[k] = count
                        stack[top] = k
                        top += 1
        count += 1
    return label


@numba.njit(cache=True, nogil=True)
def _together(
    rows: I64,
    cols: I64,
    side: int,
    seen: Bool,
    brief: Bool,
    min_voxels: int,
    share_whole: float,
    share_part: float,
) -> Bool:
    """Which voxels move (m,), from which were decidable (``seen``) and occupied only briefly (``brief``).

    Connected cells move together: a component of the plane moves as a whole if at least ``share_whole`` of its
    decidable voxels were brief. Where a mover touches something static, the component splits at the cells that are
    mostly static, and each remaining part moves if at least ``share_part`` of it was brief.
    """
    m = len(rows)
    plane = np.full(side * side, -1, dtype=np.int32)
    cell_of = np.empty(m, dtype=np.int32)
    cells = np.empty(m, dtype=np.int64)
    n_cells = 0
    for i in range(m):
        at = rows[i] * side + cols[i]
        if plane[at] < 0:
            plane[at] = n_cells
            cells[n_cells] = at
            n_cells += 1
        cell_of[i] = plane[at]
    cells = cells[:n_cells]
    n_seen = np.zeros(n_cells, dtype=np.int64)
    n_brief = np.zeros(n_cells, dtype=np.int64)
    for i in range(m):
        n_seen[cell_of[i]] += seen[i]
        n_brief[cell_of[i]] += brief[i]

    moves = np.zeros(n_cells, dtype=np.bool_)
    wanted = np.ones(n_cells, dtype=np.bool_)
    for share in (share_whole, share_part):
        label = _flood(cells, wanted, side)
        total = np.zeros(n_cells, dtype=np.int64)
        moving = np.zeros(n_cells, dtype=np.int64)
        for k in range(n_cells):
            if label[k] >= 0:
                total[label[k]] += n_seen[k]
                moving[label[k]] += n_brief[k]
        for k in range(n_cells):
            c = label[k]
            if c >= 0 and moving[c] >= min_voxels and moving[c] >= share * total[c]:
                moves[k] = True
        for k in range(n_cells):
            wanted[k] = not moves[k] and 2 * n_brief[k] >= n_seen[k]
    out = np.empty(m, dtype=np.bool_)
    for i in range(m):
        out[i] = moves[cell_of[i]]
    return out


class MovingFilter:
    """Finds the points of moving objects in a stream of scans with known poses.

    Scans go in with :meth:`push`, in order of time; masks come out as soon as ``lookahead_s`` has been seen.
    """

    def __init__(self, sensor: Sensor, settings: MovingSettings) -> None:
        self.settings = settings
        tilt = settings.tilt_deg
        self._slope_min = float(np.tan(np.radians(max(sensor.fov_bottom_deg - tilt, -60.0))))
        slope_max = float(np.tan(np.radians(min(sensor.fov_top_deg + tilt, 60.0))))
        self._turns = round(360.0 / max(2.0 * sensor.azimuth_step_deg, settings.pixel_deg))
        self._slope_step = float(np.tan(np.radians(0.5 * settings.pixel_deg)))
        self._slopes = int(np.ceil((slope_max - self._slope_min) / self._slope_step))
        self._window: deque[_Scan] = deque()
        self._pushed = 0
        self._decided = 0

    def push(self, points_map: F64, origin_map: F64, obstacle: Bool, stamp_ns: int) -> list[tuple[int, Bool]]:
        """Take one scan; return what can now be decided: (running index of the scan, moving mask over its points).

        ``points_map`` (n, 3) and the sensor's ``origin_map`` (3,) in map metres; ``obstacle`` (n,) says which points
        stand more than 0.3 m above the ground: only they can be called moving, but all of them prove what is free.
        Raises ValueError if stamps do not increase.
        """
        if self._window and stamp_ns <= self._window[-1].stamp_ns:
            raise ValueError(f"stamps must increase: {stamp_ns} after {self._window[-1].stamp_ns}")
        points = np.ascontiguousarray(points_map, dtype=np.float64)
        origin = np.asarray(origin_map, dtype=np.float64)
        nearest = _range_image(points, origin, self._turns, self._slopes, self._slope_min, self._slope_step)
        voxel_of, first = _voxels(points, obstacle, origin, self.settings.reach_m, CELL_SIZE)
        self._window.append(_Scan(stamp_ns, origin, nearest, voxel_of, points[first]))
        self._pushed += 1
        return self._decide(stamp_ns - round(self.settings.lookahead_s * 1e9))

    def flush(self) -> list[tuple[int, Bool]]:
        """Decide what is left, with less than the full look ahead: the drive has ended."""
        return self._decide(self._window[-1].stamp_ns) if self._window else []

    def _decide(self, up_to_ns: int) -> list[tuple[int, Bool]]:
        """Masks of all waiting scans not younger than ``up_to_ns``; forgets what no later scan will ask for."""
        out = []
        while self._decided < self._pushed:
            at = len(self._window) - (self._pushed - self._decided)
            if self._window[at].stamp_ns > up_to_ns:
                break
            out.append((self._decided, self._moving(at)))
            self._decided += 1
            oldest_ns = self._window[at].stamp_ns - round(self.settings.past_s * 1e9)
            while self._window[0].stamp_ns < oldest_ns:
                self._window.popleft()
        return out

    def _moving(self, at: int) -> Bool:
        """The mask of the window's scan ``at``, from the other scans of the window."""
        s, scan = self.settings, self._window[at]
        free = np.zeros(len(scan.samples), dtype=np.int32)
        hit = np.zeros(len(scan.samples), dtype=np.int32)
        sides = np.zeros(len(scan.samples), dtype=np.uint8)
        waiting = np.arange(len(scan.samples), dtype=np.int32)
        for other in self._witnesses(at):
            left = _look(
                scan.samples,
                other.nearest,
                other.origin_map,
                self._slope_min,
                self._slope_step,
                s.margin_m,
                s.height_m,
                s.enough,
                free,
                hit,
                sides,
                waiting,
            )
            waiting = waiting[:left]
        seen = free + hit >= s.min_free
        brief = (sides == 3) & (free >= s.min_free) & (free >= s.free_share * (free + hit))
        half = int(np.ceil(s.reach_m / CELL_SIZE)) + 2
        cells = np.floor(scan.samples[:, :2] / CELL_SIZE).astype(np.int64)
        cells -= np.floor(scan.origin_map[:2] / CELL_SIZE).astype(np.int64) - half
        moves = _together(
            cells[:, 1], cells[:, 0], 2 * half + 1, seen, brief, s.min_voxels, s.share_whole, s.share_part
        )
        mask = scan.voxel_of >= 0
        mask[mask] = moves[scan.voxel_of[mask]]
        return mask

    def _witnesses(self, at: int) -> list[_Scan]:
        """Up to ``looks`` other scans spread evenly over the time before, and over the time after, scan ``at``.

        Those before and after take turns, the farthest first: they are the likeliest to settle a voxel soon.
        """
        scans = list(self._window)
        before = _spread(scans[:at], self.settings.looks_past)
        after = _spread(scans[:at:-1], self.settings.looks_ahead)
        return [s for pair in zip_longest(before, after) for s in pair if s is not None]


def _spread(scans: list[_Scan], count: int) -> list[_Scan]:
    """At most ``count`` of them, evenly spread, the first always among them."""
    if len(scans) <= count:
        return scans
    return [scans[(k * len(scans)) // count] for k in range(count)]
