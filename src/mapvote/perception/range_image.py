"""Range images of scans, and looks into them: did a scan see through a place, did it hit it, or neither?

Where something lies from a sensor is worked out for all points first, in float32 from the sensor, in loops without a
branch that vectorise; then each point is entered, or asked for.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from mapvote.core.geometry import rows_from, turn
from mapvote.core.types import F32, F64, I32, U8

U16 = NDArray[np.uint16]
PER_M = np.float32(500.0)
"""Ranges are held in steps of 2 mm, up to 131 m."""
NOTHING = np.uint16(65535)
"""Of a range image: no return in that direction."""
NEAR_M = np.float32(0.5)
"""What is nearer than this to the sensor in the plane has no direction to speak of."""


class Pixels(NamedTuple):
    """How directions are divided: by azimuth, and by height over horizontal range."""

    turns: int
    """Pixels in a turn."""
    slopes: int
    slope_min: np.float32
    per_slope: np.float32
    """Pixels for a slope of 1."""


class Samples(NamedTuple):
    """Places that are asked about, metres from a common point; compacted in place as they are settled."""

    x: F32
    """(m,)"""
    y: F32
    z: F32
    of: I32
    """(m,) which of the counts each place belongs to."""


class Counts(NamedTuple):
    """What scans said of each place, (m,) each."""

    free: I32
    """Scans that saw through it."""
    hit: I32
    sides: U8
    """Whether a ray went through below (1) and above (2): a ray that only ever passes over a roof proves nothing about
    the roof."""


@numba.njit(inline="always", error_model="numpy")
def _aim(x: np.float32, y: np.float32, z: np.float32, pixels: Pixels) -> tuple[np.float32, np.int32, np.int32]:
    """(horizontal range, azimuth pixel, slope pixel: -1 or ``slopes`` outside) of a place from the sensor."""
    rho = np.sqrt(x * x + y * y)
    row = np.floor((z / max(rho, NEAR_M) - pixels.slope_min) * pixels.per_slope)
    b = np.int32(min(max(row, np.float32(-1.0)), np.float32(pixels.slopes)))
    return rho, min(np.int32(turn(x, y) * np.float32(pixels.turns)), np.int32(pixels.turns - 1)), b


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _pixels_of(rows: F32, pixels: Pixels) -> tuple[I32, I32]:
    """(pixel (n,), range (n,) in steps) of places (3, n) from the sensor; one pixel past the last is nowhere."""
    x, y, z = rows[0], rows[1], rows[2]
    n, slopes, nowhere = len(x), np.int32(pixels.slopes), np.int32(pixels.turns * pixels.slopes)
    pixel, steps = np.empty(n, np.int32), np.empty(n, np.int32)
    for i in range(np.uint64(0), np.uint64(n)):  # unsigned: an index that cannot be negative vectorises
        rho, a, b = _aim(x[i], y[i], z[i], pixels)
        pixel[i] = np.int32(a * slopes + b) if (rho >= NEAR_M) & (b >= 0) & (b < slopes) else nowhere
        steps[i] = np.int32(min(rho * PER_M + np.float32(0.5), np.float32(NOTHING - 1)))
    return pixel, steps


@numba.njit(cache=True, nogil=True)
def range_image(points: F64, origin: F64, pixels: Pixels) -> U16:
    """(turns, slopes) nearest horizontal range among the returns (n, 3) in each direction and to its left and right."""
    pixel, steps = _pixels_of(rows_from(points, origin), pixels)
    turns, slopes = pixels.turns, pixels.slopes
    flat = np.full(turns * slopes + 1, NOTHING, dtype=np.uint16)
    for i in range(np.uint64(0), np.uint64(len(pixel))):
        here = np.uint64(pixel[i])
        flat[here] = min(flat[here], np.uint16(steps[i]))
    alone = flat[:-1].reshape((turns, slopes))
    out = np.empty_like(alone)
    for k in range(turns):
        left, here, right = alone[k - 1], alone[k], alone[k + 1 if k + 1 < turns else 0]
        for s in range(np.uint64(0), np.uint64(slopes)):
            out[k, s] = min(here[s], min(left[s], right[s]))
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def look(
    samples: Samples, n: int, nearest: U16, sensor: F32, pixels: Pixels, rule: tuple[float, float, int], counts: Counts
) -> int:
    """Ask one scan about the first ``n`` samples. Counts go up in place; returns how many samples still wait.

    ``sensor`` (3,) where the scan was taken, from the samples' common point. ``rule``: (metres behind a place that a
    ray must end to have seen through it, metres above and below within which rays bear witness, enough). A sample of
    which ``enough`` scans said the same, and none the contrary, waits no longer.
    """
    x, y, z, of = samples
    free, hit, sides = counts
    rho, a, b, around = np.empty(n, np.int32), np.empty(n, np.int32), np.empty(n, np.int32), np.empty(n, np.int32)
    reach = np.float32(rule[1]) * pixels.per_slope
    for i in range(np.uint64(0), np.uint64(n)):
        h, a[i], b[i] = _aim(x[i] - sensor[0], y[i] - sensor[1], z[i] - sensor[2], pixels)
        rho[i] = np.int32(h * PER_M + np.float32(0.5))
        around[i] = np.int32(min(max(reach / max(h, NEAR_M), np.float32(2.0)), np.float32(8.0)))
    near, margin, enough, left = np.int32(NEAR_M * PER_M), np.int32(rule[0] * PER_M), rule[2], 0
    for w in range(n):
        i, row, k = of[w], b[w], around[w]
        x[left], y[left], z[left], of[left] = x[w], y[w], z[w], i
        left += 1
        if rho[w] < near or row < k or row + k >= pixels.slopes:
            continue
        below, above = NOTHING, NOTHING
        for s in range(1, k + 1):
            below, above = min(below, nearest[a[w], row - s]), min(above, nearest[a[w], row + s])
        r = min(nearest[a[w], row], min(below, above))
        if r == NOTHING or r < rho[w] - margin:
            continue
        if r > rho[w] + margin:
            free[i] += 1
            sides[i] |= (1 if below < NOTHING else 0) | (2 if above < NOTHING else 0)
        else:
            hit[i] += 1
        if (free[i] == 0 and hit[i] >= enough) or (hit[i] == 0 and free[i] >= enough and sides[i] == 3):
            left -= 1
    return left
