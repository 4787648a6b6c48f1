"""A drifting trajectory and rough anchors together know more than either."""

from itertools import pairwise

import numpy as np

from mapvote.core.geometry import exp, from_xyz_rpy, inverse, log
from mapvote.core.types import F64
from mapvote.slam.pose_graph import Anchors, Links, optimise


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
