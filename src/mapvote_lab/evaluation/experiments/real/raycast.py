"""Things put into real scans, and taken out of them, ray by ray.

A ray that meets the thing before its own return ends there instead, with the sensor's noise. A ray that had ended on
what is taken away goes on to whatever stands or lies behind, as the recording itself has measured it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from mapvote.core.geometry import inverse, transform
from mapvote.core.grid import CELL_SIZE
from mapvote.core.types import F32, F64, I64, Bool, Drive, Scan
from mapvote.localisation.prepare import deskew, motion_at
from mapvote_lab.simulation.lidar import Caster
from mapvote_lab.simulation.shapes import box

REACH_M = 60.0
_AGAIN_M = 0.05
"""What a ray hit so little before its own return is the return itself."""


@dataclass
class Thing:
    """Something that comes or goes. Coordinates in the frame of the reference trajectory."""

    kind: str
    comes: F64
    """(n, 3, 3) triangles that scans meet after the change; none if it only goes."""
    goes: tuple[F64, F64] | None = None
    """(T (4, 4) from its own axes, half extents (3,)) of the box whose points are taken out of the scans."""
    behind: F64 = field(default_factory=lambda: np.zeros((0, 3, 3)))
    """(n, 3, 3) what the rays meet that go on through the box."""
    met: list[F64] = field(default_factory=list)
    """Where rays ended on it, (m, 3), a scan after the other."""
    left: list[F64] = field(default_factory=list)
    """Points that were taken out, (m, 3), a scan after the other."""

    @property
    def centre(self) -> F64:
        """(2,) its middle from above."""
        if self.goes is not None:
            return self.goes[0][:2, 3]
        return np.asarray(self.comes.reshape(-1, 3)[:, :2].mean(axis=0))


def with_things(drive: Drive, things: Sequence[Thing], reference: F64) -> Drive:
    """The drive as it would have been recorded among ``things``; ``reference`` (n, 4, 4): where it was.

    Every scan read notes in the things where its rays ended. Scans come out de-skewed.
    """

    def read_scan(i: int) -> Scan:
        scan, T = drive.read_scan(i), reference[i]
        points = deskew(scan, motion_at(drive.stamps_ns, reference, i)).astype(np.float32)
        rng = np.random.default_rng([i, 2])
        keep, at, ends_on = np.ones(len(points), dtype=np.bool_), points.copy(), np.full(len(points), -1)
        for k, thing in enumerate(things):
            if np.linalg.norm(thing.centre - T[:2, 3]) < REACH_M:
                if thing.goes is not None:
                    inside, on = _take_out(points, keep, at, thing, T, drive.sensor.range_sigma_m, rng)
                    ends_on[inside], ends_on[on] = -1, k
                if len(thing.comes):
                    ends_on[_put_in(points, at, thing, T, drive.sensor.range_sigma_m, rng)] = k
        for k, thing in enumerate(things):
            met = keep & (ends_on == k)  # and not on what stands before it, whichever was put in first
            thing.met.append(transform(T, at[met]))
        intensity = None if scan.intensity is None else scan.intensity[keep]
        return replace(scan, points=points[keep], time_s=None, intensity=intensity)

    return replace(drive, read_scan=read_scan)


def _cast(triangles: F64, T: F64, directions: F32) -> F32:
    """Ranges (n,) of rays from the sensor at pose T (4, 4) to triangles (m, 3, 3) of the reference frame."""
    local = transform(inverse(T), triangles.reshape(-1, 3)).reshape(-1, 3, 3).astype(np.float32)
    caster = Caster(local, np.zeros(len(local), dtype=np.int32))
    return caster.cast(np.zeros_like(directions), directions)[0]


def _directions(points: F32) -> tuple[F32, F32]:
    reach = np.maximum(np.linalg.norm(points, axis=1), 1e-3).astype(np.float32)
    return reach, (points / reach[:, None]).astype(np.float32)


def _put_in(points: F32, at: F32, thing: Thing, T: F64, sigma_m: float, rng: np.random.Generator) -> Bool:
    """(n,) the rays that end on the thing now; ``points`` (n, 3) and, without noise, ``at`` (n, 3) are told where."""
    reach, directions = _directions(points)
    hit = _cast(thing.comes, T, directions)
    nearer = hit < reach - _AGAIN_M
    at[nearer] = directions[nearer] * hit[nearer, None]
    noisy = hit[nearer] + sigma_m * rng.standard_normal(np.count_nonzero(nearer), dtype=np.float32)
    points[nearer] = directions[nearer] * noisy[:, None]
    return nearer


def _take_out(
    points: F32, keep: Bool, at: F32, thing: Thing, T: F64, sigma_m: float, rng: np.random.Generator
) -> tuple[Bool, I64]:
    """((n,) the rays that had ended in what goes, (m,) those of them that go on to the thing itself, set back); as
    :func:`_put_in` the rest, and ``keep`` (n,) loses those that meet nothing within REACH_M."""
    assert thing.goes is not None
    T_ref_box, half = thing.goes
    inside = keep & (np.abs(transform(inverse(T_ref_box) @ T, points)) <= half).all(axis=1)
    rays = np.flatnonzero(inside)
    if not len(rays):
        return inside, rays
    thing.left.append(transform(T, points[inside]))
    reach, directions = _directions(points[inside])
    beyond = np.full(len(reach), np.inf, dtype=np.float32)
    if len(thing.behind):
        beyond = _cast(thing.behind, T, directions)
        beyond[beyond < reach] = np.inf
    on = rays[np.isfinite(beyond)] if len(thing.comes) else rays[:0]
    at[inside] = directions * np.where(np.isfinite(beyond), beyond, 1.0)[:, None]
    beyond += sigma_m * rng.standard_normal(len(beyond), dtype=np.float32)
    keep[rays[~(beyond < REACH_M)]] = False
    points[inside] = directions * np.where(beyond < REACH_M, beyond, 1.0)[:, None]
    return inside, on


def voxel_boxes(points: F64) -> F64:
    """(12 n, 3, 3) cubes of the occupied 0.3 m voxels of points (m, 3): what stands, coarsely."""
    corners = np.unique(np.floor(points / CELL_SIZE).astype(np.int64), axis=0) * CELL_SIZE
    unit = box(0, CELL_SIZE, 0, CELL_SIZE, 0, CELL_SIZE)
    return np.asarray((corners[:, None, None, :] + unit[None]).reshape(-1, 3, 3))
