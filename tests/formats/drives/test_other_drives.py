"""Drives that are not KITTI folders: PCD scans, ROS bags, KITTI raw."""

from __future__ import annotations

import logging
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pypcd4 import Encoding, MetaData, PointCloud
from rosbags.rosbag2 import StoragePlugin

from bag_recorder import CLOUD, Recorder
from mapvote.core import geometry
from mapvote.core.sensors import SENSORS
from mapvote.core.types import F32, F64, MapvoteError
from mapvote.formats import open_drive
from mapvote.formats.drives.point_fields import point_times_s
from mapvote.formats.geo.frame import enu_frame, poses_from_gnss

N, START = 5, 1_700_000_000_123_456_789


def cloud(i: int, n: int = 300) -> F32:
    """Points at every bearing, 5-40 m away."""
    rng = np.random.default_rng(i)
    bearing, far = rng.uniform(-np.pi, np.pi, n), rng.uniform(5, 40, n)
    out: F32 = np.column_stack([far * np.cos(bearing), far * np.sin(bearing), rng.uniform(-2, 3, n)]).astype(np.float32)
    return out


def trajectory(n: int = N, step_m: float = 12.0) -> F64:
    return np.stack([geometry.from_xyz_rpy(step_m * i, 0.1 * i, 0.0, yaw=0.02 * i) for i in range(n)])


def stamps() -> list[int]:
    return [START + 100_000_000 * i for i in range(N)]


def write_bag(
    path: Path, storage: StoragePlugin, *, topics: tuple[str, ...] = ("/points",), stamped: bool = True, cut: int = 0
) -> Path:
    """A bag of PointCloud2 (x y z intensity, Ouster's t) with poses at twice the rate."""
    bag = Recorder(path, storage)
    for i, ns in enumerate(stamps()):
        kinds = [*((axis, "<f4") for axis in "xyz"), ("pad", "<u4"), ("intensity", "<f4"), ("t", "<u4")]
        table = np.zeros(300, dtype=kinds)
        table["x"], table["y"], table["z"] = cloud(i).T
        table["intensity"], table["t"] = 51.0, np.arange(300) * 300_000
        table["x"][7] = np.nan  # a ray that hit nothing
        for topic in topics:
            bag.write(topic, CLOUD, ns + 5_000_000, bag.cloud_of(table, ns if stamped else 0, cut=cut))
    for k in range(2 * N + 1):
        pose = geometry.interpolate(trajectory()[0], trajectory()[1], k / 2 - 0.5)
        ns = START + 50_000_000 * k
        bag.pose("/odom", ns - 50_000_000 if stamped else 0, pose, ns)
    bag.bag.close()
    return path


@pytest.mark.parametrize("storage", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def test_a_ros2_bag_is_a_drive(tmp_path: Path, storage: StoragePlugin) -> None:
    drive = open_drive(write_bag(tmp_path / "bag", storage), prior="/odom", sensor="hdl32e")
    assert drive.stamps_ns.tolist() == stamps()
    keep = np.arange(300) != 7
    for i in (0, 3, 1):  # in any order
        scan = drive.read_scan(i)
        assert np.array_equal(scan.points, cloud(i)[keep])
        assert scan.intensity is not None
        assert np.allclose(scan.intensity, 0.2)
        assert scan.time_s is not None
        assert np.allclose(scan.time_s, np.arange(300)[keep] * 0.0003)
    assert drive.T_map_lidar_prior is not None
    assert np.allclose(drive.T_map_lidar_prior[1], trajectory()[1], atol=1e-9)
    assert len(open_drive(tmp_path / "bag", scans="1:4:2")) == 2


def test_one_mcap_file_without_its_folder_is_a_drive_too(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", StoragePlugin.MCAP)
    assert len(open_drive(next(bag.glob("*.mcap")), sensor="hdl32e")) == N


def test_a_mounted_sensor_turns_a_base_pose_into_a_lidar_pose(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", StoragePlugin.SQLITE3)
    prior = open_drive(bag, prior="/odom", mount="1,0,2,0,0,0", sensor="hdl32e").T_map_lidar_prior
    assert prior is not None
    assert np.allclose(prior[0, :3, 3], [1, 0, 2], atol=1e-9)


def test_bags_that_leave_a_question_open(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    bag = write_bag(tmp_path / "two", StoragePlugin.SQLITE3, topics=("/front", "/rear"))
    with pytest.raises(MapvoteError, match=r"choose with --topic .*/front \(5\), /rear \(5\)"):
        open_drive(bag)
    assert len(open_drive(bag, topic="/rear", sensor="hdl32e")) == N
    (bag / "drive.toml").write_text("topic = '/front'\nsensor = 'vlp16'\n")
    assert open_drive(bag).sensor.name == "vlp16"
    with pytest.raises(MapvoteError, match=r"no PointCloud2 topic /left; there are: /front"):
        open_drive(bag, topic="/left")
    with pytest.raises(MapvoteError, match=r"no pose topic /gps; topics with poses: /odom"):
        open_drive(bag, prior="/gps")
    with caplog.at_level(logging.WARNING):
        unstamped = open_drive(write_bag(tmp_path / "u", StoragePlugin.MCAP, stamped=False), sensor="hdl32e")
    assert "no stamps" in caplog.text
    assert unstamped.stamps_ns[0] == START + 5_000_000
    assert len(unstamped.read_scan(0).points) == 299


def test_broken_bags_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(MapvoteError, match=r"7190 bytes, but its header says 7200"):
        open_drive(write_bag(tmp_path / "cut", StoragePlugin.SQLITE3, cut=10))
    (tmp_path / "cut" / "metadata.yaml").write_text("nonsense")
    with pytest.raises(MapvoteError, match="not a readable bag"):
        open_drive(tmp_path / "cut")
    for module in [m for m in sys.modules if m.partition(".")[0] == "rosbags"]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, "rosbags", None)
    with pytest.raises(MapvoteError, match=r"mapvote\[ros\]"):
        open_drive(tmp_path / "cut")


@pytest.mark.parametrize("unit", [1.0, 1e-3, 1e-6, 1e-9])
@pytest.mark.parametrize("absolute", [False, True])
def test_point_times_are_understood_in_every_unit(unit: float, absolute: bool) -> None:
    truth_s = np.linspace(-0.05, 0.049, 100)
    if unit == 1e-9:
        raw: NDArray[Any] = np.round(truth_s * 1e9).astype(np.int64) + (START if absolute else 0)
    else:
        raw = (truth_s + (START * 1e-9 if absolute else 0.0)) / unit
    time_s = point_times_s("scan", raw, START, SENSORS["hdl32e"])
    assert time_s is not None
    assert np.allclose(time_s, truth_s, atol=1e-6)


def test_point_times_that_cannot_be() -> None:
    assert point_times_s("scan", np.zeros(9), START, SENSORS["hdl32e"]) is None
    with pytest.raises(MapvoteError, match="two clocks"):
        point_times_s("scan", 1e9 + np.linspace(0, 0.1, 9), START, SENSORS["hdl32e"])


def save_pcds(folder: Path, *, viewpoint: bool = False, in_map: bool = False) -> Path:
    (folder / "pcd").mkdir(parents=True)
    for i, pose in enumerate(trajectory()):
        points = geometry.transform(pose, cloud(i)).astype(np.float32) if in_map else cloud(i)
        pcd = PointCloud.from_xyz_points(points)
        yaw = 0.02 * i / 2
        if viewpoint:
            metadata: MetaData = pcd.metadata
            view = (*pose[:3, 3].tolist(), float(np.cos(yaw)), 0.0, 0.0, float(np.sin(yaw)))
            pcd = PointCloud(metadata.derive(viewpoint=view), pcd.pc_data)
        pcd.save(folder / "pcd" / f"{i:06d}.pcd", Encoding.BINARY_COMPRESSED)
    return folder


def test_pcd_scans_are_a_drive(tmp_path: Path) -> None:
    drive = open_drive(save_pcds(tmp_path / "d"), rate_hz=10, sensor="hdl32e")
    assert drive.T_map_lidar_prior is None
    assert all(np.array_equal(scan.points, cloud(i)) for i, scan in enumerate(drive))
    with pytest.raises(MapvoteError, match="--rate"):
        open_drive(tmp_path / "d")


def test_names_that_are_times_are_stamps(tmp_path: Path) -> None:
    for i, name in enumerate(("1700000000.10", "1700000000.20", "1700000000.3")):
        (tmp_path / "d").mkdir(exist_ok=True)
        PointCloud.from_xyz_points(cloud(i)).save(tmp_path / "d" / f"{name}.pcd")
    drive = open_drive(tmp_path / "d", sensor="hdl32e")
    assert drive.stamps_ns.tolist() == [1_700_000_000_100_000_000 + 100_000_000 * i for i in range(3)]


@pytest.mark.parametrize("in_map", [False, True])
def test_viewpoints_become_the_prior(tmp_path: Path, in_map: bool, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        drive = open_drive(save_pcds(tmp_path / "d", viewpoint=True, in_map=in_map), rate_hz=10, sensor="hdl32e")
    assert "VIEWPOINT is taken as prior" in caplog.text
    assert ("points lie in the map frame" in caplog.text) == in_map
    assert drive.T_map_lidar_prior is not None
    assert np.allclose(drive.T_map_lidar_prior, trajectory(), atol=1e-5)
    assert all(np.allclose(scan.points, cloud(i), atol=1e-4) for i, scan in enumerate(drive))


def test_kitti_raw_with_oxts(tmp_path: Path) -> None:
    day = tmp_path / "2011_09_26"
    drive = day / "2011_09_26_drive_0001_sync"
    (drive / "velodyne_points" / "data").mkdir(parents=True)
    (drive / "oxts" / "data").mkdir(parents=True)
    lines, plane = [], enu_frame(49.0, 8.4, 100.0)
    for i in range(N):
        lines.append(f"2011-09-26 13:02:25.{594360375 + 1000 * i}\n")
        lon, lat, _ = plane.to_lonlat(np.array([[2.0 * i, 0.0, 0.0]]))[0]
        row = [lat, lon, 100.0 + i, 0.0, 0.0, 0.5] + [0.0] * 24
        (drive / "oxts" / "data" / f"{i:010d}.txt").write_text(" ".join(f"{v:.12f}" for v in row))
        if i != 2:  # KITTI's 0009 lacks scans, too
            rows = np.column_stack([cloud(i), np.zeros(300)]).astype("<f4")
            rows.tofile(drive / "velodyne_points" / "data" / f"{i:010d}.bin")
    (drive / "velodyne_points" / "timestamps.txt").write_text("".join(lines))
    assert open_drive(drive, sensor="hdl64e").T_map_lidar_prior is None
    with pytest.raises(MapvoteError, match="calib_imu_to_velo"):
        open_drive(drive, prior="oxts")
    (day / "calib_imu_to_velo.txt").write_text("calib_time: 25-May-2012\nR: 1 0 0 0 1 0 0 0 1\nT: -0.8 0.3 -0.8\n")
    opened = open_drive(drive, sensor="hdl64e")
    assert opened.stamps_ns.tolist() == [1317042145_594360375 + 1000 * i for i in (0, 1, 3, 4)]
    prior = opened.T_map_lidar_prior
    assert prior is not None
    assert np.allclose(prior[:, :3, 3] - prior[0, :3, 3], [[2.0 * i, 0, i] for i in (0, 1, 3, 4)], atol=1e-4)
    heading = prior[0, :3, 0]
    assert np.allclose(heading, [np.cos(0.5), np.sin(0.5), 0])
    (drive / "prior.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 4)
    again = open_drive(drive, prior="oxts", sensor="hdl64e").T_map_lidar_prior
    assert again is not None
    assert np.array_equal(again, prior)


def test_oxts_agree_with_the_reference_of_a_real_drive() -> None:
    """Two points 1/1000 degree apart at 49 degrees: 111.21 m by the meridian's radius of curvature on the ellipsoid."""
    T_map, frame = poses_from_gnss(np.array([[8.4, 49.0, 110.0], [8.4, 49.001, 110.0]]), np.zeros((2, 3)), None)
    assert T_map[1, 1, 3] == pytest.approx(111.21, abs=0.01)
    assert frame.crs.startswith("ENU 49.0 8.4")
