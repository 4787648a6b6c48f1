"""A vehicle follows the street, knows when it is lost, and finds back."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mapvote.config import NdtSettings
from mapvote.core.geometry import from_xyz_rpy, inverse, rotation_angle, transform
from mapvote.core.point_map import PointMap, map_from_points
from mapvote.core.types import F64, PosePrior, Registration, Scan
from mapvote.matching.ndt_map import MapWindow, NdtMap
from mapvote.matching.odometry import Tracker, _differ
from mapvote.matching.prepare import Sample
from streets import path, street, sweep, twist_of

SETTINGS = NdtSettings()
POSES = path(12)
TENTH, SECOND = 100_000_000, 1_000_000_000


@pytest.fixture(scope="module")
def point_map() -> PointMap:
    return map_from_points(street(1, 2.0))


@pytest.fixture
def tracker(point_map: PointMap) -> Tracker:
    return Tracker(MapWindow(point_map), SETTINGS)


def scan(i: int) -> Scan:
    return sweep(street(100 + i, 0.6), POSES[i], twist_of(POSES, i), (i + 1) * 100_000_000)


def off(T: F64, i: int) -> float:
    return float(np.linalg.norm(T[:3, 3] - POSES[i][:3, 3]))


def prior(i: int, *shift: float, yaw_deg: float = 0.0, sigma_m: float = 1.0) -> PosePrior:
    T = POSES[i] @ from_xyz_rpy(0, 0, 0, 0, 0, np.radians(yaw_deg))
    T[:3, 3] += shift or (0.0, 0.0, 0.0)
    return PosePrior(T, sigma_m, np.radians(sigma_m))


@pytest.mark.parametrize("priors", [1, len(POSES)])
def test_a_drive_with_coarse_priors_or_only_a_first_one_is_followed_within_centimetres(
    tracker: Tracker, priors: int
) -> None:
    rng = np.random.default_rng(3)
    for i in range(len(POSES)):
        coarse = prior(i, *rng.normal(0, [0.5, 0.5, 0.1]), yaw_deg=rng.normal(0, 1))
        fix = tracker.localise(scan(i), coarse if i < priors else None)
        assert fix.trusted
        assert off(fix.registration.T_map_lidar, i) < 0.04
        assert np.degrees(rotation_angle(inverse(POSES[i]) @ fix.registration.T_map_lidar)) < 0.15
    np.testing.assert_allclose(tracker.twist[0], 10.0, atol=0.5)
    # Ten metres a second bend a scan by half a metre at its ends; de-skewed, walls lie where the street has them.
    points = transform(POSES[-1], fix.points)
    side_wall = points[(points[:, 2] > 1.0) & (np.abs(points[:, 1]) > 13.0)]
    distance = np.abs(side_wall[:, :1] - np.arange(-40.0, 35.0, 19.0)).min(axis=1)
    assert np.median(distance) < 0.04


@pytest.mark.parametrize("metres", [-9.0, -5.0, 4.0, 9.0])
def test_a_prior_metres_too_high_or_low_still_finds_the_road(tracker: Tracker, metres: float) -> None:
    for i in range(3):
        fix = tracker.localise(scan(i), prior(i, 1.0, -1.0, metres, sigma_m=2.5))
        assert fix.trusted
        assert off(fix.registration.T_map_lidar, i) < 0.04


def test_a_lost_vehicle_recovers_by_its_prior(tracker: Tracker) -> None:
    tracker.localise(scan(0), prior(0))
    assert not tracker.localise(blind(2 * TENTH), prior(1)).trusted
    fix = tracker.localise(scan(8), prior(8, 1.2, -1.0, 0.0, yaw_deg=3.0))
    assert fix.trusted
    assert off(fix.registration.T_map_lidar, 8) < 0.05


def test_starts_one_metre_and_three_degrees_off_find_the_pose(point_map: PointMap) -> None:
    rng = np.random.default_rng(9)
    found = 0
    for k in range(20):
        i = 1 + k % (len(POSES) - 2)
        way, yaw = rng.uniform(0, 2 * np.pi), rng.choice([-3.0, 3.0])
        tracker = Tracker(MapWindow(point_map), SETTINGS)
        tracker.twist = twist_of(POSES, i)
        fix = tracker.localise(scan(i), prior(i, np.cos(way), np.sin(way), 0.0, yaw_deg=float(yaw)))
        found += off(fix.registration.T_map_lidar, i) < 0.2
    assert found >= 17  # 85 %


def first_look(tracker: Tracker, stamp_ns: int, told: PosePrior | None = None) -> list[float]:
    """The position at which the tracker looks first: where it takes the vehicle to be."""
    return [round(float(x), 6) for x in tracker._seed(stamp_ns, told)[0][:3, 3]]


def blind(stamp_ns: int) -> Scan:
    return Scan(stamp_ns, np.zeros((0, 3), dtype=np.float32), np.zeros(0, dtype=np.float32))


TWIST = np.array([20.0, 0.0, 0.0, 0.0, 0.0, 0.0])


def at(x: float, sigma_m: float = 1.0) -> PosePrior:
    return PosePrior(from_xyz_rpy(x, 0.0, 1.8), sigma_m, 0.01)


def elsewhere() -> Tracker:
    """A tracker that need not know any map."""
    return Tracker(lambda position: NdtMap(position), SETTINGS)


def test_a_vehicle_of_which_nothing_is_known_is_looked_for_at_the_origin_or_where_it_is_told_to_be() -> None:
    assert first_look(elsewhere(), TENTH) == [0.0, 0.0, 0.0]
    assert first_look(elsewhere(), TENTH, at(7.0)) == [7.0, 0.0, 1.8]
    reaches = [elsewhere()._seed(TENTH, told)[1] for told in (None, at(7.0, 0.5), at(7.0, 3.0))]
    assert reaches == [10.0, 1.0, 6.0], "as far as the search goes, or two sigmas of the prior"


STANDS = np.zeros(6)


@pytest.mark.parametrize(
    ("twist", "after_ns", "sigma_m", "x"),
    [
        (TWIST, TENTH, 1.0, 102.0),  # constant velocity drifts 1.5 cm in that time
        (TWIST, TENTH, 0.0151, 102.0),
        (TWIST, TENTH, 0.015, 7.0),  # as good as the prediction: the prior
        (TWIST, SECOND, 1.51, 120.0),
        (TWIST, SECOND, 1.5, 7.0),  # 3 m/s2 for a second
        (STANDS, TENTH, 0.02, 100.0),  # measured to stand still
        (None, TENTH, 3.3, 100.0),  # of unknown motion: it may drive 32.5 m/s, 3.25 m in a tenth of a second
        (None, TENTH, 3.2, 7.0),
    ],
)
def test_the_motion_so_far_is_believed_while_it_drifts_less_than_the_prior(
    twist: F64 | None, after_ns: int, sigma_m: float, x: float
) -> None:
    tracker = elsewhere()
    tracker.move_to(from_xyz_rpy(100.0, 0.0, 1.8), 50 * TENTH, twist)
    assert first_look(tracker, 50 * TENTH + after_ns, at(7.0, sigma_m)) == [x, 0.0, 1.8]
    ahead = 0.0 if twist is None else twist[0] * 1e-9 * after_ns
    assert first_look(tracker, 50 * TENTH + after_ns) == [100.0 + ahead, 0.0, 1.8], "without one, always"


def test_two_scans_from_the_same_place_measure_that_a_vehicle_stands() -> None:
    tracker = elsewhere()
    for stamp_ns in (49 * TENTH, 50 * TENTH):
        tracker.begin(blind(stamp_ns), from_xyz_rpy(100.0, 0.0, 1.8))
    assert first_look(tracker, 51 * TENTH, at(7.0, 0.02)) == [100.0, 0.0, 1.8]


@pytest.mark.parametrize(("reach", "steps"), [(0.2, 1), (1.5, 2), (3.0, 3), (99.0, 10)])
def test_a_lost_vehicle_is_looked_for_metre_by_metre_as_far_to_all_sides(
    reach: float, steps: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried: list[F64] = []
    monkeypatch.setattr("mapvote.matching.odometry.best_of", lambda *given: tried.extend(given[2]))
    elsewhere()._search(NdtMap(np.zeros(3)), [], from_xyz_rpy(5.0, -7.0, 0.0), reach, None)
    offsets = sorted({(round(T[0, 3] - 5.0, 6), round(T[1, 3] + 7.0, 6)) for T in tried})
    every = [float(k) for k in range(-steps, steps + 1)]
    assert offsets == [(x, y) for x in every for y in every]
    assert len(tried) == 3 * len(offsets), "with three headings each"


def test_the_first_pose_of_a_survey_is_taken_as_given() -> None:
    tracker = elsewhere()
    fix = tracker.begin(blind(TENTH), POSES[3])
    assert fix.trusted
    found = fix.registration
    assert (found.score, found.inlier_share, found.iterations, found.converged) == (1.0, 1.0, 0, True)
    assert (found.T_map_lidar == POSES[3]).all()
    assert not found.covariance.any()
    assert first_look(tracker, 2 * TENTH) == [round(float(x), 6) for x in POSES[3][:3, 3]]


@pytest.mark.parametrize(("after_ns", "measured"), [(1, True), (SECOND, True), (SECOND + 1, False), (0, False)])
def test_two_poses_tell_the_motion_if_they_are_no_more_than_a_second_apart(after_ns: int, measured: bool) -> None:
    tracker = elsewhere()
    tracker.begin(blind(TENTH), from_xyz_rpy(0.0, 0.0, 0.0))
    step = from_xyz_rpy(6e-9 * after_ns, 0.0, 0.0, 0.0, 0.0, 1e-10 * after_ns)
    tracker.begin(blind(TENTH + after_ns), step)
    if measured:
        np.testing.assert_allclose(tracker.twist[[0, 5]], [6.0, 0.1], rtol=1e-3)
    else:
        assert not tracker.twist.any()


def test_after_a_gap_the_old_motion_is_kept_and_a_lost_track_forgets_it() -> None:
    tracker = elsewhere()
    tracker.move_to(np.eye(4), TENTH, TWIST)
    tracker.begin(blind(TENTH + 2 * SECOND), from_xyz_rpy(1.0, 0.0, 0.0))
    np.testing.assert_array_equal(tracker.twist, TWIST)
    tracker.move_to(np.eye(4), TENTH)
    assert not tracker.twist.any()


@pytest.mark.parametrize(
    ("axis", "change", "differ"), [(0, 0.39, False), (1, -0.41, True), (5, 0.019, False), (3, -0.021, True)]
)
def test_motions_bend_a_scan_differently_if_its_ends_or_points_20_m_away_move_by_2_cm(
    axis: int, change: float, differ: bool
) -> None:
    """In 50 ms, from the middle of a scan to its end."""
    twist = np.array([20.0, 1.0, 0.0, 0.1, 0.0, 0.3])
    assert _differ(twist, twist + change * np.eye(6)[axis]) == differ


def test_a_scan_whose_motion_was_misjudged_is_registered_once_more_and_both_times_at_the_finest_level_alone(
    tracker: Tracker, monkeypatch: pytest.MonkeyPatch
) -> None:
    tracker.localise(scan(0), prior(0))
    tracker.twist = np.array([10.6, 0.0, 0.0, 0.0, 0.0, 0.0])
    levels = []

    refine = NdtMap.refine

    def recorded(*how: Any) -> Registration:
        levels.append(how[4])
        return refine(*how)

    monkeypatch.setattr(NdtMap, "refine", recorded)
    assert off(tracker.localise(scan(1)).registration.T_map_lidar, 1) < 0.04
    assert levels == [2, 2]


@pytest.mark.parametrize(("reach", "level"), [(0.1, 2), (0.11, 1), (0.5, 1), (0.51, 0)])
def test_the_farther_a_guess_may_be_off_the_coarser_the_first_level(reach: float, level: int) -> None:
    tracker = elsewhere()
    assert tracker._first_level(reach) == 0, "of a first scan nothing is known"
    tracker.move_to(np.eye(4), TENTH)
    assert tracker._first_level(reach) == level


def registered(position_sigma: F64, converged: bool = True, inlier_share: float = 1.0) -> Registration:
    turned = from_xyz_rpy(0, 0, 0, yaw=0.7)[:3, :3]
    covariance = np.diag([0.0, 0.0, 0.0, 9.0, 9.0, 9.0])
    covariance[:3, :3] = turned @ np.diag(position_sigma**2) @ turned.T
    return Registration(np.eye(4), covariance, 1.0, inlier_share, 5, converged)


def test_a_registration_is_sound_if_it_converged_met_the_map_and_is_certain_in_every_direction() -> None:
    is_sound, certain = elsewhere().is_sound, np.full(3, 0.1)
    assert is_sound(registered(np.array([0.14, 0.1, 0.1])))
    assert is_sound(registered(certain, inlier_share=0.5)), "just enough"
    assert not is_sound(registered(certain, converged=False))
    assert not is_sound(registered(certain, inlier_share=0.49))
    for axis in np.eye(3):
        assert not is_sound(registered(0.01 + 0.15 * axis)), "along any one direction"


def test_on_a_first_scan_the_speed_is_found_by_how_the_scan_is_bent(tracker: Tracker) -> None:
    fix = tracker.localise(scan(0), prior(0))
    assert fix.trusted
    assert tracker.twist.tolist() == [10.0, 0.0, 0.0, 0.0, 0.0, 0.0], "of the speeds tried, every 2.5 m/s"
    assert off(fix.registration.T_map_lidar, 0) < 0.04


def test_each_speed_is_tried_from_the_last_pose(tracker: Tracker) -> None:
    tracker.move_to(POSES[3], 4 * TENTH)
    around = tracker.map_around(POSES[3][:3, 3])
    assert tracker.guess_motion(around, 5 * TENTH, Sample(scan(4)), np.eye(4))[0] == 10.0


def test_a_scan_without_times_is_taken_as_it_is(tracker: Tracker) -> None:
    T = POSES[2]
    points = transform(inverse(T), street(102, 0.6))
    flash = Scan(TENTH, points[np.linalg.norm(points, axis=1) < 40.0].astype(np.float32), None)
    fix = tracker.localise(flash, prior(2, 0.3, 0.2, 0.0))
    assert fix.trusted
    assert fix.points is flash.points
    assert not tracker.twist.any()
    assert off(fix.registration.T_map_lidar, 2) < 0.04


def test_a_scan_that_fits_worse_than_usual_is_tried_at_its_prior_and_at_every_speed(point_map: PointMap) -> None:
    """A street looks alike along itself: a scan may settle one house too early."""
    i = 6
    for told in (prior(i), None):
        tracker = Tracker(MapWindow(point_map), SETTINGS)
        back = POSES[i] @ from_xyz_rpy(-10.0, 0.0, 0.0)
        seen = replace(scan(i), stamp_ns=1000 * SECOND)
        start_ns = seen.stamp_ns - SECOND // 2
        tracker.move_to(back, start_ns, np.zeros(6), score=0.9)  # it was at rest, and 20 m/s half a second later
        fix = tracker.localise(seen, told)
        assert off(fix.registration.T_map_lidar, i) < 0.2
        careless = Tracker(MapWindow(point_map), SETTINGS)
        careless.move_to(back, start_ns, np.zeros(6), score=0.0)
        assert off(careless.localise(seen, None).registration.T_map_lidar, i) > 1.0, "or nothing is shown here"
