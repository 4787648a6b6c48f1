"""The ground: slopes, crowned carriageways, kerbs, sidewalks, plots. One height function, one mesh of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from mapvote.core.types import F64
from mapvote_lab.simulation.scenario import Scenario

KERB_M = 9.2
"""From the road's axis to the kerb: two lanes of 3.5 m and a parking strip of 2.2 m."""
SIDEWALK_M = 12.4
"""From the road's axis to the outer edge of the sidewalk."""
KERB_HEIGHT_M = 0.15
MARGIN_M = 80.0
"""The world goes on beyond the scored window: rays must not fall off its edge."""


@dataclass(frozen=True)
class Terrain:
    """Height over map coordinates: z in metres, smooth apart from the kerbs."""

    axis_y: float
    crossing_x: float | None
    length: float
    crown: float
    waves: F64
    """(k, 4) amplitude (m), wave numbers along x and y (1/m), phase."""

    def road_distance(self, x: ArrayLike, y: ArrayLike) -> F64:
        """Distance from the nearest road axis, metres."""
        across = np.abs(np.asarray(y, dtype=np.float64) - self.axis_y)
        if self.crossing_x is None:
            return across + 0.0 * np.asarray(x)
        return np.minimum(across, np.abs(np.asarray(x, dtype=np.float64) - self.crossing_x))

    def height(self, x: ArrayLike, y: ArrayLike) -> F64:
        """z of the ground at map (x, y), broadcast."""
        x, y = np.broadcast_arrays(np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64))
        distance = self.road_distance(x, y)
        z = np.where(distance < KERB_M, -self.crown * distance, -self.crown * KERB_M + KERB_HEIGHT_M)
        z = z + 0.015 * np.clip(distance - KERB_M, 0.0, 25.0)
        for amplitude, kx, ky, phase in self.waves:
            z = z + amplitude * np.sin(kx * x + ky * y + phase)
        return z

    def triangles(self) -> F64:
        """The ground as a mesh that follows :meth:`height`, kerbs included."""
        xs = np.arange(-MARGIN_M, self.length + MARGIN_M + 1.0, 2.0)
        # The gutter is just within the kerb: on it, rounding would decide whether the road or the sidewalk is there.
        side = np.array([3.5, KERB_M - 0.005, KERB_M + 0.005, SIDEWALK_M])
        kerb = np.concatenate([-side[::-1], [0.0], side])
        plots = np.array([18.0, 25.0, 34.2, 45.0, 60.0, 80.0])
        ys = self.axis_y + np.concatenate([-plots, kerb, plots])
        if self.crossing_x is not None:
            xs = np.unique(np.concatenate([xs, self.crossing_x + kerb]))
            ys = np.concatenate([ys, self.axis_y + np.arange(-78.0, 79.0, 4.0)])
        ys = np.unique(ys)
        gx, gy = np.meshgrid(xs, ys)
        grid = np.stack([gx, gy, self.height(gx, gy)], axis=-1)
        a, b, c, d = grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]
        return np.concatenate([np.stack([a, b, c], axis=-2), np.stack([a, c, d], axis=-2)]).reshape(-1, 3, 3)


def make_terrain(scenario: Scenario, rng: np.random.Generator) -> Terrain:
    """Seeded waves whose grades add up to at most ``scenario.max_grade`` along the road."""
    lengths = np.array([rng.uniform(250, 400), rng.uniform(90, 150)])
    shares = np.array([0.7, 0.3])
    kx = 2 * np.pi / lengths
    waves = np.column_stack([scenario.max_grade * shares / kx, kx, 0.1 * kx, rng.uniform(0, 2 * np.pi, 2)])
    return Terrain(0.5 * scenario.width_m, scenario.crossing_m, scenario.length_m, scenario.crown, waves)
