"""Where all scans of all drives were, settled together: the shape from registration, the place from every prior.

Registration to a growing map is smooth but drifts; a prior does not drift but is rough. Gauss-Newton on SE(3) over the
whole trajectory keeps the shape of the one in the frame of the other. Source: Barfoot, State Estimation for Robotics,
8.1 and 9.

A precise prior (RTK) holds each pose. Ordinary ones (GNSS) err alike for seconds to minutes, jump and go wild. Odometry
keeps its shape far better than satellites keep their place, and satellites keep their place far better than one of them
does. So the first prior founds nothing: the whole is turned about the vertical and shifted to the robust least-squares
fit of them all. Then the graph lets the priors bend it only as far as their number of *independent* errors allows, none
of them more than its distance from the others allows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import scipy

from mapvote.core.geometry import adjoints, exps, from_xyz_rpy, inverses, logs, rotation_angles
from mapvote.core.record import record
from mapvote.core.sensor_height import NO_HEIGHTS, Heights
from mapvote.core.types import F64, I64, PRECISE_PRIOR, Bool, Drive
from mapvote.survey.driven_road import WrongAttitude


@dataclass(frozen=True, slots=True)
class Drift:
    """How far a drive's poses lie from its prior. With a coarse prior this is mostly the prior's own error."""

    median_m: float
    max_m: float
    median_deg: float


@dataclass(frozen=True, slots=True)
class DriveTrack:
    """The trajectory of one drive: as surveyed, in the frame of the draft, then settled, in that of the map."""

    drive: Drive
    """The drive, with a prior as precise as its scans show it, see ``wrong_attitude``."""
    T_map_lidar: F64
    """(n, 4, 4) a pose per scan; that of a scan that could not be registered is the best guess."""
    registered: Bool
    """(n,) whether the scan could be registered; the others do not enter the map."""
    broken: tuple[int, ...]
    """Scans at which the track began anew because nothing fitted: there only priors tie the map together."""
    sigma_m: F64
    """(n,) standard deviation of each settled position in the frame of the priors, NaN without any."""
    heights: Heights = NO_HEIGHTS
    """Heights of the sensor over the map's ground."""
    wrong_attitude: WrongAttitude | None = None
    """The error of the precise attitude that the prior states: the drive is built with a coarser one."""

    @property
    def vehicle(self) -> str:
        return self.drive.vehicle

    @property
    def drive_id(self) -> str:
        return self.drive.drive_id

    @property
    def driven(self) -> F64:
        """(m, 3) the positions of its registered scans, map metres."""
        return np.asarray(self.T_map_lidar[self.registered, :3, 3])

    @property
    def length_m(self) -> float:
        """Length of the way from scan to scan."""
        return float(np.linalg.norm(np.diff(self.T_map_lidar[:, :3, 3], axis=0), axis=1).sum())

    @property
    def drift(self) -> Drift | None:
        """Distance of the poses from the prior; None without a prior."""
        prior = self.drive.T_map_lidar_prior
        if prior is None:
            return None
        off = np.linalg.norm((self.T_map_lidar - prior)[:, :3, 3], axis=1)
        turn = np.degrees(rotation_angles(inverses(prior) @ self.T_map_lidar))
        return Drift(float(np.median(off)), float(off.max()), float(np.median(turn)))


@dataclass(frozen=True, slots=True)
class Links:
    """Measured motions: pose ``second[k]`` in the frame of pose ``first[k]``."""

    first: I64
    second: I64
    T_first_second: F64
    """(k, 4, 4)."""
    sigma_m: float
    sigma_rad: float


@dataclass(frozen=True, slots=True)
class Anchors:
    """Poses known in the map beforehand."""

    pose: I64
    T_map: F64
    """(k, 4, 4)."""
    sigma_m: float
    sigma_rad: float
    stated_m: float = 1.0
    """Sigma that each states for itself alone; ``sigma_m`` is wider where many err alike."""
    weights: F64 | None = None
    """(k,) in (0, 1], how far each is believed; None: all."""


def optimise(T_map: F64, links: list[Links], anchors: list[Anchors], iterations: int = 4) -> F64:
    """Poses (n, 4, 4) moved to the least-squares solution; those that nothing fixes stay where they are."""
    poses = T_map.copy()
    for _ in range(iterations):
        H, gradient = _normal_equations(poses, links, anchors)
        step = -np.asarray(scipy.sparse.linalg.spsolve(H, gradient.ravel())).reshape(len(poses), 6)
        poses = poses @ exps(step)
        if np.abs(step).max(initial=0.0) < 1e-6:
            break
    return poses


def position_sigmas(T_map: F64, links: list[Links], anchors: list[Anchors], chosen: I64) -> F64:
    """(k,) standard deviation of the positions of the poses ``chosen`` (k,), the largest over all directions."""
    H, _ = _normal_equations(T_map, links, anchors)
    solve = scipy.sparse.linalg.splu(H).solve
    out = []
    for i in chosen.tolist():
        unit = np.zeros((6 * len(T_map), 3))
        unit[6 * i : 6 * i + 3] = np.eye(3)
        out.append(np.sqrt(np.linalg.eigvalsh(solve(unit)[6 * i : 6 * i + 3])[-1]))
    return np.array(out)


def _normal_equations(poses: F64, links: list[Links], anchors: list[Anchors]) -> tuple[scipy.sparse.csc_matrix, F64]:
    """(6n, 6n) and (n, 6) of a Gauss-Newton step T exp(step). A tiny weight on the step holds free poses."""
    n = len(poses)
    gradient = np.zeros((n, 6))
    every = np.arange(n)
    blocks = [(every, every, np.broadcast_to(1e-6 * np.eye(6), (n, 6, 6)))]
    for link in links:
        W, (i, j) = _weight(link.sigma_m, link.sigma_rad), (link.first, link.second)
        T_i_j = inverses(poses[i]) @ poses[j]
        r = logs(inverses(link.T_first_second) @ T_i_j)
        A_t = -adjoints(inverses(T_i_j)).transpose(0, 2, 1)
        A_t_W = A_t * W
        np.add.at(gradient, i, (A_t_W * r[:, None, :]).sum(axis=2))
        np.add.at(gradient, j, W * r)
        blocks += [
            (i, i, A_t_W @ A_t.transpose(0, 2, 1)),
            (j, j, np.broadcast_to(np.diag(W), (len(j), 6, 6))),
            (i, j, A_t_W),
            (j, i, A_t_W.transpose(0, 2, 1)),
        ]
    for anchor in anchors:
        W = _weight(anchor.sigma_m, anchor.sigma_rad)
        i = anchor.pose
        believed = np.ones(len(i)) if anchor.weights is None else anchor.weights
        np.add.at(gradient, i, believed[:, None] * W * logs(inverses(anchor.T_map) @ poses[i]))
        blocks.append((i, i, believed[:, None, None] * np.diag(W)))
    first, second, values = (np.concatenate(part) for part in zip(*blocks, strict=True))
    row = np.broadcast_to(6 * first[:, None, None] + np.arange(6)[:, None], values.shape)
    col = np.broadcast_to(6 * second[:, None, None] + np.arange(6), values.shape)
    # Blocks that stand in the same place add up.
    H = scipy.sparse.csc_matrix((values.ravel(), (row.ravel(), col.ravel())), shape=(6 * n, 6 * n))
    return H, gradient


def _weight(sigma_m: float, sigma_rad: float) -> F64:
    """(6,) the diagonal of an information matrix."""
    return np.array([sigma_m**-2] * 3 + [sigma_rad**-2] * 3)


@record()
@dataclass(frozen=True, slots=True)
class PoseSettling:
    """Numbers of the adjustment of all poses."""

    prior_memory_s: float = 20.0
    """Time for which the errors of a coarser prior stay alike: those of GNSS without corrections change over it."""
    slack: float = 5.0
    """Factor on a precise prior's sigma: its errors are alike for a while."""
    link_sigma_m: float = 0.003
    """Random error of the shift from scan to scan."""
    link_sigma_rad: float = float(np.radians(0.01))
    """Random error of the turn from scan to scan."""
    revisit_m: float = 10.0
    """Distance within which a scan is linked to a much older one."""
    revisit_s: float = 10.0
    """Least age of that older scan."""
    reweighted: int = 3
    """Rounds in which the priors' weights are taken anew."""
    points_at_once: int = 100_000
    """Points that are moved together: each needs its own motion."""
    covariances: int = 12
    """Poses of a drive whose covariance is computed; the others are interpolated."""
    fit_rounds: int = 30
    """Rounds of the robust fit to the priors at most."""
    wild_sigmas: float = 2.5
    """Sigmas at which a prior weighs half; farther off its weight falls on (Cauchy)."""


POSE_SETTLING = PoseSettling()


def settle_poses(tracks: Sequence[DriveTrack], numbers: PoseSettling = POSE_SETTLING) -> tuple[list[DriveTrack], float]:
    """(the tracks with poses that agree with each other's motion and with all priors; how far the priors moved a scan
    at most, after the whole had been shifted and turned to fit them, metres). The given tracks, 0 without priors."""
    drives = [track.drive for track in tracks]
    starts = np.cumsum([0] + [len(track.T_map_lidar) for track in tracks])
    T = np.concatenate([track.T_map_lidar for track in tracks])
    placed = np.flatnonzero(np.concatenate([track.registered for track in tracks]))
    if not any(drive.T_map_lidar_prior is not None for drive in drives):
        return list(tracks), 0.0
    if not any(drive.has_precise_prior for drive in drives):
        T = _laid_on_priors(drives, T, placed, starts, numbers) @ T
    rigid = T
    links = _links(drives, T, placed, _pieces(tracks, starts), numbers)
    anchors = _anchors(drives, T, starts, numbers)
    for _ in range(numbers.reweighted):
        T = optimise(T, links, anchors)
        anchors = [replace(a, weights=trust_in(_off(T, a), a.stated_m, numbers)) for a in anchors]
    bent_m = float(np.linalg.norm((T - rigid)[:, :3, 3], axis=1).max())
    settled = zip(tracks, np.split(T, starts[1:-1]), _sigmas(T, links, anchors, starts, numbers), strict=True)
    return [replace(track, T_map_lidar=poses, sigma_m=sigma_m) for track, poses, sigma_m in settled], bent_m


def carried_along(
    points: F64, surveyed: Sequence[DriveTrack], settled: Sequence[DriveTrack], numbers: PoseSettling = POSE_SETTLING
) -> F64:
    """Points (n, 3) of the draft, each moved as the nearest scan was when the tracks ``surveyed`` were settled.

    The draft was measured at the poses of the first pass. A road that is looked for under settled poses in a draft that
    is not bent alike lies too high here and too low there, by all that the first pass has drifted.
    """
    before, after = (np.concatenate([t.T_map_lidar[t.registered] for t in tracks]) for tracks in (surveyed, settled))
    if np.array_equal(before, after):
        return points
    moved = after @ inverses(before)
    tree = scipy.spatial.cKDTree(before[:, :3, 3])
    out = np.empty_like(points)
    for first in range(0, len(points), numbers.points_at_once):
        part = slice(first, first + numbers.points_at_once)
        T = moved[tree.query(points[part])[1]]
        out[part] = np.einsum("nij,nj->ni", T[:, :3, :3], points[part]) + T[:, :3, 3]
    return out


def _sigmas(T: F64, links: list[Links], anchors: list[Anchors], starts: I64, numbers: PoseSettling) -> list[F64]:
    """(n,) for each drive: position sigmas, computed at some poses and interpolated between them."""
    ends = list(pairwise(starts.tolist()))
    computed = [np.unique(np.linspace(a, b - 1, numbers.covariances).round().astype(np.int64)) for a, b in ends]
    sigmas = position_sigmas(T, links, anchors, np.concatenate(computed))
    pieces = np.split(sigmas, np.cumsum([len(a) for a in computed])[:-1])
    return [np.interp(np.arange(a, b), at, s) for (a, b), at, s in zip(ends, computed, pieces, strict=True)]


def _pieces(tracks: Sequence[DriveTrack], starts: I64) -> I64:
    """(n,) number of the unbroken stretch that each scan belongs to."""
    begins = np.zeros(int(starts[-1]), dtype=np.int64)
    begins[starts[:-1]] = 1
    for start, one in zip(starts, tracks, strict=False):
        begins[start + np.array(one.broken, dtype=np.int64)] = 1
    return np.cumsum(begins)


def _laid_on_priors(drives: Sequence[Drive], T: F64, placed: I64, starts: I64, numbers: PoseSettling) -> F64:
    """(4, 4) one motion of the whole, from all drives' priors."""
    positions = []
    priors = []
    sigmas_m = []
    for start, drive in zip(starts, drives, strict=False):
        if drive.T_map_lidar_prior is not None:
            of_drive = placed[(placed >= start) & (placed < start + len(drive))]
            positions.append(T[of_drive, :3, 3])
            priors.append(drive.T_map_lidar_prior[of_drive - start, :3, 3])
            sigmas_m.append(drive.prior_sigma_m)
    return fit_to_priors(np.concatenate(positions), np.concatenate(priors), max(sigmas_m), numbers=numbers)


def _anchors(drives: Sequence[Drive], T: F64, starts: I64, numbers: PoseSettling) -> list[Anchors]:
    """All priors of all drives; scans that share one lasting error share one weight."""
    out = []
    for start, drive in zip(starts, drives, strict=False):
        if drive.T_map_lidar_prior is None:
            continue
        slack = numbers.slack
        if not drive.has_precise_prior:
            seconds = 1e-9 * float(drive.stamps_ns[-1] - drive.stamps_ns[0])
            alike = min(1.0, numbers.prior_memory_s / max(seconds, 1e-3)) * len(drive)
            slack = float(np.sqrt(max(alike, 1.0)))
        sigma_rad = numbers.slack * slack * float(np.radians(drive.prior_sigma_deg))
        anchor = Anchors(
            np.arange(start, start + len(drive)),
            drive.T_map_lidar_prior,
            slack * drive.prior_sigma_m,
            sigma_rad if not drive.has_precise_prior else slack * float(np.radians(drive.prior_sigma_deg)),
            stated_m=max(drive.prior_sigma_m, PRECISE_PRIOR.position_m),
        )
        out.append(replace(anchor, weights=trust_in(_off(T, anchor), anchor.stated_m, numbers)))
    return out


def _off(T: F64, anchors: Anchors) -> F64:
    return np.asarray(np.linalg.norm(T[anchors.pose, :3, 3] - anchors.T_map[:, :3, 3], axis=1))


def _links(drives: Sequence[Drive], T: F64, placed: I64, piece_of: I64, numbers: PoseSettling) -> list[Links]:
    """The motion from scan to scan, and from each scan to the nearest much older one near by: it was registered to the
    map that the older one made."""
    order = np.concatenate([np.asarray(drive.stamps_ns) for drive in drives])
    consecutive = piece_of[placed[:-1]] == piece_of[placed[1:]]
    pairs = [(placed[:-1][consecutive], placed[1:][consecutive])]
    tree = scipy.spatial.cKDTree(T[placed, :3, 3])
    first = []
    second = []
    for j, near in zip(placed, tree.query_ball_point(T[placed, :3, 3], numbers.revisit_m), strict=True):
        older = [
            i
            for i in placed[near]
            if i < j and (piece_of[i] != piece_of[j] or _apart(order, int(i), int(j), numbers.revisit_s))
        ]
        if older:
            first.append(min(older, key=lambda i: (float(np.linalg.norm(T[i, :3, 3] - T[j, :3, 3])), i)))
            second.append(j)
    pairs.append((np.array(first, dtype=np.int64), np.array(second, dtype=np.int64)))
    return [Links(a, b, inverses(T[a]) @ T[b], numbers.link_sigma_m, numbers.link_sigma_rad) for a, b in pairs]


def _apart(stamps_ns: I64, i: int, j: int, revisit_s: float) -> bool:
    return bool(abs(int(stamps_ns[j]) - int(stamps_ns[i])) > 1e9 * revisit_s)


def trust_in(off_m: F64, sigma_m: float, numbers: PoseSettling = POSE_SETTLING) -> F64:
    """(n,) weight in (0, 1] of priors that lie ``off_m`` (n,) from where the others have them."""
    return np.asarray(1.0 / (1.0 + (off_m / (numbers.wild_sigmas * sigma_m)) ** 2))


def fit_to_priors(
    positions: F64,
    prior_positions: F64,
    sigma_m: float,
    yaw_rad: float = 0.0,
    numbers: PoseSettling = POSE_SETTLING,
) -> F64:
    """(4, 4) turn about z and shift that fits positions (n, 3) to their priors (n, 3), robustly.

    ``yaw_rad`` is kept where the track is too short to say anything about it. Source: Umeyama 1991 for the fit, Cauchy
    weights for the wild.
    """
    spread = float(np.linalg.norm(positions[:, :2].std(axis=0)))
    T = _shifted(positions, prior_positions, yaw_rad, np.ones(len(positions)))
    scale = max(sigma_m, float(np.median(_distances(T, positions, prior_positions))))
    for _ in range(numbers.fit_rounds):
        weights = trust_in(_distances(T, positions, prior_positions), scale, numbers)
        yaw = _yaw(positions, prior_positions, weights) if spread > 3.0 * sigma_m else yaw_rad
        moved = _shifted(positions, prior_positions, yaw, weights)
        # The scale comes down to the stated sigma step by step: at first the whole track may look wild.
        scale = max(sigma_m, 0.7 * scale)
        if scale == sigma_m and np.abs(moved - T).max() < 1e-6:
            return moved
        T = moved
    return T


def _distances(T: F64, positions: F64, priors: F64) -> F64:
    return np.asarray(np.linalg.norm(positions @ T[:3, :3].T + T[:3, 3] - priors, axis=1))


def _yaw(positions: F64, priors: F64, weights: F64) -> float:
    w = weights / weights.sum()
    a = positions[:, :2] - w @ positions[:, :2]
    b = priors[:, :2] - w @ priors[:, :2]
    cross = w @ (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    dot = w @ (a * b).sum(axis=1)
    return float(np.arctan2(cross, dot))


def _shifted(positions: F64, priors: F64, yaw: float, weights: F64) -> F64:
    T = from_xyz_rpy(0.0, 0.0, 0.0, 0.0, 0.0, yaw)
    w = weights / weights.sum()
    T[:3, 3] = w @ priors - T[:3, :3] @ (w @ positions)
    return T
