"""The road below the sensor, by a scan alone: which axis points up, how deep it lies, how it tilts, how flat it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapvote.core.types import F32, F64

UPS = {
    "+x": np.array([1.0, 0, 0]),
    "-x": np.array([-1.0, 0, 0]),
    "+y": np.array([0, 1.0, 0]),
    "-y": np.array([0, -1.0, 0]),
    "+z": np.array([0, 0, 1.0]),
    "-z": np.array([0, 0, -1.0]),
}
_NEAR_M = 15.0
_ROAD_SHARE = 0.1
"""A plane with fewer of a scan's near points than this is no road."""
_UNSTEADY_M = 0.3
_THICK_M = 0.12
_DEPTH_M = (0.2, 12.0)
_TRIES = 300


@dataclass(frozen=True, slots=True)
class Road:
    """The plane that most of the low points near the sensor lie in."""

    up: str
    """Which axis of the points points up: "+z" as it should."""
    depth_m: float
    """Of the road below the sensor."""
    share: float
    """Of the points within 15 m that lie within 0.12 m of the plane; below 0.1 it may be no road."""
    normal: F64
    """(3,) of the road, upwards, in the frame of the points."""
    scatter_m: float
    """By how much points near the plane leave it, robust standard deviation."""
    unsteady_m: float = 0.0
    """By how much the depth differs from scan to scan, robust standard deviation."""

    @property
    def is_there(self) -> bool:
        """Whether it can be a road: some points lie in it, and as deep in every scan."""
        return self.share >= _ROAD_SHARE and self.unsteady_m < _UNSTEADY_M

    @property
    def tilt_deg(self) -> float:
        """Of the sensor against the road."""
        return float(np.degrees(np.arccos(np.clip(self.normal @ UPS[self.up], -1.0, 1.0))))


def find_road(scans: Sequence[F32]) -> Road:
    """The road that several scans show. Another axis than z must hold half as much again: a wall is no road."""
    near = [_near(scan) for scan in scans]
    planes = [_best_planes(points, np.random.default_rng(k)) for k, points in enumerate(near)]
    share = {name: float(np.mean([one[name][0] for one in planes])) for name in UPS}
    best = max(share, key=lambda name: share[name])
    if share[best] < max(1.5 * share["+z"], _ROAD_SHARE):
        best = "+z"
    fitted = [_fitted(points, *one[best][1:]) for points, one in zip(near, planes, strict=True)]
    normal = np.median([normal for normal, _, _ in fitted], axis=0)
    depth_m, scatter_m = (float(np.median([one[k] for one in fitted])) for k in (1, 2))
    unsteady_m = 1.4826 * float(np.median([abs(depth - depth_m) for _, depth, _ in fitted]))
    return Road(best, depth_m, share[best], normal / np.linalg.norm(normal), scatter_m, unsteady_m)


def _near(scan: F32) -> F64:
    distance = np.linalg.norm(scan, axis=1)
    points = scan[(distance < _NEAR_M) & (distance > 2.0)].astype(np.float64)
    return points[:: max(1, len(points) // 3000)]


def _best_planes(points: F64, rng: np.random.Generator) -> dict[str, tuple[float, F64, float]]:
    """For each axis that may point up (share, normal, depth) of the plane below the sensor with most of the points.

    Planes through three points each (Fischler and Bolles, Random Sample Consensus, 1981).
    """
    out: dict[str, tuple[float, F64, float]] = {name: (0.0, up, 0.0) for name, up in UPS.items()}
    if len(points) < 30:
        return out
    a, b, c = (points[rng.integers(0, len(points), _TRIES)] for _ in range(3))
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1)
    normals = normals[length > 1e-3] / length[length > 1e-3, None]
    depth = -np.einsum("ij,ij->i", normals, a[length > 1e-3])
    normals, depth = normals * np.sign(depth)[:, None], np.abs(depth)  # towards the sensor
    for normal, d in zip(normals, depth, strict=True):
        axis = int(np.argmax(np.abs(normal)))
        if not _DEPTH_M[0] <= d <= _DEPTH_M[1] or abs(normal[axis]) < np.cos(np.radians(35.0)):
            continue
        share = float((np.abs(points @ normal + d) < _THICK_M).mean())
        name = ("+" if normal[axis] > 0 else "-") + "xyz"[axis]
        if share > out[name][0]:
            out[name] = (share, normal, float(d))
    return out


def _fitted(points: F64, normal: F64, depth_m: float) -> tuple[F64, float, float]:
    """(normal, depth, robust scatter) of the plane fitted to the points near a first guess of it, twice."""
    scatter = 0.0
    for _ in range(2):
        off = points @ normal + depth_m
        p = points[np.abs(off) < 3.0 * _THICK_M]
        if len(p) < 50:
            return normal, depth_m, 0.0
        centre = p.mean(axis=0)
        fitted = np.linalg.svd(p - centre, full_matrices=False)[2][2]
        normal = fitted if fitted @ normal > 0 else -fitted
        depth_m = -float(normal @ centre)
        scatter = 1.4826 * float(np.median(np.abs((p - centre) @ normal)))
    return normal, depth_m, scatter
