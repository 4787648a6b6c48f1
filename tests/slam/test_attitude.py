"""A surveyor's prior guides every scan: a pitch of it that its scans contradict is noticed, and not followed."""

from dataclasses import replace

import numpy as np
import pytest

from mapvote.core.geometry import from_xyz_rpy
from mapvote.core.types import Drive, Scan
from mapvote.slam.attitude import as_precise_as_shown, wrong_attitude
from mapvote.slam.surveyor import is_precise
from streets import drive_along, path

POSES = path(25, -15.0)


def surveyed(pitch_deg: float, roll_deg: float = 0.0, sigma_deg: float = 0.05) -> Drive:
    tilt = from_xyz_rpy(0.0, 0.0, 0.0, np.radians(roll_deg), np.radians(pitch_deg), 0.0)
    return drive_along(POSES, 1, POSES @ tilt, sigma_m=0.02, sigma_deg=sigma_deg)


@pytest.mark.parametrize("pitch_deg", [0.6, -0.8])
def test_a_precise_attitude_that_is_pitched_against_the_road_counts_as_coarse_and_is_named(pitch_deg: float) -> None:
    drive, wrong = as_precise_as_shown(surveyed(pitch_deg, roll_deg=0.5))
    assert wrong is not None
    assert wrong.pitch_deg == pytest.approx(pitch_deg, abs=0.15)
    assert not is_precise(drive)
    assert drive.prior_sigma_deg >= abs(wrong.pitch_deg)
    assert f"{wrong.pitch_deg:+.2f} deg" in wrong.what
    assert "prior_sigma_deg says 0.05" in wrong.what


def test_an_attitude_that_agrees_with_the_road_or_claims_no_more_than_it_holds_is_left_as_it_is() -> None:
    sound = surveyed(0.0)
    assert as_precise_as_shown(sound) == (sound, None)
    assert wrong_attitude(surveyed(0.6, sigma_deg=1.0)) is None


def test_a_stretch_without_road_proves_nothing_about_the_attitude() -> None:
    drive = surveyed(0.8)
    empty = np.zeros((0, 3), np.float32)
    assert wrong_attitude(replace(drive, read_scan=lambda i: Scan(int(drive.stamps_ns[i]), empty))) is None
