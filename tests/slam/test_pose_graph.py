"""A drifting trajectory and rough anchors together know more than either."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from mapvote.core.geometry import exp, from_xyz_rpy, inverse, log, rotation_angle
from mapvote.core.types import F64
from mapvote.slam.driven_road import road_under
from mapvote.slam.pose_graph import Anchors, DriveTrack, Links, carried_along, fit_to_priors, optimise, trust_in
from streets import drive_along, path


def chain(n: int, step: F64) -> F64:
    poses = [np.eye(4)]
    for _ in range(n - 1):
        poses.append(poses[-1] @ step)
    return np.array(poses)


def links(first: F64, n: int, sigma_m: float = 0.003) -> Links:
    return Links(np.arange(n - 1), np.arange(1, n), first, sigma_m, 2e-4)


def test_exact_measurements_are_kept_exactly() -> None:
    truth = chain(40, from_xyz_rpy(1.0, 0.0, 0.02, 0.0, 0.01, 0.05))
    motions = np.array([inverse(a) @ b for a, b in pairwise(truth)])
    start = np.array([T @ exp([0.1 * k, 0.05 * k, 0.0, 0.0, 0.0, 0.01 * k]) for k, T in enumerate(truth)])
    anchor = Anchors(np.array([0]), truth[:1], 0.01, 1e-4)
    np.testing.assert_allclose(optimise(start, [links(motions, 40)], [anchor], 20), truth, atol=1e-4)


def test_anchors_take_the_drift_and_links_take_their_noise() -> None:
    rng = np.random.default_rng(4)
    truth = chain(300, from_xyz_rpy(1.0, 0.0, 0.0, 0.0, 0.0, 0.002))
    true_motions = [inverse(a) @ b for a, b in pairwise(truth)]
    motions = np.array([T @ exp(np.r_[rng.normal(0, 0.003, 3), rng.normal(1e-4, 2e-4, 3)]) for T in true_motions])
    drifted = np.array([np.eye(4)] * 300)
    for k, motion in enumerate(motions):
        drifted[k + 1] = drifted[k] @ motion
    rough = np.array([T @ exp(np.r_[rng.normal(0, 0.1, 3), rng.normal(0, 2e-3, 3)]) for T in truth])
    fused = optimise(drifted, [links(motions, 300)], [Anchors(np.arange(300), rough, 0.1, 2e-3)], 10)

    def rms(poses: F64) -> float:
        return float(np.sqrt(np.mean(np.sum((poses - truth)[:, :3, 3] ** 2, axis=1))))

    assert rms(fused) < 0.4 * rms(rough)
    assert rms(fused) < 0.1 * rms(drifted)


def test_what_nothing_fixes_stays_where_it_is() -> None:
    poses = chain(5, from_xyz_rpy(1.0, 0.0, 0.0))
    moved = optimise(poses, [], [])
    assert max(np.abs(log(inverse(a) @ b)).max() for a, b in zip(poses, moved, strict=True)) < 1e-12


def test_a_step_is_the_least_squares_solution_of_all_residuals() -> None:
    """Against residuals differentiated by trial, an edge at a time."""
    rng = np.random.default_rng(8)
    truth = chain(6, from_xyz_rpy(1.0, 0.2, 0.0, 0.0, 0.02, 0.1))
    T = np.array([pose @ exp(rng.normal(0.0, 0.01, 6)) for pose in truth])
    first, second = np.array([0, 1, 2, 3, 4, 0]), np.array([1, 2, 3, 4, 5, 5])
    motions = np.array([inverse(truth[i]) @ truth[j] for i, j in zip(first, second, strict=True)])
    graph = [Links(first, second, motions, 0.01, 0.002)]
    anchors = [Anchors(np.array([0, 3]), truth[[0, 3]], 0.1, 0.01, weights=np.array([1.0, 0.25]))]

    def residuals(step: F64) -> F64:
        moved = np.array([pose @ exp(xi) for pose, xi in zip(T, step.reshape(-1, 6), strict=True)])
        scale, rough = np.array([0.01] * 3 + [0.002] * 3), np.array([0.1] * 3 + [0.01] * 3)
        edges = zip(first, second, motions, strict=True)
        linked = [log(inverse(Z) @ inverse(moved[i]) @ moved[j]) / scale for i, j, Z in edges]
        anchored = [np.sqrt(w) * log(inverse(truth[i]) @ moved[i]) / rough for i, w in ((0, 1.0), (3, 0.25))]
        return np.concatenate(linked + anchored)

    found = optimise(T, graph, anchors, 10)
    at = np.concatenate([log(inverse(a) @ b) for a, b in zip(T, found, strict=True)])
    for nudge in 1e-4 * rng.normal(size=(50, 36)):
        assert np.sum(residuals(at + nudge) ** 2) > np.sum(residuals(at) ** 2)


SENSOR_M = 1.8


def climbing(n: int, drift_m: float, x0: float = 0.0) -> F64:
    """(n, 4, 4) a metre apart along x, 1.8 m above a flat road, by a first pass that drifts up to ``drift_m``."""
    z = SENSOR_M + drift_m * np.linspace(0.0, 1.0, n) ** 2
    pitch = -np.arctan(np.gradient(z))
    return np.array([from_xyz_rpy(x0 + i, 0.0, z[i], 0.0, pitch[i], 0.0) for i in range(n)])


def road_of(poses: F64, seed: int) -> F64:
    """(n, 3) the road that each scan measures within 2 m below itself, as it lies in the frame of the first pass."""
    rng = np.random.default_rng(seed)
    own = np.column_stack([rng.uniform(-2.0, 2.0, (40, 2)), np.full(40, -SENSOR_M)])
    return np.concatenate([own @ T[:3, :3].T + T[:3, 3] for T in poses])


def surveyed(poses: F64, lost: slice = slice(0, 0)) -> DriveTrack:
    registered = np.ones(len(poses), np.bool_)
    registered[lost] = False
    return DriveTrack(drive_along(poses, 1), poses, registered, (), np.full(len(poses), np.nan))


def test_a_road_is_found_under_settled_poses_however_far_the_first_pass_drifted() -> None:
    drifted, settled = climbing(200, 1.5), climbing(200, 0.0)
    cloud = carried_along(road_of(drifted, 1), [surveyed(drifted)], [surveyed(settled)])
    assert np.abs(cloud[:, 2]).max() < 0.03
    road = road_under(settled, np.ones(200, np.bool_), cloud)
    np.testing.assert_allclose(road[:, 2], 0.0, atol=0.02)


def test_each_drive_carries_its_own_points_and_a_scan_that_was_lost_carries_none() -> None:
    one, other = climbing(50, 0.4), climbing(50, -0.8, x0=80.0)
    lost = one.copy()
    lost[20:25, :3, 3] += 30.0
    cloud = np.concatenate([road_of(one, 1), road_of(other, 2)])
    found = [surveyed(lost, slice(20, 25)), surveyed(other)]
    settled = [surveyed(climbing(50, 0.0), slice(20, 25)), surveyed(climbing(50, 0.0, x0=80.0))]
    moved = carried_along(cloud, found, settled)
    assert np.abs(moved[:, 2]).max() < 0.1


def test_a_survey_without_priors_stays_where_it_is_to_the_last_bit() -> None:
    poses = climbing(30, 0.7)
    cloud = road_of(poses, 4)
    assert carried_along(cloud, [surveyed(poses)], [surveyed(poses)]).tobytes() == cloud.tobytes()


@pytest.mark.parametrize(
    ("sigma_m", "sigma_deg", "precise"), [(0.02, 0.05, True), (0.02, 1.0, False), (1.0, 0.05, False)]
)
def test_only_a_prior_that_knows_place_and_attitude_guides_registration(
    sigma_m: float, sigma_deg: float, precise: bool
) -> None:
    poses = path(2)
    assert drive_along(poses, 1, poses, sigma_m=sigma_m, sigma_deg=sigma_deg).has_precise_prior is precise


def track() -> F64:
    """(400, 3) 400 m round a corner."""
    s = np.linspace(0.0, 200.0, 200)
    return np.vstack([np.column_stack([s, 0 * s, 0 * s]), np.column_stack([200 + 0 * s, s, 0 * s])])


@pytest.mark.parametrize("yaw_deg", [0.0, 2.0, 90.0, 179.0])
def test_a_turned_and_shifted_track_is_laid_back(yaw_deg: float) -> None:
    T = from_xyz_rpy(500.0, -30.0, 4.0, 0.0, 0.0, np.radians(yaw_deg))
    found = fit_to_priors(track(), track() @ T[:3, :3].T + T[:3, 3], 1.0)
    np.testing.assert_allclose(found, T, atol=1e-6)


def test_wild_priors_and_a_long_jump_hardly_move_it() -> None:
    rng = np.random.default_rng(3)
    told = track() + rng.normal(0.0, 0.5, (400, 3))
    told[rng.choice(400, 20)] += 40.0
    told[100:140, 1] += 15.0
    found = fit_to_priors(track(), told, 0.5)
    assert np.linalg.norm(found[:3, 3]) < 0.5
    assert np.degrees(rotation_angle(found)) < 0.2


def test_a_standing_vehicle_learns_no_heading_from_noise() -> None:
    rng = np.random.default_rng(4)
    found = fit_to_priors(rng.normal(0, 0.01, (50, 3)), rng.normal(0, 1.0, (50, 3)), 1.0, yaw_rad=0.3)
    assert rotation_angle(found) == pytest.approx(0.3)


def test_trust_falls_with_the_square_of_the_distance() -> None:
    np.testing.assert_allclose(trust_in(np.array([0.0, 2.5, 250.0]), 1.0), [1.0, 0.5, 1e-4], rtol=1e-3)
