"""A drifting trajectory and rough anchors together know more than either."""

from itertools import pairwise

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from mapvote.core.geometry import exp, from_xyz_rpy, inverse, log
from mapvote.core.types import F64
from mapvote.slam.pose_graph import Anchors, Links, adjoint, optimise


def chain(n: int, step: F64) -> F64:
    poses = [np.eye(4)]
    for _ in range(n - 1):
        poses.append(poses[-1] @ step)
    return np.array(poses)


def links(first: F64, n: int, sigma_m: float = 0.003) -> Links:
    return Links(np.arange(n - 1), np.arange(1, n), first, sigma_m, 2e-4)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(-1, 1), min_size=6, max_size=6), st.floats(-5, 5), st.floats(-1, 1))
def test_adjoint_carries_a_motion_to_the_other_side(xi: list[float], x: float, yaw: float) -> None:
    T = from_xyz_rpy(x, 1.0, -2.0, 0.1, 0.2, yaw)
    np.testing.assert_allclose(exp(adjoint(T) @ np.array(xi)), T @ exp(xi) @ inverse(T), atol=1e-9)


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
