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


class _Sought(NamedTuple):
    """Where samples lie as one scan saw them, (n,) each."""

    steps: I32
    """Horizontal range."""
    pixel: I32
    """Index into the flat image; 0 where the image cannot tell."""
    around: I32
    """Pixels above and below within which rays bear witness."""


BOTH_SIDES = np.uint8(3)
"""Rays went through below and above."""
_UNTOLD, _THROUGH, _STRUCK = np.uint8(0), np.uint8(4), np.uint8(8)
"""What a scan says of a sample. With _THROUGH come the sides."""
_LEAST, _MOST = 2, 8
"""Pixels above and below that are looked at: at 8 m and beyond the least."""


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _seek(samples: Samples, n: int, sensor: F32, pixels: Pixels, height_m: np.float32) -> _Sought:
    x, y, z, _ = samples
    steps, pixel, around = np.empty(n, np.int32), np.empty(n, np.int32), np.empty(n, np.int32)
    near, slopes, reach = np.int32(NEAR_M * PER_M), np.int32(pixels.slopes), height_m * pixels.per_slope
    for i in range(np.uint64(0), np.uint64(n)):
        rho, a, b = _aim(x[i] - sensor[0], y[i] - sensor[1], z[i] - sensor[2], pixels)
        steps[i] = np.int32(rho * PER_M + np.float32(0.5))
        k = np.int32(min(max(reach / max(rho, NEAR_M), np.float32(_LEAST)), np.float32(_MOST)))
        inside = (steps[i] >= near) & (b >= k) & (b + k < slopes)
        pixel[i] = np.int32(a * slopes + b) if inside else np.int32(0)
        around[i] = k
    return _Sought(steps, pixel, around)


@numba.njit(cache=True, nogil=True)
def _read(sought: _Sought, nearest: U16) -> tuple[U16, U16, U16]:
    """(range at each sample's pixel, least range below it, and above). Most look no farther than _LEAST, so that the
    first loop is short: the more pixels it is after at once, the less it waits for memory."""
    n, image = np.uint64(len(sought.pixel)), nearest.ravel()
    here, below, above = np.empty(n, np.uint16), np.empty(n, np.uint16), np.empty(n, np.uint16)
    for w in range(n):
        p = np.uint64(max(sought.pixel[w], np.int32(_LEAST)))
        here[w] = image[p]
        below[w] = min(image[p - np.uint64(1)], image[p - np.uint64(2)])
        above[w] = min(image[p + np.uint64(1)], image[p + np.uint64(2)])
    for w in range(n):
        p = np.uint64(sought.pixel[w])
        if (sought.around[w] > _LEAST) & (p > 0):
            for s in range(np.uint64(_LEAST + 1), np.uint64(sought.around[w] + 1)):
                below[w], above[w] = min(below[w], image[p - s]), min(above[w], image[p + s])
    return here, below, above


@numba.njit(cache=True, nogil=True)
def _tell(sought: _Sought, nearest: U16, margin: np.int32) -> U8:
    """(n,) what a scan says of each sample: none of it by a branch, which nobody could foresee."""
    here, below, above = _read(sought, nearest)
    told = np.empty(len(here), np.uint8)
    for w in range(np.uint64(0), np.uint64(len(here))):
        r, steps = np.int32(min(here[w], min(below[w], above[w]))), sought.steps[w]
        known = (sought.pixel[w] > 0) & (r != np.int32(NOTHING)) & (r >= steps - margin)
        low = np.uint8(1) if below[w] < NOTHING else np.uint8(0)
        high = np.uint8(2) if above[w] < NOTHING else np.uint8(0)
        through, struck = low | high | _THROUGH, _STRUCK if known else _UNTOLD
        told[w] = through if known & (r > steps + margin) else struck
    return told


@numba.njit(cache=True, nogil=True)
def look(
    samples: Samples, n: int, nearest: U16, sensor: F32, pixels: Pixels, rule: tuple[float, float, int], counts: Counts
) -> int:
    """Ask one scan about the first ``n`` samples. Counts go up in place; returns how many samples still wait.

    ``sensor`` (3,) where the scan was taken, from the samples' common point. ``rule``: (metres behind a place that a
    ray must end to have seen through it, metres above and below within which rays bear witness, enough > 0). A sample
    of which ``enough`` scans said the same, and none the contrary, waits no longer.
    """
    x, y, z, of = samples
    free, hit, sides = counts
    told = _tell(_seek(samples, n, sensor, pixels, np.float32(rule[1])), nearest, np.int32(rule[0] * PER_M))
    enough, left = rule[2], np.uint64(0)
    for w in range(np.uint64(0), np.uint64(n)):
        i = np.uint64(of[w])
        x[left], y[left], z[left], of[left] = x[w], y[w], z[w], of[w]
        free[i] += 1 if told[w] & _THROUGH else 0
        hit[i] += 1 if told[w] & _STRUCK else 0
        sides[i] |= told[w] & BOTH_SIDES
        through = (hit[i] == 0) & (free[i] >= enough) & (sides[i] == BOTH_SIDES)
        settled = through | ((free[i] == 0) & (hit[i] >= enough))
        left += np.uint64(0) if settled else np.uint64(1)
    return int(left)
