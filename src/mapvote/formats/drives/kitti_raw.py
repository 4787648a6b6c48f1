"""KITTI's raw recordings: velodyne_points/data/*.bin with timestamps, oxts/data/*.txt as prior (Geiger et al. 2013)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mapvote.core import geometry
from mapvote.core.types import F64, I64, Drive, MapvoteError
from mapvote.formats.clean import log
from mapvote.formats.drives.bin_layout import layout_of
from mapvote.formats.drives.kitti_360 import has_kitti_360_poses, kitti_360_poses
from mapvote.formats.drives.numbered import lines_of_scans, of_scans, read_times_ns, scan_files
from mapvote.formats.drives.options import DriveFile, DriveOptions, map_frame, read_drive_file
from mapvote.formats.drives.poses import check_rigid, read_calib, read_numbers
from mapvote.formats.drives.scan_folder import ScanFolder, open_scan_folder
from mapvote.formats.drives.trajectory import Trajectory
from mapvote.formats.geo.gnss import poses_from_gnss


def is_kitti_raw(path: Path) -> bool:
    return (path / "velodyne_points" / "data").is_dir()


def open_kitti_raw(path: Path, options: DriveOptions) -> Drive:
    """The recording in ``path``. Its oxts are the prior, where calib_imu_to_velo.txt is there or one folder up; of
    KITTI-360 its poses.
    """
    about = read_drive_file(path)
    files = scan_files(path / "velodyne_points" / "data", ".bin")
    table = path / "velodyne_points" / "timestamps.txt"
    if not table.is_file():
        raise MapvoteError(f"{table}: missing; unpack the whole recording")
    times_ns = read_times_ns(table)
    stamps_ns: I64 = times_ns[lines_of_scans(len(times_ns), files, table)]
    wanted = options.prior or about.prior
    if wanted == "oxts":  # a name of ours, no file
        options = DriveOptions(**{n: getattr(options, n) for n in DriveOptions.__slots__} | {"prior": None})
        about = DriveFile(**{n: getattr(about, n) for n in DriveFile.__struct_fields__} | {"prior": None})

    def prior() -> Trajectory | F64 | None:
        if wanted is None and has_kitti_360_poses(path):
            return kitti_360_poses(path, files, stamps_ns)
        return _oxts_prior(path, files, stamps_ns, about, options, wanted=wanted == "oxts")

    layout = layout_of(files, options.columns or about.columns, options.dtype or about.dtype)
    folder = ScanFolder(files, stamps_ns, layout.read, prior, zero_is_no_return=False)
    return open_scan_folder(path, about, options, folder)


def _oxts_prior(
    path: Path, files: list[Path], stamps_ns: I64, about: DriveFile, options: DriveOptions, *, wanted: bool
) -> Trajectory | None:
    folder = path / "oxts" / "data"
    calib = next((f for d in (path, path.parent) if (f := d / "calib_imu_to_velo.txt").is_file()), None)
    if calib is None or not folder.is_dir():
        message = f"{path}: no prior: {'oxts/data' if calib else 'calib_imu_to_velo.txt'} is missing"
        if wanted:
            raise MapvoteError(f"{message}; put it there, or --prior none")
        log.warning("%s", message)
        return None
    numbers = read_calib(calib)
    if "R" not in numbers or "T" not in numbers or numbers["R"].size != 9 or numbers["T"].size != 3:
        raise MapvoteError(f"{calib}: no lines R: (9 numbers) and T: (3 numbers)")
    T_lidar_imu = np.eye(4)
    T_lidar_imu[:3, :3], T_lidar_imu[:3, 3] = numbers["R"].reshape(3, 3), numbers["T"]
    check_rigid(T_lidar_imu[None], str(calib))
    rows = np.concatenate([read_numbers(f, 30) for f in scan_files(folder, ".txt")])
    T_map_imu, frame = poses_from_gnss(rows[:, [1, 0, 2]], rows[:, 3:6], map_frame(about, options))
    T_map_lidar = of_scans(T_map_imu @ geometry.inverse(T_lidar_imu), files, folder)
    return Trajectory(stamps_ns, T_map_lidar, of_vehicle=False, frame=frame)
