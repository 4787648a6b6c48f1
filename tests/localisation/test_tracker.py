"""A vehicle follows the street, knows when it is lost, and finds back."""

import numpy as np
import pytest

from mapvote.config import NdtSettings
from mapvote.core.geometry import exp, from_xyz_rpy, inverse, rotation_angle, transform
from mapvote.core.point_map import PointMap, map_from_points
from mapvote.core.types import F64, Scan
from mapvote.localisation.ndt import PosePrior
from mapvote.localisation.tracker import MapWindow, Tracker, window_points
from streets import path, street, sweep, twist_of

SETTINGS = NdtSettings()
POSES = path(12)


@pytest.fixture(scope="module")
def point_map() -> PointMap:
    return map_from_points(street(1, 2.0))


@pytest.fixture
def tracker(point_map: PointMap) -> Tracker:
    return Tracker(MapWindow(point_map, SETTINGS), SETTINGS)


def scan(i: int) -> Scan:
    return sweep(street(100 + i, 0.6), POSES[i], twist_of(POSES, i), (i + 1) * 100_000_000)


def off(T: F64, i: int) -> float:
    return float(np.linalg.norm(T[:3, 3] - POSES[i][:3, 3]))


def prior(i: int, *shift: float, yaw_deg: float = 0.0, sigma_m: float = 1.0) -> PosePrior:
    T = POSES[i] @ from_xyz_rpy(0, 0, 0, 0, 0, np.radians(yaw_deg))
    T[:3, 3] += shift or (0.0, 0.0, 0.0)
    return PosePrior(T, sigma_m, np.radians(sigma_m))


def test_a_drive_with_coarse_priors_is_followed_within_centimetres(tracker: Tracker) -> None:
    rng = np.random.default_rng(3)
    for i in range(len(POSES)):
        fix = tracker.localise(scan(i), prior(i, *rng.normal(0, [0.5, 0.5, 0.1]), yaw_deg=rng.normal(0, 1)))
        assert fix.trusted
        assert off(fix.registration.T_map_lidar, i) < 0.04
        assert np.degrees(rotation_angle(inverse(POSES[i]) @ fix.registration.T_map_lidar)) < 0.15


def test_the_first_pose_is_prior_enough(tracker: Tracker) -> None:
    for i in range(len(POSES)):
        fix = tracker.localise(scan(i), prior(0, 0.5, -0.5, 0.0) if i == 0 else None)
        assert fix.trusted
        assert off(fix.registration.T_map_lidar, i) < 0.04
    np.testing.assert_allclose(tracker.twist[0], 10.0, atol=0.5)


def test_points_come_back_de_skewed(tracker: Tracker) -> None:
    """Ten metres a second bend a scan by half a metre at its ends; de-skewed, walls lie where the street has them."""
    for i in range(3):
        fix = tracker.localise(scan(i), prior(i))
    points = transform(POSES[2], fix.points)
    side_wall = points[(points[:, 2] > 1.0) & (np.abs(points[:, 1]) > 13.0)]
    truth = np.arange(-40.0, 35.0, 19.0)
    distance = np.abs(side_wall[:, :1] - truth[None, :]).min(axis=1)
    assert np.median(distance) < 0.04


def test_a_vehicle_put_elsewhere_abstains_instead_of_voting(tracker: Tracker) -> None:
    tracker.localise(scan(0), prior(0))
    elsewhere = transform(from_xyz_rpy(0, 0, 0, 0, 0, 1.2), street(5, 0.6)[::2] * [1.0, 2.5, 1.0])
    lost = sweep(elsewhere, POSES[1], np.zeros(6), 200_000_000)
    fix = tracker.localise(lost, prior(1))
    assert not fix.trusted


def test_a_lost_vehicle_recovers_by_its_prior(tracker: Tracker) -> None:
    tracker.localise(scan(0), prior(0))
    blind = Scan(200_000_000, np.zeros((0, 3), dtype=np.float32), np.zeros(0, dtype=np.float32))
    assert not tracker.localise(blind, prior(1)).trusted
    fix = tracker.localise(scan(8), prior(8, 1.2, -1.0, 0.0, yaw_deg=3.0))
    assert fix.trusted
    assert off(fix.registration.T_map_lidar, 8) < 0.05


def test_only_the_map_around_the_vehicle_is_held(point_map: PointMap) -> None:
    here = window_points(point_map, np.array([0.0, 0.0, 0.0]), SETTINGS.half_window_m)
    assert len(here) == sum(len(tile.points) for tile in point_map.tiles.values())
    assert len(window_points(point_map, np.array([900.0, 0.0, 0.0]), SETTINGS.half_window_m)) == 0


def test_starts_one_metre_and_three_degrees_off_find_the_pose(point_map: PointMap) -> None:
    rng = np.random.default_rng(9)
    found = 0
    for k in range(20):
        i = 1 + k % (len(POSES) - 2)
        way, yaw = rng.uniform(0, 2 * np.pi), rng.choice([-3.0, 3.0])
        tracker = Tracker(MapWindow(point_map, SETTINGS), SETTINGS)
        tracker.twist = twist_of(POSES, i)
        fix = tracker.localise(scan(i), prior(i, np.cos(way), np.sin(way), 0.0, yaw_deg=float(yaw)))
        found += off(fix.registration.T_map_lidar, i) < 0.2
    assert found >= 17  # 85 %


def test_the_same_scans_give_the_same_poses_to_the_last_bit(point_map: PointMap) -> None:
    runs = []
    for _ in range(2):
        tracker = Tracker(MapWindow(point_map, SETTINGS), SETTINGS)
        runs.append([tracker.localise(scan(i), prior(i, 0.3, 0.2, 0.0)).registration.T_map_lidar for i in range(3)])
    np.testing.assert_array_equal(runs[0], runs[1])


def test_motion_found_by_one_scan_serves_the_next(tracker: Tracker) -> None:
    tracker.localise(scan(0), prior(0))
    predicted = POSES[0] @ exp(0.1 * tracker.twist)
    assert np.linalg.norm(predicted[:3, 3] - POSES[1][:3, 3]) < 0.3
