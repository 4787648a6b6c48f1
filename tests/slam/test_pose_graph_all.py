"""The draft follows its poses: what priors do to the path they do to the cloud under it."""

from __future__ import annotations

import numpy as np
import pytest

from mapvote.core.geometry import from_xyz_rpy
from mapvote.core.types import F64
from mapvote.slam.pose_graph_all import carried_along
from mapvote.slam.road_prior import road_under
from mapvote.slam.surveyor import Surveyed, is_precise
from streets import drive_along, path

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


def surveyed(poses: F64, lost: slice = slice(0, 0)) -> Surveyed:
    registered = np.ones(len(poses), np.bool_)
    registered[lost] = False
    return Surveyed(poses, registered, ())


def test_a_road_is_found_under_settled_poses_however_far_the_first_pass_drifted() -> None:
    drifted, settled = climbing(200, 1.5), climbing(200, 0.0)
    cloud = carried_along(road_of(drifted, 1), [surveyed(drifted)], [settled])
    assert np.abs(cloud[:, 2]).max() < 0.03
    road = road_under(settled, np.ones(200, np.bool_), cloud)
    assert abs(road.sensor_height_m - SENSOR_M) < 0.02
    np.testing.assert_allclose(road.points_map[:, 2], 0.0, atol=0.02)


def test_each_drive_carries_its_own_points_and_a_scan_that_was_lost_carries_none() -> None:
    one, other = climbing(50, 0.4), climbing(50, -0.8, x0=80.0)
    lost = one.copy()
    lost[20:25, :3, 3] += 30.0
    cloud = np.concatenate([road_of(one, 1), road_of(other, 2)])
    found = [surveyed(lost, slice(20, 25)), surveyed(other)]
    moved = carried_along(cloud, found, [climbing(50, 0.0), climbing(50, 0.0, x0=80.0)])
    assert np.abs(moved[:, 2]).max() < 0.1


def test_a_survey_without_priors_stays_where_it_is_to_the_last_bit() -> None:
    poses = climbing(30, 0.7)
    cloud = road_of(poses, 4)
    assert carried_along(cloud, [surveyed(poses)], [poses]).tobytes() == cloud.tobytes()


@pytest.mark.parametrize(
    ("sigma_m", "sigma_deg", "precise"), [(0.02, 0.05, True), (0.02, 1.0, False), (1.0, 0.05, False)]
)
def test_only_a_prior_that_knows_place_and_attitude_guides_registration(
    sigma_m: float, sigma_deg: float, precise: bool
) -> None:
    poses = path(2)
    assert is_precise(drive_along(poses, 1, poses, sigma_m=sigma_m, sigma_deg=sigma_deg)) is precise
