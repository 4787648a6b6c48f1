"""Satellite fixes as priors: place, heading and standard deviations that follow from the fixes up to a stamp."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapvote.core.geometry import from_xyz_rpy
from mapvote.core.types import F64, I64, MapvoteError, PosePrior
from mapvote.formats.drives.fixes import (
    FIX_RULES,
    UNKNOWN_RAD,
    Fixes,
    antenna_lever,
    fixes_of,
    heading_of_imu,
    prior_at,
    priors_at,
    sigmas_of,
)
from mapvote.formats.drives.trajectory import read_trajectory
from mapvote.formats.geo.frame import MapFrame

UTM = MapFrame("EPSG:32632", (457_000.0, 5_428_000.0, 0.0))
SECOND = 10**9
AT_LIDAR = np.eye(4)


def fixes_at(positions: F64, sigma_m: float, rate_hz: float = 1.0) -> Fixes:
    times_ns = np.round(np.arange(len(positions)) * SECOND / rate_hz).astype(np.int64)
    covariance = np.tile(np.diag([sigma_m**2, sigma_m**2, 9.0]).ravel(), (len(positions), 1))
    return fixes_of(times_ns, UTM.to_lonlat(positions), covariance, UTM)


def straight(n: int, yaw_rad: float, speed_mps: float) -> F64:
    """(n, 3) positions a second apart."""
    way = np.arange(n) * speed_mps
    return np.column_stack([way * np.cos(yaw_rad), way * np.sin(yaw_rad), np.zeros(n)])


def prior_of(fixes: Fixes, stamp_ns: int) -> PosePrior:
    prior = prior_at(fixes, stamp_ns, AT_LIDAR)
    assert prior is not None
    return prior


def yaw_of(T: F64) -> float:
    return float(np.arctan2(T[1, 0], T[0, 0]))


def turned_by(angle_rad: float, other_rad: float) -> float:
    return abs(float(np.angle(np.exp(1j * (angle_rad - other_rad)))))


def with_headings(fixes: Fixes, yaws_rad: F64, sigma_rad: float, rate_hz: float = 50.0) -> Fixes:
    times_ns = np.round(np.arange(len(yaws_rad)) * SECOND / rate_hz).astype(np.int64)
    return fixes.with_headings(times_ns.tolist(), yaws_rad.tolist(), [sigma_rad] * len(yaws_rad))


@given(
    yaw_rad=st.floats(-3.1, 3.1),
    speed_mps=st.floats(3.0, 25.0),
    sigma_m=st.floats(0.02, 3.0),
    age_s=st.floats(0.0, 1.0),
    seed=st.integers(0, 1000),
)
def test_place_and_heading_are_within_five_of_the_sigmas_that_the_prior_states(
    yaw_rad: float, speed_mps: float, sigma_m: float, age_s: float, seed: int
) -> None:
    noise = np.random.default_rng(seed).normal(0.0, sigma_m, (8, 3))
    prior = prior_of(fixes_at(straight(8, yaw_rad, speed_mps) + noise, sigma_m), 7 * SECOND + int(age_s * SECOND))
    true = (7.0 + age_s) * speed_mps * np.array([np.cos(yaw_rad), np.sin(yaw_rad)])
    assert np.linalg.norm(prior.T_map_lidar[:2, 3] - true) < 5.0 * prior.sigma_m
    assert turned_by(yaw_of(prior.T_map_lidar), yaw_rad) < 5.0 * prior.sigma_rad
    assert prior.sigma_m >= sigma_m


@given(st.integers(0, 7 * SECOND))
def test_a_prior_uses_no_fix_and_no_heading_after_its_stamp(stamp_ns: int) -> None:
    every = fixes_at(straight(9, 0.3, 8.0), 1.0)
    before = every.times_ns <= stamp_ns
    until = Fixes(every.times_ns[before], every.position[before], every.sigma_m[before], every.north_rad[before])
    all_that_came = prior_of(every, stamp_ns)
    assert np.array_equal(all_that_came.T_map_lidar, prior_of(until, stamp_ns).T_map_lidar)


def test_a_standing_vehicle_has_a_place_and_no_heading() -> None:
    noise = np.random.default_rng(1).normal(0.0, 2.0, (9, 3))
    prior = prior_of(fixes_at(noise, 2.0), 8 * SECOND)
    assert prior.sigma_rad == UNKNOWN_RAD
    assert prior.sigma_m < 3.0


def test_no_fix_before_the_stamp_or_an_old_one_gives_no_prior() -> None:
    fixes = fixes_at(straight(3, 0.0, 5.0), 1.0)
    assert prior_at(fixes, -1, AT_LIDAR) is None
    assert prior_at(fixes, int((2.0 + FIX_RULES.old_s) * SECOND) + 1, AT_LIDAR) is None
    assert prior_at(Fixes(), 0, AT_LIDAR) is None
    assert priors_at(fixes, np.array([-5]), AT_LIDAR) is None


def test_scans_without_a_fix_have_no_sigma_and_those_after_it_have() -> None:
    stamps_ns: I64 = np.array([-SECOND, 0, SECOND, 9 * SECOND])
    priors = priors_at(fixes_at(straight(3, 0.0, 5.0), 1.0), stamps_ns, AT_LIDAR)
    assert priors is not None
    assert np.isfinite(priors[1][:, 0]).tolist() == [False, True, True, False]


def test_two_antennas_give_the_heading_of_a_standing_vehicle_turned_by_the_meridian() -> None:
    fixes = with_headings(fixes_at(np.zeros((3, 3)), 0.02), np.full(101, 0.5), 0.01)
    prior = prior_of(fixes, 2 * SECOND)
    north_rad = float(fixes.north_rad[-1])
    assert 0.0 < abs(north_rad) < 0.05
    assert turned_by(yaw_of(prior.T_map_lidar), 0.5 + north_rad) < 1e-9
    assert prior.sigma_rad == pytest.approx(0.01)


def test_an_imu_without_north_carries_the_heading_of_the_way_through_a_turn() -> None:
    """Ten seconds straight on, then a quarter turn in place: the IMU counts from an angle of its own."""
    positions = np.concatenate([straight(11, 0.2, 10.0), np.tile(straight(11, 0.2, 10.0)[-1:], (2, 1))])
    turn = np.concatenate([np.full(501, 1.7), 1.7 + np.linspace(0.0, np.pi / 2, 100)])
    fixes = with_headings(fixes_at(positions, 0.1), np.asarray((turn + np.pi) % (2 * np.pi) - np.pi), np.inf)
    prior = prior_of(fixes, 12 * SECOND)
    assert turned_by(yaw_of(prior.T_map_lidar), 0.2 + np.pi / 2) < 4.0 * prior.sigma_rad
    assert prior.sigma_rad < 0.1


def test_a_vehicle_that_reverses_against_its_stated_heading_has_no_known_heading() -> None:
    fixes = with_headings(fixes_at(straight(9, 0.0, -3.0), 0.05), np.zeros(401), 0.05)
    assert prior_of(fixes, 8 * SECOND).sigma_rad == UNKNOWN_RAD


@given(turn_rad=st.floats(-3.1, 3.1), start_rad=st.floats(-3.1, 3.1), drop=st.integers(0, 60))
def test_the_turn_between_two_times_does_not_depend_on_the_headings_kept_before(
    turn_rad: float, start_rad: float, drop: int
) -> None:
    yaws = np.asarray((start_rad + np.linspace(0.0, turn_rad, 101) + np.pi) % (2 * np.pi) - np.pi)
    whole = with_headings(Fixes(), yaws, np.inf)
    later = Fixes().with_headings(whole.turn_times_ns[drop:].tolist(), yaws[drop:].tolist(), [np.inf] * (101 - drop))
    times_ns: I64 = np.array([1_300_000_000, 1_777_777_777, 2 * SECOND])
    assert np.array_equal(whole.yaw_at(times_ns), later.yaw_at(times_ns))


def test_a_stated_covariance_counts_by_its_widest_direction_in_the_plane() -> None:
    turned = from_xyz_rpy(0.0, 0.0, 0.0, 0.0, 0.0, 0.7)[:3, :3]
    tilted = turned @ np.diag([9.0, 1.0, 100.0]) @ turned.T
    unstated = np.full(9, np.nan)
    sigmas = sigmas_of(np.array([tilted.ravel(), unstated, np.zeros(9), np.diag([1e-8] * 3).ravel()]))
    assert sigmas == pytest.approx([3.0, FIX_RULES.unstated_m, FIX_RULES.unstated_m, FIX_RULES.least_m])


def test_an_imu_says_that_it_has_no_orientation() -> None:
    level = [0.0, 0.0, 0.0, 1.0]
    assert np.isnan(heading_of_imu(level, [-1.0, *[0.0] * 8], np.eye(4))[0])
    assert np.isnan(heading_of_imu([0.0] * 4, [0.0] * 9, np.eye(4))[0])
    assert heading_of_imu(level, [0.0] * 9, np.eye(4)) == (0.0, np.inf)
    turned = from_xyz_rpy(0.0, 0.0, 0.0, 0.0, 0.0, np.pi / 2)
    yaw_rad, sigma_rad = heading_of_imu(level, [*[0.0] * 8, 0.04], turned)
    assert (yaw_rad, sigma_rad) == pytest.approx((-np.pi / 2, 0.2))


def test_the_lidar_lies_beside_the_antenna_by_the_frames() -> None:
    frames = {"lidar": from_xyz_rpy(1.0, 0.0, 1.8), "gnss": from_xyz_rpy(-0.5, 0.2, 2.0)}
    assert np.allclose(antenna_lever(frames, "gnss", "lidar"), from_xyz_rpy(1.5, -0.2, -0.2))
    assert np.allclose(antenna_lever({}, "gnss", "lidar"), np.eye(4))
    moved = prior_at(fixes_at(straight(9, 0.0, 10.0), 0.05), 8 * SECOND, from_xyz_rpy(1.5, -0.2, 0.0))
    assert moved is not None
    assert np.allclose(moved.T_map_lidar[:2, 3], [81.5, -0.2], atol=0.1)


def test_fixes_need_the_place_of_the_map_on_earth() -> None:
    with pytest.raises(MapvoteError, match=r"import the map with --crs"):
        fixes_of(np.array([0]), np.array([[8.4, 49.0, 100.0]]), None, MapFrame())


def test_a_table_of_fixes_states_their_standard_deviation_and_whole_poses_stay_poses(tmp_path: Path) -> None:
    lonlat = UTM.to_lonlat(straight(4, 0.0, 5.0))
    rows = [f"{i},{lat:.9f},{lon:.9f},100.0" for i, (lon, lat, _) in enumerate(lonlat)]
    table = tmp_path / "fixes.csv"
    table.write_text("\n".join(["time,latitude,longitude,altitude,accuracy", *(f"{row},1.5" for row in rows)]))
    fixes = read_trajectory(table, UTM).fixes
    assert fixes is not None
    assert fixes.sigma_m.tolist() == [1.5] * 4
    table.write_text("\n".join(["time,latitude,longitude,altitude,yaw [deg]", *(f"{row},30" for row in rows)]))
    whole = read_trajectory(table, UTM)
    assert whole.fixes is None
    assert turned_by(yaw_of(whole.T_map[0]), np.radians(30.0)) < 0.05
