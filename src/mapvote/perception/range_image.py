"""Range images of scans, and looks into them: did a scan see through a place, did it hit it, or neither?

Where something lies from a sensor is worked out for all points first, in float32 from the sensor, in loops without a
branch that vectorise; then each point is entered, or looked up.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapvote.core.azimuth import turn
from mapvote.core.geometry import rows_from
from mapvote.core.kernel import inlined, kernel
from mapvote.core.types import F32, F64, I32, U8

U16 = NDArray[np.uint16]
PER_M = np.float32(500.0)
"""Ranges are held in steps of 2 mm, up to 131 m."""
NOTHING = np.uint16(65535)
"""Of a range image: no return in that direction."""
NEAR_M = np.float32(0.5)
"""Points nearer than this to the sensor in the plane have no usable direction."""


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


class LookCounts(NamedTuple):
    """What scans observed at each place, (m,) each."""

    free: I32
    """Scans that saw through it."""
    hit: I32
    """Scans that saw something in it."""
    sides: U8
    """Whether a ray passed below (1) and above (2): a ray that only ever passes over a roof proves nothing about
    the roof."""


@inlined
def _aim(x: np.float32, y: np.float32, z: np.float32, pixels: Pixels) -> tuple[np.float32, np.int32, np.int32]:
    """(horizontal range, azimuth pixel, slope pixel: -1 or ``slopes`` outside) of a place from the sensor."""
    rho = np.sqrt(x * x + y * y)
    row = np.floor((z / max(rho, NEAR_M) - pixels.slope_min) * pixels.per_slope)
    b = np.int32(min(max(row, np.float32(-1.0)), np.float32(pixels.slopes)))
    return rho, min(np.int32(turn(x, y) * np.float32(pixels.turns)), np.int32(pixels.turns - 1)), b


@kernel
def _enter_image(rows: F32, pixels: Pixels, pixel: I32, steps: I32, flat: U16, out: U16) -> None:
    """:func:`range_image` of places (3, n) from the sensor, by scratch: ``pixel`` (n,), the last one being nowhere,
    ``steps`` (n,) of range, and ``flat`` (turns * slopes + 1,)."""
    x, y, z = rows[0], rows[1], rows[2]
    turns, n = pixels.turns, np.uint64(len(x))
    slopes, nowhere = np.int32(pixels.slopes), np.int32(pixels.turns * pixels.slopes)
    for i in range(np.uint64(0), n):  # unsigned: an index that cannot be negative vectorises
        rho, a, b = _aim(x[i], y[i], z[i], pixels)
        pixel[i] = np.int32(a * slopes + b) if (rho >= NEAR_M) & (b >= 0) & (b < slopes) else nowhere
        steps[i] = np.int32(min(rho * PER_M + np.float32(0.5), np.float32(NOTHING - 1)))
    for i in range(np.uint64(0), np.uint64(len(flat))):
        flat[i] = NOTHING
    for i in range(np.uint64(0), n):
        here = np.uint64(pixel[i])
        flat[here] = min(flat[here], np.uint16(steps[i]))
    wide = np.uint64(pixels.slopes)
    for k in range(turns):
        left = np.uint64(k - 1 if k > 0 else turns - 1) * wide
        middle, right = np.uint64(k) * wide, np.uint64(k + 1 if k + 1 < turns else 0) * wide
        for s in range(np.uint64(0), wide):
            out[k, s] = min(flat[middle + s], min(flat[left + s], flat[right + s]))


def range_image(points: F64, origin: F64, pixels: Pixels) -> U16:
    """(turns, slopes) nearest horizontal range among the returns (n, 3) in each direction and to its left and right."""
    n, size = len(points), pixels.turns * pixels.slopes
    out, flat = np.empty((pixels.turns, pixels.slopes), np.uint16), np.empty(size + 1, np.uint16)
    _enter_image(rows_from(points, origin), pixels, np.empty(n, np.int32), np.empty(n, np.int32), flat, out)
    return out


class Sought(NamedTuple):
    """Where samples lie as one scan saw them, and what it saw there, (n,) each: scratch of :func:`look`."""

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


def room_to_look(n: int) -> Sought:
    """Scratch for :func:`look` at up to n samples."""
    steps, pixel, around = np.empty((3, n), np.int32)
    return Sought(steps, pixel, around, *np.empty((3, n), np.uint16))


BOTH_SIDES = np.uint8(3)
"""Rays passed below and above."""
_LEAST, _MOST = 2, 8
"""Pixels above and below that are read: at 8 m and beyond the fewest."""


@inlined
def _seek(samples: Samples, n: int, sensor: F32, pixels: Pixels, height_m: np.float32, sought: Sought) -> None:
    """Where the first ``n`` samples lie from the sensor: fills ``steps``, ``pixel`` and ``around``."""
    x, y, z, _ = samples
    steps, pixel, around = sought.steps, sought.pixel, sought.around
    near, slopes, reach = np.int32(NEAR_M * PER_M), np.int32(pixels.slopes), height_m * pixels.per_slope
    for i in range(np.uint64(0), np.uint64(n)):
        rho, a, b = _aim(x[i] - sensor[0], y[i] - sensor[1], z[i] - sensor[2], pixels)
        steps[i] = np.int32(rho * PER_M + np.float32(0.5))
        k = np.int32(min(max(reach / max(rho, NEAR_M), np.float32(_LEAST)), np.float32(_MOST)))
        inside = (steps[i] >= near) & (b >= k) & (b + k < slopes)
        pixel[i] = np.int32(a * slopes + b) if inside else np.int32(0)
        around[i] = k


@inlined
def _read(n: int, image: U16, sought: Sought) -> None:
    """The ranges at, below and above each sample's pixel. Most look no farther than _LEAST, so that the first loop is
    short: the more pixels it is after at once, the less it waits for memory."""
    here, below, above = sought.here, sought.below, sought.above
    for w in range(np.uint64(0), np.uint64(n)):
        p = np.uint64(max(sought.pixel[w], np.int32(_LEAST)))
        here[w] = image[p]
        below[w] = min(image[p - np.uint64(1)], image[p - np.uint64(2)])
        above[w] = min(image[p + np.uint64(1)], image[p + np.uint64(2)])
    for w in range(np.uint64(0), np.uint64(n)):
        p = np.uint64(sought.pixel[w])
        if (sought.around[w] > _LEAST) & (p > 0):
            for s in range(np.uint64(_LEAST + 1), np.uint64(sought.around[w] + 1)):
                below[w], above[w] = min(below[w], image[p - s]), min(above[w], image[p + s])


@kernel
def look(
    samples: Samples, n: int, image: U16, sensor: F32, pixels: Pixels, rule: tuple[float, float, int],
    counts: LookCounts, sought: Sought,
) -> int:  # fmt: skip
    """Ask one scan about the first ``n`` samples, by its range ``image``, flat.

    Counts go up in place; returns how many samples still wait.

    ``sensor`` (3,) where the scan was taken, from the samples' common point. ``rule``: (metres behind a place that a
    ray must end to have seen through it, metres above and below within which rays bear witness, enough > 0). A sample
    of which ``enough`` scans said the same, and none the contrary, waits no longer. No step has a branch that nobody
    could predict. ``sought``: scratch for ``n`` samples or more.
    """
    x, y, z, of = samples
    free, hit, sides = counts
    behind_m, height_m, enough = rule
    _seek(samples, n, sensor, pixels, np.float32(height_m), sought)
    _read(n, image, sought)
    margin, left = np.int32(behind_m * PER_M), np.uint64(0)
    for w in range(np.uint64(0), np.uint64(n)):
        below, above, steps = sought.below[w], sought.above[w], sought.steps[w]
        r = np.int32(min(sought.here[w], min(below, above)))
        known = (sought.pixel[w] > 0) & (r != np.int32(NOTHING)) & (r >= steps - margin)
        through = known & (r > steps + margin)
        low = np.uint8(1) if below < NOTHING else np.uint8(0)
        high = np.uint8(2) if above < NOTHING else np.uint8(0)
        i = np.uint64(of[w])
        x[left], y[left], z[left], of[left] = x[w], y[w], z[w], of[w]
        free[i] += 1 if through else 0
        hit[i] += 1 if known & ~through else 0
        sides[i] |= low | high if through else np.uint8(0)
        passed = (hit[i] == 0) & (free[i] >= enough) & (sides[i] == BOTH_SIDES)
        settled = passed | ((free[i] == 0) & (hit[i] >= enough))
        left += np.uint64(0) if settled else np.uint64(1)
    return int(left)
