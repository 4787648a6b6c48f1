"""Planes of one scan over the local grid: hits, voxels that rays passed, visibility (paper III-A), rays into the sky.

mapvote.perception.fans walks over the cells: the 3D question becomes a 2D one.

A sensor reports returns only. If the road and the walls answer in a direction, and nothing answers above the highest
of them, then no surface up there was within range. The test uses whole sectors, because single beams are lost on
glass, on dark paint and by chance. For the same reason a ray lost between returns proves nothing.
Hardly any other ray passes above a house that was pulled down, or where one was built.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from mapvote.core.columns import TOP_BIT
from mapvote.core.grid import CELL_SIZE, Grid
from mapvote.core.kernel import kernel
from mapvote.core.record import record
from mapvote.core.sensors import Sensor
from mapvote.core.types import F32, F64, I32, U8, U64, Bool, Reference
from mapvote.perception.fans import FANS, Fans, Rays, follow_rays, gather_rays, mark_passed, set_out
from mapvote.perception.placement import cells_and_obstacles


@record(votes=True)
@dataclass(frozen=True, slots=True)
class RayRule:
    """Emptiness along a ray."""

    clearance_m: float = 0.45
    """Distance before its own hit up to which a ray proves emptiness, metres: half a voxel's diagonal, range noise and
    pose error."""


RAY_RULE = RayRule()
CLEARANCE_M = RAY_RULE.clearance_m


class Sight(IntEnum):
    """How far a cell could be seen, the best of all fans that cross it."""

    NEVER = 0
    """No ray was fired in this direction: the cell has no observation."""
    BEYOND = 1
    """Behind the farthest return of every fan."""
    BEHIND = 2
    """Behind a fan's nearest obstacle, but before its farthest return: visible under ``farthest_return``."""
    CLEAR = 3
    """Before or at the nearest obstacle of some fan: visible under ``first_hit``."""


@dataclass(frozen=True, slots=True)
class ScanView:
    """One scan on the local grid. All planes are (rows, cols) of ``grid``."""

    grid: Grid
    counts: I32
    """Obstacle points of stationary objects in the cell: n of paper Eq. (1); (0, 0) if not requested."""
    hit: U64
    """Column words of those points; (0, 0) if not requested."""
    passed: U64
    """Column words of voxels that a ray passed well before its own hit. Bit 63 (all above) is never passed."""
    sight: U8
    """:class:`Sight` of the cell; (0, 0) if not requested."""

    def joined(self, other: ScanView) -> ScanView:
        """The view of two LiDARs of one sweep, over the same grid."""
        counts = self.counts + other.counts
        sight = np.maximum(self.sight, other.sight)
        return ScanView(self.grid, counts, self.hit | other.hit, self.passed | other.passed, sight)


def enter_hits(up: F32, origin_z: float, cell: I32, keep: Bool, base: I32, counts: I32, hit: U64) -> None:
    """Stationary obstacle points, ``up`` (n,) metres from ``origin_z``, into ``counts`` and ``hit`` words (flat planes,
    in place)."""
    here = np.flatnonzero(keep & (cell >= 0))
    at = cell[here]
    layer = np.floor((up[here].astype(np.float64) + origin_z) / CELL_SIZE).astype(np.int64)
    bit = np.clip(layer - base[at], 0, TOP_BIT).astype(np.uint64)
    np.bitwise_or.at(hit, at, np.uint64(1) << bit)
    counts += np.bincount(at, minlength=len(counts)).astype(np.int32)


def mark_sight(
    rays: Rays, obstacle: NDArray[np.bool_], fans: Fans, origin: F64, corner: tuple[float, float], sight: U8
) -> None:
    """Walk every fan from the sensor to the edge of the window, and enter how far it sees into ``sight``."""
    nearest = np.full(FANS, np.inf, np.float32)
    farthest = np.zeros(FANS, np.float32)
    _mark_sight(rays, obstacle, fans.direction, origin, corner, sight, nearest, farthest)


@kernel
def _mark_sight(
    rays: Rays, obstacle: NDArray[np.bool_], direction: F64, origin: F64, corner: tuple[float, float], sight: U8,
    nearest: F32, farthest: F32,
) -> None:  # fmt: skip
    rows, cols = sight.shape
    x = (origin[0] - corner[0]) / CELL_SIZE
    y = (origin[1] - corner[1]) / CELL_SIZE
    for i in range(len(rays.reach)):
        h = rays.reach[i]
        f = rays.fan[i]
        if h >= CELL_SIZE:
            farthest[f] = max(farthest[f], h)
            nearest[f] = min(nearest[f], h if obstacle[i] else np.float32(np.inf))
    for f in range(FANS):
        if farthest[f] == 0.0:
            continue
        dx, dy = direction[f]
        step_r = 1 if dy > 0 else -1
        step_c = 1 if dx > 0 else -1
        r, c, t0, next_r, next_c, width_r, width_c = set_out(x, y, dx, dy, np.float32(0.0))
        while 0 <= r < rows and 0 <= c < cols:
            level = 1 if t0 > farthest[f] else (2 if t0 > nearest[f] else 3)
            if sight[r, c] < level:
                sight[r, c] = level
            t0 = min(next_c, next_r)
            if next_c < next_r:
                c += step_c
                next_c += width_c
            else:
                r += step_r
                next_r += width_r


def cast_rays(
    rows: F32,
    origin_map: F64,
    obstacle: Bool,
    moving: Bool,
    reference: Reference,
    cell: I32 | None = None,
    with_sight: bool = True,
    sky: Callable[[Rays], Rays] | None = None,
) -> ScanView:
    """One scan's planes over ``reference.grid``, which must hold the sensor.

    ``rows`` (3, n) metres from ``origin_map`` (3,), map metres, along the map's axes; ``obstacle`` (n,) and ``cell``
    as :func:`mapvote.perception.placement.place_points` gives them (``cell`` is computed where it is not given). Points
    of ``moving`` objects occlude but do not occupy (docs/method.md); the rays of ground points prove emptiness above
    the ground. Without ``with_sight`` the view has neither sight nor hits: rays are followed to their ends only.
    ``sky``: which rays passed into the sky (:class:`Sky`); they are followed, too.
    """
    if cell is None:
        cell, _ = cells_and_obstacles(rows, origin_map, reference)
    grid = reference.grid
    requested = grid.shape if with_sight else (0, 0)
    counts = np.zeros(requested, dtype=np.int32)
    hit = np.zeros(requested, dtype=np.uint64)
    sight = np.zeros(requested, dtype=np.uint8)
    base = np.ascontiguousarray(reference.base)
    rays = follow_rays(rows, CLEARANCE_M)
    fans = gather_rays(rays) if sky is None else gather_rays(rays, sky(rays))
    passed = np.zeros(grid.shape, dtype=np.uint64)  # now, so that the cache still holds it
    mark_passed(fans, origin_map, (grid.x0, grid.y0), base, passed.ravel())
    if with_sight:
        still = obstacle & ~moving
        enter_hits(rows[2], float(origin_map[2]), cell, still, base.ravel(), counts.ravel(), hit.ravel())
        mark_sight(rays, obstacle, fans, origin_map, (grid.x0, grid.y0), sight)
    return ScanView(grid, counts, hit, passed, sight)


SKY_SECTORS = 256
"""Sectors in a turn, 1.4 deg each: about 8 firings of each beam. Both neighbours of a sector must be as empty."""


@record(votes=True)
@dataclass(frozen=True, slots=True)
class SkyRule:
    """Numbers of the test for rays into the sky."""

    answered: float = 0.25
    """Share of a sector's rays that must have a return: fewer may be due to lost packets or the vehicle's roof."""
    min_upright: float = 0.866
    """Cosine of the largest lean, 30 deg, at which a beam has one slope in every direction of the map."""
    follow_m: float = 60.0
    """Horizontal distance for which a ray into the sky is followed: the corners of any window lie within it."""
    every_fan: int = 2
    """One fan of so many casts rays into the sky: at 40 m they are 0.25 m apart."""


SKY_RULE = SkyRule()


@kernel
def _highest(rays: Rays, lean: F64, slopes: F32, top: F32, count: I32) -> None:
    """Enter into ``top`` (SKY_SECTORS,), which holds -inf, the steepest slope of a return in each sector, from the
    sensor's own plane, and into ``count`` (2, SKY_SECTORS), which holds 0, how many came, in turns: a sum waits for the
    one before it. ``slopes`` (n,): scratch, of all returns, in a loop that vectorises."""
    wide = np.uint64(FANS // SKY_SECTORS)
    for i in range(np.uint64(0), np.uint64(len(slopes))):
        lifted = np.float32(rays.x[i] * lean[0] + rays.y[i] * lean[1])
        slopes[i] = rays.slope[i] * np.float32(CELL_SIZE) + lifted
    for k in range(np.uint64(0), np.uint64(len(slopes))):
        sector = np.uint64(rays.fan[k]) // wide
        count[k & np.uint64(1), sector] += 1
        if slopes[k] > top[sector]:
            top[sector] = slopes[k]


@kernel
def _rise(
    returned: tuple[F32, I32, float], edge: F32, slopes: F32, lean: F64, casting: tuple[I32, F32, F32],
    out: tuple[F32, F32, F32, I32],
) -> int:  # fmt: skip
    """Enter into the first of ``out`` (x, y, slope, fan) the rays of the beams, of ascending ``slopes``, between the
    highest returns and ``edge`` (SKY_SECTORS,) of each fan that casts; returns how many. ``returned``: the slope of the
    highest return of each sector (SKY_SECTORS,), how many came, and how many must have come there and to both sides.
    ``casting``: the numbers of these fans and their directions x and y."""
    top, count, least = returned
    fans, along_x, along_y = casting
    x, y, slope, fan = out
    n = 0
    for f in range(len(fans)):
        s = fans[f] // (FANS // SKY_SECTORS)
        left = (s + 1) % SKY_SECTORS
        if min(count[s], min(count[s - 1], count[left])) < least:
            continue
        most = max(top[s], max(top[s - 1], top[left]))
        first = 0
        while first < len(slopes) and slopes[first] <= most:
            first += 1
        # The beam next to the highest return may have grazed the same surface: it is left out.
        for beam in range(first + 1, len(slopes)):
            if slopes[beam] > edge[s]:
                break
            x[n] = along_x[f]
            y[n] = along_y[f]
            slope[n] = (slopes[beam] - along_x[f] * lean[0] - along_y[f] * lean[1]) / CELL_SIZE
            fan[n] = fans[f]
            n += 1
    return n


class Sky:
    """The elevations above which a sensor's rays passed into the sky.

    Beams on rings are known. A sensor without rings fires everywhere in its field of view, whose upper edge is where
    returns have come from so far in the drive, sector by sector.
    """

    def __init__(self, sensor: Sensor, rule: SkyRule = SKY_RULE) -> None:
        self._rule = rule
        beams = sorted(sensor.elevations_deg)
        self._edge = None if sensor.rings else np.full(SKY_SECTORS, -np.inf, np.float32)
        """(SKY_SECTORS,) slope of the upper edge of the field of view, counter-clockwise from forward."""
        upright = np.tan(np.radians(beams)).astype(np.float32)
        self._slopes = {True: upright, False: np.ascontiguousarray(-upright[::-1])}
        """By whether the sensor's z axis points up: upside down, the lowest beam is the highest."""
        self._least = rule.answered * len(beams) * sensor.azimuths / SKY_SECTORS
        self._fan = np.arange(0, FANS, rule.every_fan, dtype=np.int32)
        azimuth = (self._fan + 0.5) * 2.0 * np.pi / FANS
        self._x = np.cos(azimuth).astype(np.float32)
        self._y = np.sin(azimuth).astype(np.float32)
        self._far = np.full(len(self._fan) * len(beams), np.float32(rule.follow_m))
        """Where rays into the sky end: as many as there can be."""

    def rays(self, up_map: F64, forward_map: F64, rays: Rays) -> Rays:
        """The rays of a scan into the sky, from ``rays``, those that returned. ``up_map`` (3,): the axis that the
        sensor turns about, in their frame; it may point down, and lean by up to 30 deg. A sensor that leans by more
        gets no ray into the sky: its beams are no cones about the vertical. ``forward_map`` (3,): its x axis."""
        x, y, z = up_map.tolist()
        if abs(z) < self._rule.min_upright * math.sqrt(x * x + y * y + z * z):
            none, no_fan = self._far[:0], self._fan[:0]
            return Rays(none, none, none, none, none, no_fan)
        lean = up_map[:2] / z
        top = np.full(SKY_SECTORS, -np.inf, np.float32)
        counts = np.zeros((2, SKY_SECTORS), np.int32)
        _highest(rays, lean, np.empty(len(rays.reach), np.float32), top, counts)
        count = counts[0] + counts[1]
        edge = self._edge_seen(top, forward_map)
        # Rays of the beams above the highest returns of their sector and its neighbours, and below the edge.
        slopes = self._slopes[z > 0.0]
        most = len(self._far)
        along_x, along_y, slope = np.empty((3, most), np.float32)
        fan = np.empty(most, np.int32)
        casting = self._fan, self._x, self._y
        n = _rise((top, count, self._least), edge, slopes, lean, casting, (along_x, along_y, slope, fan))
        far = self._far[:n]
        return Rays(far, along_x[:n], along_y[:n], slope[:n], far, fan[:n])

    def _edge_seen(self, top: F32, forward_map: F64) -> F32:
        """(SKY_SECTORS,) slope up to which the sensor fires in each sector of the map, after one more scan with its
        highest returns ``top``; infinite where its beams lie on rings."""
        if self._edge is None:
            return np.full(SKY_SECTORS, np.inf, np.float32)
        turned = round(float(np.arctan2(forward_map[1], forward_map[0])) / (2.0 * np.pi) * SKY_SECTORS)
        np.maximum(self._edge, np.roll(top, -turned), out=self._edge)
        edge = np.roll(self._edge, turned)
        return np.minimum(edge, np.minimum(np.roll(edge, 1), np.roll(edge, -1)))
