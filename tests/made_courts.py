"""Clouds of a small made-up court: ground, walls, hedges, poles and boxes, as two surveys of it would have them."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from mapvote.core.types import F64

Box = tuple[float, float, float, float, float]
"""x0, y0, x1, y1, height, metres."""
WALLS: tuple[Box, ...] = (
    (-30.0, -22.0, 31.0, -21.8, 8.0),
    (-30.0, 24.0, 8.0, 24.2, 6.0),
    (-31.0, -22.0, -30.8, 15.0, 5.0),
    (33.0, -10.0, 33.2, 24.0, 7.0),
    (12.0, 19.0, 26.0, 19.2, 4.0),
)
_PLACES = np.random.default_rng(7).uniform((-29.0, -20.0, 0.8), (32.0, 23.0, 4.0), (30, 3))
POSTS: tuple[Box, ...] = tuple((x, y, x + 0.3, y + 0.3, height) for x, y, height in _PLACES.tolist())
CARS: tuple[Box, ...] = (
    (-20.0, -17.0, -15.6, -15.2, 1.5),
    (-11.0, -17.0, -6.6, -15.2, 1.6),
    (3.0, 16.0, 7.5, 17.8, 1.5),
    (20.0, -16.0, 22.0, -11.5, 1.9),
    (-24.0, 2.0, -22.1, 6.4, 1.5),
    (14.0, 3.0, 14.4, 3.4, 4.0),
    (-4.0, 5.0, -3.6, 5.4, 5.0),
    (25.0, 8.0, 25.4, 8.4, 4.5),
)


def made_court(boxes: tuple[Box, ...] = CARS, *, seed: int = 1, spacing_m: float = 0.17, noise_m: float = 0.015) -> F64:
    """(n, 3) points on the ground (a gentle slope, but for what stands on it), the walls and the ``boxes``."""
    rng = np.random.default_rng(seed)
    step = np.arange(-33.0, 35.0, spacing_m)
    x, y = (grid.ravel() for grid in np.meshgrid(step, step[(step > -25) & (step < 26)]))
    under = np.zeros(len(x), dtype=np.bool_)
    for x0, y0, x1, y1, _ in boxes:
        under |= (x > x0) & (x < x1) & (y > y0) & (y < y1)
    parts = [np.column_stack([x, y, np.zeros_like(x)])[~under]]
    for x0, y0, x1, y1, height in (*WALLS, *POSTS, *boxes):
        z = np.arange(0.1, height, spacing_m)
        around = [
            *((u, v) for u in np.arange(x0, x1, spacing_m) for v in (y0, y1)),
            *((u, v) for v in np.arange(y0, y1, spacing_m) for u in (x0, x1)),
        ]
        parts.append(np.column_stack([np.repeat(around, len(z), axis=0), np.tile(z, len(around))]))
    points = np.concatenate(parts)
    points[:, :2] += rng.uniform(-spacing_m / 2, spacing_m / 2, (len(points), 2)) * (points[:, 2:] == 0)
    points = points[rng.random(len(points)) < 0.9] + 0.0
    points[:, 2] += 0.01 * points[:, 0] + 0.005 * points[:, 1]
    return np.asarray(points + rng.normal(0.0, noise_m, points.shape))


def court_clouds() -> Path:
    """The folder of the real court's clouds in one frame, as docs/diff.md says how to make it; skips where absent."""
    folder = os.environ.get("MAPVOTE_COURT")
    if not folder or not (Path(folder) / "gtmap.pcd").is_file():
        pytest.skip("no real court: MAPVOTE_COURT does not name a folder with gtmap.pcd (docs/diff.md)")
    return Path(folder)
