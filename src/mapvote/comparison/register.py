"""One cloud or map registered to another, without a prior: the pose, its error, the parts that do not fit a rigid
motion, and the map in the frame and on the lattice of the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapvote.comparison.patches import (
    SIDE_M,
    Patches,
    RigidFit,
    bent_under,
    fit_rigid,
    parts_of,
    register_patches,
    unbent,
)
from mapvote.core.columns import TOP_BIT
from mapvote.core.geometry import inverse, rotation_angle, transform
from mapvote.core.grid import CELL_SIZE
from mapvote.core.point_map import PointMap, all_fields, all_points, map_from_points
from mapvote.core.types import F64, Bool, MapvoteError
from mapvote.localisation.coarse_search import LEAST_LEAD, place_without_prior

_LEAST_FITTING = 0.25
"""Share of the compared patches that must agree on one motion: fewer are chance."""
_MOST_LEFT = 0.1
"""Share of the patches that may stay bent after they were moved."""

_SAME_M, _SAME_DEG = 0.05, 0.1
"""Maps of one lattice that are registered this near to where they are already lie where they are: their free space
holds cell by cell."""


@dataclass(frozen=True, slots=True)
class BentPart:
    """A part of a cloud that one rigid motion does not lay on the other."""

    name: str
    """As "south of y = -45 m", in the frame of a."""
    most_m: float
    """How far its patches are off at most."""
    patches: int

    def told(self) -> str:
        return f"{self.name} this session is off by up to {self.most_m:.1f} m ({self.patches} patches)"


@dataclass(frozen=True, slots=True)
class Registered:
    """A cloud b in the frame of a."""

    T_a_b: F64
    points: F64
    """(n, 3) b's points in a's frame."""
    lead: float
    """By which share of its score the place is ahead of the best place elsewhere."""
    patches: Patches
    fit: RigidFit
    bent: tuple[BentPart, ...]
    unbent: bool
    """Whether the points were moved patch by patch."""
    why_not: str
    """Why they were not, although requested."""

    def told(self) -> list[str]:
        """The registration in sentences."""
        T = self.T_a_b
        yaw = np.degrees(np.arctan2(T[1, 0], T[0, 0]))
        tilt = np.degrees(np.arccos(np.clip(T[2, 2], -1.0, 1.0)))
        x, y, z = T[:3, 3]
        agree = int(self.fit.agree.sum())
        lines = [
            f"B lies in A at x {x:.3f}, y {y:.3f}, z {z:.3f} m, turned by {yaw:.3f} deg, tilted by {tilt:.3f} deg "
            f"(+-{self.fit.sigma_m:.3f} m, {self.fit.sigma_deg:.3f} deg)",
            f"{agree} of {int(self.patches.compared.sum())} patches of {SIDE_M:.0f} m agree on it; the best place "
            f"elsewhere scores {self.lead:.0%} less",
        ]
        lines += [f"bent: {part.told()}" for part in self.bent]
        if self.unbent:
            lines.append("the bent parts were moved patch by patch (--unbend)")
        elif self.why_not:
            lines.append(f"not unbent: {self.why_not}")
        return lines

    def compared(self, xy: F64) -> Bool:
        """(n,) whether places (n, 2) in a's frame lie where a rigid part of b covers them: in a patch that agrees, or
        outside all patches nearer to one that agrees than to a bent one."""
        out = np.zeros(len(xy), dtype=np.bool_)
        doubt = np.zeros(len(xy), dtype=np.bool_)
        nearest = np.full((2, len(xy)), np.inf)
        shown = self.patches.compared
        agree = shown if self.unbent else self.fit.agree
        for centre, off in zip(self.patches.T_a_patch[shown, :2, 3], ~agree[shown], strict=True):
            far = np.abs(xy - centre).max(axis=1)
            (doubt if off else out)[far < SIDE_M / 2] = True
            nearest[int(off)] = np.minimum(nearest[int(off)], far)
        return np.asarray(out | (~doubt & (nearest[0] <= nearest[1])))

    def other_motions(self) -> list[tuple[F64, F64]]:
        """((2,) middle of each bent patch in a's frame, (4, 4) T that moves b's points, as they lie in a by the rigid
        motion, to where the patch itself fits): what looks changed under one motion may fit under another."""
        out = []
        for k in np.flatnonzero(self.patches.compared & ~self.fit.agree):
            T_patch = self.patches.T_a_patch[k]
            before = np.eye(4)
            before[:3, :3] = self.T_a_b[:3, :3]
            before[:3, 3] = self.T_a_b[:3, :3] @ self.patches.centre_b[k] + self.T_a_b[:3, 3]
            out.append((T_patch[:2, 3], T_patch @ np.linalg.inv(before)))
        return out


def register_maps(map_a: PointMap, map_b: PointMap, *, unbend: bool = False) -> Registered:
    """Map or cloud b registered to a, metres, z up, without a prior.

    ``unbend``: move bent parts patch by patch, if that makes them fit. MapvoteError, with figures, where the place is
    ambiguous or nothing fits.
    """
    points_a, points_b = all_points(map_a), all_points(map_b)
    placed = place_without_prior(points_a, points_b)
    if placed.lead < LEAST_LEAD:
        raise MapvoteError(
            f"the clouds fit at several places: the best one scores {placed.score:.2f}, the next one only "
            f"{placed.lead:.0%} less; are they of one place, and do they overlap by more than a street of equal houses?"
        )
    paths = [np.concatenate(map_a.driven)] if map_a.driven else []
    paths += [transform(placed.T_a_b, np.concatenate(map_b.driven))] if map_b.driven else []
    patches = register_patches(points_a, points_b, placed.T_a_b, paths)
    fit = fit_rigid(patches, placed.T_a_b)
    agree = int(fit.agree.sum())
    if agree < _LEAST_FITTING * patches.compared.sum() or not patches.compared.any():
        raise MapvoteError(
            f"only {agree} of {int(patches.compared.sum())} pieces agree on one motion: not one place, or badly bent"
        )
    moved, why = None, ""
    if unbend and fit.bent.any():
        moved, why = _unbend(points_a, points_b, patches, fit, paths)
    rigid = points_b @ fit.T_a_b[:3, :3].T + fit.T_a_b[:3, 3]
    points = rigid if moved is None else moved
    return Registered(fit.T_a_b, points, placed.lead, patches, fit, _bent_parts(patches, fit), moved is not None, why)


def _bent_parts(patches: Patches, fit: RigidFit) -> tuple[BentPart, ...]:
    """The parts, the largest first."""
    shown = np.flatnonzero(patches.compared)
    parts = parts_of(patches.T_a_patch[shown, :3, 3], fit.bent[shown])
    return tuple(BentPart(name, float(fit.shift_m[shown][mine].max()), int(mine.sum())) for name, mine in parts)


def _unbend(
    points_a: F64, points_b: F64, patches: Patches, fit: RigidFit, paths: Sequence[F64]
) -> tuple[F64 | None, str]:
    """(points of b moved patch by patch, "") or (None, why that does not help)."""
    moved = unbent(points_b, patches, fit.T_a_b)
    again = register_patches(points_a, moved, np.eye(4), paths)
    still = bent_under(again, np.eye(4))
    if still.sum() > _MOST_LEFT * again.compared.sum():
        worst = float(np.linalg.norm(again.residuals(np.eye(4))[still, :3], axis=1).max())
        return None, (
            f"{int(still.sum())} of {int(again.compared.sum())} patches stay off by up to {worst:.1f} m: within "
            f"{SIDE_M:.0f} m the session is not rigid, things beside each other are shifted by different amounts"
        )
    return moved, ""


def brought_into(map_a: PointMap, map_b: PointMap, *, unbend: bool = False) -> tuple[PointMap, Registered]:
    """(b as a map in a's frame on a's lattice, how it was registered).

    Its ground is computed anew from its points; its free space comes along, unless b was unbent. A map that lies in a's
    frame already is returned as it is. MapvoteError where they do not register.
    """
    registered = register_maps(map_a, map_b, unbend=unbend)
    if map_a.lattice == map_b.lattice and not registered.unbent and _is_in_place(registered.T_a_b, all_points(map_b)):
        return map_b, registered
    fields = all_fields(map_b)
    moved = map_from_points(registered.points, lattice=map_a.lattice, map_id=map_b.map_id, fields=fields)
    return moved if registered.unbent else with_free_space_of(moved, [map_b], registered.T_a_b[None]), registered


def _is_in_place(T: F64, points: F64) -> bool:
    middle = np.median(points, axis=0)
    return bool(
        np.linalg.norm(T[:3, :3] @ middle + T[:3, 3] - middle) < _SAME_M and np.degrees(rotation_angle(T)) < _SAME_DEG
    )


def with_free_space_of(point_map: PointMap, maps: Sequence[PointMap], T: F64) -> PointMap:
    """The map with the free space that ``maps`` know, which lie in its frame at T (k, 4, 4).

    Each voxel asks the maps for its own middle: the other way round, the voxels of a turned map leave gaps. No voxel
    that holds a point of the map becomes free."""
    out = {}
    from_map = [(one, inverse(T_map)) for one, T_map in zip(maps, T, strict=True)]
    for index, tile in point_map.tiles.items():
        rows, cols = np.nonzero(np.isfinite(tile.ground_z))
        words = np.zeros(len(rows), dtype=np.uint64)
        x, y = tile.window.centres()
        middles = np.column_stack([x[cols], y[rows], np.zeros(len(rows))])
        for one, T_one_map in from_map:
            for bit in range(TOP_BIT):
                middles[:, 2] = (tile.base[rows, cols] + bit + 0.5) * CELL_SIZE
                is_free = _is_free(one, transform(T_one_map, middles))
                words |= is_free.astype(np.uint64) << np.uint64(bit)
        free = np.zeros(tile.window.shape, dtype=np.uint64)
        free[rows, cols] = words
        free &= ~tile.obstacle_words
        out[index] = replace(tile, free=free) if free.any() else tile
    return replace(point_map, tiles=out)


def _is_free(one: PointMap, places: F64) -> Bool:
    """(n,) whether places (n, 3) lie in voxels that the map knows to be free."""
    out = np.zeros(len(places), dtype=np.bool_)
    for part, mine, cell in one.by_tile(places):
        if part.free is not None:
            bit = np.floor(places[mine, 2] / CELL_SIZE).astype(np.int64) - part.base[cell]
            words = part.free[cell] >> np.clip(bit, 0, TOP_BIT).astype(np.uint64)
            out[mine] = (bit >= 0) & (bit < TOP_BIT) & (words & np.uint64(1) == 1)
    return out
