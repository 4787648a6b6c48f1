"""One cloud or map registered to another, without a prior: the pose, its error, the parts that do not fit a rigid
motion, and the map in the frame and on the lattice of the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from mapvote.compare.free_space import with_free_space_of
from mapvote.compare.point_to_plane import PLANE_MATCH, Surface, refine_on_planes
from mapvote.core.geometry import exp, exps, hat, inverse, logs, rotation_angle, transform
from mapvote.core.point_map import PointMap, all_fields, all_points, map_from_points
from mapvote.core.record import record
from mapvote.core.types import F64, I64, Bool, MapvoteError
from mapvote.core.voxels import voxel_downsample
from mapvote.matching.coarse_search import COARSE_SEARCH, place_without_prior, stands
from mapvote.matching.matcher import likelihood_at
from mapvote.matching.ndt_map import NDT_WINDOW, NdtMap
from mapvote.matching.prepare import thin_for_levels


@record()
@dataclass(frozen=True, slots=True)
class PatchNumbers:
    """Numbers of the registration patch by patch."""

    step_m: float = 15.0
    """Spacing of the patches."""
    side_m: float = 30.0
    """Side of a patch: neighbours share three quarters of their points."""
    min_points: int = 150
    """Voxels of 0.7 m that a patch must fill."""
    surface_m: float = 0.1
    """Side of the voxels to whose one point a cloud is thinned for distances to surfaces."""
    thin_m: float = 0.3
    """Side of the voxels to whose one point a cloud is thinned for NDT."""
    around_m: float = 10.0
    """Margin of the other cloud around the patch."""
    min_inliers: float = 0.5
    """Share of a patch's points that must agree."""
    sure_m: float = 0.15
    """Standard deviation from which a patch is not used: ground alone leaves the shift along it open."""
    floor_m: float = 0.05
    """Disagreement of patches for other reasons than a bend: noise, voxels, changes."""
    floor_rad: float = float(np.radians(0.5))
    """Turn of scans: 80 m from the path of a survey half a degree is 0.7 m."""
    bent_m: float = 0.25
    """Least shift of a bent patch; it also exceeds four standard deviations and the shift of ``floor_rad`` at its
    distance from the survey's path."""
    gain: float = 0.1
    """Share by which a bent patch fits better at its own place: along a wall without ends every place fits alike."""
    min_bent: int = 3
    """Patches side by side that must be bent: fewer are the sparse fringe of a survey."""
    rounds: int = 20
    """Rounds of the robust fit of one motion."""
    min_fitting: float = 0.25
    """Share of the compared patches that must agree on one motion: fewer are chance."""
    most_left: float = 0.1
    """Share of the patches that may stay bent after they were moved."""
    in_place_m: float = 0.05
    """Shift below which maps of one lattice already lie in place: their free space holds cell by cell."""
    in_place_deg: float = 0.1
    """Turn below which they do."""


PATCHES = PatchNumbers()


@dataclass(frozen=True, slots=True)
class Patches:
    """Pieces of a cloud b, each registered to a by itself: (k, ..) arrays."""

    centre_b: F64
    """(k, 3) in b's frame."""
    T_a_patch: F64
    """(k, 4, 4) pose in a of the patch's centre, with b's axes."""
    covariance: F64
    """(k, 6, 6) of (rho, phi) about the centre, in a's axes."""
    inliers: F64
    """(k,) share of the points that agree."""
    compared: Bool
    """(k,) whether the registration is certain enough."""
    lever_m: F64
    """(k,) from the nearest place of the path from which a, or b, was measured, whichever is farther; 0 if no path is
    known."""
    thin_a: F64
    """(n, 3) points of a, thinned to ``thin_m``."""
    thin_b: F64
    """(m, 3) points of b, likewise, in b's frame."""
    points: tuple[tuple[I64, I64], ...]
    """For each patch: which of ``thin_a`` lie around it, and which of ``thin_b`` in it."""
    numbers: PatchNumbers = PATCHES

    def residuals(self, T_a_b: F64) -> F64:
        """(k, 6) of each patch against one motion: shift (metres) and turn (radians), in a's axes."""
        shift = self.T_a_patch[:, :3, 3] - (self.centre_b @ T_a_b[:3, :3].T + T_a_b[:3, 3])
        turned = np.tile(np.eye(4), (len(shift), 1, 1))
        turned[:, :3, :3] = self.T_a_patch[:, :3, :3] @ T_a_b[:3, :3].T
        return np.column_stack([shift, logs(turned)[:, 3:]])

    def gain(self, k: int, T_a_b: F64) -> float:
        """Share of its likelihood by which patch k fits better at its own place than under one motion. Only points
        above the ground count: its ground fits everywhere."""
        near = self.thin_a[self.points[k][0]]
        own_points = self.thin_b[self.points[k][1]] - self.centre_b[k]
        ndt_map = _ndt(near, self.T_a_patch[k, :3, 3], self.numbers)
        clouds = thin_for_levels(own_points[stands(own_points)])
        other = T_a_b.copy()
        other[:3, 3] = T_a_b[:3, :3] @ self.centre_b[k] + T_a_b[:3, 3]
        own = likelihood_at(ndt_map, clouds[-1], self.T_a_patch[k], -1)
        return 1.0 - likelihood_at(ndt_map, clouds[-1], other, -1) / max(own, 1e-9)

    def apart_m(self, T_a_b: F64) -> F64:
        """(m,) how far each compared patch moves from one motion to where it lies on the surfaces of a, metres."""
        surface_a = Surface.of(self.thin_a)
        surface_b = Surface.of(self.thin_b)
        compared = np.flatnonzero(self.compared)
        # Patches share points: each normal is taken once, and as many as decide where b lies on a.
        matched = np.unique(np.concatenate([self.points[k][1] for k in compared]))
        matched = np.random.default_rng(0).permutation(matched)[: PLANE_MATCH.most_points]
        normal, flatness = surface_b.normals(self.thin_b[matched])
        out = []
        for k in compared:
            own = np.isin(matched, self.points[k][1])
            start = T_a_b.copy()
            start[:3, 3] = T_a_b[:3, :3] @ self.centre_b[k] + T_a_b[:3, 3]
            information = np.asarray(np.linalg.inv(self.covariance[k]), dtype=np.float64)
            points = self.thin_b[matched[own]] - self.centre_b[k]
            refined = refine_on_planes(surface_a, points, (normal[own], flatness[own]), start, information)
            out.append(np.linalg.norm(refined[:3, 3] - start[:3, 3]))
        return np.array(out)

    @property
    def bound_m(self) -> F64:
        """(k,) how far a patch may be off one motion without being bent."""
        numbers = self.numbers
        bent_m = np.full(len(self.lever_m), numbers.bent_m)
        return np.maximum.reduce([bent_m, 4.0 * self.sigma_m, numbers.floor_rad * self.lever_m])

    @property
    def sigma_m(self) -> F64:
        """(k,) largest standard deviation of the position."""
        return np.asarray(np.sqrt(np.linalg.eigvalsh(self.covariance[:, :3, :3])[:, -1]))


def register_patches(
    points_a: F64, points_b: F64, T_a_b: F64, paths: Sequence[F64], numbers: PatchNumbers = PATCHES
) -> Patches:
    """Every patch of b that overlaps a, registered from T_a_b. MapvoteError if none overlaps.

    ``paths``: (n, 3) each, from where a or b was measured, in a's frame by T_a_b."""
    thin_a = _thinned(points_a, numbers.thin_m)
    thin_b = _thinned(points_b, numbers.thin_m)
    tree_a = scipy.spatial.KDTree(thin_a[:, :2])
    tree_b = scipy.spatial.KDTree(thin_b[:, :2])
    path_trees = [scipy.spatial.KDTree(path) for path in paths]
    centres = []
    poses = []
    covariances = []
    inliers = []
    compared = []
    levers_m = []
    kept = []
    T = T_a_b
    corners = np.unique(np.floor(thin_b[:, :2] / numbers.step_m).astype(np.int64), axis=0)
    for corner in corners:
        # The points of b in the patch, and those of a around it.
        middle = numbers.step_m * (corner + 0.5)
        own = _in_square(tree_b, middle, numbers.side_m / 2)
        if len(own) < numbers.min_points:
            continue
        own_points = thin_b[own]
        centre = np.array([*middle, np.median(own_points[:, 2])])
        at = T[:3, :3] @ centre + T[:3, 3]
        near = _in_square(tree_a, at[:2], numbers.side_m / 2 + numbers.around_m)
        clouds = thin_for_levels(own_points - centre)
        if clouds[-1].shape[1] < numbers.min_points or len(near) < numbers.min_points:
            continue
        # Where the patch fits best by itself.
        guess = np.eye(4)
        guess[:3, :3] = T[:3, :3]
        guess[:3, 3] = at
        fit = _ndt(thin_a[near], at, numbers).refine(clouds, guess)
        sigma_m = float(np.sqrt(np.linalg.eigvalsh(fit.covariance[:3, :3])[-1]))
        centres.append(centre)
        poses.append(fit.T_map_lidar)
        covariances.append(fit.covariance)
        inliers.append(fit.inlier_share)
        levers_m.append(max((tree.query(at)[0] for tree in path_trees), default=0.0))
        kept.append((near, own))
        compared.append(fit.inlier_share > numbers.min_inliers and sigma_m < numbers.sure_m)
    if not centres:
        raise MapvoteError("the clouds do not overlap: no piece of one lies where the other has points")
    return Patches(
        np.array(centres),
        np.array(poses),
        np.array(covariances),
        np.array(inliers),
        np.array(compared),
        np.array(levers_m),
        thin_a,
        thin_b,
        tuple(kept),
        numbers,
    )


def _in_square(tree: scipy.spatial.KDTree, middle: F64, half_m: float) -> I64:
    """Which points of a tree lie in the square around ``middle`` (2,)."""
    return np.array(tree.query_ball_point(middle, half_m, p=np.inf), dtype=np.int64)


def _thinned(points: F64, size_m: float) -> F64:
    """One of the points (n, 3) per voxel of side ``size_m``, counted from a voxel at their own corner: the coordinates
    of a country reach beyond what a key of a voxel holds."""
    x0, y0 = size_m * np.floor(points[:, :2].min(axis=0) / size_m)
    return points[voxel_downsample(points, size_m, x0, y0)]


def _ndt(points: F64, centre: F64, numbers: PatchNumbers) -> NdtMap:
    ndt_map = NdtMap(centre, numbers=replace(NDT_WINDOW, half_window_m=numbers.side_m))
    ndt_map.enter(points)
    return ndt_map


@dataclass(frozen=True, slots=True)
class RigidFit:
    """One motion for all patches."""

    T_a_b: F64
    middle: F64
    """(3,) middle of the patches that agree, in a's frame."""
    covariance: F64
    """(6, 6) of (rho, phi) about ``middle``, in a's axes."""
    shift_m: F64
    """(k,) length of each patch's residual shift."""
    agree: Bool
    """(k,) compared patches that fit this motion."""
    bent: Bool
    """(k,) compared patches that do not, three of them or more side by side. Fewer show no bend, but nothing is
    compared there."""

    @property
    def sigma_m(self) -> float:
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[:3, :3])[-1]))

    @property
    def sigma_deg(self) -> float:
        return float(np.degrees(np.sqrt(np.linalg.eigvalsh(self.covariance[3:, 3:])[-1])))


def fit_rigid(patches: Patches, T_a_b: F64) -> RigidFit:
    """The motion on which most patches agree, from T_a_b. MapvoteError if no patch could be compared."""
    if not patches.compared.any():
        raise MapvoteError("no piece of one cloud fits the other: are they of one place, z up, in metres?")
    numbers = patches.numbers
    T = T_a_b.copy()
    # The information of each patch: its own, and the floor that noise, changes and turned scans leave.
    floor = np.tile(np.diag([numbers.floor_m**2] * 3 + [numbers.floor_rad**2] * 3), (len(patches.lever_m), 1, 1))
    floor[:, range(3), range(3)] += (numbers.floor_rad * patches.lever_m[:, None]) ** 2
    information = np.linalg.inv(patches.covariance + floor) * patches.compared[:, None, None]
    weights = np.ones(len(information))
    # Gauss-Newton steps of one motion about the middle of the patches, robustly.
    for round_ in range(numbers.rounds):
        r = patches.residuals(T)
        off = np.einsum("ki,kij,kj->k", r, information, r) / 6.0
        scale = max(2.0, 64.0 / 2.0**round_)  # wide at first: no start is so bad that all are outliers
        weights = (scale / (scale + off)) ** 2
        middle = np.average(patches.T_a_patch[:, :3, 3], axis=0, weights=np.where(patches.compared, weights, 0.0))
        J = np.tile(np.eye(6), (len(r), 1, 1))  # a turn about the middle moves each centre by phi x (centre - middle)
        J[:, :3, 3:] = -np.array([hat(p - middle) for p in patches.T_a_patch[:, :3, 3] - r[:, :3]])
        H = np.einsum("k,kji,kjl,klm->im", weights, J, information, J)
        step = np.linalg.solve(H + 1e-6 * np.eye(6), np.einsum("k,kji,kjl,kl->i", weights, J, information, r))
        about = np.eye(4)
        about[:3, 3] = middle
        T = about @ exp(step) @ inverse(about) @ T
    # The patches that agree, the covariance by their spread, and the patches that are bent.
    r = patches.residuals(T)
    agree = patches.compared & (np.linalg.norm(r[:, :3], axis=1) < numbers.bent_m)
    spread = max(1.0, float(np.einsum("ki,kij,kj->k", r, information, r)[agree].mean() / 6.0)) if agree.any() else 1.0
    # Neighbouring patches share points: a quarter of them are independent.
    covariance = np.linalg.inv(H + 1e-6 * np.eye(6)) * spread * (numbers.side_m / numbers.step_m) ** 2
    off = bent_under(patches, T)
    bent = np.zeros_like(off)
    for connected in _side_by_side(patches.T_a_patch[:, :2, 3], off, numbers):
        bent |= connected & (connected.sum() >= numbers.min_bent)
    return RigidFit(T, middle, covariance, np.linalg.norm(r[:, :3], axis=1), patches.compared & ~off, bent)


def bent_under(patches: Patches, T_a_b: F64) -> Bool:
    """(k,) compared patches that are off one motion by more than ``bound_m``, and that fit better where they are."""
    shift = np.linalg.norm(patches.residuals(T_a_b)[:, :3], axis=1)
    bent = patches.compared & (shift > patches.bound_m)
    for k in np.flatnonzero(bent):
        bent[k] = patches.gain(int(k), T_a_b) > patches.numbers.gain
    return np.asarray(bent)


def unbent(points_b: F64, patches: Patches, T_a_b: F64) -> F64:
    """points_b (m, 3) in a's frame, each moved by the compared patches around it, the nearer the more: the twists of
    their residuals are averaged with Gaussian weights of half a patch's side. Patches that are off without being bent
    move nothing."""
    residuals = patches.residuals(T_a_b)
    tells = bent_under(patches, T_a_b) | (np.linalg.norm(residuals[:, :3], axis=1) < patches.numbers.bent_m)
    r = np.where(tells[:, None], residuals, 0.0)[patches.compared]
    centres = patches.centre_b[patches.compared]
    # The weights of the nearest patches, for squares of 2 m.
    coarse, cell = np.unique(np.floor(points_b[:, :2] / 2.0).astype(np.int64), axis=0, return_inverse=True)
    nearest = min(8, len(centres))
    far, index = scipy.spatial.KDTree(centres[:, :2]).query(2.0 * coarse + 1.0, k=[*range(1, nearest + 1)])
    weight = np.exp(-0.5 * (far / (0.5 * patches.numbers.side_m)) ** 2) + 1e-12
    weight /= weight.sum(axis=1, keepdims=True)
    # Each point moved by the average.
    moves = np.tile(np.eye(4), (len(r), 1, 1))
    moves[:, :3, :3] = exps(np.column_stack([np.zeros((len(r), 3)), r[:, 3:]]))[:, :3, :3]
    at = centres @ T_a_b[:3, :3].T + T_a_b[:3, 3]
    rigid = points_b @ T_a_b[:3, :3].T + T_a_b[:3, 3]
    cell = cell.reshape(-1)
    out = np.zeros_like(rigid)
    for k in range(nearest):
        one = index[cell, k]
        moved = np.einsum("nij,nj->ni", moves[one][:, :3, :3], rigid - at[one]) + at[one] + r[one, :3]
        out += weight[cell, k, None] * moved
    return out


def parts_of(centre: F64, off: Bool, numbers: PatchNumbers = PATCHES) -> list[tuple[str, Bool]]:
    """(name, (k,) its patches) of each connected group of the patches ``off`` (k,), whose middles (k, 3) are in a's
    frame: "south of y = -45 m" where a half-plane divides the group from the patches that are not off, else a box.

    A half-plane divides them if it holds three of four of the group and three of four in it are of the group.
    """
    out = []
    for connected in _side_by_side(centre[:, :2], off, numbers):
        name = _half_plane(centre, connected, off, numbers)
        if name is None:
            low = centre[connected].min(axis=0) - numbers.side_m / 2
            high = centre[connected].max(axis=0) + numbers.side_m / 2
            name = f"in x {low[0]:.0f} to {high[0]:.0f}, y {low[1]:.0f} to {high[1]:.0f} m"
        out.append((name, connected))
    return out


def _side_by_side(centre_xy: F64, off: Bool, numbers: PatchNumbers) -> list[Bool]:
    """(k,) masks of the connected groups of the patches ``off``, the largest first."""
    members = np.flatnonzero(off)
    if not len(members):
        return []
    tree = scipy.spatial.KDTree(centre_xy[members])
    _, label = scipy.sparse.csgraph.connected_components(
        tree.sparse_distance_matrix(tree, 1.5 * numbers.step_m).tocsr(), directed=False
    )
    return [
        np.isin(np.arange(len(off)), members[label == number])
        for number in np.argsort(-np.bincount(label), kind="stable")
    ]


def _half_plane(centre: F64, connected: Bool, off: Bool, numbers: PatchNumbers) -> str | None:
    """The half-plane that divides the patches ``connected`` from those that are not ``off``; None without one."""
    best: tuple[float, str | None] = 0.75, None
    for axis, low, high in ((1, "south", "north"), (0, "west", "east")):
        values = centre[:, axis]
        for bound in np.unique(values[connected]):
            for inside, side, way in ((values <= bound, low, 1.0), (values >= bound, high, -1.0)):
                both = (connected & inside).sum()
                share = min(both / connected.sum(), both / (inside & (connected | ~off)).sum())
                if share >= best[0] and not inside.all():
                    best = share, f"{side} of {'xy'[axis]} = {bound + way * numbers.step_m / 2:.0f} m"
    return best[1]


@dataclass(frozen=True, slots=True)
class BentPart:
    """A part of a cloud that one rigid motion does not lay on the other."""

    name: str
    """A name such as "south of y = -45 m", in the frame of a."""
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
    """Share of its score by which the place is ahead of the best place elsewhere."""
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
        middle = self.fit.middle
        yaw = np.degrees(np.arctan2(T[1, 0], T[0, 0]))
        tilt = np.degrees(np.arccos(np.clip(T[2, 2], -1.0, 1.0)))
        dx, dy, dz = np.round(middle - transform(inverse(T), middle[None])[0], 3) + 0.0
        agree = int(self.fit.agree.sum())
        compared = int(self.patches.compared.sum())
        lines = [
            f"in the middle of the overlap (A's x {middle[0]:.1f}, y {middle[1]:.1f}, z {middle[2]:.1f}) B is moved by "
            f"x {dx:.3f}, y {dy:.3f}, z {dz:.3f} m, turned by {round(yaw, 3) + 0.0:.3f} deg, tilted by {tilt:.3f} deg "
            f"(+-{self.fit.sigma_m:.3f} m, {self.fit.sigma_deg:.3f} deg)",
            f"{agree} of {compared} patches of {self.patches.numbers.side_m:.0f} m agree on it; "
            f"the best place elsewhere scores {self.lead:.0%} less",
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
            (doubt if off else out)[far < self.patches.numbers.side_m / 2] = True
            nearest[int(off)] = np.minimum(nearest[int(off)], far)
        return np.asarray(out | (~doubt & (nearest[0] <= nearest[1])))

    def other_motions(self) -> list[tuple[F64, F64]]:
        """((2,) middle of each bent patch in a's frame, (4, 4) T that moves b's points, as they lie in a by the rigid
        motion, to where the patch itself fits). A difference under one motion may fit under another."""
        out = []
        for k in np.flatnonzero(self.patches.compared & ~self.fit.agree):
            T_patch = self.patches.T_a_patch[k]
            before = np.eye(4)
            before[:3, :3] = self.T_a_b[:3, :3]
            before[:3, 3] = self.T_a_b[:3, :3] @ self.patches.centre_b[k] + self.T_a_b[:3, 3]
            out.append((T_patch[:2, 3], T_patch @ np.linalg.inv(before)))
        return out


def register_maps(
    map_a: PointMap, map_b: PointMap, *, unbend: bool = False, numbers: PatchNumbers = PATCHES
) -> Registered:
    """Map or cloud b registered to a, metres, z up, without a prior.

    ``unbend``: move bent parts patch by patch, if that makes them fit. MapvoteError, with figures, where the place is
    ambiguous or nothing fits.
    """
    points_a = all_points(map_a)
    points_b = all_points(map_b)
    # A place that is clearly ahead of all others.
    placed = place_without_prior(points_a, points_b)
    if placed.lead < COARSE_SEARCH.min_lead:
        raise MapvoteError(
            f"the clouds fit at several places: the best one scores {placed.score:.2f}, the next one only "
            f"{placed.lead:.0%} less; are they of one place, and do they overlap by more than a street of equal houses?"
        )
    # One motion on which the patches agree, then moved onto the surfaces.
    paths = [np.concatenate(map_a.driven)] if map_a.driven else []
    paths += [transform(placed.T_a_b, np.concatenate(map_b.driven))] if map_b.driven else []
    patches = register_patches(points_a, points_b, placed.T_a_b, paths, numbers)
    fit = fit_rigid(patches, placed.T_a_b)
    agree = int(fit.agree.sum())
    if agree < numbers.min_fitting * patches.compared.sum() or not patches.compared.any():
        raise MapvoteError(
            f"only {agree} of {int(patches.compared.sum())} pieces agree on one motion: not one place, or badly bent"
        )
    fit = replace(fit, T_a_b=_on_surfaces(points_a, points_b, patches, fit))
    # Bent parts patch by patch, on request.
    moved = None
    refusal = ""
    if unbend and fit.bent.any():
        moved, refusal = _unbend(points_a, points_b, patches, fit, paths)
    rigid = points_b @ fit.T_a_b[:3, :3].T + fit.T_a_b[:3, 3]
    points = rigid if moved is None else moved
    return Registered(
        fit.T_a_b, points, placed.lead, patches, fit, _bent_parts(patches, fit), moved is not None, refusal
    )


def _on_surfaces(points_a: F64, points_b: F64, patches: Patches, fit: RigidFit) -> F64:
    """(4, 4) the motion of ``fit``, moved to where b lies on the surfaces of a, by the points in patches that agree."""
    numbers = patches.numbers
    T = np.eye(4)
    T[:3, :3] = fit.T_a_b[:3, :3]
    T[:3, 3] = fit.middle
    middle_b = transform(inverse(fit.T_a_b), fit.middle[None])[0]
    # Only points of b that a rigid motion lays on a, and the points of a around them.
    agree = scipy.spatial.KDTree(patches.T_a_patch[fit.agree, :2, 3])
    surfaces = []
    for points, T_a_points in ((points_a, np.eye(4)), (points_b, fit.T_a_b)):
        thin = _thinned(points, numbers.surface_m)
        apart = agree.query(transform(T_a_points, thin)[:, :2], p=np.inf, distance_upper_bound=numbers.side_m / 2)[0]
        surfaces.append(Surface.of(thin[np.isfinite(apart)]))
    surface_a, surface_b = surfaces
    matched = _thinned(surface_b.points, numbers.thin_m)
    matched = matched[np.random.default_rng(0).permutation(len(matched))[: PLANE_MATCH.most_points]]
    information = np.asarray(np.linalg.inv(fit.covariance), dtype=np.float64)
    T = refine_on_planes(surface_a, matched - middle_b, surface_b.normals(matched), T, information)
    T_a_b = T.copy()
    T_a_b[:3, 3] -= T[:3, :3] @ middle_b
    return T_a_b


def _bent_parts(patches: Patches, fit: RigidFit) -> tuple[BentPart, ...]:
    """The parts, the largest first."""
    shown = np.flatnonzero(patches.compared)
    parts = parts_of(patches.T_a_patch[shown, :3, 3], fit.bent[shown], patches.numbers)
    return tuple(BentPart(name, float(fit.shift_m[shown][part].max()), int(part.sum())) for name, part in parts)


def _unbend(
    points_a: F64, points_b: F64, patches: Patches, fit: RigidFit, paths: Sequence[F64]
) -> tuple[F64 | None, str]:
    """(points of b moved patch by patch, "") or (None, why that does not help)."""
    moved = unbent(points_b, patches, fit.T_a_b)
    again = register_patches(points_a, moved, np.eye(4), paths, patches.numbers)
    still = bent_under(again, np.eye(4))
    if still.sum() > patches.numbers.most_left * again.compared.sum():
        worst = float(np.linalg.norm(again.residuals(np.eye(4))[still, :3], axis=1).max())
        return None, (
            f"{int(still.sum())} of {int(again.compared.sum())} patches stay off by up to {worst:.1f} m: within "
            f"{patches.numbers.side_m:.0f} m the session is not rigid: objects beside each other are shifted by "
            "different amounts"
        )
    return moved, ""


def brought_into(map_a: PointMap, map_b: PointMap, *, unbend: bool = False) -> tuple[PointMap, Registered]:
    """(b as a map in a's frame on a's lattice, how it was registered).

    Its ground is computed anew from its points; its free space comes along, unless b was unbent. A map that lies in a's
    frame already is returned as it is. MapvoteError where they do not register.
    """
    registered = register_maps(map_a, map_b, unbend=unbend)
    if map_a.lattice == map_b.lattice and not registered.unbent and _is_in_place(registered, all_points(map_b)):
        return map_b, registered
    fields = all_fields(map_b)
    moved = map_from_points(registered.points, lattice=map_a.lattice, map_id=map_b.map_id, fields=fields)
    return moved if registered.unbent else with_free_space_of(moved, [map_b], registered.T_a_b[None]), registered


def _is_in_place(registered: Registered, points: F64) -> bool:
    T = registered.T_a_b
    numbers = registered.patches.numbers
    middle = np.median(points, axis=0)
    shift_m = np.linalg.norm(T[:3, :3] @ middle + T[:3, 3] - middle)
    return bool(shift_m < numbers.in_place_m and np.degrees(rotation_angle(T)) < numbers.in_place_deg)
