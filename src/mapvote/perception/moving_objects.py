"""Removal of moving objects on an occupancy grid in the world frame (paper II, [9]).

A voxel that is occupied only briefly belongs to a moving object, and connected cells move together.
"Briefly" is a ratio of what could be observed, never a number of scans: each voxel of a scan is looked up
from the other scans of a short window; those that saw through it (free) are weighed against
those that saw something in it (hit), and those that could not see it do not count. Structure that has only
just come into view was never seen through, so it is not called moving.

Whether a scan saw through a voxel is one look-up in that scan's range image. The voxel is free only if every ray
close to it, to all sides, ended behind it, so thin things, edges and foliage stay; and only if, over the window,
rays passed both just below and just above the place, because a ray over a roof does not observe the roof.
It needs no map, only poses, so it serves SLAM and voting alike.

Online: a scan is decided after at most ``lookahead_s`` (1 s), because the space behind a vehicle ahead is observed
only once that vehicle has driven on. Nothing older than ``Movers.past_s`` (2 s) before it is used.

Limits: a car that waits through the whole window is static. A car farther away than ``reach_m`` is never called
moving. An object with only the sky behind it is judged by the cells it is connected to: rays without return are
unknown.

Range images are made and read in two loops. The first computes the direction and range of all points, in float32 from
the sensor, without a branch, so that it vectorises. The second enters each point, or looks it up.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from itertools import zip_longest
from typing import NamedTuple

import numpy as np

from mapvote.config import MovingSettings
from mapvote.core.geometry import turn
from mapvote.core.grid import CELL_SIZE
from mapvote.core.kernel import disjoint, inlined, kernel, two_at
from mapvote.core.record import record
from mapvote.core.sensors import Sensor
from mapvote.core.types import F32, F64, I32, I64, U16, Bool
from mapvote.core.voxels import grouped, voxel_key
from mapvote.perception.placement import ONE_LIDAR, LidarPart


@record(votes=True)
@dataclass(frozen=True, slots=True)
class RangeImages:
    """Numbers of the range images in which moving objects are found."""

    steps_per_m: float = 500.0
    """Steps of a range per metre: 2 mm, up to 131 m."""
    least_range_m: float = 0.5
    """Distance of points from the sensor in the plane below which they have no usable direction, metres."""


RANGE_IMAGES = RangeImages()
# Kernels take no records: they read these names.
PER_M = np.float32(RANGE_IMAGES.steps_per_m)
NO_RETURN = np.uint16(65535)
"""Value of a range image in directions without a return."""
LEAST_RANGE_M = np.float32(RANGE_IMAGES.least_range_m)
# What scans saw at a place is one int32: how many saw through it, in the lowest byte, and
HIT = np.int32(1 << 8)
"""for each that saw something in it, in the next byte;"""
BELOW, ABOVE = np.int32(1 << 16), np.int32(1 << 17)
"""a ray passed below, and above: a ray that only ever passes over a roof proves nothing about the roof."""


class Pixels(NamedTuple):
    """How directions are divided: by azimuth, and by height over horizontal range."""

    turns: int
    """Pixels in a turn."""
    slopes: int
    slope_min: np.float32
    per_slope: np.float32
    """Pixels for a slope of 1."""


class Samples(NamedTuple):
    """Places to look up, metres from a common point; compacted in place as they are settled."""

    x: F32
    """(m,)"""
    y: F32
    z: F32
    of: I32
    """(m,) which of the counts each place belongs to."""


@inlined
def _aim(x: np.float32, y: np.float32, z: np.float32, pixels: Pixels) -> tuple[np.float32, np.int32, np.int32]:
    """(horizontal range, azimuth pixel, slope pixel: -1 or ``slopes`` outside) of a place from the sensor."""
    rho = np.sqrt(x * x + y * y)
    row = np.floor((z / max(rho, LEAST_RANGE_M) - pixels.slope_min) * pixels.per_slope)
    b = np.int32(min(max(row, np.float32(-1.0)), np.float32(pixels.slopes)))
    return rho, min(np.int32(turn(x, y) * np.float32(pixels.turns)), np.int32(pixels.turns - 1)), b


@kernel
def _enter_image(rows: F32, pixels: Pixels, pixel: I32, steps: I32, flat: U16, out: U16) -> None:
    """:func:`range_image` of places (3, n) from the sensor, by scratch: ``pixel`` (n,), the last one being nowhere,
    ``steps`` (n,) of range, and ``flat`` (turns * slopes + 1,)."""
    x = rows[0]
    y = rows[1]
    z = rows[2]
    turns = pixels.turns
    n = np.uint64(len(x))
    slopes = np.int32(pixels.slopes)
    nowhere = np.int32(pixels.turns * pixels.slopes)
    for i in range(np.uint64(0), n):  # unsigned: an index that cannot be negative vectorises
        rho, a, b = _aim(x[i], y[i], z[i], pixels)
        pixel[i] = np.int32(a * slopes + b) if (rho >= LEAST_RANGE_M) & (b >= 0) & (b < slopes) else nowhere
        steps[i] = np.int32(min(rho * PER_M + np.float32(0.5), np.float32(NO_RETURN - 1)))
    for i in range(np.uint64(0), np.uint64(len(flat))):
        flat[i] = NO_RETURN
    for i in range(np.uint64(0), n):
        here = np.uint64(pixel[i])
        flat[here] = min(flat[here], np.uint16(steps[i]))
    wide = np.uint64(pixels.slopes)
    for k in range(turns):
        left = np.uint64(k - 1 if k > 0 else turns - 1) * wide
        middle = np.uint64(k) * wide
        right = np.uint64(k + 1 if k + 1 < turns else 0) * wide
        for s in range(np.uint64(0), wide):
            out[k, s] = min(flat[middle + s], min(flat[left + s], flat[right + s]))


def range_image(rows: F32, pixels: Pixels, out: U16) -> None:
    """Into ``out`` (turns, slopes) the nearest horizontal range among the returns ``rows`` (3, n), metres from the
    sensor, in each direction and to its left and right."""
    n = rows.shape[1]
    flat = np.empty(out.size + 1, np.uint16)
    _enter_image(rows, pixels, np.empty(n, np.int32), np.empty(n, np.int32), flat, out)


class Sought(NamedTuple):
    """Direction and range of samples from one scan's sensor, and the ranges it measured, (n,) each: scratch of
    :func:`look`."""

    steps: I32
    """Horizontal range."""
    pixel: I32
    """Index into the flat image; 0 where the image has no answer."""
    around: I32
    """Pixels above and below within which rays bear witness."""
    here: U16
    """Range at the sample's pixel, and the least range below and above it."""
    below: U16
    above: U16
    observed: I32
    """Counts of what scans saw at the sample, and whether it waits (1) or is settled (0)."""
    waits: I32


def room_to_look(n: int) -> Sought:
    """Scratch for :func:`look` at up to n samples."""
    steps, pixel, around, observed, waits = np.empty((5, n), np.int32)
    here, below, above = np.empty((3, n), np.uint16)
    return Sought(steps, pixel, around, here, below, above, observed, waits)


_LEAST_PIXELS, _MOST_PIXELS = 2, 8
"""Pixels above and below that are read: at 8 m and beyond the fewest."""


@inlined
def _seek(samples: Samples, n: int, sensor: F32, pixels: Pixels, height_m: np.float32, sought: Sought) -> None:
    """Compute range and direction of the first ``n`` samples: fills ``steps``, ``pixel`` and ``around``."""
    x, y, z, _ = samples
    steps = sought.steps
    pixel = sought.pixel
    around = sought.around
    near = np.int32(LEAST_RANGE_M * PER_M)
    slopes = np.int32(pixels.slopes)
    reach = height_m * pixels.per_slope
    for i in range(np.uint64(0), np.uint64(n)):
        rho, a, b = _aim(x[i] - sensor[0], y[i] - sensor[1], z[i] - sensor[2], pixels)
        steps[i] = np.int32(rho * PER_M + np.float32(0.5))
        k = np.int32(min(max(reach / max(rho, LEAST_RANGE_M), np.float32(_LEAST_PIXELS)), np.float32(_MOST_PIXELS)))
        inside = (steps[i] >= near) & (b >= k) & (b + k < slopes)
        pixel[i] = np.int32(a * slopes + b) if inside else np.int32(0)
        around[i] = k


@inlined
def _ask(n: int, image: U16, rule: tuple[np.int32, np.int32], sought: Sought) -> int:
    """Add what one scan saw at each of the first ``n`` samples; returns how many still wait. ``rule``: steps behind a
    sample that a ray must end to have seen through it, and ``enough``, see :func:`look`.

    Most samples read only _LEAST_PIXELS to each side: the first loop gathers those of eight samples at once. The last
    one has no branch, so that it vectorises."""
    steps, pixel, around, here, below, above, observed, waits = sought
    low = np.int32(0xFFFF)
    high = np.int32(16)
    for w in range(np.uint64(0), np.uint64(n)):
        at = np.int64(max(pixel[w], np.int32(_LEAST_PIXELS)))
        under = two_at(image, at - 2)
        over = two_at(image, at + 1)
        here[w] = two_at(image, at) & low
        below[w] = min(np.int32(under & low), np.int32(under >> high & low))
        above[w] = min(np.int32(over & low), np.int32(over >> high & low))
    for w in range(np.uint64(0), np.uint64(n)):
        p = np.uint64(pixel[w])
        if (around[w] > _LEAST_PIXELS) & (p > 0):
            for s in range(np.uint64(_LEAST_PIXELS + 1), np.uint64(around[w] + 1)):
                below[w] = min(below[w], image[p - s])
                above[w] = min(above[w], image[p + s])
    margin, enough = rule
    none = np.int32(0)
    waiting = 0
    for w in range(np.uint64(0), np.uint64(n)):
        under = np.int32(below[w])
        over = np.int32(above[w])
        nearest = min(np.int32(here[w]), min(under, over))
        behind = np.int32(nearest - steps[w])
        answers = (pixel[w] > 0) & (nearest != np.int32(NO_RETURN)) & (behind >= -margin)
        low = BELOW if under < np.int32(NO_RETURN) else none
        high = ABOVE if over < np.int32(NO_RETURN) else none
        before = observed[w]
        through = np.int32(np.int32(before + np.int32(1)) | low | high)
        seen = through if behind > margin else np.int32(before + HIT)
        after = seen if answers else before
        observed[w] = after
        free = np.int32(after & np.int32(255))
        hit = np.int32(after >> np.int32(8) & np.int32(255))
        passed = (hit == 0) & (free >= enough) & (after >= BELOW + ABOVE)
        settled = passed | ((free == 0) & (hit >= enough))
        waits[w] = none if settled else np.int32(1)
        waiting += waits[w]
    return waiting


@disjoint
def look(
    samples: Samples, n: int, images: U16, slots: I64, sensors: F32, pixels: Pixels, rule: tuple[float, float, int],
    seen: I32, sought: Sought,
) -> np.int64:  # fmt: skip
    """Ask some scans, one after the other, about the first ``n`` samples: by the range ``images`` (m, size), flat, in
    the ``slots`` (k,). A call for each would take a tenth longer.

    Their observations go into ``seen`` (m,), by ``samples.of``: see HIT. Returns how many samples still wait.

    ``sensors`` (k, 3) where the scans were taken, from the samples' common point. ``rule``: (metres behind a place that
    a ray must end to have seen through it, metres above and below within which rays bear witness, enough > 0). A sample
    of which ``enough`` scans said the same, and none the contrary, waits no longer. ``sought``: scratch for ``n``
    samples or more.
    """
    x, y, z, of = samples
    observed = sought.observed
    behind_m, height_m, enough = rule
    asked = np.int32(behind_m * PER_M), np.int32(enough)
    waiting = np.uint64(n)
    for w in range(np.uint64(0), waiting):
        observed[w] = seen[np.uint64(of[w])]
    for k in range(len(slots)):
        _seek(samples, waiting, sensors[k], pixels, np.float32(height_m), sought)
        if _ask(waiting, images[slots[k]], asked, sought) == np.int64(waiting):
            continue
        left = np.uint64(0)
        for w in range(np.uint64(0), waiting):  # a settled sample is overwritten: no branch to predict
            seen[np.uint64(of[w])] = observed[w]
            x[left] = x[w]
            y[left] = y[w]
            z[left] = z[w]
            of[left] = of[w]
            observed[left] = observed[w]
            left += np.uint64(sought.waits[w])
        waiting = left
    for w in range(np.uint64(0), waiting):
        seen[np.uint64(of[w])] = observed[w]
    return np.int64(waiting)


@record(votes=True)
@dataclass(frozen=True, slots=True)
class Movers:
    """Numbers of the filter, set on the development streets of the simulator."""

    reach_m: float = 57.0
    """Points farther away are never called moving: the corners of the local grid are 56.7 m away."""
    past_s: float = 2.0
    """Scans older than this before a scan are not used."""
    looks_past: int = 6
    """Scans used before."""
    looks_ahead: int = 5
    """Scans used after."""
    pixel_deg: float = 0.6
    """Direction pixel of the free-space look-up."""
    tilt_deg: float = 4.0
    """Pitch and roll of the vehicle to allow for."""
    margin_m: float = 0.5
    """A ray that ends this far behind a voxel saw through it."""
    height_m: float = 0.12
    """Rays this far above and below a voxel bear witness to it."""
    min_free: int = 2
    """Scans that saw through a voxel before it can be called brief."""
    enough: int = 3
    """Scans that agree without dissent settle a voxel."""
    free_share: float = 0.5
    """Share of the scans able to see a voxel that saw through it."""
    min_voxels: int = 4
    """Brief voxels that a moving object has at least."""
    share_whole: float = 0.5
    """Brief share at which connected cells move together."""
    share_part: float = 0.7
    """The same share for the cells that remain beside static ones."""


MOVERS = Movers()


@record()
@dataclass(frozen=True, slots=True)
class ImageRoom:
    """Room for the range images of the window."""

    first: int = 32
    """Images for which there is room at first: one LiDAR's of 3 s. It doubles where they are more."""


IMAGE_ROOM = ImageRoom()


@dataclass(frozen=True, slots=True)
class _Scan:
    """One scan in the window."""

    stamp_ns: int
    origin_map: F64
    slots: list[int]
    """The places of its images among the filter's: one for each LiDAR of a sweep."""
    points: int
    """How many points it has."""
    chosen: I32
    """(k,) those that can be moving: not ground, within reach."""
    voxel_of: I32
    """(k,) index into ``samples`` of each of them."""
    samples: F32
    """(3, m) one obstacle point per voxel, metres from ``origin_map``."""


class MovingFilter:
    """Finds the points of moving objects in a stream of scans with known poses.

    Scans go in with :meth:`push`, in order of time; masks come out as soon as ``lookahead_s`` has been seen.
    """

    def __init__(self, sensor: Sensor, settings: MovingSettings, movers: Movers = MOVERS) -> None:
        self.settings = settings
        self.movers = movers
        slope_min = np.tan(np.radians(max(sensor.fov_bottom_deg - movers.tilt_deg, -60.0)))
        slope_max = np.tan(np.radians(min(sensor.fov_top_deg + movers.tilt_deg, 60.0)))
        per_slope = 1.0 / np.tan(np.radians(0.5 * movers.pixel_deg))
        turns = round(360.0 / max(2.0 * sensor.azimuth_step_deg, movers.pixel_deg))
        slopes = int(np.ceil((slope_max - slope_min) * per_slope))
        self._pixels = Pixels(turns, slopes, np.float32(slope_min), np.float32(per_slope))
        self._half = int(np.ceil(movers.reach_m / CELL_SIZE)) + 2
        """Cells from the sensor to the sides of the square in which voxels are grouped, which ``_plane`` is of."""
        self._plane = np.full((2 * self._half + 1,) * 2, -1, dtype=np.int32)
        self._images = np.empty((IMAGE_ROOM.first, turns * slopes), np.uint16)
        """Those of the window, in any order: one kernel reads many. Horizontal range of the nearest return around each
        direction, see :func:`range_image`."""
        self._origins_map = np.empty((IMAGE_ROOM.first, 3))
        """Where the rays of each image begin, map metres."""
        self._free_slots = list(range(IMAGE_ROOM.first))
        self._room = room_to_look(0)
        self._window: deque[_Scan] = deque()
        self._waiting = 0
        """How many of the window's youngest scans are undecided."""

    def push(
        self, rows: F32, origin_map: F64, obstacle: Bool, stamp_ns: int, lidars: tuple[LidarPart, ...] = ONE_LIDAR
    ) -> list[Bool]:
        """Take one scan; return what can now be decided: the masks of moving points (n,) of the oldest scans that
        were still undecided, in their order.

        ``rows`` (3, n) metres from the sensor, which is at ``origin_map`` (3,), map metres, along the map's axes;
        ``obstacle`` (n,) says which points stand more than 0.3 m above the ground: only they can be called moving, but
        all of them prove what is free. ``lidars``: those that took the points, each from where its rays begin.
        Raises ValueError if stamps do not increase.
        """
        if self._window and stamp_ns <= self._window[-1].stamp_ns:
            raise ValueError(f"stamps must increase: {stamp_ns} after {self._window[-1].stamp_ns}")
        origin = np.asarray(origin_map, dtype=np.float64)
        slots = [self._drawn(one.own_rows(rows), one.origin_map(origin)) for one in lidars]
        chosen, voxel_of, samples = voxels(rows, obstacle, origin, self.movers.reach_m, CELL_SIZE)
        self._window.append(_Scan(stamp_ns, origin, slots, len(obstacle), chosen, voxel_of, samples))
        self._waiting += 1
        return self._decide(stamp_ns - round(self.settings.lookahead_s * 1e9))

    def flush(self) -> list[Bool]:
        """Decide what is left, with less than the full look ahead: the drive has ended."""
        decided = self._decide(self._window[-1].stamp_ns) if self._window else []
        while self._window:
            self._drop(self._window.pop())
        return decided

    def forget(self, count: int) -> None:
        """The ``count`` youngest scans, none of them decided, were taken elsewhere than told."""
        for _ in range(count):
            self._drop(self._window.pop())
        self._waiting -= count

    def _drawn(self, rows: F32, origin_map: F64) -> int:
        """The slot of a new image of returns (3, n), which were measured from ``origin_map`` (3,)."""
        if not self._free_slots:
            before = len(self._images)
            self._images = np.concatenate([self._images, np.empty_like(self._images)])
            self._origins_map = np.concatenate([self._origins_map, np.empty_like(self._origins_map)])
            self._free_slots += range(before, 2 * before)
        slot = self._free_slots.pop()
        self._origins_map[slot] = origin_map
        range_image(rows, self._pixels, self._images[slot].reshape(self._pixels.turns, -1))
        return slot

    def _drop(self, scan: _Scan) -> None:
        """No later scan will ask this one."""
        self._free_slots += scan.slots

    def _decide(self, up_to_ns: int) -> list[Bool]:
        """Masks of all waiting scans not younger than ``up_to_ns``; forgets what no later scan will ask for."""
        out = []
        while self._waiting:
            at = len(self._window) - self._waiting
            if self._window[at].stamp_ns > up_to_ns:
                break
            out.append(self._moving(at))
            self._waiting -= 1
            oldest_ns = self._window[at].stamp_ns - round(self.movers.past_s * 1e9)
            while self._window[0].stamp_ns < oldest_ns:
                self._drop(self._window.popleft())
        return out

    def _moving(self, at: int) -> Bool:
        """The mask of the window's scan ``at``, from the other scans of the window."""
        scan = self._window[at]
        movers = self.movers
        m = scan.samples.shape[1]
        observed = np.zeros(m, np.int32)
        x, y, z = scan.samples.copy()
        waiting = Samples(x, y, z, np.arange(m, dtype=np.int32))
        # Each of the other scans counts what it saw at the samples.
        slots = np.array([slot for other in self._witnesses(at) for slot in other.slots], np.int64)
        sensors = (self._origins_map.take(slots, axis=0) - scan.origin_map).astype(np.float32)
        rule = movers.margin_m, movers.height_m, movers.enough
        if m > len(self._room.waits):
            self._room = room_to_look(2 * m)
        look(waiting, m, self._images, slots, sensors, self._pixels, rule, observed, self._room)
        # Which voxels were brief, and the cell of each in a square around the sensor.
        place = np.empty(m, np.int32)
        seen_often = np.empty(m, np.bool_)
        brief = np.empty(m, np.bool_)
        bounds = movers.min_free, movers.free_share
        _weigh(scan.samples, scan.origin_map, self._half, observed, bounds, place, seen_often, brief)
        # Connected cells move together.
        moving = np.zeros(scan.points, np.bool_)
        shares = movers.min_voxels, movers.share_whole, movers.share_part
        mark_components(place, self._plane, seen_often, brief, shares, (scan.voxel_of, scan.chosen), moving)
        return moving

    def _witnesses(self, at: int) -> list[_Scan]:
        """Up to ``looks`` other scans spread evenly over the time before, and over the time after, scan ``at``.

        Those before and after take turns, the farthest first: they are the likeliest to settle a voxel soon.
        """
        scans = list(self._window)
        before = _spread(scans[:at], self.movers.looks_past)
        after = _spread(scans[:at:-1], self.movers.looks_ahead)
        return [s for pair in zip_longest(before, after) for s in pair if s is not None]


def _spread(scans: list[_Scan], count: int) -> list[_Scan]:
    """At most ``count`` of them, evenly spread, the first always among them."""
    if len(scans) <= count:
        return scans
    return [scans[(k * len(scans)) // count] for k in range(count)]


@kernel
def _weigh(
    samples: F32, origin: F64, half: int, observed: I32, bounds: tuple[int, float], place: I32, seen: Bool,
    brief: Bool,
) -> None:  # fmt: skip
    """For each of ``samples`` (3, m) from ``origin``: its cell in the square of ``half`` cells to each side, whether
    enough scans could see it, and whether it is brief: rays passed it on both sides, and most scans that could see it
    saw through it, by what they ``observed`` (m,). ``bounds``: min_free and free_share."""
    min_free, free_share = bounds
    side = 2 * half + 1
    col0 = np.int64(np.floor(origin[0] / CELL_SIZE)) - half
    row0 = np.int64(np.floor(origin[1] / CELL_SIZE)) - half
    for i in range(np.uint64(0), np.uint64(len(place))):
        col = np.int64(np.floor((np.float64(samples[0, i]) + origin[0]) / CELL_SIZE)) - col0
        row = np.int64(np.floor((np.float64(samples[1, i]) + origin[1]) / CELL_SIZE)) - row0
        place[i] = row * side + col
        free = observed[i] & np.int32(255)
        total = free + (observed[i] >> np.int32(8) & np.int32(255))
        seen[i] = total >= min_free
        brief[i] = (observed[i] >= BELOW + ABOVE) & (free >= min_free) & (free >= free_share * total)


@disjoint
def _choose(rows: F32, obstacle: Bool, origin: F64, reach: float, cell: float, chosen: I32, keys: I64) -> np.int64:
    """How many points ``rows`` (3, n) from ``origin`` are obstacles within ``reach``: which, and the keys of their
    voxels, into the first of ``chosen`` (n,) and ``keys`` (n,)."""
    count = np.uint64(0)
    reach2 = np.float32(reach * reach)
    east = rows[0]
    north = rows[1]
    up = rows[2]
    x0 = origin[0]
    y0 = origin[1]
    z0 = origin[2]
    per_m = 1.0 / cell
    for i in range(np.uint64(0), np.uint64(len(obstacle))):  # what is not chosen is written over: no branch to predict
        chosen[count] = i
        count += np.uint64(obstacle[i])
    for k in range(np.uint64(0), count):
        p = np.uint64(chosen[k])
        x = east[p]
        y = north[p]
        z = (np.float64(up[p]) + z0) * per_m
        key = voxel_key((np.float64(x) + x0) * per_m, (np.float64(y) + y0) * per_m, z, 1.0)
        keys[k] = key if x * x + y * y <= reach2 else np.int64(0)
    within = np.uint64(0)
    for k in range(np.uint64(0), count):
        chosen[within] = chosen[k]
        keys[within] = keys[k]
        within += np.uint64(keys[k] != 0)
    return np.int64(within)


def voxels(rows: F32, obstacle: Bool, origin: F64, reach: float, cell: float) -> tuple[I32, I32, F32]:
    """(obstacles within ``reach`` (k,), the voxel of each (k,), the first point of each voxel (3, m)), voxels in order
    of their first points."""
    n = rows.shape[1]
    chosen = np.empty(n, np.int32)
    keys = np.empty(n, np.int64)
    count = _choose(rows, obstacle, origin, reach, cell, chosen, keys)
    of, first = grouped(keys[:count], 1 << 15)  # scans of 66,000 points have 7,000 voxels: few share a slot
    return chosen[:count].copy(), of, rows.take(chosen[first], axis=1)


@inlined
def _flood(cells: I32, n: int, state: I32, seeds: I32, side: int, plane: I32, label: I32, stack: I32) -> None:
    """Label of each of n cells by 8-connected component of those whose ``state`` is 1, from 0; -1 for others, and where
    no cell of a component is among the ``seeds``.

    ``cells`` (n,) are distinct indices row * side + col with 0 < row, col < side - 1; ``plane`` (side * side,): scratch
    that holds -1 beside them: the place in them of each cell that waits. ``stack`` (n,): scratch.
    """
    none = np.int32(-1)
    for k in range(np.uint64(0), np.uint64(n)):
        label[k] = none
        plane[np.uint64(cells[k])] = np.int32(k) if state[k] == 1 else none
    count = 0
    for seed in range(np.uint64(0), np.uint64(n)):
        if seeds[seed] == 0 or plane[np.uint64(cells[seed])] < 0:
            continue
        plane[np.uint64(cells[seed])] = none
        label[seed] = count
        stack[0] = seed
        top = np.uint64(1)
        while top > 0:
            top -= np.uint64(1)
            corner = np.uint64(cells[np.uint64(stack[top])] - side - 1)
            for dr in range(np.uint64(0), np.uint64(3)):
                at = corner + dr * np.uint64(side)
                for dc in range(np.uint64(0), np.uint64(3)):
                    k = plane[at + dc]
                    if k >= 0:
                        plane[at + dc] = none
                        label[np.uint64(k)] = count
                        stack[top] = k
                        top += np.uint64(1)
        count += 1


@kernel
def _components(
    place: I32, side: int, seen: Bool, brief: Bool, shares: tuple[int, float, float], plane: I32, work: I32,
    points: tuple[I32, I32], out: Bool,
) -> None:  # fmt: skip
    """:func:`mark_components`; ``work`` (9, m): scratch, ``plane`` flat."""
    min_voxels, share_whole, share_part = shares
    static, open_, moves = 0, 1, 2
    cells = work[0]
    cell_of = work[1]
    n_seen = work[2]
    n_brief = work[3]
    total = work[4]
    moving = work[5]
    label = work[6]
    stack = work[7]
    state = work[8]
    n = 0
    for i in range(np.uint64(0), np.uint64(len(place))):
        at = np.uint64(place[i])
        if plane[at] < 0:
            plane[at] = n
            cells[n] = place[i]
            n_seen[n] = 0
            n_brief[n] = 0
            state[n] = open_
            n += 1
        own = np.uint64(plane[at])
        cell_of[i] = plane[at]
        n_seen[own] += seen[i]
        n_brief[own] += brief[i]
    for pass_ in range(2):
        share = share_whole if pass_ == 0 else share_part
        _flood(cells, n, state, n_brief, side, plane, label, stack)  # nothing moves without brief voxels
        for k in range(n):
            total[k] = moving[k] = 0
        for k in range(n):
            if label[k] >= 0:
                total[label[k]] += n_seen[k]
                moving[label[k]] += n_brief[k]
        for k in range(n):
            c = label[k]
            if c >= 0 and moving[c] >= min_voxels and moving[c] >= share * total[c]:
                state[k] = moves
            elif state[k] != moves:
                state[k] = open_ if 2 * n_brief[k] >= n_seen[k] else static
    for k in range(n):
        plane[np.uint64(cells[k])] = -1
    voxel_of, chosen = points
    for j in range(np.uint64(0), np.uint64(len(chosen))):
        out[np.uint64(chosen[j])] = state[np.uint64(cell_of[np.uint64(voxel_of[j])])] == moves


def mark_components(
    place: I32, plane: I32, seen: Bool, brief: Bool, shares: tuple[int, float, float], points: tuple[I32, I32],
    out: Bool,
) -> None:  # fmt: skip
    """Enter into ``out`` (n,) which points move, from which of their voxels (m,) were decidable (``seen``) and occupied
    only briefly (``brief``). ``points``: the voxel of each point (k,), and which of all points it is.

    ``place`` (m,): the cell of each voxel, row * side + col with 0 < row, col < side - 1. ``plane`` (side, side):
    scratch that holds -1, and does so again afterwards. ``shares``: min_voxels, share_whole and share_part of
    :class:`Movers`. Connected cells move together: a component of the plane moves as a whole if at least
    ``share_whole`` of its decidable voxels were brief, and ``min_voxels`` of them. Where a mover touches something
    static, the component splits at the cells that are mostly static, and each remaining part moves if at least
    ``share_part`` of it was brief.
    """
    work = np.empty((9, len(place)), dtype=np.int32)
    _components(place, len(plane), seen, brief, shares, plane.reshape(-1), work, points, out)
