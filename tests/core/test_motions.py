"""What is said of many motions at once is what is said of each."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapvote.core import motions
from mapvote.core.geometry import exp, inverse, log, rotation_angle
from mapvote.core.types import F64

NUMBER = st.one_of(st.floats(-3.0, 3.0), st.sampled_from([0.0, 1e-12, -1e-9, 1e-7, np.pi, 3.1415920, -3.14159265]))
TANGENTS = st.lists(st.tuples(*[NUMBER] * 6), min_size=0, max_size=5).map(lambda xs: np.array(xs).reshape(-1, 6))


@settings(max_examples=200, deadline=None)
@given(TANGENTS)
def test_of_each_of_many_motions_the_same_is_said_as_of_one(xi: F64) -> None:
    T = motions.exps(xi)
    assert T.shape == (len(xi), 4, 4)
    for k, x in enumerate(xi):
        np.testing.assert_allclose(T[k], exp(x), atol=1e-14)
        np.testing.assert_allclose(motions.inverses(T)[k], inverse(T[k]), atol=1e-14)
        np.testing.assert_allclose(motions.logs(T)[k], log(T[k]), atol=1e-12)
        assert motions.rotation_angles(T)[k] == pytest.approx(rotation_angle(T[k]), abs=1e-12)


def test_the_way_to_tangent_vectors_and_back_ends_where_it_began() -> None:
    xi = np.random.default_rng(3).uniform(-1.7, 1.7, (200, 6))
    np.testing.assert_allclose(motions.logs(motions.exps(xi)), xi, atol=1e-9)


@settings(max_examples=30, deadline=None)
@given(TANGENTS, st.tuples(*[st.floats(-1.0, 1.0)] * 6))
def test_adjoints_carry_a_motion_to_the_other_side(of: F64, xi: tuple[float, ...]) -> None:
    T = motions.exps(of)
    for A, one in zip(motions.adjoints(T), T, strict=True):
        np.testing.assert_allclose(exp(A @ np.array(xi)), one @ exp(xi) @ inverse(one), atol=1e-9)
