"""The same drive with worse beliefs or in the rain."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mapvote.core.geometry import from_xyz_rpy
from mapvote.core.sensors import SENSORS
from mapvote.core.types import F64, Drive
from mapvote.formats import DriveWriter, open_drive
from mapvote_lab.evaluation import real_street
from mapvote_lab.evaluation.real_street import Edit, part_of

SPEED = 10.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """40 scans at 10 Hz along x at 10 m/s; every scan a ring of points 30 m away."""
    out = tmp_path_factory.mktemp("drive") / "straight"
    angle = np.linspace(0.0, 2.0 * np.pi, 500, endpoint=False)
    ring = np.column_stack([30.0 * np.cos(angle), 30.0 * np.sin(angle), np.zeros(500)]).astype(np.float32)
    writer = DriveWriter(out, vehicle="v", sensor=SENSORS["hdl32e"], start_ns=10**18, prior_sigma_m=0.5).open()
    for i in range(40):
        writer.write_scan(i, ring)
    T = np.stack([from_xyz_rpy(SPEED * 0.1 * i, 0.0, 1.8) for i in range(40)])
    writer.close(10**18 + np.arange(40) * 10**8, T)
    return out


def believed(folder: Path, edit: Edit) -> F64:
    """(n, 3) positions of the prior of every third scan, after the change, less the true ones."""
    drive = open_drive(folder, scans="::3")
    T = part_of(edit(open_drive(folder)), np.arange(0, 40, 3)).T_map_lidar_prior
    assert T is not None
    assert drive.T_map_lidar_prior is not None
    return np.asarray(T[:, :3, 3] - drive.T_map_lidar_prior[:, :3, 3])


@pytest.mark.parametrize("seconds", [0.2, 1.0, 2.0])
def test_a_late_prior_lies_as_far_behind_as_was_driven_meanwhile_from_the_first_scan_on(
    folder: Path, seconds: float
) -> None:
    np.testing.assert_allclose(believed(folder, real_street.late(seconds))[:, 0], -SPEED * seconds, atol=1e-6)


def test_a_bias_is_constant_and_a_drift_grows_from_nothing(folder: Path) -> None:
    np.testing.assert_allclose(np.linalg.norm(believed(folder, real_street.biased(3.0)), axis=1), 3.0, atol=1e-6)
    drift = np.linalg.norm(believed(folder, real_street.drifting(5.0)), axis=1)
    assert drift[0] < 1e-6
    assert abs(drift[-1] - 5.0) < 0.01
    assert (np.diff(drift) > 0).all()


def test_another_street_crosses_this_one(folder: Path) -> None:
    drive = open_drive(folder)
    T = real_street.of_another_street()(drive).T_map_lidar_prior
    assert T is not None
    assert np.ptp(T[:, 0, 3]) < 1e-6
    assert abs(np.ptp(T[:, 1, 3]) - 39.0) < 1e-6


def test_rain_shortens_its_share_of_the_rays_and_turns_none(folder: Path) -> None:
    drive: Drive = open_drive(folder)
    dry, wet = drive.read_scan(3).points, real_street.in_rain(0.2)(drive).read_scan(3).points
    reach = np.linalg.norm(wet, axis=1) / np.linalg.norm(dry, axis=1)
    assert 0.12 < (reach < 0.99).mean() < 0.28
    np.testing.assert_allclose(wet / np.linalg.norm(wet, axis=1)[:, None], dry / 30.0, atol=1e-4)


def test_a_thinned_scan_is_a_part_of_the_scan(folder: Path) -> None:
    drive = open_drive(folder)
    whole, few = drive.read_scan(5).points, real_street.with_fewer_points(0.7)(drive).read_scan(5).points
    assert 0.2 < len(few) / len(whole) < 0.4
    assert {tuple(p) for p in few.tolist()} <= {tuple(p) for p in whole.tolist()}
