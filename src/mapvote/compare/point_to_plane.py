"""The last centimetres of a registration: each point to the surface of the other cloud (Chen and Medioni 1992).

NDT compares points with one distribution per metre of space. Near a wall whose points two voxels share, its optimum is
up to 0.1 m off, even for a cloud against itself. The distance to the nearest point along the normal of the surface has
no such bias, but needs a start within half a metre.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from mapvote.core.geometry import exp, log, transform
from mapvote.core.record import record
from mapvote.core.types import F64


@record()
@dataclass(frozen=True, slots=True)
class PlaneMatch:
    """Numbers of the refinement."""

    neighbours: int = 12
    """Nearest points that give a surface its normal, with the point itself."""
    around_m: float = 1.0
    """Neighbours that lie farther away belong to another surface."""
    most_points: int = 30_000
    """Points of b that are matched at most."""
    reaches_m: tuple[float, ...] = (0.5, 0.4, 0.3, 0.25, 0.2)
    """Greatest distance between matched points, round by round; the last one holds from there on."""
    rounds: int = 30
    """Most rounds."""
    scale_m: float = 0.05
    """Distance at which the weight of a point is a half (Cauchy)."""
    sigma_m: float = 0.1
    """Standard deviation of one match along its normal. Neighbours share their surface's roughness, so it is larger
    than that of a range."""
    settled_m: float = 1e-4
    """A step shorter than this, also at ``lever_m``, is the last."""
    lever_m: float = 20.0
    """Distance at which a turn counts as a shift in ``settled_m``."""
    least: int = 50
    """Fewer matches decide nothing: the start stays."""


PLANE_MATCH = PlaneMatch()


@dataclass(frozen=True, slots=True)
class Surface:
    """A cloud whose points are asked for their nearest neighbours, metres."""

    points: F64
    """(n, 3)."""
    tree: scipy.spatial.KDTree

    @classmethod
    def of(cls, points: F64) -> Surface:
        return cls(points, scipy.spatial.KDTree(points))

    def normals(self, places: F64, numbers: PlaneMatch = PLANE_MATCH) -> tuple[F64, F64]:
        """((m, 3) unit normals at places (m, 3), (m,) how flat the surface is there, in [0, 1]: 1 for a plane).

        The normal is the direction in which the neighbours vary least; 1 - smallest / middle variance is the flatness.
        """
        distance, index = self.tree.query(places, k=numbers.neighbours, distance_upper_bound=numbers.around_m)
        near = np.isfinite(distance)
        neighbours = self.points[np.minimum(index, len(self.points) - 1)]
        count = np.maximum(near.sum(axis=1), 1)[:, None]
        mean = (neighbours * near[..., None]).sum(axis=1) / count
        spread = np.where(near[..., None], neighbours - mean[:, None], 0.0)
        variance, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", spread, spread))
        flatness = 1.0 - variance[:, 0] / np.maximum(variance[:, 1], 1e-9)
        flatness[near.sum(axis=1) < 4] = 0.0  # three points always lie in a plane
        return axes[:, :, 0], flatness


def refine_on_planes(
    surface_a: Surface,
    points_b: F64,
    normals_b: tuple[F64, F64],
    T_a_b: F64,
    information: F64,
    numbers: PlaneMatch = PLANE_MATCH,
) -> F64:
    """(4, 4) T_a_b, moved to where points_b (n, 3) with ``normals_b`` (:meth:`Surface.normals`) lie on ``surface_a``.

    ``information`` (6, 6): of the start ``T_a_b``, (rho, phi) about the origin of b in a's axes. It holds the
    directions in which no surface decides. The start is returned where fewer than ``numbers.least`` points are matched.
    """
    normal_b, flatness = normals_b
    origin = T_a_b[:3, 3]
    start = transform(T_a_b, points_b) - origin
    normal_start = normal_b @ T_a_b[:3, :3].T
    moved = np.eye(4)
    for round_ in range(numbers.rounds):
        # The nearest point of a, for every point of b.
        here = transform(moved, start)
        normal = normal_start @ moved[:3, :3].T
        reach_m = numbers.reaches_m[min(round_, len(numbers.reaches_m) - 1)]
        distance, index = surface_a.tree.query(here + origin, distance_upper_bound=reach_m)
        near = np.isfinite(distance)
        if near.sum() < numbers.least:
            return T_a_b
        # One step of Gauss and Newton over the distances along the normals.
        here = here[near]
        normal = normal[near]
        off_m = ((surface_a.points[index[near]] - origin - here) * normal).sum(axis=1)
        weight = flatness[near] / (1.0 + (off_m / numbers.scale_m) ** 2) / numbers.sigma_m**2
        J = np.column_stack([normal, np.cross(here, normal)])
        H = (J * weight[:, None]).T @ J + information
        step = np.linalg.solve(H, J.T @ (weight * off_m) - information @ log(moved))
        moved = exp(step) @ moved
        if np.linalg.norm(step[:3]) + numbers.lever_m * np.linalg.norm(step[3:]) < numbers.settled_m:
            break
    refined = moved.copy()
    refined[:3, :3] = moved[:3, :3] @ T_a_b[:3, :3]
    refined[:3, 3] = moved[:3, 3] + origin
    return refined
