"""Rays that went into the sky: no return came back, and all the same they passed through what is before it.

A sensor reports returns only. Yet in a direction in which the road and the walls answer, and above the highest of them
nothing does, whatever the beams up there met was farther off than they reach. That is asked of whole sectors, for
single beams are lost on glass, on dark paint and by chance; and between returns nothing is told, for the same reason.
Above a house that was pulled down, and where one was built, hardly any other ray goes by.
"""

from __future__ import annotations

import numba
import numpy as np

from mapvote.core.grid import CELL_SIZE
from mapvote.core.sensors import Sensor
from mapvote.core.types import F32, F64
from mapvote.perception.fans import FANS, Rays

SECTORS = 256
"""In a turn: of 1.4 deg, 8 firings or so of each beam; the ones beside a sector must be as empty."""
ANSWERED = 0.25
"""Share of a sector's rays that must have a return: where fewer have, lost packets or the vehicle may be the cause."""
SKY_M = 60.0
"""Horizontal metres for which a ray into the sky is followed: to the corners of any window, and well within range."""
_EVERY = 2
"""Of the fans every second one: at 40 m they are .25 m apart."""


@numba.njit(cache=True, nogil=True)
def _highest(rays: Rays, lean: F64, least: float) -> F32:
    """(SECTORS,) the steepest slope of a return in each, from the sensor's own plane; infinite where too few came."""
    wide = FANS // SECTORS
    top, count = np.full(SECTORS, -np.inf, np.float32), np.zeros(SECTORS, np.int32)
    for i in range(np.uint64(0), np.uint64(len(rays.reach))):
        sector = np.uint64(rays.fan[i] // wide)
        slope = rays.slope[i] * np.float32(CELL_SIZE) + np.float32(rays.x[i] * lean[0] + rays.y[i] * lean[1])
        top[sector] = max(top[sector], slope)
        count[sector] += 1
    for s in range(SECTORS):
        if count[s] < least:
            top[s] = np.inf
    return top


@numba.njit(cache=True, nogil=True)
def _into_sky(rays: Rays, slopes: F32, lean: F64, least: float) -> Rays:
    top, wide, beams = _highest(rays, lean, least), FANS // SECTORS, len(slopes)
    above = np.empty(SECTORS, np.int32)
    room = 0
    for s in range(SECTORS):
        most = max(top[s], max(top[s - 1], top[(s + 1) % SECTORS]))
        above[s] = min(np.searchsorted(slopes, most, side="right") + 1, beams)  # the next one may have grazed it
        room += (beams - above[s]) * wide // _EVERY
    x, y, slope = np.empty(room, np.float32), np.empty(room, np.float32), np.empty(room, np.float32)
    fan = np.empty(room, np.int32)
    k = 0
    for s in range(SECTORS):
        for f in range(s * wide, (s + 1) * wide, _EVERY):
            azimuth = (f + 0.5) * 2.0 * np.pi / FANS
            for b in range(above[s], beams):
                x[k], y[k], fan[k] = np.cos(azimuth), np.sin(azimuth), f
                slope[k] = (slopes[b] - x[k] * lean[0] - y[k] * lean[1]) / CELL_SIZE
                k += 1
    far = np.full(room, np.float32(SKY_M))
    return Rays(far, x, y, slope, far, fan)


class Sky:
    """Above which elevations a sensor's rays went into the sky."""

    def __init__(self, sensor: Sensor) -> None:
        beams = sorted(sensor.elevations_deg) if sensor.rings else []  # elsewhere nobody knows where a ray went
        self._slopes = np.tan(np.radians(beams)).astype(np.float32)
        self._least = ANSWERED * len(beams) * sensor.azimuths / SECTORS

    def rays(self, up_map: F64, rays: Rays) -> Rays:
        """Those of a scan that went into the sky, by ``rays``, those that came back. ``up_map`` (3,): the sensor's own
        upward axis in their frame, which may lean some degrees."""
        return _into_sky(rays, self._slopes, up_map[:2] / up_map[2], self._least)
