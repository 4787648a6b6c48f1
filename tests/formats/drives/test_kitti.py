"""KITTI drive folders, as they are written, as they come and as they break."""

from __future__ import annotations

import logging
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

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
ROW = "1 0 0 0 0 1 0 0 0 0 1 0\n"


def cloud(seed: int, n: int = 400) -> F32:
    rng = np.random.default_rng(seed)
    return rng.uniform([-40, -40, -2], [40, 40, 4], (n, 3)).astype(np.float32)


def along_x(n: int) -> F64:
    return geometry.poses_at([[1.5 * i, 0.0, 0.0] for i in range(n)])


def make(path: Path) -> Path:
    writer = DriveWriter(path, "car-1", SENSORS["hdl32e"], start_ns=10**18, prior_sigma_m=0.3).open()
    for i in reversed(range(6)):
        writer.write_scan(i, cloud(i), np.full(400, 0.5, dtype=np.float32))
    assert not path.exists(), "a folder half written must not look like a drive"
    writer.close(10**18 + 100_000_001 * np.arange(6), along_x(6))
    return path


def test_a_written_drive_is_read_back(tmp_path: Path) -> None:
    drive = open_drive(make(tmp_path / "d"))
    assert (drive.vehicle, drive.drive_id, drive.sensor.name) == ("car-1", "d", "hdl32e")
    assert drive.stamps_ns.tolist() == [10**18 + 100_000_001 * i for i in range(6)]
    assert drive.prior_sigma_m == 0.3
    for i, scan in enumerate(drive):
        assert np.array_equal(scan.points, cloud(i)[np.linalg.norm(cloud(i), axis=1) >= 0.9])
        assert scan.time_s is None
        assert set(scan.fields["intensity"]) == {0.5}
    assert drive.T_map_lidar_prior is not None
    assert np.array_equal(drive.T_map_lidar_prior, along_x(6))


def test_a_drive_folder_is_as_the_documents_lay_it_out(tmp_path: Path) -> None:
    folder = make(tmp_path / "d")
    rows = np.fromfile(folder / "velodyne/000002.bin", dtype="<f4").reshape(-1, 4)
    np.testing.assert_array_equal(rows, np.column_stack([cloud(2), np.full(400, 0.5)]))
    assert (folder / "times.txt").read_text().splitlines()[:2] == ["0.000000000", "0.100000001"]
    assert np.loadtxt(folder / "prior.txt").shape == (6, 12)
    about = tomllib.loads((folder / "drive.toml").read_text())
    assert (about["sensor"], about["start_ns"], len(about["T_base_lidar"])) == ("hdl32e", 10**18, 12)


def test_a_drive_is_never_overwritten_and_never_short_of_scans(tmp_path: Path) -> None:
    writer = DriveWriter(tmp_path / "v1", "v1", SENSORS["vlp16"], start_ns=0).open()
    with pytest.raises(MapvoteError, match="0 scans written, but 1 stamps"):
        writer.close(np.array([0], dtype=np.int64))
    with pytest.raises(MapvoteError, match="exists already"):
        DriveWriter(make(tmp_path / "v2"), "v2", SENSORS["vlp16"], start_ns=0).open()


def test_scans_chooses_slices_and_keeps_everything_in_step(tmp_path: Path) -> None:
    drive = open_drive(make(tmp_path / "d"), scans="0:2,4::1")
    assert len(drive) == 4
    assert drive.stamps_ns[2] == 10**18 + 4 * 100_000_001
    assert drive.T_map_lidar_prior is not None
    assert drive.T_map_lidar_prior[2, 0, 3] == 6.0
    assert np.array_equal(drive.read_scan(2).points, open_drive(tmp_path / "d").read_scan(4).points)
    assert len(open_drive(tmp_path / "d", scans="-1")) == 1
    assert len(open_drive(tmp_path / "d", scans="::2,0:3")) == 4


def test_prior_may_be_refused_or_replaced_and_a_rate_stands_in_for_times(tmp_path: Path) -> None:
    make(tmp_path / "d")
    assert open_drive(tmp_path / "d", prior="none").T_map_lidar_prior is None
    (tmp_path / "other.txt").write_text("1 0 0 7 0 1 0 0 0 0 1 0\n" * 6)
    prior = open_drive(tmp_path / "d", prior=str(tmp_path / "other.txt")).T_map_lidar_prior
    assert prior is not None
    assert set(prior[:, 0, 3]) == {7.0}
    for name in ("times.txt", "drive.toml"):
        (tmp_path / "d" / name).unlink()
    assert open_drive(tmp_path / "d", rate_hz=5.0).stamps_ns.tolist() == [i * 200_000_000 for i in range(6)]


def test_a_scan_that_is_not_compensated_gets_its_times_from_the_turning_sensor(tmp_path: Path) -> None:
    writer = DriveWriter(tmp_path / "d", "v", SENSORS["hdl32e"], start_ns=0, motion_compensated=False).open()
    writer.write_scan(0, np.array([[10, 0, 0], [0, 10, 0], [0, -10, 0]], dtype=np.float32))
    writer.close(np.array([0]))
    time_s = open_drive(tmp_path / "d").read_scan(0).time_s
    assert time_s is not None
    # clockwise from behind: the left side is seen a quarter turn before the stamp, the right side after it
    assert np.allclose(time_s, [0.0, -0.025, 0.025])


def test_missing_and_empty_drives(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "no scans" / "velodyne").mkdir(parents=True)
    for name, said in (("nowhere", "nothing is there"), ("empty", "no known layout"), ("no scans", "no scans")):
        with pytest.raises(MapvoteError, match=said):
            open_drive(tmp_path / name)


def text(name: str, content: str) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_text(content)


def rows(change: Callable[[Any], Any]) -> Callable[[Path], object]:
    """Change the rows of scan 3."""

    def edit(folder: Path) -> None:
        file = folder / "velodyne" / "000003.bin"
        np.asarray(change(np.fromfile(file, dtype="<f4").reshape(-1, 4)), dtype="<f4").tofile(file)

    return edit


def spoilt(points: int) -> Callable[[Path], object]:
    return rows(lambda r: np.where(np.arange(400)[:, None] < points, np.nan, r))


@pytest.mark.parametrize(
    ("edit", "options", "said"),
    [
        (rows(lambda r: r.ravel()[:-1]), {}, r"000003\.bin: 6396 bytes are not a multiple of 16"),
        (spoilt(120), {}, r"000003\.bin: 120 of 400 points are not finite"),
        (spoilt(24), {}, r"24 of 400 .* damaged, or not float32"),
        (rows(lambda r: r * [1000, 1000, 1000, 1]), {}, "look like millimetres"),
        (text("times.txt", "0.0\n0.1\n0.3\n0.2\n0.4\n0.5\n"), {}, r"scan 3 .* does not come after scan 2"),
        (lambda folder: [(folder / name).unlink() for name in ("times.txt", "drive.toml")], {}, "--rate"),
        (text("drive.toml", "vehicel = 'x'\n"), {}, "unknown key 'vehicel'; did you mean 'vehicle'"),
        (text("prior.txt", ROW * 5), {}, "5 lines for 6 scans"),
        (text("prior.txt", ROW * 3 + "2 0 0 0 0 2 0 0 0 0 2 0\n" + ROW * 2), {}, r"pose 3 .*scale 2\.000"),
        (text("prior.txt", ROW * 3 + "1 0 0 0 0 -1 0 0 0 0 1 0\n" + ROW * 2), {}, "left-handed"),
        (text("prior.txt", ROW * 3 + "nan 0 0 0 0 1 0 0 0 0 1 0\n" + ROW * 2), {}, "not a number"),
        (text("prior.txt", ROW * 3 + "1 0 0 0 0 1 0 0\n" + ROW * 2), {}, r":4: 8 numbers, but a row has 12"),
        (str, {"prior": "nowhere.txt"}, "no such prior"),
        (str, {"mount": "1,2,3"}, "T_base_lidar must be"),
        (str, {"sensor": "hdl32"}, "did you mean 'hdl32e'"),
        *((str, {"scans": scans}, "--scans") for scans in ("9", "a:b", "3:3", "", "1:2:3:4", "0:2,", "::0")),
    ],
)
def test_faults_of_a_drive_and_of_its_options_are_named(
    tmp_path: Path, edit: Callable[[Path], object], options: dict[str, str], said: str
) -> None:
    edit(make(tmp_path / "d"))
    with pytest.raises(MapvoteError, match=said):
        list(open_drive(tmp_path / "d", **options))  # type: ignore[arg-type]


def test_a_few_nan_points_are_dropped_and_counted_aloud(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    spoilt(8)(make(tmp_path / "d"))
    with caplog.at_level(logging.WARNING):
        scans = list(open_drive(tmp_path / "d"))
    assert all(np.isfinite(s.points).all() for s in scans)
    assert "dropped 8 points" in caplog.text


def test_a_mount_from_six_numbers_is_metres_and_degrees(tmp_path: Path) -> None:
    drive = open_drive(make(tmp_path / "d"), mount="1, 0, 2, 0, 0, 90")
    assert np.allclose(geometry.transform(drive.T_base_lidar, np.array([[1.0, 0, 0]])), [[1, 1, 2]])


def test_camera_poses_of_kitti_odometry_are_recognised_and_converted(tmp_path: Path) -> None:
    turning = np.stack([geometry.exp(np.array([2.0 * i, 0, 0, 0, 0, 0.1 * i])) for i in range(6)])
    Tr = np.vstack([np.array(TR.split(), dtype=float).reshape(3, 4), [0, 0, 0, 1]])
    published = Tr @ turning @ np.linalg.inv(Tr)  # by KITTI odometry, of this trajectory
    np.savetxt(make(tmp_path / "00") / "poses.txt", published[:, :3].reshape(-1, 12), fmt="%.12e")
    with pytest.raises(MapvoteError, match=r"camera poses .* calib\.txt"):
        open_drive(tmp_path / "00", prior="poses.txt")
    (tmp_path / "00" / "calib.txt").write_text(f"P0: {TR}\nTr: {TR}\n")
    prior = open_drive(tmp_path / "00", prior="poses.txt").T_map_lidar_prior
    assert prior is not None
    assert np.allclose(prior, turning, atol=1e-5)
    # poses that are T_map_lidar already are left alone
    assert np.array_equal(read_T_map_lidar(tmp_path / "00" / "prior.txt", tmp_path / "00"), along_x(6))
