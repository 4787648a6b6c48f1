"""Clouds are registered without a prior, and what is bent is named."""

from __future__ import annotations

import numpy as np
import pytest

from made_courts import made_court
from mapvote.comparison.register import register_clouds
from mapvote.core.geometry import from_xyz_rpy, inverse, transform
from mapvote.core.types import F64, MapvoteError


@pytest.fixture(scope="module")
def court() -> F64:
    return made_court()


@pytest.mark.parametrize("yaw_deg", [7.0, 101.0, -163.0])
def test_a_cloud_turned_by_any_yaw_and_moved_far_off_is_found(court: F64, yaw_deg: float) -> None:
    T = from_xyz_rpy(340.0, -1200.0, 55.0, roll=0.01, yaw=np.radians(yaw_deg))
    found = register_clouds(court, transform(inverse(T), made_court(seed=2)))
    off = transform(found.T_a_b @ inverse(T), court) - court
    assert np.linalg.norm(off, axis=1).max() < 0.15
    assert np.median(np.linalg.norm(off, axis=1)) < 0.08
    assert not found.bent
    assert found.fit.sigma_m < 0.05


def test_the_drifted_part_of_a_session_is_named_with_how_far_it_is_off(court: F64) -> None:
    bent = made_court(seed=3)
    east = np.maximum(bent[:, 0] - 12.0, 0.0)
    bent[:, 1] += 0.004 * east**2
    found = register_clouds(court, bent)
    assert [part.name.split(" = ")[0] for part in found.bent] == ["east of x"]
    assert 0.5 < found.bent[0].most_m < 1.8
    whole = register_clouds(court, bent, unbend=True)
    assert whole.unbent
    off = whole.points - made_court(seed=3)
    assert np.quantile(np.abs(off[:, 1]), 0.9) < 0.15


def test_two_planes_of_ground_cannot_be_registered() -> None:
    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform(-30, 30, (20_000, 2)), rng.normal(0, 0.01, 20_000)])
    with pytest.raises(MapvoteError, match="nothing stands"):
        register_clouds(ground, ground)
