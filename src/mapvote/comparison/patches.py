"""Is one rigid motion enough? A cloud is registered patch by patch, and the patches are compared.

A map whose SLAM has drifted is bent: no rigid motion registers it to another map. Each patch of it is small enough to
be rigid, and is registered by NDT from the motion of the whole. A robust rigid fit (iteratively reweighted Gauss-Newton
on SE(3), weights of Geman and McClure) through these registrations has the residual of every patch. Where it is larger
than its error allows, the cloud is bent there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from mapvote.core.geometry import exp, exps, hat, inverse, logs
from mapvote.core.types import F64, Bool, MapvoteError
from mapvote.core.voxels import voxel_downsample
from mapvote.localisation.ndt import fitness, refine
from mapvote.localisation.ndt_map import NdtMap
from mapvote.localisation.prepare import thin_for_levels

STEP_M, SIDE_M = 15.0, 30.0
"""Patches begin every STEP_M and are SIDE_M wide: neighbours share three quarters of their points."""
_LEAST_POINTS = 150
"""Voxels of .7 m that a patch must fill."""
_AROUND_M = 10.0
"""Margin of the other cloud around the patch."""
_MIN_INLIERS = 0.5
_SURE_M = 0.15
"""A patch whose standard deviation is larger is not used: ground alone leaves the shift along it open."""
_FLOOR_M, _FLOOR_RAD = 0.05, np.radians(0.5)
"""What patches disagree by for other reasons than a bend: noise, voxels, what changed, and turned scans. At 80 m
from the path of a survey half a degree is 0.7 m."""
BENT_M = 0.25
"""A patch that is off by more, by more than four standard deviations, and by more than a scan's turn explains at its
distance from the survey's path, may be bent."""
_GAIN = 0.1
"""It is bent if its own place fits better than the motion of the whole by such a share: along a wall without ends every
place fits alike."""
_STANDS_M = 0.5
_LEAST_BENT = 3
"""Patches side by side that are off: fewer are the sparse fringe of a survey, where NDT finds what it likes."""
_ROUNDS = 20


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
    points: tuple[tuple[F64, F64], ...]
    """Of each patch a's points around it, and its own from its centre."""

    def residuals(self, T_a_b: F64) -> F64:
        """(k, 6) of each patch against one motion: shift (metres) and turn (radians), in a's axes."""
        shift = self.T_a_patch[:, :3, 3] - (self.centre_b @ T_a_b[:3, :3].T + T_a_b[:3, 3])
        turned = np.tile(np.eye(4), (len(shift), 1, 1))
        turned[:, :3, :3] = self.T_a_patch[:, :3, :3] @ T_a_b[:3, :3].T
        return np.column_stack([shift, logs(turned)[:, 3:]])

    def gain(self, k: int, T_a_b: F64) -> float:
        """By which share of its likelihood what stands in patch k fits better at its own place than under one motion:
        its ground fits everywhere."""
        near, mine = self.points[k]
        ndt_map, clouds = _ndt(near, self.T_a_patch[k, :3, 3]), thin_for_levels(mine[_stands(mine)])
        other = T_a_b.copy()
        other[:3, 3] = T_a_b[:3, :3] @ self.centre_b[k] + T_a_b[:3, 3]
        finest = len(ndt_map.levels) - 1
        own = fitness(ndt_map, clouds, self.T_a_patch[k], finest)
        return 1.0 - fitness(ndt_map, clouds, other, finest) / max(own, 1e-9)

    @property
    def bound_m(self) -> F64:
        """(k,) how far a patch may be off one motion without being bent."""
        return np.maximum.reduce([np.full(len(self.lever_m), BENT_M), 4.0 * self.sigma_m, _FLOOR_RAD * self.lever_m])

    @property
    def sigma_m(self) -> F64:
        """(k,) largest standard deviation of the position."""
        return np.asarray(np.sqrt(np.linalg.eigvalsh(self.covariance[:, :3, :3])[:, -1]))


def register_patches(points_a: F64, points_b: F64, T_a_b: F64, paths: Sequence[F64]) -> Patches:
    """Every patch of b that overlaps a, registered from T_a_b. MapvoteError if none overlaps.

    ``paths``: (n, 3) each, from where a or b was measured, in a's frame by T_a_b."""
    thin_a, thin_b = points_a[voxel_downsample(points_a, 0.3)], points_b[voxel_downsample(points_b, 0.3)]
    tree_a, tree_b = KDTree(thin_a[:, :2]), KDTree(thin_b[:, :2])
    path_trees = [KDTree(path) for path in paths]
    centres, poses, covariances, inliers, compared, levers_m, kept = [], [], [], [], [], [], []
    T = T_a_b
    corners = np.unique(np.floor(thin_b[:, :2] / STEP_M).astype(np.int64), axis=0)
    for corner in corners:
        middle = STEP_M * (corner + 0.5)
        mine = thin_b[tree_b.query_ball_point(middle, SIDE_M / 2, p=np.inf)]
        if len(mine) < _LEAST_POINTS:
            continue
        centre = np.array([*middle, np.median(mine[:, 2])])
        at = T[:3, :3] @ centre + T[:3, 3]
        near = thin_a[tree_a.query_ball_point(at[:2], SIDE_M / 2 + _AROUND_M, p=np.inf)]
        clouds = thin_for_levels(mine - centre)
        if clouds[-1].shape[1] < _LEAST_POINTS or len(near) < _LEAST_POINTS:
            continue
        guess = np.eye(4)
        guess[:3, :3], guess[:3, 3] = T[:3, :3], at
        found = refine(_ndt(near, at), clouds, guess)
        sigma_m = float(np.sqrt(np.linalg.eigvalsh(found.covariance[:3, :3])[-1]))
        centres.append(centre)
        poses.append(found.T_map_lidar)
        covariances.append(found.covariance)
        inliers.append(found.inlier_share)
        levers_m.append(max((tree.query(at)[0] for tree in path_trees), default=0.0))
        kept.append((near, mine - centre))
        compared.append(found.inlier_share > _MIN_INLIERS and sigma_m < _SURE_M)
    if not centres:
        raise MapvoteError("the clouds do not overlap: no piece of one lies where the other has points")
    return Patches(
        np.array(centres),
        np.array(poses),
        np.array(covariances),
        np.array(inliers),
        np.array(compared),
        np.array(levers_m),
        tuple(kept),
    )


def _stands(points: F64) -> Bool:
    """(n,) points that lie higher than _STANDS_M above the lowest one of their square metre."""
    _, cell = np.unique(np.floor(points[:, :2]).astype(np.int64), axis=0, return_inverse=True)
    lowest = np.full(len(points), np.inf)
    np.minimum.at(lowest, cell.reshape(-1), points[:, 2])
    return np.asarray(points[:, 2] > lowest[cell.reshape(-1)] + _STANDS_M)


def _ndt(points: F64, centre: F64) -> NdtMap:
    ndt_map = NdtMap(centre, half_window_m=SIDE_M)
    ndt_map.enter(points)
    return ndt_map


@dataclass(frozen=True, slots=True)
class RigidFit:
    """One motion for all patches."""

    T_a_b: F64
    covariance: F64
    """(6, 6) of (rho, phi) about the middle of the patches that agree, in a's axes."""
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
    T = T_a_b.copy()
    floor = np.tile(np.diag([_FLOOR_M**2] * 3 + [_FLOOR_RAD**2] * 3), (len(patches.lever_m), 1, 1))
    floor[:, range(3), range(3)] += (_FLOOR_RAD * patches.lever_m[:, None]) ** 2
    information = np.linalg.inv(patches.covariance + floor) * patches.compared[:, None, None]
    weights = np.ones(len(information))
    for round_ in range(_ROUNDS):
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
    r = patches.residuals(T)
    agree = patches.compared & (np.linalg.norm(r[:, :3], axis=1) < BENT_M)
    spread = max(1.0, float(np.einsum("ki,kij,kj->k", r, information, r)[agree].mean() / 6.0)) if agree.any() else 1.0
    # Neighbouring patches share points: a quarter of them are independent.
    covariance = np.linalg.inv(H + 1e-6 * np.eye(6)) * spread * (SIDE_M / STEP_M) ** 2
    off = bent_under(patches, T)
    bent = np.zeros_like(off)
    for mine in _side_by_side(patches.T_a_patch[:, :2, 3], off):
        bent |= mine & (mine.sum() >= _LEAST_BENT)
    return RigidFit(T, covariance, np.linalg.norm(r[:, :3], axis=1), patches.compared & ~off, bent)


def bent_under(patches: Patches, T_a_b: F64) -> Bool:
    """(k,) compared patches that are off one motion by more than ``bound_m``, and that fit better where they are."""
    shift = np.linalg.norm(patches.residuals(T_a_b)[:, :3], axis=1)
    bent = patches.compared & (shift > patches.bound_m)
    for k in np.flatnonzero(bent):
        bent[k] = patches.gain(int(k), T_a_b) > _GAIN
    return np.asarray(bent)


def unbent(points_b: F64, patches: Patches, T_a_b: F64) -> F64:
    """points_b (m, 3) in a's frame, each moved by the compared patches around it, the nearer the more: the twists of
    their residuals are averaged with Gaussian weights of half a patch's side. What is off without being bent stays."""
    residuals = patches.residuals(T_a_b)
    tells = bent_under(patches, T_a_b) | (np.linalg.norm(residuals[:, :3], axis=1) < BENT_M)
    r = np.where(tells[:, None], residuals, 0.0)[patches.compared]
    centres = patches.centre_b[patches.compared]
    coarse, cell = np.unique(np.floor(points_b[:, :2] / 2.0).astype(np.int64), axis=0, return_inverse=True)
    nearest = min(8, len(centres))
    far, index = KDTree(centres[:, :2]).query(2.0 * coarse + 1.0, k=[*range(1, nearest + 1)])
    weight = np.exp(-0.5 * (far / (0.5 * SIDE_M)) ** 2) + 1e-12
    weight /= weight.sum(axis=1, keepdims=True)
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


def parts_of(centre: F64, off: Bool) -> list[tuple[str, Bool]]:
    """(name, (k,) its patches) of each connected group of the patches ``off`` (k,), whose middles (k, 3) are in a's
    frame: "south of y = -45 m" where a half-plane divides the group from the patches that are not off, else a box.

    A half-plane divides them if it holds three of four of the group and three of four in it are of the group.
    """
    out = []
    for mine in _side_by_side(centre[:, :2], off):
        name = _half_plane(centre, mine, off)
        if name is None:
            low, high = centre[mine].min(axis=0) - SIDE_M / 2, centre[mine].max(axis=0) + SIDE_M / 2
            name = f"in x {low[0]:.0f} to {high[0]:.0f}, y {low[1]:.0f} to {high[1]:.0f} m"
        out.append((name, mine))
    return out


def _side_by_side(centre_xy: F64, off: Bool) -> list[Bool]:
    """(k,) masks of the connected groups of the patches ``off``, the largest first."""
    members = np.flatnonzero(off)
    if not len(members):
        return []
    tree = KDTree(centre_xy[members])
    _, label = connected_components(tree.sparse_distance_matrix(tree, 1.5 * STEP_M).tocsr(), directed=False)
    return [
        np.isin(np.arange(len(off)), members[label == number])
        for number in np.argsort(-np.bincount(label), kind="stable")
    ]


def _half_plane(centre: F64, mine: Bool, off: Bool) -> str | None:
    """The name of the half-plane that divides the patches ``mine`` from those that are not ``off``; None without."""
    best: tuple[float, str | None] = 0.75, None
    for axis, low, high in ((1, "south", "north"), (0, "west", "east")):
        values = centre[:, axis]
        for bound in np.unique(values[mine]):
            for inside, side, way in ((values <= bound, low, 1.0), (values >= bound, high, -1.0)):
                share = min((mine & inside).sum() / mine.sum(), (mine & inside).sum() / (inside & (mine | ~off)).sum())
                if share >= best[0] and not inside.all():
                    best = share, f"{side} of {'xy'[axis]} = {bound + way * STEP_M / 2:.0f} m"
    return best[1]
