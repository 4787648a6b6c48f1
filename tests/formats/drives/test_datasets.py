"""The datasets' own layouts, written here as their papers and development kits describe them, are read as they are."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from mapvote.core import geometry
from mapvote.core.point_map import map_from_points
from mapvote.core.types import F64, Drive, MapvoteError
from mapvote.formats import export_map, open_drive, read_map
from mapvote.formats.drives.datasets import MULRAN_MOUNT, NEWER_COLLEGE_MOUNT
from mapvote.formats.drives.trajectory import read_trajectory
from mapvote.formats.maps.cloud import Cloud
from mapvote.formats.maps.las import write_las
from mapvote.formats.maps.ply_e57 import write_ply

N = 4
START = 1_600_000_000
HALL = np.random.default_rng(0).uniform([-20, -20, -2], [20, 20, 6], (3000, 3))


def seen_from(T_map_lidar: F64) -> NDArray[np.float32]:
    """The hall's points in the sensor's frame."""
    return geometry.transform(geometry.inverse(T_map_lidar), HALL).astype(np.float32)


def poses() -> F64:
    return np.stack([geometry.from_xyz_rpy(1.0 * i, 0.2 * i, 0.1, 0.01, 0.02, 0.3 + 0.05 * i) for i in range(N)])


def bins(folder: Path, names: list[str], T: F64, *extra: NDArray[np.float32] | float) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, T_i in zip(names, T, strict=True):
        columns = [*seen_from(T_i).T, *(np.broadcast_to(np.float32(e), len(HALL)) for e in extra)]
        np.column_stack(columns).astype("<f4").tofile(folder / name)


def check(drive: Drive, *, tolerance: float = 2e-3) -> None:
    """Every scan, at the pose of the prior, is the hall again: points, mount and poses are read in one convention."""
    assert len(drive) == N
    assert drive.T_map_lidar_prior is not None
    for scan, T in zip(drive, drive.T_map_lidar_prior, strict=True):
        again = geometry.transform(T, scan.points.astype(np.float64))
        assert len(again) > 2900  # but for the few too near to the sensor
        assert cKDTree(HALL).query(again)[0].max() < tolerance
    assert (np.diff(drive.stamps_ns) == 100_000_000).all()


RING = np.arange(3000, dtype=np.float32) % 32


def test_nuscenes_scene_with_its_tables(tmp_path: Path) -> None:
    T_base_lidar = geometry.from_xyz_rpy(0.9, 0.0, 1.8, 0.0, 0.0, -np.pi / 2)  # their lidar looks along y
    T = poses() @ T_base_lidar
    names = [f"n015__LIDAR_TOP__{START * 10**6 + i * 100_000}.pcd.bin" for i in range(N)]
    bins(tmp_path / "samples" / "LIDAR_TOP", names[:1], T[:1], 7.0, RING)
    bins(tmp_path / "sweeps" / "LIDAR_TOP", names[1:], T[1:], 7.0, RING)
    tables = tmp_path / "v1.0-mini"
    tables.mkdir()

    def quaternion(M: F64) -> list[float]:
        return [float(v) for v in Rotation.from_matrix(M[:3, :3]).as_quat(scalar_first=True)]

    def row(token: str, M: F64) -> dict[str, object]:
        return {"token": token, "translation": M[:3, 3].tolist(), "rotation": quaternion(M)}

    data = [
        {
            "token": f"d{i}",
            "sample_token": "s",
            "ego_pose_token": f"p{i}",
            "calibrated_sensor_token": "c",
            "timestamp": START * 10**6 + i * 100_000,
            "filename": f"{'samples' if i == 0 else 'sweeps'}/LIDAR_TOP/{names[i]}",
        }
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
        (tables / f"{name}.json").write_text(json.dumps(rows))
    with pytest.raises(MapvoteError, match="scene-0061, scene-0103"):
        open_drive(tmp_path)
    drive = open_drive(tmp_path, topic="scene-0061")
    check(drive)
    assert np.allclose(drive.T_base_lidar[:3, :3], np.eye(3), atol=1e-9)  # x forward, as everywhere
    scan = drive.read_scan(0)
    assert scan.ring is not None
    assert set(np.unique(scan.ring)) == set(range(32))


def test_five_columns_under_kitti_names_are_recognised(tmp_path: Path) -> None:
    bins(tmp_path / "velodyne", [f"{i:06d}.bin" for i in range(N)], poses(), 7.0, RING)
    scan = open_drive(tmp_path, rate_hz=10.0).read_scan(0)
    near, which = cKDTree(seen_from(poses()[0])).query(scan.points)
    assert near.max() == 0
    assert scan.ring is not None
    assert np.array_equal(scan.ring, RING[which].astype(np.uint16))


def test_columns_of_any_kind_are_named_on_the_command_line(tmp_path: Path) -> None:
    folder = tmp_path / "velodyne"
    folder.mkdir()
    for i, T in enumerate(poses()):
        p = seen_from(T).astype(np.float64)
        np.column_stack([np.zeros(len(p)), p[:, 1], p[:, 0], p[:, 2]]).tofile(folder / f"{i:06d}.bin")
    drive = open_drive(tmp_path, rate_hz=10.0, columns="intensity,y,x,z", dtype="float64")
    assert cKDTree(seen_from(poses()[2])).query(drive.read_scan(2).points)[0].max() < 1e-6
    for wrong in ("x,y", "x,y,z,z", "x,,y,z"):
        with pytest.raises(MapvoteError, match="name every column once"):
            open_drive(tmp_path, rate_hz=10.0, columns=wrong)


def test_boreas_sequence(tmp_path: Path) -> None:
    T = poses()
    bins(tmp_path / "lidar", [f"{START * 10**6 + i * 100_000}.bin" for i in range(N)], T, 1.0, 3.0, 0.0)
    rows = ["GPSTime,easting,northing,altitude,vel_east,vel_north,vel_up,roll,pitch,heading,wz,wy,wx"]
    for i, T_i in enumerate(T):
        roll, pitch, yaw = Rotation.from_matrix(T_i[:3, :3].T).as_euler("xyz")
        numbers = [*T_i[:3, 3], 0, 0, 0, roll, pitch, yaw, 0, 0, 0]
        rows.append(",".join([str(START * 10**6 + i * 100_000), *(f"{v:.9f}" for v in numbers)]))
    (tmp_path / "applanix").mkdir()
    (tmp_path / "applanix" / "lidar_poses.csv").write_text("\n".join(rows) + "\n")
    check(open_drive(tmp_path))


def test_mulran_sequence(tmp_path: Path) -> None:
    bins(tmp_path / "Ouster", [f"{START * 10**9 + i * 10**8}.bin" for i in range(N)], poses() @ MULRAN_MOUNT, 9.0)
    rows = [
        ",".join([str(START * 10**9 + i * 10**8), *(f"{v:.9f}" for v in T[:3].ravel())]) for i, T in enumerate(poses())
    ]
    (tmp_path / "global_pose.csv").write_text("\n".join(rows) + "\n")
    check(open_drive(tmp_path))


def test_newer_college_experiment(tmp_path: Path) -> None:
    from pypcd4 import PointCloud

    folder, truth = tmp_path / "raw_format" / "ouster_scan", tmp_path / "ground_truth"
    folder.mkdir(parents=True)
    truth.mkdir()
    rows = ["sec,nsec,x,y,z,qx,qy,qz,qw"]
    for i, T in enumerate(poses()):
        PointCloud.from_xyz_points(seen_from(T @ NEWER_COLLEGE_MOUNT)).save(
            folder / f"cloud_{START}_{i * 10**8:09d}.pcd"
        )
        values = [*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()]
        rows.append(f"{START},{i * 10**8}," + ",".join(f"{v:.9f}" for v in values))
    (truth / "registered_poses.csv").write_text("\n".join(rows) + "\n")
    check(open_drive(tmp_path))


def test_oxford_traversal(tmp_path: Path) -> None:
    turned = np.diag([1.0, -1.0, -1.0, 1.0])
    swap = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])
    folder = tmp_path / "velodyne_left"
    folder.mkdir()
    rows = ["timestamp,ins_status,latitude,longitude,altitude,northing,easting,down,utm_zone,roll,pitch,yaw"]
    for i, T in enumerate(poses()):
        p = seen_from(T)
        np.stack([p[:, 0], -p[:, 1], -p[:, 2], np.ones(len(p))]).astype("<f4").tofile(
            folder / f"{START * 10**6 + i * 100_000}.bin"
        )
        ned = swap @ T @ turned
        roll, pitch, yaw = Rotation.from_matrix(ned[:3, :3]).as_euler("xyz")
        numbers = [51.76, -1.26, 100.0, ned[0, 3], ned[1, 3], ned[2, 3]]
        text = ",".join(f"{v:.9f}" for v in numbers)
        rows.append(f"{START * 10**6 + i * 100_000},INS_SOLUTION_GOOD,{text},30U,{roll:.9f},{pitch:.9f},{yaw:.9f}")
    (tmp_path / "gps").mkdir()
    (tmp_path / "gps" / "ins.csv").write_text("\n".join(rows) + "\n")
    drive = open_drive(tmp_path)
    check(drive)
    assert drive.georeference["crs"] == "EPSG:32630"


def test_kitti_360_takes_its_own_poses(tmp_path: Path) -> None:
    name = "2013_05_28_drive_0000_sync"
    drive, calib = tmp_path / "data_3d_raw" / name, tmp_path / "calibration"
    T_imu_camera = geometry.from_xyz_rpy(1.0, 0.1, -0.2, 1.6, 0.02, 1.5)
    T_lidar_camera = geometry.from_xyz_rpy(0.8, -0.3, 0.1, -1.5, 0.0, -1.6)
    T_imu_lidar = T_imu_camera @ geometry.inverse(T_lidar_camera)
    bins(drive / "velodyne_points" / "data", [f"{i:010d}.bin" for i in range(N)], poses() @ T_imu_lidar, 0.5)
    stamps = [f"2013-05-28 08:46:0{i // 10}.{i % 10}00000000\n" for i in range(N)]
    (drive / "velodyne_points" / "timestamps.txt").write_text("".join(stamps))
    table = tmp_path / "data_poses" / name / "poses.txt"
    table.parent.mkdir(parents=True)
    calib.mkdir()
    table.write_text(
        "".join(f"{i} " + " ".join(f"{v:.9f}" for v in T[:3].ravel()) + "\n" for i, T in enumerate(poses()))
    )
    (calib / "calib_cam_to_pose.txt").write_text("image_00: " + " ".join(f"{v:.9f}" for v in T_imu_camera[:3].ravel()))
    (calib / "calib_cam_to_velo.txt").write_text(" ".join(f"{v:.9f}" for v in T_lidar_camera[:3].ravel()))
    check(open_drive(drive))


@pytest.mark.parametrize("suffix", [".ply", ".las", ".laz", ".npy", ".bin"])
def test_folders_of_scans_with_a_tum_trajectory(tmp_path: Path, suffix: str) -> None:
    for i, T in enumerate(poses()):
        file, p = tmp_path / f"{START + i * 0.1:.1f}{suffix}", seen_from(T)
        if suffix == ".npy":
            np.save(file, p)
        elif suffix == ".bin":
            np.column_stack([p, np.full(len(p), 0.5)]).astype("<f4").tofile(file)
        elif suffix == ".ply":
            write_ply(file, Cloud(p))
        else:
            write_las(file, Cloud(p))
    rows = [
        " ".join(f"{v:.9f}" for v in [START + 0.1 * i, *T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()])
        for i, T in enumerate(poses())
    ]
    (tmp_path / "trajectory.tum").write_text("# t x y z qx qy qz qw\n" + "\n".join(rows) + "\n")
    check(open_drive(tmp_path, prior="trajectory.tum"))


def test_latitudes_and_longitudes_go_into_the_maps_frame(tmp_path: Path) -> None:
    from mapvote.formats.geo.frame import MapFrame

    utm = MapFrame("EPSG:32654", (367_000.0, 3_948_000.0, 0.0))
    T = poses()
    T[:, :3, :3] = Rotation.from_euler("z", np.linspace(0.3, 0.5, N)[:, None]).as_matrix()
    bins(tmp_path / "velodyne", [f"{i:06d}.bin" for i in range(N)], T, 0.5)
    (tmp_path / "times.txt").write_text("".join(f"{START + 0.1 * i:.1f}\n" for i in range(N)))
    lonlat = utm.to_lonlat(T[:, :3, 3])
    north = utm.axes_at(lonlat)
    rows = ["timestamp [s],latitude,longitude,altitude,heading [deg]"]
    for i, T_i in enumerate(T):
        ahead = north[i].T @ T_i[:3, 0]  # x of the vehicle along east, north, up
        heading = np.degrees(np.arctan2(ahead[0], ahead[1])) % 360.0
        rows.append(f"{START + 0.1 * i:.1f},{lonlat[i, 1]:.11f},{lonlat[i, 0]:.11f},{lonlat[i, 2]:.4f},{heading:.9f}")
    (tmp_path / "gnss.csv").write_text("\n".join(rows) + "\n")
    drive = open_drive(tmp_path, prior="gnss.csv", frame=utm)
    assert drive.T_map_lidar_prior is not None
    assert np.abs(drive.T_map_lidar_prior - T).max() < 1e-4
    assert drive.georeference["crs"] == "EPSG:32654"


def test_autowares_default_folder_is_a_map(tmp_path: Path) -> None:
    export_map(map_from_points(HALL), tmp_path / "a.pcd")
    folder = tmp_path / "map"
    folder.mkdir()
    (tmp_path / "a.pcd").rename(folder / "pointcloud_map.pcd")
    (folder / "lanelet2_map.osm").write_text("<osm/>")
    (folder / "map_projector_info.yaml").write_text("projector_type: MGRS\nvertical_datum: WGS84\nmgrs_grid: 54SUE\n")
    found = read_map(folder)
    assert sum(len(t.points) for t in found.tiles.values()) == len(HALL)
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
