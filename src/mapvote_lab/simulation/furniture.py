"""What stands along a kerb: trees, poles, signs, guard rails, shelters, boxes. Local frame: x along the street,
y away from the road, z up from the ground; the middle of the foot at the origin.
"""

from __future__ import annotations

import numpy as np

from mapvote.core.types import F64
from mapvote_lab.simulation.shapes import box, cylinder, foliage, join, place


def tree(rng: np.random.Generator) -> F64:
    """A street tree: trunk and a crown that lets some rays pass."""
    trunk, crown = rng.uniform(2.2, 3.0), rng.uniform(1.4, 2.4)
    half = (crown, crown * rng.uniform(0.7, 0.95), rng.uniform(1.2, 2.2))
    leaves = foliage(rng, half, trunk + 0.8 * half[2], int(55 * crown**2), 0.28)
    return join([cylinder(rng.uniform(0.09, 0.2), -0.5, trunk + half[2], 7), leaves])


def pole(rng: np.random.Generator) -> F64:
    """A street lamp: a mast and an arm over the carriageway."""
    height = rng.uniform(6.5, 9.0)
    return join([cylinder(0.11, -0.5, height, 8, 0.07), box(-0.06, 0.06, -2.2, 0.0, height - 0.15, height)])


def sign(rng: np.random.Generator) -> F64:
    """A traffic sign facing along the street."""
    height = rng.uniform(2.0, 3.2)
    return join([cylinder(0.04, -0.5, height, 6), box(-0.02, 0.02, -0.32, 0.32, height - 0.65, height)])


def rail(length: float) -> F64:
    """A guard rail with posts, x from 0 to ``length``."""
    posts = [box(x - 0.06, x + 0.06, -0.06, 0.06, -0.3, 0.8) for x in np.arange(0.0, length + 0.01, 2.0)]
    return join([box(0, length, -0.04, 0.04, 0.45, 0.78), *posts])


def street_box(rng: np.random.Generator) -> F64:
    """A bench, a switch cabinet, a row of bollards or a bus shelter."""
    kind = rng.choice(["bench", "cabinet", "bollards", "shelter"], p=[0.3, 0.35, 0.25, 0.1])
    if kind == "bench":
        return join(
            [
                box(-0.8, 0.8, -0.2, 0.2, 0.38, 0.46),
                box(-0.8, 0.8, 0.2, 0.26, 0.4, 0.9),
                box(-0.7, -0.6, -0.2, 0.2, 0, 0.4),
            ]
        )
    if kind == "cabinet":
        return box(-0.4, 0.4, -0.2, 0.2, -0.2, rng.uniform(0.9, 1.5))
    if kind == "bollards":
        return join([place(cylinder(0.07, -0.2, 0.85, 6), x, 0, 0) for x in (-3.0, -1.5, 0.0, 1.5, 3.0)])
    roof = box(-2.0, 2.0, -0.7, 0.8, 2.4, 2.5)
    return join(
        [
            roof,
            box(-2.0, 2.0, 0.74, 0.8, 0.2, 2.4),
            box(-2.0, -1.94, -0.4, 0.8, 0.2, 2.4),
            box(-1.2, 1.2, 0.3, 0.7, 0.4, 0.5),
        ]
    )


def gantry(half_span: float) -> F64:
    """An overhead sign gantry across the whole road, y from -half_span to half_span."""
    posts = [box(-0.15, 0.15, y - 0.15, y + 0.15, -0.5, 6.3) for y in (-half_span, half_span)]
    plates = [box(-0.25, -0.18, y - 1.6, y + 1.6, 5.1, 6.9) for y in (-4.0, 4.0)]
    return join([*posts, box(-0.15, 0.15, -half_span, half_span, 5.7, 6.1), *plates])
