"""A drive that knows satellite fixes alone: they bound the search for the first place, and every scan votes."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from mapvote.config import NdtSettings
from mapvote.core.geometry import from_xyz_rpy
from mapvote.core.point_map import PointMap, map_from_points
from mapvote.core.sensors import SENSORS
from mapvote.core.types import F64, PosePrior
from mapvote.doctor.scans import _check_track
from mapvote.formats.drives.fixes import Fixes, fixes_of, prior_at, priors_at
from mapvote.formats.geo.frame import MapFrame
from mapvote.matching.global_search import Bound, GlobalSearch
from mapvote.vehicle import Vehicle
from streets import drive_along, path, street

UTM = MapFrame("EPSG:32632", (457_000.0, 5_428_000.0, 0.0))
SCANS = 45
OVER_THE_SEA_M = 47.0
"""The ellipsoid, from which receivers count heights, lies this far below the sea in Germany."""


@cache
def town() -> PointMap:
    return map_from_points(street(1))


def fixes_along(poses: F64, every: int, sigma_m: float) -> Fixes:
    """Fixes of every ``every``-th of poses (n, 4, 4) at 10 Hz, with independent errors."""
    noise = np.random.default_rng(2).normal(0.0, sigma_m, (len(poses), 3))
    lonlat = UTM.to_lonlat(poses[:, :3, 3] + noise + [0.0, 0.0, OVER_THE_SEA_M])
    stamps_ns = np.arange(1, len(poses) + 1) * 100_000_000
    covariances = np.tile(np.diag([sigma_m**2] * 3).ravel(), (len(poses), 1))
    return fixes_of(stamps_ns[::every], lonlat[::every], covariances[::every], UTM)


@pytest.mark.slow
@pytest.mark.parametrize(("sigma_m", "every"), [(2.0, 10), (0.02, 2)], ids=["2 m, 1 Hz", "2 cm, 5 Hz"])
def test_every_scan_votes_by_fixes_whose_heights_count_from_elsewhere(sigma_m: float, every: int) -> None:
    poses = path(SCANS, start_x=-25.0)
    fixes = fixes_along(poses, every, sigma_m)
    recorded = drive_along(poses, 1)
    vehicle = Vehicle("car", recorded.sensor, town())
    for i, scan in enumerate(recorded):
        vehicle.observe(scan, prior_at(fixes, int(recorded.stamps_ns[i]), np.eye(4)))
    vehicle.finish()
    report = vehicle.report
    off_m = np.linalg.norm(np.array(report.T_map_lidar)[:, :3, 3] - poses[:, :3, 3], axis=1)
    misfit_m = report.prior_misfit_m()
    sigma_stated_m = report.prior_sigma_m()
    assert report.lost == []
    assert off_m.max() < 0.1
    assert misfit_m is not None
    assert sigma_stated_m is not None
    assert misfit_m < 3.0 * sigma_stated_m


def test_a_bound_keeps_the_search_within_it() -> None:
    poses = path(1, start_x=-10.0)
    scan = drive_along(poses, 1).read_scan(0)
    search = GlobalSearch(town(), NdtSettings(), SENSORS["hdl32e"].range_sigma_m)
    near = search(scan, Bound(-12.0, 1.0, 10.0))
    assert near is not None
    assert np.linalg.norm(near[:2, 3] - poses[0][:2, 3]) < 0.2
    elsewhere = search(scan, Bound(30.0, 0.0, 5.0))  # houses of a street are alike
    assert elsewhere is None or np.linalg.norm(elsewhere[:2, 3] - [30.0, 0.0]) < 5.0
    assert search(scan, Bound(500.0, 0.0, 20.0)) is None


def test_the_doctor_does_not_complain_of_the_steps_from_fix_to_fix() -> None:
    poses = path(SCANS)
    drive = drive_along(poses, 1)
    told = priors_at(fixes_along(poses, 10, 2.0), drive.stamps_ns, np.eye(4))
    assert told is not None
    by_fixes = replace(drive, T_map_lidar_prior=told[0], prior_sigmas=told[1])
    assert list(_check_track(by_fixes, told[0])) == []
    assert any("jumps" in finding.what for finding in _check_track(replace(by_fixes, prior_sigmas=None), told[0]))


def test_a_planar_prior_says_nothing_of_height_roll_and_pitch() -> None:
    information = PosePrior(from_xyz_rpy(0.0, 0.0, 0.0), 2.0, 0.1, is_planar=True).information
    assert np.diag(information).tolist() == [0.25, 0.25, 0.0, 0.0, 0.0, pytest.approx(100.0)]
