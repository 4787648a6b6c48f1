"""KITTI drive folders, as they come and as they break."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest

from mapvote.core import geometry
from mapvote.core.sensors import SENSORS
from mapvote.core.types import F32, F64, MapvoteError
from mapvote.formats import DriveWriter, open_drive, read_T_map_lidar

# T_camera_lidar of KITTI odometry sequence 00 (Geiger et al.)
TR = (
    "4.276802385584e-04 -9.999672484946e-01 -8.084491683471e-03 -1.198459927713e-02 "
    "-7.210626507497e-03 8.081198471645e-03 -9.999413164504e-01 -5.403984729748e-02 "
    "9.999738645903e-01 4.859485810390e-04 -7.206933692422e-03 -2.921968648686e-01"
)


def cloud(seed: int, n: int = 400) -> F32:
    rng = np.random.default_rng(seed)
    return rng.uniform([-40, -40, -2], [40, 40, 4], (n, 3)).astype(np.float32)


def along_x(n: int) -> F64:
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, 0, 3] = 1.5 * np.arange(n)
    return T


def make(path: Path, n: int = 6, prior: F64 | None = None) -> Path:
    writer = DriveWriter(path, "car-1", SENSORS["hdl32e"], start_ns=10**18, prior_sigma_m=0.3).open()
    for i in range(n):
        writer.write_scan(i, cloud(i), np.full(400, 0.5, dtype=np.float32))
    writer.close(10**18 + 100_000_001 * np.arange(n), along_x(n) if prior is None else prior)
    return path


def test_what_was_written_is_read(tmp_path: Path) -> None:
    drive = open_drive(make(tmp_path / "d"))
    assert (drive.vehicle, drive.drive_id, drive.sensor.name) == ("car-1", "d", "hdl32e")
    assert drive.stamps_ns.tolist() == [10**18 + 100_000_001 * i for i in range(6)]
    assert drive.prior_sigma_m == 0.3
    for i, scan in enumerate(drive):
        assert np.array_equal(scan.points, cloud(i)[np.linalg.norm(cloud(i), axis=1) >= 0.9])
        assert scan.time_s is None
        assert scan.intensity is not None
        assert set(scan.intensity) == {0.5}
    assert drive.T_map_lidar_prior is not None
    assert np.array_equal(drive.T_map_lidar_prior, along_x(6))


def test_scans_chooses_slices_and_keeps_everything_in_step(tmp_path: Path) -> None:
    drive = open_drive(make(tmp_path / "d"), scans="0:2,4::1")
    assert len(drive) == 4
    assert drive.stamps_ns[2] == 10**18 + 4 * 100_000_001
    assert drive.T_map_lidar_prior is not None
    assert drive.T_map_lidar_prior[2, 0, 3] == 6.0
    assert np.array_equal(drive.read_scan(2).points, open_drive(tmp_path / "d").read_scan(4).points)
    assert len(open_drive(tmp_path / "d", scans="-1")) == 1
    assert len(open_drive(tmp_path / "d", scans="::2,0:3")) == 4


@pytest.mark.parametrize("scans", ["9", "a:b", "3:3", "", "1:2:3:4", "0:2,", "::0"])
def test_scans_that_choose_nothing_are_named(tmp_path: Path, scans: str) -> None:
    with pytest.raises(MapvoteError, match="--scans"):
        open_drive(make(tmp_path / "d"), scans=scans)


def test_prior_may_be_refused_or_replaced(tmp_path: Path) -> None:
    make(tmp_path / "d")
    assert open_drive(tmp_path / "d", prior="none").T_map_lidar_prior is None
    other = tmp_path / "other.txt"
    other.write_text("1 0 0 7 0 1 0 0 0 0 1 0\n" * 6)
    prior = open_drive(tmp_path / "d", prior=str(other)).T_map_lidar_prior
    assert prior is not None
    assert set(prior[:, 0, 3]) == {7.0}
    with pytest.raises(MapvoteError, match="no such prior"):
        open_drive(tmp_path / "d", prior="nowhere.txt")


def test_a_scan_that_is_not_compensated_gets_its_times_from_the_turning_sensor(tmp_path: Path) -> None:
    writer = DriveWriter(tmp_path / "d", "v", SENSORS["hdl32e"], start_ns=0, motion_compensated=False).open()
    writer.write_scan(0, np.array([[10, 0, 0], [0, 10, 0], [0, -10, 0]], dtype=np.float32))
    writer.close(np.array([0]))
    time_s = open_drive(tmp_path / "d").read_scan(0).time_s
    assert time_s is not None
    # clockwise from behind: the left side is seen a quarter turn before the stamp, the right side after it
    assert np.allclose(time_s, [0.0, -0.025, 0.025])


def test_missing_and_empty_drives(tmp_path: Path) -> None:
    with pytest.raises(MapvoteError, match="nothing is there"):
        open_drive(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(MapvoteError, match="no known layout"):
        open_drive(tmp_path / "empty")
    (tmp_path / "empty" / "velodyne").mkdir()
    with pytest.raises(MapvoteError, match="no scans"):
        open_drive(tmp_path / "empty")


def test_a_truncated_scan_is_named(tmp_path: Path) -> None:
    file = make(tmp_path / "d") / "velodyne" / "000003.bin"
    file.write_bytes(file.read_bytes()[:-5])
    drive = open_drive(tmp_path / "d")
    drive.read_scan(2)
    with pytest.raises(MapvoteError, match=r"000003\.bin: 6395 bytes are not a multiple of 16"):
        drive.read_scan(3)


def spoil(file: Path, share: float) -> None:
    rows = np.fromfile(file, dtype="<f4").reshape(-1, 4)
    rows[: round(share * len(rows)), 1] = np.nan
    rows.tofile(file)


def test_a_few_nan_points_are_dropped_and_counted_aloud(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    spoil(make(tmp_path / "d") / "velodyne" / "000001.bin", 0.02)
    with caplog.at_level(logging.WARNING):
        scans = list(open_drive(tmp_path / "d"))
    assert all(np.isfinite(s.points).all() for s in scans)
    assert "dropped 8 points" in caplog.text


def test_many_nan_points_are_refused(tmp_path: Path) -> None:
    spoil(make(tmp_path / "d") / "velodyne" / "000001.bin", 0.3)
    with pytest.raises(MapvoteError, match=r"000001\.bin: 120 of 400 points are not finite"):
        list(open_drive(tmp_path / "d"))


def test_the_likely_cause_is_named_only_where_it_is_likely(tmp_path: Path) -> None:
    spoil(make(tmp_path / "d") / "velodyne" / "000001.bin", 0.06)
    with pytest.raises(MapvoteError, match=r"24 of 400 .* damaged, or not float32"):
        list(open_drive(tmp_path / "d"))
    rows = np.fromfile(tmp_path / "d" / "velodyne" / "000002.bin", dtype="<f4").reshape(-1, 4)
    (rows * [1000, 1000, 1000, 1]).astype("<f4").tofile(tmp_path / "d" / "velodyne" / "000002.bin")
    with pytest.raises(MapvoteError, match="look like millimetres"):
        open_drive(tmp_path / "d").read_scan(2)


def test_unsorted_times_are_named(tmp_path: Path) -> None:
    (make(tmp_path / "d") / "times.txt").write_text("0.0\n0.1\n0.3\n0.2\n0.4\n0.5\n")
    with pytest.raises(MapvoteError, match=r"scan 3 .* does not come after scan 2"):
        open_drive(tmp_path / "d")


def test_without_times_a_rate_is_needed(tmp_path: Path) -> None:
    (make(tmp_path / "d") / "times.txt").unlink()
    (tmp_path / "d" / "drive.toml").unlink()
    with pytest.raises(MapvoteError, match="--rate"):
        open_drive(tmp_path / "d")
    assert open_drive(tmp_path / "d", rate_hz=5.0).stamps_ns.tolist() == [i * 200_000_000 for i in range(6)]


def test_a_misspelt_key_of_drive_toml_is_an_error(tmp_path: Path) -> None:
    (make(tmp_path / "d") / "drive.toml").write_text("vehicel = 'x'\n")
    with pytest.raises(MapvoteError, match="unknown key 'vehicel'; did you mean 'vehicle'"):
        open_drive(tmp_path / "d")


def test_mount_from_six_or_twelve_numbers(tmp_path: Path) -> None:
    drive = open_drive(make(tmp_path / "d"), mount="1, 0, 2, 0, 0, 90")
    assert np.allclose(geometry.transform(drive.T_base_lidar, np.array([[1.0, 0, 0]])), [[1, 1, 2]])
    with pytest.raises(MapvoteError, match="T_base_lidar must be"):
        open_drive(tmp_path / "d", mount="1,2,3")


@pytest.mark.parametrize(
    ("row", "defect"),
    [
        ("2 0 0 0 0 2 0 0 0 0 2 0", r"scale 2\.000"),
        ("1 0 0 0 0 -1 0 0 0 0 1 0", "left-handed"),
        ("nan 0 0 0 0 1 0 0 0 0 1 0", "not a number"),
        ("1 0 0 0 0 1 0 0", "expected 12 numbers, found 8"),
    ],
)
def test_a_broken_prior_is_named(tmp_path: Path, row: str, defect: str) -> None:
    good = "1 0 0 0 0 1 0 0 0 0 1 0\n"
    (make(tmp_path / "d") / "prior.txt").write_text(good * 3 + row + "\n" + good * 2)
    with pytest.raises(MapvoteError, match=defect):
        open_drive(tmp_path / "d")


def test_a_prior_of_the_wrong_length_is_named(tmp_path: Path) -> None:
    (make(tmp_path / "d") / "prior.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 5)
    with pytest.raises(MapvoteError, match="5 lines for 6 scans"):
        open_drive(tmp_path / "d")


def camera_rows(T_map_lidar: F64) -> str:
    """What KITTI odometry would have published for this trajectory."""
    Tr = np.eye(4)
    Tr[:3] = np.array(TR.split(), dtype=float).reshape(3, 4)
    T = Tr @ T_map_lidar @ np.linalg.inv(Tr)
    return "".join(" ".join(f"{v:.12e}" for v in row) + "\n" for row in T[:, :3].reshape(-1, 12))


def test_camera_poses_of_kitti_odometry_are_recognised_and_converted(tmp_path: Path) -> None:
    turning = np.stack([geometry.exp(np.array([2.0 * i, 0, 0, 0, 0, 0.1 * i])) for i in range(6)])
    (make(tmp_path / "00") / "poses.txt").write_text(camera_rows(turning))
    with pytest.raises(MapvoteError, match=r"camera poses .* calib\.txt"):
        open_drive(tmp_path / "00", prior="poses.txt")
    (tmp_path / "00" / "calib.txt").write_text(f"P0: {TR}\nTr: {TR}\n")
    prior = open_drive(tmp_path / "00", prior="poses.txt").T_map_lidar_prior
    assert prior is not None
    assert np.allclose(prior, turning, atol=1e-5)
    # poses that are T_map_lidar already are left alone
    assert np.array_equal(read_T_map_lidar(tmp_path / "00" / "prior.txt", tmp_path / "00"), along_x(6))


def test_unknown_sensor_lists_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(MapvoteError, match="did you mean 'hdl32e'"):
        open_drive(make(tmp_path / "d"), sensor="hdl32")
