"""Rays that went into the sky: no return came back, and all the same they passed through what is before it.

A sensor reports returns only. Yet in a direction in which the road and the walls answer, and above the highest of them
nothing does, whatever the beams up there met was farther off than they reach. That is asked of whole sectors, for
single beams are lost on glass, on dark paint and by chance; and between returns nothing is told, for the same reason.
Above a house that was pulled down, and where one was built, hardly any other ray goes by.
"""

from __future__ import annotations

import numpy as np

from mapvote.core.grid import CELL_SIZE
from mapvote.core.kernel import kernel
from mapvote.core.sensors import Sensor
from mapvote.core.types import F32, F64, I32
from mapvote.perception.fans import FANS, Rays

SECTORS = 256
"""In a turn: of 1.4 deg, 8 firings or so of each beam; the ones beside a sector must be as empty."""
ANSWERED = 0.25
"""Share of a sector's rays that must have a return: where fewer have, lost packets or the vehicle may be the cause."""
SKY_M = 60.0
"""Horizontal metres for which a ray into the sky is followed: to the corners of any window, and well within range."""
_EVERY = 2
"""Of the fans every second one: at 40 m they are .25 m apart."""


@kernel
def _highest(rays: Rays, lean: F64, least: float, top: F32, count: I32) -> None:
    """Into ``top`` (SECTORS,), from -inf, the steepest slope of a return in each, from the sensor's own plane; infinite
    where too few came. ``count`` (SECTORS,): scratch of zeros."""
    wide = FANS // SECTORS
    for i in range(np.uint64(0), np.uint64(len(rays.reach))):
        sector = np.uint64(rays.fan[i] // wide)
        slope = rays.slope[i] * np.float32(CELL_SIZE) + np.float32(rays.x[i] * lean[0] + rays.y[i] * lean[1])
        top[sector] = max(top[sector], slope)
        count[sector] += 1
    for s in range(SECTORS):
        if count[s] < least:
            top[s] = np.inf


_FAN = np.arange(0, FANS, _EVERY, dtype=np.int32)
_AZIMUTH = (_FAN + 0.5) * 2.0 * np.pi / FANS
_X, _Y = np.cos(_AZIMUTH).astype(np.float32), np.sin(_AZIMUTH).astype(np.float32)


def _into_sky(rays: Rays, slopes: F32, lean: F64, least: float) -> Rays:
    """Rays of the beams, of ascending ``slopes`` (beams,), that lie above all returns of their sector and its
    neighbours."""
    top = np.full(SECTORS, -np.inf, np.float32)
    _highest(rays, lean, least, top, np.zeros(SECTORS, np.int32))
    most = np.maximum(top, np.maximum(np.roll(top, 1), np.roll(top, -1)))
    above = np.minimum(np.searchsorted(slopes, most, side="right") + 1, len(slopes))  # the next one may have grazed it
    above = above[_FAN // (FANS // SECTORS)]
    some = len(slopes) - above
    of, room = np.repeat(np.arange(len(_FAN)), some), int(some.sum())
    beam = np.arange(room) - np.repeat(np.cumsum(some) - some - above, some)
    x, y = _X[of], _Y[of]
    slope = ((slopes[beam] - x * lean[0] - y * lean[1]) / CELL_SIZE).astype(np.float32)
    far = np.full(room, np.float32(SKY_M))
    return Rays(far, x, y, slope, far, _FAN[of])


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
