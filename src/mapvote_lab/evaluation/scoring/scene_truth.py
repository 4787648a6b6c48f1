"""What really happened, as the simulator wrote it. The only module that opens a truth folder."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from mapvote.core.geometry import inverse
from mapvote.core.grid import CELL_SIZE, Grid, Lattice
from mapvote.core.types import F64, NO_VOTE, U8, Bool, MapvoteError
from mapvote.formats.drives.trajectory import read_poses

_KEPT, _ADDED, _REMOVED = 0, 1, 2
_AROUND_M = 0.6
"""Walls stand on the outline of a footprint: cells this far outside it still belong to the object."""
_ARM_M = 2.0


@dataclass(frozen=True, slots=True)
class Truth:
    """Cells, surfaces, objects and poses of one simulated scene, in the frame in which the survey's RTK speaks."""

    folder: Path
    x0: float
    y0: float
    strict: U8
    provenance: U8
    reason: U8
    """Why a cell is unscored (docs/simulation.md)."""
    densest: U8
    """Most points of built bodies that one scan of a vehicle had in the cell."""
    hit: Bool
    """Where a vehicle recorded a point of a built body."""
    passed: Bool
    """Where a vehicle's ray went through the place of a demolished surface."""
    objects: tuple[dict[str, Any], ...]
    """``kind`` "built" or "demolished", ``footprint`` [[x, y], ..], ``height_m``."""

    def grid_on(self, lattice: Lattice) -> Grid:
        """The truth's window on a map's lattice; MapvoteError if the two do not fall on the same cells."""
        row, col = (self.y0 - lattice.y0) / CELL_SIZE, (self.x0 - lattice.x0) / CELL_SIZE
        if abs(row - round(row)) > 1e-6 or abs(col - round(col)) > 1e-6:
            raise MapvoteError(
                f"{self.folder}: its cells start at ({self.x0}, {self.y0}), off the map's lattice "
                f"({lattice.x0}, {lattice.y0}): build the map on multiples of {CELL_SIZE} m"
            )
        return Grid(lattice, round(row), round(col), *self.strict.shape)

    def poses(self, drive: str) -> F64:
        """(n, 4, 4) true T_map_lidar of a drive at its stamps."""
        return read_poses(self.folder / drive / "poses.txt")

    def moving(self, drive: str, scan: int) -> Bool:
        """(n,) which points of the scan's file hit a body that moves."""
        return np.asarray(np.load(self.folder / drive / "moving" / f"{scan:06d}.npy"), dtype=np.bool_)

    def surfaces(self) -> tuple[F64, F64, F64]:
        """(kept, added, removed): noise-free surface samples (n, 3), map metres."""
        with np.load(self.folder / "surface.npz") as file:
            points, label = file["points"].astype(np.float64), file["label"]
        return points[label == _KEPT], points[label == _ADDED], points[label == _REMOVED]

    def cells_of(self, footprint: list[list[float]]) -> Bool:
        """(rows, cols) cells whose centres lie in a convex footprint or within 0.6 m of it."""
        corners = np.asarray(footprint)
        turn = np.roll(corners, -1, axis=0) - corners
        x1, y1 = np.roll(corners, -1, axis=0).T
        area = 0.5 * float(np.sum(corners[:, 0] * y1 - corners[:, 1] * x1))
        outward = np.column_stack([turn[:, 1], -turn[:, 0]]) * np.sign(area) / np.linalg.norm(turn, axis=1)[:, None]
        rows, cols = self.strict.shape
        x = self.x0 + (np.arange(cols) + 0.5) * CELL_SIZE
        y = self.y0 + (np.arange(rows) + 0.5) * CELL_SIZE
        inside = np.ones((rows, cols), dtype=np.bool_)
        for (cx, cy), (nx, ny) in zip(corners, outward, strict=True):
            inside &= (x[None, :] - cx) * nx + (y[:, None] - cy) * ny <= _AROUND_M
        return inside


def read_truth(scene: Path) -> Truth:
    """The truth beside simulated drives: ``scene``/truth. MapvoteError if it is not there or not whole."""
    folder = scene / "truth"
    try:
        with np.load(folder / "truth.npz") as file:
            strict, provenance, reason = file["strict"], file["provenance"], file["reason"]
            densest, hit, passed = file["densest"], file["hit"], file["passed"]
            x0, y0 = float(file["x0"]), float(file["y0"])
        objects = json.loads((folder / "objects.json").read_text())["objects"]
    except (OSError, KeyError, ValueError) as error:
        raise MapvoteError(f"{folder}: no usable truth ({error}); simulate the scene again") from error
    return Truth(folder, x0, y0, strict, provenance, reason, densest, hit, passed, tuple(objects))


def lay_on(states: U8, grid: Grid, window: Grid) -> U8:
    """``states`` over ``grid`` as an array over ``window`` of the same lattice; NO_VOTE where they do not reach."""
    out = np.full(window.shape, NO_VOTE, dtype=np.uint8)
    common = grid.intersection(window)
    if 0 in common.shape:
        return out
    out[common.slices_in(window)] = states[common.slices_in(grid)]
    return out


def rigid_between(T_map_a: F64, T_world_a: F64) -> F64:
    """T_map_world (4, 4) that best carries one trajectory (n, 4, 4) onto the other, least squares (Kabsch 1976).

    Each pose stands for its position and for points 2 m along its axes, so that a straight road, whose positions
    leave the turn about it open, still fixes all six degrees of freedom.
    """
    to, of = T_map_a[:, :3, 3].mean(axis=0), T_world_a[:, :3, 3].mean(axis=0)
    spread = (T_map_a[:, :3, 3] - to).T @ (T_world_a[:, :3, 3] - of)
    spread += _ARM_M**2 * np.einsum("nij,nkj->ik", T_map_a[:, :3, :3], T_world_a[:, :3, :3])
    u, _, vt = np.linalg.svd(spread)
    T = np.eye(4)
    T[:3, :3] = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    T[:3, 3] = to - T[:3, :3] @ of
    return T


def pose_errors(T_found: F64, T_true: F64) -> tuple[F64, F64]:
    """(metres (n,), radians (n,)) between poses (n, 4, 4) in one frame."""
    metres = np.linalg.norm(T_found[:, :3, 3] - T_true[:, :3, 3], axis=1)
    cosines = [0.5 * (np.trace((inverse(a) @ b)[:3, :3]) - 1.0) for a, b in zip(T_found, T_true, strict=True)]
    return metres, np.arccos(np.clip(cosines, -1.0, 1.0))


class PoseErrors(msgspec.Struct, frozen=True, kw_only=True):
    """Of a drive's scans: over those that were localised."""

    scans: int
    localised: int
    median_m: float
    p99_m: float
    max_m: float
    median_deg: float


def error_summary(T_found: F64, T_true: F64) -> PoseErrors:
    """Of poses (n, 4, 4), both in one frame; a scan that was not localised is a row of NaN."""
    there = np.isfinite(T_found).all(axis=(1, 2))
    metres, radians = pose_errors(T_found[there], T_true[there])
    if not there.any():
        metres, radians = np.zeros(1), np.zeros(1)
    return PoseErrors(
        scans=len(T_found),
        localised=int(there.sum()),
        median_m=float(np.median(metres)),
        p99_m=float(np.percentile(metres, 99)),
        max_m=float(metres.max()),
        median_deg=float(np.degrees(np.median(radians))),
    )
