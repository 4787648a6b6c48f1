"""How far a scan saw, cell by cell: a walk along every fan of rays to the edge of the window (paper III-A)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mapvote.core.grid import CELL_SIZE
from mapvote.core.kernel import kernel
from mapvote.core.types import F32, F64, U8
from mapvote.perception.fans import FANS, Fans, Rays, set_out


def mark_sight(
    rays: Rays, obstacle: NDArray[np.bool_], fans: Fans, origin: F64, corner: tuple[float, float], sight: U8
) -> None:
    """Walk every fan from the sensor to the edge of the window, and enter how far it sees into ``sight``."""
    nearest, farthest = np.full(FANS, np.inf, np.float32), np.zeros(FANS, np.float32)
    _mark_sight(rays, obstacle, fans.direction, origin, corner, sight, nearest, farthest)


@kernel
def _mark_sight(
    rays: Rays, obstacle: NDArray[np.bool_], direction: F64, origin: F64, corner: tuple[float, float], sight: U8,
    nearest: F32, farthest: F32,
) -> None:  # fmt: skip
    rows, cols = sight.shape
    x, y = (origin[0] - corner[0]) / CELL_SIZE, (origin[1] - corner[1]) / CELL_SIZE
    for i in range(len(rays.reach)):
        h, f = rays.reach[i], rays.fan[i]
        if h >= CELL_SIZE:
            farthest[f] = max(farthest[f], h)
            nearest[f] = min(nearest[f], h if obstacle[i] else np.float32(np.inf))
    for f in range(FANS):
        if farthest[f] == 0.0:
            continue
        dx, dy = direction[f]
        step_r, step_c = (1 if dy > 0 else -1), (1 if dx > 0 else -1)
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
