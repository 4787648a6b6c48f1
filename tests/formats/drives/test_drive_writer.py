"""The drive folder as docs/decisions/data.md lays it out, read back with nothing but numpy and tomllib."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest

from mapvote.core.sensors import SENSORS
from mapvote.core.types import MapvoteError
from mapvote.formats.drives.scan_folder import DriveWriter


def test_a_drive_folder_holds_scans_times_prior_and_description(tmp_path: Path) -> None:
    writer = DriveWriter(tmp_path / "v1", "v1", SENSORS["hdl32e"], start_ns=1_700_000_000_000_000_000).open()
    cloud = np.arange(12, dtype=np.float32).reshape(4, 3)
    writer.write_scan(1, cloud[:2])
    writer.write_scan(0, cloud, np.full(4, 0.5, dtype=np.float32))
    assert not (tmp_path / "v1").exists(), "a folder half written must not look like a drive"
    poses = np.stack([np.eye(4), np.eye(4)])
    poses[1, 0, 3] = 1.25
    writer.close(writer.start_ns + np.array([0, 100_000_001], dtype=np.int64), poses)
    scan = np.fromfile(tmp_path / "v1/velodyne/000000.bin", dtype="<f4").reshape(-1, 4)
    np.testing.assert_array_equal(scan[:, :3], cloud)
    np.testing.assert_array_equal(scan[:, 3], 0.5)
    assert (tmp_path / "v1/times.txt").read_text() == "0.000000000\n0.100000001\n"
    assert np.loadtxt(tmp_path / "v1/prior.txt").shape == (2, 12)
    about = tomllib.loads((tmp_path / "v1/drive.toml").read_text())
    assert about["sensor"] == "hdl32e"
    assert about["start_ns"] == writer.start_ns
    assert len(about["T_base_lidar"]) == 12


def test_a_drive_is_never_overwritten_and_never_short_of_scans(tmp_path: Path) -> None:
    writer = DriveWriter(tmp_path / "v1", "v1", SENSORS["vlp16"], start_ns=0).open()
    with pytest.raises(MapvoteError, match="0 scans written, but 1 stamps"):
        writer.close(np.array([0], dtype=np.int64))
    (tmp_path / "v2").mkdir()
    with pytest.raises(MapvoteError, match="exists already"):
        DriveWriter(tmp_path / "v2", "v2", SENSORS["vlp16"], start_ns=0).open()
