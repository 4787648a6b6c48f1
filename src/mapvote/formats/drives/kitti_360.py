"""KITTI-360's poses: data_poses/SEQUENCE/poses.txt and calibration/, above a recording in KITTI raw's layout.

The world is local metres with z up; poses are of the GPS/IMU (Liao et al. 2022).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mapvote.core import geometry
from mapvote.core.types import F64, I64, MapvoteError
from mapvote.formats.drives.numbered import number_of
from mapvote.formats.drives.poses import check_rigid, read_calib, read_numbers
from mapvote.formats.drives.trajectory import Trajectory, sorted_trajectory
from mapvote.formats.extras import read_text
from mapvote.formats.geo.frame import MapFrame


def _pose_file(path: Path) -> Path:
    return path.resolve().parents[1] / "data_poses" / path.resolve().name / "poses.txt"


def has_kitti_360_poses(path: Path) -> bool:
    """Whether ``path`` is data_3d_raw/SEQUENCE of KITTI-360 with its poses beside."""
    return len(path.resolve().parents) > 1 and _pose_file(path).is_file()


def kitti_360_poses(path: Path, files: list[Path], stamps_ns: I64) -> Trajectory:
    """The poses of the scans that have one, by the numbers in the scans' names; between them they are interpolated.

    Some frames at the start of a sequence have no pose: MapvoteError says which scans to choose.
    """
    file = _pose_file(path)
    rows = read_numbers(file, 13)
    T_world_imu = np.tile(np.eye(4), (len(rows), 1, 1))
    T_world_imu[:, :3] = rows[:, 1:].reshape(-1, 3, 4)
    check_rigid(T_world_imu, str(file))
    T_imu_lidar = _T_imu_lidar(path.resolve().parents[1] / "calibration")
    numbers = np.array([number_of(f) for f in files])
    first = np.searchsorted(numbers, rows[:, 0])
    known = (first < len(numbers)) & (numbers[np.minimum(first, len(numbers) - 1)] == rows[:, 0])
    if not known.any():
        raise MapvoteError(f"{file}: no pose for any of the scans {files[0].name} to {files[-1].name}; --prior none")
    return sorted_trajectory(
        stamps_ns[first[known]], (T_world_imu @ T_imu_lidar)[known], of_vehicle=False, frame=MapFrame()
    )


def _T_imu_lidar(folder: Path) -> F64:
    """(4, 4) through camera 0: calib_cam_to_pose.txt and calib_cam_to_velo.txt."""
    calib = read_calib(folder / "calib_cam_to_pose.txt")
    velo = np.array([float(word) for word in read_text(folder / "calib_cam_to_velo.txt").split()])
    if "image_00" not in calib or calib["image_00"].size != 12 or velo.size != 12:
        raise MapvoteError(f"{folder}: calib_cam_to_pose.txt (image_00) and calib_cam_to_velo.txt need 12 numbers each")
    T_imu_camera, T_lidar_camera = np.eye(4), np.eye(4)
    T_imu_camera[:3], T_lidar_camera[:3] = calib["image_00"].reshape(3, 4), velo.reshape(3, 4)
    return T_imu_camera @ geometry.inverse(T_lidar_camera)
