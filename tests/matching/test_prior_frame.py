"""Odometry in a frame of its own: where that frame lies in the map is learnt from localised scans, and followed."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapvote.core.geometry import from_xyz_rpy
from mapvote.core.point_map import PointMap, map_from_points
from mapvote.core.types import F64, PosePrior
from mapvote.formats.drives.frames import is_map_frame
from mapvote.matching.prior_frame import PriorFrame, distance_to
from mapvote.vehicle import Vehicle
from odometry_errors import odometry
from streets import drive_along, path, street

SCANS = 45


@cache
def town() -> PointMap:
    return map_from_points(street(1))


def drive(prior: F64 | None, poses: F64, *, in_map: bool = False) -> tuple[Vehicle, int, float]:
    """The vehicle after the drive, how many scans voted, and the largest error of those, metres."""
    recorded = drive_along(poses, 1, prior=prior)
    vehicle = Vehicle("car", recorded.sensor, town())
    if not in_map:
        vehicle.expect_own_frame()
    for i, scan in enumerate(recorded):
        vehicle.observe(scan, None if prior is None else prior[i])
    vehicle.finish()
    report = vehicle.report
    found = [i for i in range(len(poses)) if i not in set(report.lost)]
    errors = [np.linalg.norm(report.T_map_lidar[i][:3, 3] - poses[i][:3, 3]) for i in found]
    return vehicle, len(found), float(max(errors, default=0.0))


def prior(T: F64) -> PosePrior:
    return PosePrior(T, 1.0, 0.02)


poses_of = st.tuples(*[st.floats(-500, 500)] * 2, st.floats(-9, 9), *[st.floats(-3, 3)] * 3).map(
    lambda v: from_xyz_rpy(*v)
)


@given(T_map_odom=poses_of, T_odom_lidar=poses_of, T_step=st.floats(-2, 2).map(lambda x: from_xyz_rpy(x, 0.1, 0.0)))
def test_one_localised_scan_gives_the_frame_and_every_later_prior_its_place(
    T_map_odom: F64, T_odom_lidar: F64, T_step: F64
) -> None:
    frame = PriorFrame(in_map=False)
    frame.begin(prior(T_odom_lidar), T_map_odom @ T_odom_lidar)
    assert np.allclose(frame.T_map_prior, T_map_odom, atol=1e-6)
    later = T_odom_lidar @ T_step
    assert not frame.learn(prior(later), T_map_odom @ later)
    assert np.allclose(frame.in_map(prior(later)).T_map_lidar, T_map_odom @ later, atol=1e-6)


def test_a_frame_that_drifts_is_followed_within_a_tenth_of_a_metre_and_its_sigma_is_told() -> None:
    poses = path(200, speed_mps=10.0)
    said = odometry(poses, from_xyz_rpy(100.0, 50.0, 0.0, 0.0, 0.0, 0.6), drift=0.02)
    frame = PriorFrame(in_map=False)
    off = []
    for T_odom, T_map in zip(said, poses, strict=True):
        if frame.is_unknown:
            frame.begin(prior(T_odom), T_map)
        off.append(distance_to(frame.in_map(prior(T_odom)).T_map_lidar, T_map)[0])
        frame.learn(prior(T_odom), T_map)
    assert max(off) < 0.1
    assert 0.01 < frame.sigma_m < 0.1
    assert "yaw" in frame.told()


def test_a_wrong_scan_moves_the_frame_little_and_the_road_without_a_scan_widens_the_prior() -> None:
    frame = PriorFrame(in_map=False)
    noise = np.random.default_rng(3).normal(0.0, 0.02, (60, 3))
    poses = path(60)
    frame.begin(prior(poses[0]), poses[0])
    for T, shift in zip(poses, noise, strict=True):
        frame.learn(prior(T), from_xyz_rpy(*shift) @ T)
    frame.learn(prior(poses[-1]), from_xyz_rpy(8.0, 0.0, 0.0) @ poses[-1])
    assert distance_to(frame.in_map(prior(poses[-1])).T_map_lidar, poses[-1])[0] < 0.15
    near = frame.in_map(prior(poses[-1])).sigma_m
    far = frame.in_map(prior(poses[-1] @ from_xyz_rpy(200.0, 0.0, 0.0))).sigma_m
    assert far > near + 5.0


def test_a_prior_in_the_map_stays_as_it_is_and_one_far_off_five_times_is_a_frame_of_its_own() -> None:
    frame = PriorFrame()
    T = from_xyz_rpy(10.0, 5.0, 1.0)
    for _ in range(20):
        assert not frame.learn(prior(T), from_xyz_rpy(2.0, 1.0, 0.0) @ T)
    assert frame.in_map(prior(T)).T_map_lidar is T
    far = from_xyz_rpy(40.0, 0.0, 0.0) @ T
    taken = [frame.learn(prior(T), far) for _ in range(5)]
    assert taken == [False] * 4 + [True]
    assert np.allclose(frame.in_map(prior(T)).T_map_lidar, far)


def test_names_of_frames_say_whether_poses_are_in_the_map() -> None:
    assert all(map(is_map_frame, ("map", "/map", "car1/map", "utm", "Earth", "")))
    assert not any(map(is_map_frame, ("odom", "car1/odom", "camera_init", "base_link", "mapping_start")))


STARTS = {
    "turned and shifted": from_xyz_rpy(100.0, 50.0, 0.0, 0.0, 0.0, 0.6),
    "from zero": np.eye(4),
    "half a turn, uphill": from_xyz_rpy(-300.0, 0.0, 5.0, 0.05, -0.08, 3.0),
}


@pytest.mark.parametrize("start", STARTS, ids=str)
def test_every_scan_votes_though_odometry_is_in_its_own_frame_and_drifts_by_2_percent(start: str) -> None:
    poses = path(SCANS, start_x=-25.0)
    vehicle, voted, error_m = drive(odometry(poses, STARTS[start], drift=0.02), poses)
    assert (voted, vehicle.report.lost) == (SCANS, [])
    assert error_m < 0.1
    misfit_m = vehicle.report.prior_misfit_m()
    assert misfit_m is not None
    assert misfit_m < 0.1
    frame = vehicle.prior_frame
    assert frame is not None
    assert (frame.is_own, frame.begun) == (True, 1)


@pytest.mark.slow
def test_odometry_that_begins_anew_on_the_road_costs_no_scan() -> None:
    poses = path(SCANS, start_x=-25.0)
    said = odometry(poses, np.eye(4))
    said[25:] = from_xyz_rpy(-30.0, 70.0, 0.0, 0.0, 0.0, 1.0) @ said[25:]
    vehicle, voted, error_m = drive(said, poses)
    assert (voted, error_m < 0.1) == (SCANS, True)
    assert vehicle.prior_frame is not None
    assert vehicle.prior_frame.begun == 2


@pytest.mark.slow
def test_without_a_prior_scans_before_the_first_place_are_followed_back() -> None:
    poses = path(SCANS, start_x=-25.0)
    _, voted, error_m = drive(None, poses)
    assert (voted, error_m < 0.1) == (SCANS, True)


def test_odometry_stated_in_the_map_that_is_not_is_found_out() -> None:
    poses = path(SCANS, start_x=-25.0)
    said = odometry(poses, from_xyz_rpy(900.0, 50.0, 0.0, 0.0, 0.0, 0.6))
    vehicle, voted, error_m = drive(said, poses, in_map=True)
    assert (voted, error_m < 0.1) == (SCANS, True)
    assert vehicle.prior_frame is not None
    assert vehicle.prior_frame.is_own
