"""Planes of one scan over the local grid: hits, voxels that rays passed, visibility (paper III-A), rays into the sky.

mapvote.perception.fans walks over the cells: the 3D question becomes a 2D one.

A sensor reports returns only. If the road and the walls answer in a direction, and nothing answers above the highest
of them, then no surface up there was within range. The test uses whole sectors, because single beams are lost on
glass, on dark paint and by chance. For the same reason a ray lost between returns proves nothing.
Hardly any other ray passes above a house that was pulled down, or where one was built.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapvote.core.columns import GROUND_MARGIN_M, column_bit, height_above
from mapvote.core.geometry import rows_from
from mapvote.core.grid import CELL_SIZE, Grid
from mapvote.core.kernel import kernel
from mapvote.core.record import record
from mapvote.core.sensors import Sensor
from mapvote.core.types import F32, F64, I32, U8, U64, Bool, Reference
from mapvote.perception.fans import FANS, Fans, Rays, follow_rays, gather_rays, mark_passed, set_out


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
    """Obstacle points of stationary objects in the cell: n of paper Eq. (1)."""
    hit: U64
    """Column words of those points."""
    passed: U64
    """Column words of voxels that a ray passed well before its own hit. Bit 63 (all above) is never passed."""
    sight: U8
    """:class:`Sight` of the cell; (0, 0) if not requested."""


@kernel
def _obstacles(
    points: F64, ground_z: F32, base: I32, lattice: tuple[float, float], corner: tuple[int, int],
    cell: I32, obstacle: NDArray[np.bool_],
) -> None:  # fmt: skip
    rows, cols = ground_z.shape
    (x0, y0), (row0, col0) = lattice, corner
    for i in range(len(points)):  # cells as Lattice.cells_of has them, to the last bit
        c = int(np.floor((points[i, 0] - x0) / CELL_SIZE)) - col0
        r = int(np.floor((points[i, 1] - y0) / CELL_SIZE)) - row0
        cell[i] = -1
        obstacle[i] = False
        if r < 0 or c < 0 or r >= rows or c >= cols:
            continue
        cell[i] = r * cols + c
        obstacle[i] = height_above(points[i, 2], ground_z[r, c], base[r, c]) >= GROUND_MARGIN_M


def find_obstacles(points_map: F64, reference: Reference) -> tuple[Bool, I32]:
    """(obstacle (n,) bool, cell (n,) int32) of points (n, 3), map metres.

    By the rule that built the reference, see :func:`mapvote.core.columns.height_above`. ``cell`` is row * cols + col in
    the reference's grid, -1 outside it.
    """
    cell = np.empty(len(points_map), dtype=np.int32)
    obstacle = np.empty(len(points_map), dtype=np.bool_)
    grid = reference.grid
    lattice = (grid.lattice.x0, grid.lattice.y0)
    corner = (grid.row0, grid.col0)
    _obstacles(points_map, reference.ground_z, reference.base, lattice, corner, cell, obstacle)
    return obstacle, cell


@kernel
def _enter_hits(points: F64, cell: I32, keep: NDArray[np.bool_], base: I32, counts: I32, hit: U64) -> None:
    """Stationary obstacle points into counts and hit words (flat planes, in place)."""
    for i in range(len(points)):
        if keep[i] and cell[i] >= 0:
            k = cell[i]
            hit[k] |= np.uint64(1) << np.uint64(column_bit(points[i, 2], base[k]))
            counts[k] += 1


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


class Fired(NamedTuple):
    """How the sensor of a scan fires."""

    sky: Callable[[Rays], Rays] | None = None
    """From the rays that returned to those that passed into the sky (:class:`Sky`), which are followed, too."""
    every_fan: bool = False
    """Whether no two fans hold the same elevations (:func:`mapvote.perception.fans.gather_rays`)."""


def cast_rays(
    points_map: F64,
    origin_map: F64,
    obstacle: Bool,
    moving: Bool,
    reference: Reference,
    cell: I32 | None = None,
    with_sight: bool = True,
    fired: Fired = Fired(),  # noqa: B008 - a tuple
) -> ScanView:
    """One scan's planes over ``reference.grid``, which must hold the sensor.

    ``points_map`` (n, 3) and ``origin_map`` (3,) map metres; ``obstacle`` (n,) as :func:`find_obstacles` gives it
    (which also gives ``cell``, if it is not to be computed again). Points of ``moving`` objects occlude but do not
    occupy (docs/method.md); the rays of ground points prove emptiness above the ground. Without ``with_sight``
    the view has none: rays are followed to their ends only. ``fired``: what the sensor is known to
    have done beside its returns.
    """
    if cell is None:
        _, cell = find_obstacles(points_map, reference)
    grid = reference.grid
    counts = np.zeros(grid.shape, dtype=np.int32)
    hit = np.zeros(grid.shape, dtype=np.uint64)
    passed = np.zeros(grid.shape, dtype=np.uint64)
    sight = np.zeros(grid.shape if with_sight else (0, 0), dtype=np.uint8)
    base = np.ascontiguousarray(reference.base)
    _enter_hits(points_map, cell, obstacle & ~moving, base.ravel(), counts.ravel(), hit.ravel())
    rays = follow_rays(rows_from(points_map, origin_map), CLEARANCE_M)
    fans = gather_rays(rays, every_fan=fired.every_fan)
    mark_passed(fans, origin_map, (grid.x0, grid.y0), base, passed.ravel())
    if fired.sky is not None:
        mark_passed(gather_rays(fired.sky(rays)), origin_map, (grid.x0, grid.y0), base, passed.ravel())
    if with_sight:
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
def _highest(rays: Rays, lean: F64, top: F32, count: I32) -> None:
    """Enter into ``top`` (SKY_SECTORS,), which holds -inf, the steepest slope of a return in each sector, from the
    sensor's own plane, and into ``count`` (SKY_SECTORS,), which holds 0, how many came."""
    wide = FANS // SKY_SECTORS
    for i in range(np.uint64(0), np.uint64(len(rays.reach))):
        sector = np.uint64(rays.fan[i] // wide)
        slope = rays.slope[i] * np.float32(CELL_SIZE) + np.float32(rays.x[i] * lean[0] + rays.y[i] * lean[1])
        top[sector] = max(top[sector], slope)
        count[sector] += 1


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

    def rays(self, up_map: F64, forward_map: F64, rays: Rays) -> Rays:
        """The rays of a scan into the sky, from ``rays``, those that returned. ``up_map`` (3,): the axis that the
        sensor turns about, in their frame; it may point down, and lean by up to 30 deg. A sensor that leans by more
        gets no ray into the sky: its beams are no cones about the vertical. ``forward_map`` (3,): its x axis."""
        if abs(up_map[2]) < self._rule.min_upright * np.linalg.norm(up_map):
            nowhere = np.full(SKY_SECTORS, np.inf, np.float32)
            return self._above_returns(nowhere, nowhere, np.zeros(0, np.float32), np.zeros(2))
        lean = up_map[:2] / up_map[2]
        top = np.full(SKY_SECTORS, -np.inf, np.float32)
        count = np.zeros(SKY_SECTORS, np.int32)
        _highest(rays, lean, top, count)
        edge = self._edge_seen(top, forward_map)
        return self._above_returns(
            np.where(count < self._least, np.inf, top), edge, self._slopes[up_map[2] > 0.0], lean
        )

    def _edge_seen(self, top: F32, forward_map: F64) -> F32:
        """(SKY_SECTORS,) slope up to which the sensor fires in each sector of the map, after one more scan with its
        highest returns ``top``; infinite where its beams lie on rings."""
        if self._edge is None:
            return np.full(SKY_SECTORS, np.inf, np.float32)
        turned = round(float(np.arctan2(forward_map[1], forward_map[0])) / (2.0 * np.pi) * SKY_SECTORS)
        np.maximum(self._edge, np.roll(top, -turned), out=self._edge)
        edge = np.roll(self._edge, turned)
        return np.minimum(edge, np.minimum(np.roll(edge, 1), np.roll(edge, -1)))

    def _above_returns(self, top: F32, edge: F32, slopes: F32, lean: F64) -> Rays:
        """Rays of the beams, of ascending ``slopes`` (beams,), that lie above the highest returns ``top`` of their
        sector and its neighbours and below the ``edge`` of the field of view, (SKY_SECTORS,) each."""
        most = np.maximum(top, np.maximum(np.roll(top, 1), np.roll(top, -1)))
        # The beam next to the highest return may have grazed the same surface: it is left out.
        above = np.minimum(np.searchsorted(slopes, most, side="right") + 1, len(slopes))
        below = np.maximum(np.searchsorted(slopes, edge, side="right"), above)
        sector = self._fan // (FANS // SKY_SECTORS)
        above = above[sector]
        beams_above = below[sector] - above
        fan_of = np.repeat(np.arange(len(self._fan)), beams_above)
        n_rays = int(beams_above.sum())
        beam = np.arange(n_rays) - np.repeat(np.cumsum(beams_above) - beams_above - above, beams_above)
        x = self._x[fan_of]
        y = self._y[fan_of]
        slope = ((slopes[beam] - x * lean[0] - y * lean[1]) / CELL_SIZE).astype(np.float32)
        far = np.full(n_rays, np.float32(self._rule.follow_m))
        return Rays(far, x, y, slope, far, self._fan[fan_of])
