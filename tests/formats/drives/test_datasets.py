"""The datasets' own layouts, written here as their papers and development kits describe them, are read as they are."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from pypcd4 import Encoding, MetaData, PointCloud
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from mapvote.core import geometry
from mapvote.core.point_map import map_from_points
from mapvote.core.types import F64, Drive, MapvoteError
from mapvote.formats import export_map, open_drive, read_map
from mapvote.formats.drives.datasets import MULRAN_MOUNT, NEWER_COLLEGE_MOUNT
from mapvote.formats.drives.trajectory import read_trajectory
from mapvote.formats.geo.frame import MapFrame, enu_frame, poses_from_gnss
from mapvote.formats.maps.cloud import Cloud
from mapvote.formats.maps.las import write_las
from mapvote.formats.maps.ply import write_ply

N = 4
START = 1_600_000_000
MICRO = [str(START * 10**6 + i * 100_000) for i in range(N)]
NANO = [str(START * 10**9 + i * 10**8) for i in range(N)]
HALL = np.random.default_rng(0).uniform([-20, -20, -2], [20, 20, 6], (3000, 3))
RING = np.arange(3000, dtype=np.float32) % 32


def seen_from(T_map_lidar: F64) -> NDArray[np.float32]:
    """The hall's points in the sensor's frame."""
    return geometry.transform(geometry.inverse(T_map_lidar), HALL).astype(np.float32)


def poses(step_m: float = 1.0) -> F64:
    return np.stack([geometry.from_xyz_rpy(step_m * i, 0.2 * i, 0.1, 0.01, 0.02, 0.3 + 0.05 * i) for i in range(N)])


def bins(folder: Path, names: Iterable[str], T: F64, *extra: NDArray[np.float32] | float) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, T_i in zip(names, T, strict=True):
        columns = [*seen_from(T_i).T, *(np.broadcast_to(np.float32(e), len(HALL)) for e in extra)]
        np.column_stack(columns).astype("<f4").tofile(folder / f"{name}.bin")


def table(file: Path, header: str, rows: Iterable[Iterable[str | float]], apart: str = ",") -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    lines = [apart.join(v if isinstance(v, str) else f"{v:.11f}" for v in row) for row in rows]
    file.write_text("\n".join([header, *lines] if header else lines) + "\n")


def quaternion(T: F64) -> list[float]:
    return [float(v) for v in Rotation.from_matrix(T[:3, :3]).as_quat()]


def check(drive: Drive, *, tolerance: float = 2e-3) -> None:
    """Every scan, at the pose of the prior, is the hall again: points, mount and poses are read in one convention."""
    assert len(drive) == N
    assert drive.T_map_lidar_prior is not None
    for scan, T in zip(drive, drive.T_map_lidar_prior, strict=True):
        again = geometry.transform(T, scan.points.astype(np.float64))
        assert len(again) > 2900  # but for the few too near to the sensor
        assert cKDTree(HALL).query(again)[0].max() < tolerance
    assert (np.diff(drive.stamps_ns) == 100_000_000).all()


def test_nuscenes_scene_with_its_tables(tmp_path: Path) -> None:
    T_base_lidar = geometry.from_xyz_rpy(0.9, 0.0, 1.8, 0.0, 0.0, -np.pi / 2)  # their lidar looks along y
    names = [f"n015__LIDAR_TOP__{stamp}.pcd" for stamp in MICRO]
    folders = ["samples/LIDAR_TOP", *["sweeps/LIDAR_TOP"] * (N - 1)]
    for folder, name, T in zip(folders, names, poses() @ T_base_lidar, strict=True):
        bins(tmp_path / folder, [name], T[None], 7.0, RING)

    def row(token: str, M: F64) -> dict[str, object]:
        return {"token": token, "translation": M[:3, 3].tolist(), "rotation": np.roll(quaternion(M), 1).tolist()}

    data = [
        {"token": f"d{i}", "sample_token": "s", "ego_pose_token": f"p{i}", "calibrated_sensor_token": "c"}
        | {"timestamp": int(MICRO[i]), "filename": f"{folders[i]}/{names[i]}.bin"}
        for i in range(N)
    ]
    content = {
        "scene": [{"token": "sc", "name": "scene-0061"}, {"token": "sd", "name": "scene-0103"}],
        "sample": [{"token": "s", "scene_token": "sc"}],
        "sample_data": data,
        "ego_pose": [row(f"p{i}", M) for i, M in enumerate(poses())],
        "calibrated_sensor": [row("c", T_base_lidar)],
    }
    for name, rows in content.items():
        table(tmp_path / "v1.0-mini" / f"{name}.json", json.dumps(rows), [])
    with pytest.raises(MapvoteError, match="scene-0061, scene-0103"):
        open_drive(tmp_path)
    drive = open_drive(tmp_path, topic="scene-0061")
    check(drive)
    assert np.allclose(drive.T_base_lidar[:3, :3], np.eye(3), atol=1e-9)  # x forward, as everywhere
    assert set(np.unique(drive.read_scan(0).ring)) == set(range(32))  # type: ignore[arg-type]


def test_five_columns_under_kitti_names_are_recognised(tmp_path: Path) -> None:
    bins(tmp_path / "velodyne", [f"{i:06d}" for i in range(N)], poses(), 7.0, RING)
    scan = open_drive(tmp_path, rate_hz=10.0).read_scan(0)
    near, which = cKDTree(seen_from(poses()[0])).query(scan.points)
    assert near.max() == 0
    assert scan.ring is not None
    assert np.array_equal(scan.ring, RING[which].astype(np.uint16))


def test_columns_of_any_kind_are_named_on_the_command_line(tmp_path: Path) -> None:
    (tmp_path / "velodyne").mkdir()
    for i, T in enumerate(poses()):
        p = seen_from(T).astype(np.float64)
        np.column_stack([np.zeros(len(p)), p[:, 1], p[:, 0], p[:, 2]]).tofile(tmp_path / "velodyne" / f"{i:06d}.bin")
    drive = open_drive(tmp_path, rate_hz=10.0, columns="intensity,y,x,z", dtype="float64")
    assert cKDTree(seen_from(poses()[2])).query(drive.read_scan(2).points)[0].max() < 1e-6
    for wrong in ("x,y", "x,y,z,z", "x,,y,z"):
        with pytest.raises(MapvoteError, match="name every column once"):
            open_drive(tmp_path, rate_hz=10.0, columns=wrong)


def test_boreas_sequence(tmp_path: Path) -> None:
    bins(tmp_path / "lidar", MICRO, poses(), 1.0, 3.0, 0.0)
    angles = Rotation.from_matrix(poses()[:, :3, :3].swapaxes(1, 2)).as_euler("xyz")
    rows = ([MICRO[i], *poses()[i, :3, 3], 0, 0, 0, *angles[i], 0, 0, 0] for i in range(N))
    names = "GPSTime,easting,northing,altitude,vel_east,vel_north,vel_up,roll,pitch,heading,wz,wy,wx"
    table(tmp_path / "applanix" / "lidar_poses.csv", names, rows)
    check(open_drive(tmp_path))


def test_mulran_sequence(tmp_path: Path) -> None:
    bins(tmp_path / "Ouster", NANO, poses() @ MULRAN_MOUNT, 9.0)
    table(tmp_path / "global_pose.csv", "", ([NANO[i], *T[:3].ravel()] for i, T in enumerate(poses())))
    check(open_drive(tmp_path))


def test_newer_college_experiment(tmp_path: Path) -> None:
    folder = tmp_path / "raw_format" / "ouster_scan"
    folder.mkdir(parents=True)
    for i, T in enumerate(poses() @ NEWER_COLLEGE_MOUNT):
        PointCloud.from_xyz_points(seen_from(T)).save(folder / f"cloud_{START}_{i * 10**8:09d}.pcd")
    rows = ([str(START), str(i * 10**8), *T[:3, 3], *quaternion(T)] for i, T in enumerate(poses()))
    table(tmp_path / "ground_truth" / "registered_poses.csv", "sec,nsec,x,y,z,qx,qy,qz,qw", rows)
    check(open_drive(tmp_path))


def test_oxford_traversal(tmp_path: Path) -> None:
    swap = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])
    (tmp_path / "velodyne_left").mkdir()
    for stamp, T in zip(MICRO, poses(), strict=True):
        columns = np.column_stack([seen_from(T) * [1, -1, -1], np.ones(len(HALL))])
        columns.T.astype("<f4").tofile(tmp_path / "velodyne_left" / f"{stamp}.bin")
    ned = swap @ poses() @ np.diag([1.0, -1.0, -1.0, 1.0])
    angles = Rotation.from_matrix(ned[:, :3, :3]).as_euler("xyz")
    rows = ([MICRO[i], "INS_SOLUTION_GOOD", 51.76, -1.26, 100.0, *ned[i, :3, 3], "30U", *angles[i]] for i in range(N))
    names = "timestamp,ins_status,latitude,longitude,altitude,northing,easting,down,utm_zone,roll,pitch,yaw"
    table(tmp_path / "gps" / "ins.csv", names, rows)
    drive = open_drive(tmp_path)
    check(drive)
    assert drive.georeference["crs"] == "EPSG:32630"


def test_kitti_360_takes_its_own_poses(tmp_path: Path) -> None:
    name = "2013_05_28_drive_0000_sync"
    drive, calib = tmp_path / "data_3d_raw" / name, tmp_path / "calibration"
    T_imu_camera = geometry.from_xyz_rpy(1.0, 0.1, -0.2, 1.6, 0.02, 1.5)
    T_lidar_camera = geometry.from_xyz_rpy(0.8, -0.3, 0.1, -1.5, 0.0, -1.6)
    T_imu_lidar = T_imu_camera @ geometry.inverse(T_lidar_camera)
    bins(drive / "velodyne_points" / "data", [f"{i:010d}" for i in range(N)], poses() @ T_imu_lidar, 0.5)
    stamps = [f"2013-05-28 08:46:0{i // 10}.{i % 10}00000000" for i in range(N)]
    table(drive / "velodyne_points" / "timestamps.txt", "", ([stamp] for stamp in stamps))
    rows = ([str(i), *T[:3].ravel()] for i, T in enumerate(poses()))
    table(tmp_path / "data_poses" / name / "poses.txt", "", rows, " ")
    table(calib / "calib_cam_to_pose.txt", "", [["image_00:", *T_imu_camera[:3].ravel()]], " ")
    table(calib / "calib_cam_to_velo.txt", "", [T_lidar_camera[:3].ravel()], " ")
    check(open_drive(drive))


@pytest.mark.parametrize("suffix", [".ply", ".las", ".laz", ".npy", ".bin"])
def test_folders_of_scans_with_a_tum_trajectory(tmp_path: Path, suffix: str) -> None:
    for i, T in enumerate(poses()):
        file, p = tmp_path / f"{START + i * 0.1:.1f}{suffix}", seen_from(T)
        if suffix == ".npy":
            np.save(file, p)
        elif suffix == ".bin":
            np.column_stack([p, np.full(len(p), 0.5)]).astype("<f4").tofile(file)
        else:
            (write_ply if suffix == ".ply" else write_las)(file, Cloud(p))
    rows = ([START + 0.1 * i, *T[:3, 3], *quaternion(T)] for i, T in enumerate(poses()))
    table(tmp_path / "trajectory.tum", "# t x y z qx qy qz qw", rows, " ")
    check(open_drive(tmp_path, prior="trajectory.tum"))


def test_latitudes_and_longitudes_go_into_the_maps_frame(tmp_path: Path) -> None:
    utm = MapFrame("EPSG:32654", (367_000.0, 3_948_000.0, 0.0))
    T = poses()
    T[:, :3, :3] = Rotation.from_euler("z", np.linspace(0.3, 0.5, N)[:, None]).as_matrix()
    bins(tmp_path / "velodyne", [f"{i:06d}" for i in range(N)], T, 0.5)
    table(tmp_path / "times.txt", "", ([START + 0.1 * i] for i in range(N)))
    lonlat = utm.to_lonlat(T[:, :3, 3])
    ahead = np.einsum("nji,nj->ni", utm.axes_at(lonlat), T[:, :3, 0])  # x of the vehicle along east, north, up
    heading = np.degrees(np.arctan2(ahead[:, 0], ahead[:, 1])) % 360.0
    rows = ([START + 0.1 * i, *lonlat[i, [1, 0, 2]], heading[i]] for i in range(N))
    table(tmp_path / "gnss.csv", "timestamp [s],latitude,longitude,altitude,heading [deg]", rows)
    drive = open_drive(tmp_path, prior="gnss.csv", frame=utm)
    assert drive.T_map_lidar_prior is not None
    assert np.abs(drive.T_map_lidar_prior - T).max() < 1e-4
    assert drive.georeference["crs"] == "EPSG:32654"


def test_autowares_default_folder_is_a_map(tmp_path: Path) -> None:
    export_map(map_from_points(HALL), tmp_path / "a.pcd")
    table(tmp_path / "map" / "lanelet2_map.osm", "<osm/>", [])
    (tmp_path / "a.pcd").rename(tmp_path / "map" / "pointcloud_map.pcd")
    projector = "projector_type: MGRS\nvertical_datum: WGS84\nmgrs_grid: 54SUE"
    table(tmp_path / "map" / "map_projector_info.yaml", projector, [])
    found = read_map(tmp_path / "map")
    assert found.n_points == len(HALL)
    assert found.georeference["crs"] == "EPSG:32654"
    assert found.georeference["offset"] == "300000.0,3900000.0,0.0"


FIRST = "1600000000,0,0,0,0,0,0,1"


@pytest.mark.parametrize(
    ("names", "second", "said"),
    [
        ("sec,x,y,z,qx,qy,qz,qw", "1600000001,,0,0,0,0,0,1", "row 2 has no number in column x; leave it out"),
        ("sec,x,y,z,qx,qy,qz,qw", "1600000001,0,0,0,0,0,0,0.5", "row 2 has no unit quaternion"),
        ("sec,x,y,z,qx,qy,qz,qw", "1600000001,0,0", "csv:3: 3 values, but the header names 8"),
        ("sec,x,y,z,qx,qy,qz,qw", "never,0,0,0,0,0,0,1", "row 2 has no time"),
        ("sec,x,y,a,qx,qy,qz,qw", FIRST, "no column z"),
        ("sec,x,y,z,a,b,c,d", FIRST, "no orientation"),
        ("when,x,y,z,qx,qy,qz,qw", FIRST, "no column of times"),
    ],
)
def test_a_table_of_poses_that_is_not_whole_is_named(tmp_path: Path, names: str, second: str, said: str) -> None:
    (tmp_path / "t.csv").write_text(f"{names}\n{FIRST}\n{second}\n")
    with pytest.raises(MapvoteError, match=said):
        read_trajectory(tmp_path / "t.csv")


def test_seconds_as_numpy_writes_them_and_nanoseconds_beside_them_are_added(tmp_path: Path) -> None:
    rows = "1.600000000000000000e+09, 2.5e+08, 0,0,0,0,0,0,1\n1.6e9, 3.5e8, 1,0,0,0,0,0,1\n"
    (tmp_path / "t.csv").write_text(f"# sec,nsec,x,y,z,qx,qy,qz,qw\n{rows}")
    times_ns = read_trajectory(tmp_path / "t.csv").times_ns
    assert times_ns.tolist() == [1_600_000_000_250_000_000, 1_600_000_000_350_000_000]


@pytest.mark.parametrize("how", ["plain", "with viewpoints", "in the map"])
def test_pcd_scans_are_a_drive_and_viewpoints_become_the_prior(
    tmp_path: Path, how: str, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "pcd").mkdir()
    for i, T in enumerate(poses(12.0)):
        points = geometry.transform(T, HALL) if how == "in the map" else HALL
        cloud = PointCloud.from_xyz_points(points.astype(np.float32))
        about: MetaData = cloud.metadata
        view = (0.0, 0, 0, 1, 0, 0, 0) if how == "plain" else (*T[:3, 3], *np.roll(quaternion(T), 1))
        cloud = PointCloud(about.derive(viewpoint=view), cloud.pc_data)
        cloud.save(tmp_path / "pcd" / f"{i:06d}.pcd", Encoding.BINARY_COMPRESSED)
    with pytest.raises(MapvoteError, match="--rate"):
        open_drive(tmp_path)
    with caplog.at_level(logging.WARNING):
        drive = open_drive(tmp_path, rate_hz=10, sensor="hdl32e")
    assert ("VIEWPOINT is taken as prior" in caplog.text) == (how != "plain")
    assert ("points lie in the map frame" in caplog.text) == (how == "in the map")
    assert all(cKDTree(HALL).query(scan.points)[0].max() < 1e-4 for scan in drive)
    prior = drive.T_map_lidar_prior
    assert prior is None if how == "plain" else np.allclose(prior, poses(12.0), atol=1e-5)  # type: ignore[arg-type]


def test_names_that_are_times_are_stamps(tmp_path: Path) -> None:
    for name in ("1700000000.10", "1700000000.20", "1700000000.3"):
        PointCloud.from_xyz_points(HALL.astype(np.float32)).save(tmp_path / f"{name}.pcd")
    drive = open_drive(tmp_path, sensor="hdl32e")
    assert drive.stamps_ns.tolist() == [1_700_000_000_100_000_000 + 100_000_000 * i for i in range(3)]


def test_kitti_raw_with_oxts(tmp_path: Path) -> None:
    day = tmp_path / "2011_09_26"
    drive, plane = day / "2011_09_26_drive_0001_sync", enu_frame(49.0, 8.4, 100.0)
    for i in range(5):
        lon, lat, _ = plane.to_lonlat(np.array([[2.0 * i, 0.0, 0.0]]))[0]
        row = [lat, lon, 100.0 + i, 0.0, 0.0, 0.5] + [0.0] * 24
        table(drive / "oxts" / "data" / f"{i:010d}.txt", "", [[f"{v:.12f}" for v in row]], " ")
        if i != 2:  # KITTI's 0009 lacks scans, too
            bins(drive / "velodyne_points" / "data", [f"{i:010d}"], np.eye(4)[None], 0.0)
    stamps = ([f"2011-09-26 13:02:25.{594360375 + 1000 * i}"] for i in range(5))
    table(drive / "velodyne_points" / "timestamps.txt", "", stamps)
    assert open_drive(drive, sensor="hdl64e").T_map_lidar_prior is None
    with pytest.raises(MapvoteError, match="calib_imu_to_velo"):
        open_drive(drive, prior="oxts")
    (day / "calib_imu_to_velo.txt").write_text("calib_time: 25-May-2012\nR: 1 0 0 0 1 0 0 0 1\nT: -0.8 0.3 -0.8\n")
    opened = open_drive(drive, sensor="hdl64e")
    assert opened.stamps_ns.tolist() == [1317042145_594360375 + 1000 * i for i in (0, 1, 3, 4)]
    prior = opened.T_map_lidar_prior
    assert prior is not None
    assert np.allclose(prior[:, :3, 3] - prior[0, :3, 3], [[2.0 * i, 0, i] for i in (0, 1, 3, 4)], atol=1e-4)
    assert np.allclose(prior[0, :3, 0], [np.cos(0.5), np.sin(0.5), 0])
    (drive / "prior.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 4)
    again = open_drive(drive, prior="oxts", sensor="hdl64e").T_map_lidar_prior
    assert again is not None
    assert np.array_equal(again, prior)


def test_oxts_agree_with_the_reference_of_a_real_drive() -> None:
    """Two points 1/1000 degree apart at 49 degrees: 111.21 m by the meridian's radius of curvature on the ellipsoid."""
    T_map, frame = poses_from_gnss(np.array([[8.4, 49.0, 110.0], [8.4, 49.001, 110.0]]), np.zeros((2, 3)), None)
    assert T_map[1, 1, 3] == pytest.approx(111.21, abs=0.01)
    assert frame.crs.startswith("ENU 49.0 8.4")
