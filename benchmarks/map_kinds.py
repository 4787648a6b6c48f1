"""Kinds of broken maps: what is done to a sound one's points, and the words by which it is named rightly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mapvote.core.geometry import from_xyz_rpy, transform

Change = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class MapKind:
    """``change`` of points (n, 3) that stand around the origin: the middle of the drive, on the road."""

    name: str
    right: str
    """A regular expression that names it."""
    change: Change
    moved: np.ndarray | None = None
    """(4, 4) the same as a similarity, where it is one: what the doctor measures is held against it."""
    grave: bool = True


def moved(name: str, right: str, scale: float = 1.0, **pose_deg: float) -> MapKind:
    """Moved as a whole: x, y, z in metres, roll, pitch, yaw in degrees, scaled about the middle."""
    turn = {axis: np.radians(pose_deg.pop(axis, 0.0)) for axis in ("roll", "pitch", "yaw")}
    T = from_xyz_rpy(*(pose_deg.get(axis, 0.0) for axis in "xyz"), **turn)
    T[:3, :3] *= scale
    return MapKind(name, right, lambda p: p @ T[:3, :3].T + T[:3, 3], T)


def twice(x: float, y: float, z: float) -> Change:
    """Half of the points are there again, elsewhere and with an error of their own."""

    def change(p: np.ndarray) -> np.ndarray:
        rng = np.random.default_rng(4)
        again = p[rng.random(len(p)) < 0.5]
        return np.concatenate([p, again + np.array([x, y, z]) + rng.normal(0, 0.03, again.shape)])

    return change


def hilly(p: np.ndarray) -> np.ndarray:
    return p + np.column_stack([0 * p[:, 0], 0 * p[:, 0], 1.5 * np.sin(p[:, 0] / 12.0)])


def bent(p: np.ndarray) -> np.ndarray:
    """As a survey without loops drifts: turned the more, the farther along."""
    angle = np.radians(0.15) * p[:, 0]
    c, s = np.cos(angle), np.sin(angle)
    return np.column_stack([c * p[:, 0] - s * p[:, 1], s * p[:, 0] + c * p[:, 1], p[:, 2]])


def noisy(sigma_m: float) -> Change:
    return lambda p: p + np.random.default_rng(2).normal(0, sigma_m, p.shape)


def with_strays(p: np.ndarray) -> np.ndarray:
    return np.concatenate([p, np.random.default_rng(3).uniform(-9e4, 9e4, (50, 3))])


def above_ground(p: np.ndarray) -> np.ndarray:
    """Without the points near the lowest of their square of 2 m."""
    cell = np.floor(p[:, :2] / 2.0).astype(np.int64)
    _, which = np.unique(cell, axis=0, return_inverse=True)
    lowest = np.full(which.max() + 1, np.inf)
    np.minimum.at(lowest, which, p[:, 2])
    return p[p[:, 2] - lowest[which] > 0.4]


NOWHERE = "fits the map nowhere|do not overlap"
SHIFT, TURN, SCALE = "shifted by", "turned about z by", "scaled by|differ in scale"
MIRROR = "mirrored"
UP = "upside down"
TWICE = "there twice"

MAP_KINDS = (
    moved("shifted by 0.5 m", SHIFT, x=0.4, y=0.3),
    moved("shifted by 2 m", SHIFT, x=-1.2, y=1.6),
    moved("shifted by 5 m", SHIFT, x=3.0, y=4.0),
    moved("0.5 m too high", SHIFT, z=0.5),
    moved("30 m too high (a geoid)", SHIFT, z=30.0),
    moved("shifted by 40 m", SHIFT, x=32.0, y=-24.0),
    moved("shifted by 300 km", "do not overlap", x=3e5),
    moved("turned by 2 deg", TURN, yaw=2.0),
    moved("turned by 10 deg", TURN, yaw=10.0),
    moved("turned by 90 deg", TURN, yaw=90.0),
    moved("turned by 180 deg", TURN, yaw=180.0),
    moved("tilted by 4 deg", "tilted by", pitch=4.0),
    moved("scaled by 1.03", SCALE, 1.03),
    moved("scaled by 0.97", SCALE, 0.97),
    moved("in feet", SCALE + "|too large|too small|feet", 1 / 0.3048),
    moved("in centimetres", "centimetres", 100.0),
    moved("in millimetres", "millimetres", 1000.0),
    moved("in kilometres", "kilometres", 0.001),
    MapKind("mirrored, y negated", MIRROR, lambda p: p * [1, -1, 1]),
    MapKind("mirrored, x negated", MIRROR, lambda p: p * [-1, 1, 1]),
    MapKind("x and y swapped", MIRROR + "|swapped", lambda p: p[:, [1, 0, 2]]),
    MapKind("upside down, turned over", UP, lambda p: p * [1, -1, -1]),
    MapKind("upside down, z negated", UP, lambda p: p * [1, 1, -1]),
    MapKind("y up", r"axis \+y points up", lambda p: p[:, [0, 2, 1]] * [1, 1, -1]),
    MapKind("twice, 2.2 m apart", TWICE, twice(2.0, 1.0, 0.0)),
    MapKind("twice, 1.2 m apart", TWICE, twice(0.4, -1.1, 0.0)),
    MapKind("twice, 0.5 m above each other", TWICE, twice(0.0, 0.0, 0.5)),
    MapKind("half of it missing", "holds nothing around", lambda p: p[p[:, 0] * 0.9 + p[:, 1] * 0.43 > 0]),
    MapKind("without its ground", "ground", above_ground),
    MapKind("points that scatter by 0.25 m", "thick|scatter", noisy(0.25)),
    MapKind("heights that wave by 1.5 m", "thick|height|bent|tilted|only|nowhere|above the map", hilly),
    MapKind("bent", "bent|only|nowhere", bent),
    MapKind("rounded to 0.5 m", "rounded to 0.5 m", lambda p: np.round(2 * p) / 2),
    MapKind("one point in a hundred", "apart", lambda p: p[::100]),
    MapKind("with strays", "far off all others", with_strays, grave=False),
    MapKind("flat", "flat", lambda p: p * [1, 1, 0]),
    MapKind("joined with itself", TWICE, lambda p: np.concatenate([p, p]), grave=False),
)
"""And, told from these by the benchmark itself: the map of another street."""


def around(points: np.ndarray, middle: np.ndarray, change: Change) -> np.ndarray:
    """``change`` done about ``middle`` (3,), map metres."""
    return change(points - middle) + middle


def moved_poses(T: np.ndarray, middle: np.ndarray, similarity: np.ndarray) -> np.ndarray:
    """Where poses (n, 4, 4) lie once the map has been moved so about ``middle``."""
    scale = np.cbrt(np.linalg.det(similarity[:3, :3]))
    out = T.copy()
    out[:, :3, :3] = similarity[:3, :3] / scale @ T[:, :3, :3]
    out[:, :3, 3] = transform(similarity, T[:, :3, 3] - middle) + middle
    return out
