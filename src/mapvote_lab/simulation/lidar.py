"""A LiDAR on Embree: rays, noise, drop-outs, and motion while a scan is taken (paper II).

Where the rays go, and when: mapvote_lab.simulation.patterns.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from mapvote.core.kernel import allocating
from mapvote.core.record import record
from mapvote.core.sensors import Sensor
from mapvote.core.types import F32, F64, I32, I64, Bool
from mapvote_lab.simulation.patterns import pattern_of

NOTHING = -1
"""Object id of a ray that meets nothing."""


@record()
@dataclass(frozen=True, slots=True)
class ReturnStrength:
    """Which rays of the simulated LiDAR give no point, by how strong their return is."""

    base_drop: float = 0.008
    """Share of all rays that are lost by chance."""
    faint: float = 0.035
    """Strength at which a return is lost with a chance of 1/e; 1: a surface at the greatest range, met at a right
    angle."""
    nearest_m: float = 5.0
    """Returns nearer than this are no stronger than at this range, metres."""


RETURN_STRENGTH = ReturnStrength()


class Caster:
    """Triangles (n, 3, 3) float32 to shoot at, each owned by an object (n,) int32."""

    def __init__(self, triangles: F32, owners: I32) -> None:
        self._owners = np.append(owners, np.int32(NOTHING))
        self._scene = EmbreeScene()
        if len(triangles):
            TriangleMesh(self._scene, np.ascontiguousarray(triangles, dtype=np.float32))
        self._empty = len(triangles) == 0

    def cast(self, origins: F32, directions: F32) -> tuple[F32, I32, F32]:
        """First hits of rays (n, 3), unit directions: range (n,) (inf if none), object id (n,), |cos of incidence|."""
        if self._empty:
            n = len(origins)
            return np.full(n, np.inf, np.float32), np.full(n, NOTHING, np.int32), np.ones(n, np.float32)
        hit = self._scene.run(origins, directions, output=1)
        return _first_hits(hit["tfar"], hit["primID"], hit["Ng"], directions, self._owners)

    def normals(self, rays: Sweep, met: I64) -> F32:
        """(n, 3) unit normals of the surfaces that the rays ``met`` (n,) of a sweep hit, each of which must hit one."""
        normals = self._scene.run(rays.origins[met], rays.directions[met], output=1)["Ng"]
        return (normals / (np.linalg.norm(normals, axis=1, keepdims=True) + 1e-12)).astype(np.float32)


class SlicedCaster:
    """Bodies that move while a scan is taken: a caster for each slice of its rays, which are in order of time."""

    def __init__(self, slices: Sequence[Caster], first: I64) -> None:
        """``first`` (slices,): the first ray of each slice."""
        self._slices = slices
        self._first = first

    def cast(self, origins: F32, directions: F32) -> tuple[F32, I32, F32]:
        """All rays of a sweep, see :meth:`Caster.cast`."""
        parts = zip(
            self._slices, np.split(origins, self._first[1:]), np.split(directions, self._first[1:]), strict=True
        )
        ranges, objects, cosine = zip(*(caster.cast(o, d) for caster, o, d in parts), strict=True)
        return np.concatenate(ranges), np.concatenate(objects), np.concatenate(cosine)

    def normals(self, rays: Sweep, met: I64) -> F32:
        """Normals, see :meth:`Caster.normals`."""
        normals = np.empty((len(met), 3), np.float32)
        slice_of = np.searchsorted(self._first, met, side="right") - 1
        for k in np.unique(slice_of):
            normals[slice_of == k] = self._slices[k].normals(rays, met[slice_of == k])
        return normals


@allocating
def _first_hits(far: F32, triangle: I32, normals: F32, directions: F32, owners: I32) -> tuple[F32, I32, F32]:
    """Range, object and |cos of incidence| of rays that met a ``triangle`` each (n,), or -1."""
    n = len(far)
    ranges = np.full(n, np.inf, np.float32)
    objects = np.empty(n, np.int32)
    cosine = np.zeros(n, np.float32)
    for i in range(n):
        objects[i] = owners[triangle[i]]
        if triangle[i] >= 0:
            ranges[i] = far[i]
            x = normals[i, 0]
            y = normals[i, 1]
            z = normals[i, 2]
            along = x * directions[i, 0] + y * directions[i, 1] + z * directions[i, 2]
            cosine[i] = abs(along) / (np.sqrt(x * x + y * y + z * z) + np.float32(1e-12))
    return ranges, objects, cosine


@dataclass(frozen=True)
class Sweep:
    """The rays of one scan in firing order."""

    origins: F32
    """(rays, 3) map frame."""
    directions: F32
    """(rays, 3) unit, map frame."""
    directions_lidar: F32
    """(rays, 3) unit, in the sensor's frame at the moment of firing."""
    time_s: F64
    """(rays,) when each leaves, from the stamp."""
    together: int
    """Rays that leave together: the neighbour of a ray is so many rays on."""


def sweep(
    sensor: Sensor, T_map_lidar_at: Callable[[F64], F64], stamp_s: float, phase: float, distortion: bool
) -> Sweep:
    """Rays of the scan with this stamp; ``T_map_lidar_at`` takes (n,) seconds to (n, 4, 4).

    ``phase`` in [0, 1) turns the firing pattern by a share of its step, as it drifts from scan to scan. Without
    ``distortion`` all rays leave from the pose at the stamp.
    """
    firing = pattern_of(sensor)(sensor, stamp_s, phase)
    local = firing.directions
    time_s = firing.time_s if distortion else np.zeros(1)
    T = T_map_lidar_at(stamp_s + time_s)
    rotation = np.ascontiguousarray(np.swapaxes(T[:, :3, :3], 1, 2), dtype=np.float32)
    directions = np.matmul(local, rotation)
    origins = np.broadcast_to(T[:, None, :3, 3].astype(np.float32), local.shape)
    return Sweep(
        np.ascontiguousarray(origins).reshape(-1, 3),
        directions.reshape(-1, 3),
        local.reshape(-1, 3),
        np.repeat(firing.time_s, local.shape[1]),
        local.shape[1],
    )


def measure(
    sensor: Sensor,
    ranges: F32,
    cosine: F32,
    rng: np.random.Generator,
    returns: ReturnStrength = RETURN_STRENGTH,
) -> tuple[F32, Bool]:
    """Noisy ranges (n,) and which rays give a point: in range, not too faint, not dropped by chance."""
    n = len(ranges)
    noisy = ranges + np.float32(sensor.range_sigma_m) * rng.standard_normal(n, dtype=np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        strength = cosine * (sensor.max_range_m / np.maximum(ranges, returns.nearest_m)) ** 2
        chance = returns.base_drop + np.exp(-strength / returns.faint)
    kept = rng.random(n, dtype=np.float32) >= chance
    return noisy, kept & (noisy > sensor.min_range_m) & (ranges < sensor.max_range_m)
