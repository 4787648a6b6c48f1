"""Things that a map holds twice, a little apart: found without knowing where they are."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from mapvote.core.types import F64

_BIN_M = 0.05
_FEW = 1000
"""Fewer points show nothing."""
_CELL_M, _SIDE = 0.2, 640
"""A square of 128 m in cells of 0.2 m is looked at."""
_NEAREST_M, _FARTHEST_M = 1.0, 8.0
"""Nearer copies are lost in the thickness of the walls themselves."""
_PEAK = 5.3
"""Times the usual unevenness. Sound maps of streets give 2 at most, of 24 scans with side walls alike 4.7; copies
shifted by 1 to 5 m 6 to 20."""


def ghost_layer(height: F64) -> float | None:
    """How far above (+) or below the ground a second one lies, metres; None if there is none.

    ``height`` (n,) of points over the ground. A second road is as sharp a peak of their histogram as the first; kerbs,
    cars and hedges are broad.
    """
    if (np.abs(height) < 1.0).sum() < _FEW:
        return None
    count, edges = np.histogram(height[np.isfinite(height)], bins=np.arange(-2.5, 2.5, _BIN_M))
    peak = np.convolve(count, np.ones(3), mode="same")
    middle = 0.5 * (edges[1:] + edges[:-1])
    ground = float(peak[np.abs(middle) < 0.15].max())
    away = np.abs(middle) >= 0.35
    best = int(np.argmax(np.where(away, peak, 0)))
    around = np.abs(middle - middle[best])
    beside = float(np.median(peak[(around > 0.15) & (around < 0.4) & (np.abs(middle) > 0.15)]))
    return float(middle[best]) if peak[best] > 0.3 * ground and peak[best] > 2.0 * beside else None


def ghost_shift(standing: F64) -> tuple[float, float] | None:
    """(x, y) by which what stands is there twice, metres; None if it is not.

    ``standing`` (n, 3), points of walls and poles. Their picture from above is compared with itself, shifted: apart
    from no shift at all, and shifts along straight walls, only a copy makes a sharp peak.
    """
    if len(standing) < _FEW:
        return None
    centre = np.median(standing[:, :2], axis=0)
    cells = np.floor((standing[:, :2] - centre) / _CELL_M).astype(np.int64) + _SIDE // 2
    cells = cells[((cells >= 0) & (cells < _SIDE)).all(axis=1)]
    picture = np.zeros((_SIDE, _SIDE))
    picture[cells[:, 1], cells[:, 0]] = 1.0
    picture -= ndimage.uniform_filter(picture, 25)
    # Half of the whitening that would leave only phases: walls are like themselves all along, copies are not.
    spectrum = np.abs(np.fft.rfft2(picture, s=(2 * _SIDE, 2 * _SIDE)))
    likeness = np.fft.fftshift(np.fft.irfft2(spectrum))
    reach = int(_FARTHEST_M / _CELL_M)
    near = likeness[_SIDE - reach : _SIDE + reach + 1, _SIDE - reach : _SIDE + reach + 1]
    near = ndimage.uniform_filter(near, 3)
    usual = 1.4826 * float(np.median(np.abs(near - np.median(near))))
    # Only what rises above everything half a metre around it is a copy.
    ring = np.ones((7, 7), dtype=bool)
    ring[2:5, 2:5] = False
    sharp = near - ndimage.percentile_filter(near, 90, footprint=ring)
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1] * _CELL_M
    sharp[(np.hypot(x, y) < _NEAREST_M) | (near < ndimage.maximum_filter(near, 5))] = 0.0
    best = np.unravel_index(int(np.argmax(sharp)), sharp.shape)
    if sharp[best] < _PEAK * usual:
        return None
    return float(x[best]), float(y[best])
