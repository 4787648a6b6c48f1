"""Triangles of simple solids and of what a street is made of: (n, 3, 3) float64 arrays, metres.

Along a kerb (trees, poles, signs, guard rails, shelters, boxes) x runs along the street, y away from the road, z up
from the ground; the middle of the foot is the origin. On a plot (buildings with recesses, balconies, awnings, roofs)
u runs along the street from 0 to ``width``, v away from the road from 0 (the facade line), z up from the sidewalk.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mapvote.core.types import F64


def join(parts: Sequence[F64]) -> F64:
    """All triangles of ``parts`` in one array; (0, 3, 3) if there are none."""
    return np.concatenate(parts) if parts else np.zeros((0, 3, 3))


def box(x0: float, x1: float, y0: float, y1: float, z0: float, z1: float) -> F64:
    """An axis-aligned box, 12 triangles."""
    return taper((x0, x1, y0, y1, z0), (x0, x1, y0, y1, z1))


def taper(low: tuple[float, float, float, float, float], high: tuple[float, float, float, float, float]) -> F64:
    """A frustum between two rectangles (x0, x1, y0, y1, z), 12 triangles: cabins, roofs, wedges."""
    corners = np.array([[r[i], r[2 + j], r[4]] for i in (0, 1) for j in (0, 1) for r in (low, high)])
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    return corners[np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])]


def cylinder(radius: float, z0: float, z1: float, sides: int = 8, top_radius: float | None = None) -> F64:
    """An upright cylinder or cone frustum around the z axis, closed on top."""
    angle = np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False)
    ring = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(sides)])
    low = ring * radius + [0, 0, z0]
    high = ring * (radius if top_radius is None else top_radius) + [0, 0, z1]
    low2 = np.roll(low, -1, axis=0)
    high2 = np.roll(high, -1, axis=0)
    centre = np.broadcast_to([0.0, 0.0, z1], low.shape)
    faces = [[low, low2, high2], [low, high2, high], [high, high2, centre]]
    return np.concatenate([np.stack(face, axis=1) for face in faces])


def foliage(
    rng: np.random.Generator, half: tuple[float, float, float], centre_z: float, leaves: int, size: float
) -> F64:
    """Random leaf triangles in an ellipsoid of half axes ``half`` around (0, 0, centre_z): rays pass between them."""
    direction = rng.normal(size=(leaves, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    radius = rng.uniform(0.3, 1.0, size=(leaves, 1)) ** 0.5
    centres = direction * radius * np.array(half) + [0.0, 0.0, centre_z]
    return centres[:, None, :] + rng.uniform(-size, size, size=(leaves, 3, 3))


def hedge(rng: np.random.Generator, length: float, width: float, height: float) -> F64:
    """A leafy box from x = 0 to ``length``, y around 0, z from the ground."""
    leaves = int(60 * length * max(height, 0.5))
    low = [0.0, -0.5 * width, 0.05]
    high = [length, 0.5 * width, height]
    return rng.uniform(low, high, size=(leaves, 3))[:, None, :] + rng.uniform(-0.12, 0.12, size=(leaves, 3, 3))


def car(length: float = 4.4, width: float = 1.8, height: float = 1.5) -> F64:
    """A saloon, x forward, centred, wheels at z = 0."""
    waist = 0.58 * height
    l2 = 0.5 * length
    w2 = 0.5 * width
    body = taper((-l2, l2, -w2, w2, 0.2), (-l2 + 0.1, l2 - 0.15, -w2 + 0.05, w2 - 0.05, waist))
    cabin = taper(
        (-0.92 * l2, 0.45 * l2, -w2 + 0.08, w2 - 0.08, waist), (-0.7 * l2, 0.1 * l2, -w2 + 0.2, w2 - 0.2, height)
    )
    wheels = [
        box(s * 0.62 * l2 - 0.3, s * 0.62 * l2 + 0.3, side * w2 - 0.12, side * w2 + 0.02, 0.0, 0.6)
        for s in (-1, 1)
        for side in (-0.95, 0.95)
    ]
    return join([body, cabin, *wheels])


def van(length: float = 5.6, width: float = 2.0, height: float = 2.4) -> F64:
    """A delivery van or small lorry, x forward."""
    l2 = 0.5 * length
    w2 = 0.5 * width
    cargo = box(-l2, 0.5 * l2, -w2, w2, 0.35, height)
    front = taper((0.5 * l2, l2, -w2, w2, 0.3), (0.5 * l2, 0.75 * l2, -w2 + 0.1, w2 - 0.1, 0.9 * height))
    return join([cargo, front])


def bus(length: float = 10.5, width: float = 2.5, height: float = 3.1) -> F64:
    """A city bus, x forward."""
    return box(-0.5 * length, 0.5 * length, -0.5 * width, 0.5 * width, 0.3, height)


def pedestrian(height: float = 1.7) -> F64:
    """A walker: two legs, a trunk, a head."""
    legs = [box(-0.1, 0.1, y - 0.08, y + 0.08, 0.0, 0.48 * height) for y in (-0.11, 0.11)]
    trunk = box(-0.14, 0.14, -0.23, 0.23, 0.48 * height, 0.86 * height)
    return join([*legs, trunk, box(-0.1, 0.1, -0.09, 0.09, 0.86 * height, height)])


def two_wheeler(height: float = 1.7, motor: bool = False) -> F64:
    """A cyclist or, heavier, a motorcyclist; x forward."""
    half = 0.16 if motor else 0.05
    frame = box(-0.85, 0.85, -half, half, 0.05, 0.95)
    return join(
        [frame, box(-0.35, 0.2, -0.22, 0.22, 0.7, 0.86 * height), box(-0.1, 0.12, -0.1, 0.1, 0.86 * height, height)]
    )


def place(triangles: F64, x: float, y: float, z: float, yaw: float = 0.0) -> F64:
    """Turn by ``yaw`` (radians, counter-clockwise) and move."""
    c = np.cos(yaw)
    s = np.sin(yaw)
    return triangles @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) + [x, y, z]


def sample(triangles: F64, spacing: float, rng: np.random.Generator) -> F64:
    """(m, 3) random points on the triangles, about one per ``spacing`` squared."""
    edges = triangles[:, 1:] - triangles[:, :1]
    area = 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    which = np.repeat(np.arange(len(triangles)), rng.poisson(area / spacing**2))
    u, v = rng.uniform(size=(2, len(which), 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return triangles[which, 0] + u * edges[which, 0] + v * edges[which, 1]


def tree(rng: np.random.Generator) -> F64:
    """A street tree: trunk and a crown that lets some rays pass."""
    trunk = rng.uniform(2.2, 3.0)
    crown = rng.uniform(1.4, 2.4)
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
        u = rng.uniform(0.5, width - 0.7)
        z = rng.uniform(2.8, max(2.9, height - 2.0))
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
        left = rng.uniform(0.25, 0.4) * width
        right = rng.uniform(0.6, 0.75) * width
        back = rng.uniform(0.6, 1.8)
        return [
            box(0, left, 0, depth, FOOT_M, height),
            box(right, width, 0, depth, FOOT_M, height),
            box(left, right, back, depth, FOOT_M, height),
        ]
    if kind == "step":
        split = rng.uniform(0.35, 0.65) * width
        back = rng.uniform(0.8, 2.5)
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
        u = rng.uniform(0.2, 0.5) * width
        v = rng.uniform(0.3, 0.5) * depth
        return [box(u, u + 0.3 * width, v, v + 0.3 * depth, height, height + 2.2)]
    over = rng.uniform(0.2, 0.6)
    rise = rng.uniform(1.2, 2.8)
    ridge = 0.5 * depth
    return [
        taper(
            (-over, width + over, -over, depth + over, height),
            (0.5, width - 0.5, ridge - 0.1, ridge + 0.1, height + rise),
        )
    ]


def _awning(rng: np.random.Generator, width: float) -> list[F64]:
    """A roof over the shop front: the map has points there only high above the ground."""
    u0 = rng.uniform(0.0, 0.3) * width
    u1 = rng.uniform(0.65, 1.0) * width
    reach = rng.uniform(0.9, 1.9)
    z = rng.uniform(2.4, 3.1)
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
