"""A drifting trajectory and rough anchors together know more than either."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import accumulate, pairwise

import numpy as np
import pytest

from mapvote.core.geometry import exp, from_xyz_rpy, inverse, log, rotation_angle
from mapvote.core.types import F64
from mapvote.survey.driven_road import road_under
from mapvote.survey.pose_graph import Anchors, DriveTrack, Links, carried_along, fit_to_priors, optimise, trust_in
from streets import drive_along, path


def chain(motions: Iterable[F64]) -> F64:
    """(n, 4, 4) poses from the origin on."""
    return np.array(list(accumulate(motions, np.matmul, initial=np.eye(4))))


def between(poses: F64) -> F64:
    return np.array([inverse(a) @ b for a, b in pairwise(poses)])


def links(motions: F64) -> Links:
    n = len(motions)
    return Links(np.arange(n), np.arange(1, n + 1), motions, 0.003, 2e-4)


def disturbed(poses: F64, rng: np.random.Generator, sigma_m: float, sigma_rad: float, turn_rad: float = 0.0) -> F64:
    noise = [np.r_[rng.normal(0, sigma_m, 3), rng.normal(turn_rad, sigma_rad, 3)] for _ in poses]
    return np.array([T @ exp(xi) for T, xi in zip(poses, noise, strict=True)])


def test_exact_measurements_are_kept_exactly_and_what_nothing_fixes_stays_where_it_is() -> None:
    truth = chain([from_xyz_rpy(1.0, 0.0, 0.02, 0.0, 0.01, 0.05)] * 39)
    start = np.array([T @ exp([0.1 * k, 0.05 * k, 0.0, 0.0, 0.0, 0.01 * k]) for k, T in enumerate(truth)])
    anchor = Anchors(np.array([0]), truth[:1], 0.01, 1e-4)
    np.testing.assert_allclose(optimise(start, [links(between(truth))], [anchor], 20), truth, atol=1e-4)
    np.testing.assert_allclose(optimise(start, [], []), start, atol=1e-12)


def test_anchors_take_the_drift_and_links_take_their_noise() -> None:
    rng = np.random.default_rng(4)
    truth = chain([from_xyz_rpy(1.0, 0.0, 0.0, 0.0, 0.0, 0.002)] * 299)
    motions = disturbed(between(truth), rng, 0.003, 2e-4, 1e-4)
    drifted, rough = chain(motions), disturbed(truth, rng, 0.1, 2e-3)
    fused = optimise(drifted, [links(motions)], [Anchors(np.arange(300), rough, 0.1, 2e-3)], 10)
    far, near, off = (np.linalg.norm((poses - truth)[:, :3, 3]) for poses in (drifted, rough, fused))
    assert off < 0.4 * near
    assert off < 0.1 * far


def test_a_step_is_the_least_squares_solution_of_all_residuals() -> None:
    """Against residuals differentiated by trial, an edge at a time."""
    rng = np.random.default_rng(8)
    truth = chain([from_xyz_rpy(1.0, 0.2, 0.0, 0.0, 0.02, 0.1)] * 5)
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


def test_each_drive_carries_its_own_points_a_lost_scan_none_and_what_has_no_prior_stays_to_the_last_bit() -> None:
    one, other = climbing(50, 0.4), climbing(50, -0.8, x0=80.0)
    lost = one.copy()
    lost[20:25, :3, 3] += 30.0
    cloud = np.concatenate([road_of(one, 1), road_of(other, 2)])
    found = [surveyed(lost, slice(20, 25)), surveyed(other)]
    settled = [surveyed(climbing(50, 0.0), slice(20, 25)), surveyed(climbing(50, 0.0, x0=80.0))]
    assert np.abs(carried_along(cloud, found, settled)[:, 2]).max() < 0.1
    assert carried_along(cloud, found, found).tobytes() == cloud.tobytes()


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
def test_a_turned_and_shifted_track_is_laid_back_and_wild_priors_and_a_long_jump_hardly_move_it(yaw_deg: float) -> None:
    T = from_xyz_rpy(500.0, -30.0, 4.0, 0.0, 0.0, np.radians(yaw_deg))
    told = track() @ T[:3, :3].T + T[:3, 3]
    np.testing.assert_allclose(fit_to_priors(track(), told, 1.0), T, atol=1e-6)
    rng = np.random.default_rng(3)
    told += rng.normal(0.0, 0.5, (400, 3))
    told[rng.choice(400, 20)] += 40.0
    told[100:140, 1] += 15.0
    off = inverse(T) @ fit_to_priors(track(), told, 0.5)
    assert np.linalg.norm(off[:3, 3]) < 0.5
    assert np.degrees(rotation_angle(off)) < 0.2


def test_a_standing_vehicle_learns_no_heading_from_noise() -> None:
    rng = np.random.default_rng(4)
    found = fit_to_priors(rng.normal(0, 0.01, (50, 3)), rng.normal(0, 1.0, (50, 3)), 1.0, yaw_rad=0.3)
    assert rotation_angle(found) == pytest.approx(0.3)


def test_trust_falls_with_the_square_of_the_distance() -> None:
    np.testing.assert_allclose(trust_in(np.array([0.0, 2.5, 250.0]), 1.0), [1.0, 0.5, 1e-4], rtol=1e-3)
