"""The frame of the priors: where all of them together have a track, wild ones apart."""

import numpy as np
import pytest

from mapvote.core.geometry import from_xyz_rpy, rotation_angle
from mapvote.core.types import F64
from mapvote.slam.prior_alignment import fit_to_priors, trust_in


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
