"""Buildings with facades as streets have them: recesses, balconies, awnings, signs, roofs.

Local frame of a plot: u along the street from 0 to ``width``, v away from the road from 0 (the facade line),
z up from the sidewalk.
"""

from __future__ import annotations

import numpy as np

from mapvote.core.types import F64
from mapvote_lab.simulation.shapes import box, join, taper

FOOT_M = -1.2
"""Walls reach below the ground so that no gap opens on slopes."""


def building(rng: np.random.Generator, width: float, depth: float, height: float) -> F64:
    """One building, (n, 3, 3) triangles in the plot's frame. ``height`` of the eaves, metres."""
    parts = _walls(rng, width, depth, height) + _roof(rng, width, depth, height)
    floors = int(height // 3.0)
    if rng.uniform() < 0.45:
        parts += _awning(rng, width)
    if floors >= 2 and rng.uniform() < 0.5:
        parts += _balconies(rng, width, floors)
    if rng.uniform() < 0.4:  # a sign that juts out over the sidewalk
        u, z = rng.uniform(0.5, width - 0.7), rng.uniform(2.8, max(2.9, height - 2.0))
        parts.append(box(u, u + 0.15, -0.9, 0.0, z, min(z + 1.6, height)))
    if rng.uniform() < 0.5:  # steps, a vending machine, flower boxes
        u = rng.uniform(0.3, width - 1.8)
        parts.append(box(u, u + rng.uniform(0.8, 1.5), -rng.uniform(0.4, 0.9), 0.0, FOOT_M, rng.uniform(0.45, 1.8)))
    return join(parts)


def _walls(rng: np.random.Generator, width: float, depth: float, height: float) -> list[F64]:
    """The body, with an entrance recess or a stepped facade in most buildings."""
    kind = rng.choice(["plain", "recess", "step", "arcade"], p=[0.3, 0.35, 0.2, 0.15])
    if kind == "plain" or width < 7.0:
        return [box(0, width, 0, depth, FOOT_M, height)]
    if kind == "recess":
        left, right = rng.uniform(0.25, 0.4) * width, rng.uniform(0.6, 0.75) * width
        back = rng.uniform(0.6, 1.8)
        return [
            box(0, left, 0, depth, FOOT_M, height),
            box(right, width, 0, depth, FOOT_M, height),
            box(left, right, back, depth, FOOT_M, height),
        ]
    if kind == "step":
        split, back = rng.uniform(0.35, 0.65) * width, rng.uniform(0.8, 2.5)
        return [
            box(0, split, 0, depth, FOOT_M, height),
            box(split, width, back, depth, FOOT_M, height * rng.uniform(0.6, 1)),
        ]
    pillars = [
        box(u - 0.2, u + 0.2, 0, 0.4, FOOT_M, 3.0) for u in np.linspace(0.2, width - 0.2, max(2, int(width // 3.5)))
    ]
    return [box(0, width, 1.8, depth, FOOT_M, 3.0), box(0, width, 0, depth, 3.0, height), *pillars]


def _roof(rng: np.random.Generator, width: float, depth: float, height: float) -> list[F64]:
    if height > 9.0 or rng.uniform() < 0.5:  # flat, with a parapet or a plant room
        u, v = rng.uniform(0.2, 0.5) * width, rng.uniform(0.3, 0.5) * depth
        return [box(u, u + 0.3 * width, v, v + 0.3 * depth, height, height + 2.2)]
    over, rise = rng.uniform(0.2, 0.6), rng.uniform(1.2, 2.8)
    ridge = 0.5 * depth
    return [
        taper(
            (-over, width + over, -over, depth + over, height),
            (0.5, width - 0.5, ridge - 0.1, ridge + 0.1, height + rise),
        )
    ]


def _awning(rng: np.random.Generator, width: float) -> list[F64]:
    """A roof over the shop front: the map has points there only high above the ground."""
    u0, u1 = rng.uniform(0.0, 0.3) * width, rng.uniform(0.65, 1.0) * width
    reach, z = rng.uniform(0.9, 1.9), rng.uniform(2.4, 3.1)
    return [taper((u0, u1, -reach, 0.0, z), (u0, u1, -0.3, 0.0, z + 0.6))]


def _balconies(rng: np.random.Generator, width: float, floors: int) -> list[F64]:
    """Slabs with solid parapets, the same on every upper floor."""
    reach = rng.uniform(0.8, 1.4)
    count = max(1, int(width // 6.0))
    slots = np.linspace(0.0, width, count + 1)
    parts = []
    for floor in range(1, floors):
        z = 3.0 * floor + 0.1
        for left, right in zip(slots[:-1] + 0.7, slots[1:] - 0.7, strict=True):
            parts += [box(left, right, -reach, 0, z - 0.15, z), box(left, right, -reach, -reach + 0.1, z, z + 1.0)]
    return parts
