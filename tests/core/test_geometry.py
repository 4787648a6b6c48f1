"""SE(3): the group laws, and that log undoes exp. Azimuths as the C library says, corners and all."""

from itertools import product

import numba
import numpy as np
import pytest
import scipy
from hypothesis import given, settings
from hypothesis import strategies as st

from mapvote.core import geometry
from mapvote.core.geometry import exp, inverse, log, rotation_angle, turn
from mapvote.core.types import F32, F64

metres = st.floats(-100.0, 100.0)
angles = st.floats(-1.7, 1.7)  # |phi| < sqrt(3) * 1.7 < pi: where log is the inverse of exp
twists = st.tuples(metres, metres, metres, angles, angles, angles).map(np.array)


@given(twists)
def test_log_undoes_exp_and_the_inverse_is_the_motion_back(xi: np.ndarray) -> None:
    T = exp(xi)
    assert geometry.is_rigid(T)
    np.testing.assert_allclose(log(T), xi, atol=1e-6)
    np.testing.assert_allclose(inverse(T) @ T, np.eye(4), atol=1e-9)
    np.testing.assert_allclose(inverse(T), exp(-xi), atol=1e-9)


@given(twists, twists)
def test_interpolation_meets_both_ends_and_moves_at_constant_twist(a: np.ndarray, b: np.ndarray) -> None:
    T_0, T_1 = exp(a), exp(a) @ exp(0.5 * b)
    np.testing.assert_allclose(geometry.interpolate(T_0, T_1, 0.0), T_0, atol=1e-8)
    np.testing.assert_allclose(geometry.interpolate(T_0, T_1, 1.0), T_1, atol=1e-6)
    half = geometry.interpolate(T_0, T_1, 0.5)
    np.testing.assert_allclose(geometry.interpolate(T_0, half, 2.0), T_1, atol=1e-6)


numbers = st.floats(-2.0, 2.0)


@given(st.lists(st.tuples(numbers, numbers, numbers, numbers).filter(lambda q: np.linalg.norm(q) > 0.01), max_size=4))
def test_quaternions_of_any_length_are_the_rotations_that_scipy_gives(rows: list[tuple[float, ...]]) -> None:
    quaternions = np.array(rows).reshape(-1, 4)
    R = geometry.rotations_of(quaternions)
    assert R.shape == (len(rows), 3, 3)
    if rows:
        expected = scipy.spatial.transform.Rotation.from_quat(quaternions).as_matrix()
        np.testing.assert_allclose(R, expected, atol=1e-14)


def test_half_a_turn_has_a_logarithm() -> None:
    for axis in np.eye(3):
        xi = np.concatenate([np.zeros(3), np.pi * axis])
        T = exp(xi)
        np.testing.assert_allclose(exp(log(T)), T, atol=1e-6)
        assert abs(rotation_angle(T) - np.pi) < 1e-6


def test_yaw_turns_x_towards_y() -> None:
    T_map_lidar = geometry.from_xyz_rpy(10.0, 0.0, 2.0, yaw=np.pi / 2)
    np.testing.assert_allclose(geometry.transform(T_map_lidar, np.array([[1.0, 0.0, 0.0]])), [[10.0, 1.0, 2.0]])


def test_a_mirror_or_a_nan_is_not_rigid() -> None:
    assert not geometry.is_rigid(np.diag([1.0, -1.0, 1.0, 1.0]))
    assert not geometry.is_rigid(np.full((4, 4), np.nan))


def test_turn_is_the_azimuth_in_turns_to_1e_5_rad() -> None:
    angle = np.linspace(-np.pi, np.pi, 2001)
    found = [turn(np.float32(3.0 * np.cos(a)), np.float32(3.0 * np.sin(a))) for a in angle]
    off = 2.0 * np.pi * np.array(found) - angle
    assert np.abs((off + np.pi) % (2.0 * np.pi) - np.pi).max() < 2e-5
    assert turn(np.float32(0.0), np.float32(0.0)) == 0.0


@numba.njit(error_model="numpy")  # type: ignore[untyped-decorator]
def azimuths(y: F32, x: F32) -> F32:
    out = np.empty_like(x)
    for i in range(len(x)):
        out[i] = geometry.azimuth(y[i], x[i])
    return out


def test_the_azimuth_is_the_true_one_but_for_the_last_digit_and_signs_of_zero_count() -> None:
    """Near and far, on a grid too, so that many points lie on an axis or a diagonal."""
    rng = np.random.default_rng(3)
    x, y = (rng.normal(0.0, 1.0, (2, 300_000)) * 10.0 ** rng.uniform(-4.0, 3.0, (2, 300_000))).astype(np.float32)
    x[::3], y[::3] = np.round(x[::3], 1), np.round(y[::3], 1)
    corners = np.array(list(product([0.0, -0.0, 2.0, -2.0, 1e-30], [0.0, -0.0, 1.0, -1.0, 1e30, -1e30])), np.float32)
    y, x = np.append(y, corners[:, 0]), np.append(x, corners[:, 1])
    exact, found = np.arctan2(y.astype(np.float64), x.astype(np.float64)), azimuths(y, x)
    assert (np.abs(found - exact) / np.spacing(np.maximum(np.abs(exact), 1e-30).astype(np.float32))).max() < 1.5
    np.testing.assert_array_equal(np.signbit(found), np.signbit(exact))


NUMBER = st.one_of(st.floats(-3.0, 3.0), st.sampled_from([0.0, 1e-12, -1e-9, 1e-7, np.pi, 3.1415920, -3.14159265]))
TANGENTS = st.lists(st.tuples(*[NUMBER] * 6), min_size=0, max_size=5).map(lambda xs: np.array(xs).reshape(-1, 6))


@settings(max_examples=60, deadline=None)
@given(TANGENTS)
def test_functions_of_many_motions_agree_with_those_of_one(xi: F64) -> None:
    T = geometry.exps(xi)
    assert T.shape == (len(xi), 4, 4)
    for k, x in enumerate(xi):
        np.testing.assert_allclose(T[k], exp(x), atol=1e-14)
        np.testing.assert_allclose(geometry.inverses(T)[k], inverse(T[k]), atol=1e-14)
        np.testing.assert_allclose(geometry.logs(T)[k], log(T[k]), atol=1e-12)
        assert geometry.rotation_angles(T)[k] == pytest.approx(rotation_angle(T[k]), abs=1e-12)


@settings(max_examples=30, deadline=None)
@given(TANGENTS, st.tuples(*[st.floats(-1.0, 1.0)] * 6))
def test_adjoints_carry_a_motion_to_the_other_side(of: F64, xi: tuple[float, ...]) -> None:
    T = geometry.exps(of)
    for A, one in zip(geometry.adjoints(T), T, strict=True):
        np.testing.assert_allclose(exp(A @ np.array(xi)), one @ exp(xi) @ inverse(one), atol=1e-9)
