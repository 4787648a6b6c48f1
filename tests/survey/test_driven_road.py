"""The road under the path shows the height of the sensor, and a pitch of the precise prior that guides every scan."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mapvote.core.geometry import from_xyz_rpy
from mapvote.core.types import F64, Drive, Scan
from mapvote.survey.driven_road import road_under, wrong_attitude
from streets import drive_along, path

POSES = path(25, -15.0)
ALL = np.ones(60, np.bool_)


def driven(grade: float = 0.0) -> F64:
    """(60, 4, 4) a metre apart along x, 1.73 m above the road."""
    T = np.tile(np.eye(4), (60, 1, 1))
    T[:, 0, 3] = np.arange(60)
    T[:, 2, 3] = 1.73 + grade * T[:, 0, 3]
    return T


def track(count: int, z: float, spread: float, length_m: float = 60.0) -> F64:
    rng = np.random.default_rng(count)
    return rng.uniform((0, -0.7, z - spread), (length_m, 0.7, z + spread), (count, 3))


def test_reflections_and_the_car_ahead_do_not_change_the_height_of_the_sensor() -> None:
    road, below, car = track(800, 0.0, 0.02), track(200, -3.0, 2.5), track(400, 0.8, 0.6)
    found = road_under(driven(), ALL, np.vstack([road, below, car]))
    assert np.ptp(found[:, 0]) == 59.0
    np.testing.assert_allclose(found[:, 2], 0.0, atol=0.02)


def test_on_a_hill_the_road_climbs_with_the_path() -> None:
    cloud = track(2000, 0.0, 0.02)
    cloud[:, 2] += 0.1 * cloud[:, 0]
    found = road_under(driven(grade=0.1), ALL, cloud)
    np.testing.assert_allclose(found[:, 2], 0.1 * found[:, 0], atol=0.02)


def test_stretches_without_registered_scans_give_no_road() -> None:
    registered = (np.arange(60) < 20) | (np.arange(60) >= 40)
    x = road_under(driven(), registered, track(3000, 0.0, 0.02))[:, 0]
    assert not ((x > 19.01) & (x < 39.99)).any()


def test_a_path_without_measured_road_gives_no_road() -> None:
    for length_m, z, shown in ((8.0, 0.0, False), (30.0, 0.0, True), (60.0, 50.0, False)):
        cloud = track(300, z, 0.02, length_m)
        assert bool(len(road_under(driven(), ALL, cloud))) == shown


def surveyed(pitch_deg: float, roll_deg: float = 0.0, sigma_deg: float = 0.05) -> Drive:
    tilt = from_xyz_rpy(0.0, 0.0, 0.0, np.radians(roll_deg), np.radians(pitch_deg), 0.0)
    return drive_along(POSES, 1, POSES @ tilt, sigma_m=0.02, sigma_deg=sigma_deg)


@pytest.mark.parametrize("pitch_deg", [0.6, -0.8])
def test_a_precise_attitude_that_is_pitched_against_the_road_is_named_with_a_sigma_that_is_coarse(
    pitch_deg: float,
) -> None:
    drive = surveyed(pitch_deg, roll_deg=0.5)
    wrong = wrong_attitude(drive)
    assert wrong is not None
    assert wrong.pitch_deg == pytest.approx(pitch_deg, abs=0.15)
    assert not replace(drive, prior_sigma_deg=wrong.sigma_deg).has_precise_prior
    assert wrong.sigma_deg >= abs(wrong.pitch_deg)
    assert f"{wrong.pitch_deg:+.2f} deg" in wrong.what
    assert "prior_sigma_deg says 0.05" in wrong.what


def test_an_attitude_that_agrees_with_the_road_claims_no_more_than_it_holds_or_sees_no_road_is_not_contradicted() -> (
    None
):
    drive = surveyed(0.8)
    nothing = replace(drive, read_scan=lambda i: Scan(int(drive.stamps_ns[i]), np.zeros((0, 3), np.float32)))
    for sound in (surveyed(0.0), surveyed(0.6, sigma_deg=1.0), nothing):
        assert wrong_attitude(sound) is None
