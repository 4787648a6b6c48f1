"""Triangles of simple solids: (n, 3, 3) float64 arrays, metres. What the street is made of."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mapvote.core.types import F64

_BOX_QUADS = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
_BOX_FACES = np.concatenate([_BOX_QUADS[:, [0, 1, 2]], _BOX_QUADS[:, [0, 2, 3]]])


def join(parts: Sequence[F64]) -> F64:
    """All triangles of ``parts`` in one array; (0, 3, 3) if there are none."""
    return np.concatenate(parts) if parts else np.zeros((0, 3, 3))


def box(x0: float, x1: float, y0: float, y1: float, z0: float, z1: float) -> F64:
    """An axis-aligned box, 12 triangles."""
    return taper((x0, x1, y0, y1, z0), (x0, x1, y0, y1, z1))


def taper(low: tuple[float, float, float, float, float], high: tuple[float, float, float, float, float]) -> F64:
    """A frustum between two rectangles (x0, x1, y0, y1, z), 12 triangles: cabins, roofs, wedges."""
    corners = np.array([[r[i], r[2 + j], r[4]] for i in (0, 1) for j in (0, 1) for r in (low, high)])
    return corners[_BOX_FACES]


def cylinder(radius: float, z0: float, z1: float, sides: int = 8, top_radius: float | None = None) -> F64:
    """An upright cylinder or cone frustum around the z axis, closed on top."""
    angle = np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False)
    ring = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(sides)])
    low = ring * radius + [0, 0, z0]
    high = ring * (radius if top_radius is None else top_radius) + [0, 0, z1]
    low2, high2 = np.roll(low, -1, axis=0), np.roll(high, -1, axis=0)
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
    low, high = [0.0, -0.5 * width, 0.05], [length, 0.5 * width, height]
    return rng.uniform(low, high, size=(leaves, 3))[:, None, :] + rng.uniform(-0.12, 0.12, size=(leaves, 3, 3))


def car(length: float = 4.4, width: float = 1.8, height: float = 1.5) -> F64:
    """A saloon, x forward, centred, wheels at z = 0."""
    waist, l2, w2 = 0.58 * height, 0.5 * length, 0.5 * width
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
    l2, w2 = 0.5 * length, 0.5 * width
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
    c, s = np.cos(yaw), np.sin(yaw)
    return triangles @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) + [x, y, z]


def sample(triangles: F64, spacing: float, rng: np.random.Generator) -> F64:
    """(m, 3) random points on the triangles, about one per ``spacing`` squared."""
    edges = triangles[:, 1:] - triangles[:, :1]
    area = 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    which = np.repeat(np.arange(len(triangles)), rng.poisson(area / spacing**2))
    u, v = rng.uniform(size=(2, len(which), 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return triangles[which, 0] + u * edges[which, 0] + v * edges[which, 1]
