"""KITTI's raw recordings: velodyne_points/data/*.bin with timestamps, oxts/data/*.txt as prior (Geiger et al. 2013)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mapvote.core import geometry
from mapvote.core.sensors import Sensor
from mapvote.core.types import F64, Drive, MapvoteError, Scan
from mapvote.formats.clean import BadPoints, clean_scan, log
from mapvote.formats.drives.kitti import read_bin, read_T_map_lidar
from mapvote.formats.drives.numbered import lines_of_scans, of_scans, prior_file, read_times_ns, scan_files
from mapvote.formats.drives.options import DriveFile, DriveOptions, make_drive, read_drive_file
from mapvote.formats.drives.poses import check_rigid, from_oxts, read_calib, read_numbers


def is_kitti_raw(path: Path) -> bool:
    return (path / "velodyne_points" / "data").is_dir()


def open_kitti_raw(path: Path, options: DriveOptions) -> Drive:
    """The recording in ``path``. Its oxts are the prior, where calib_imu_to_velo.txt is there or one folder up."""
    about = read_drive_file(path)
    files = scan_files(path / "velodyne_points" / "data", ".bin")
    table = path / "velodyne_points" / "timestamps.txt"
    if not table.is_file():
        raise MapvoteError(f"{table}: missing; unpack the whole recording")
    times_ns = read_times_ns(table)
    stamps_ns = times_ns[lines_of_scans(len(times_ns), files, table)]
    if (options.prior or about.prior) in (None, "oxts"):
        T_prior = _oxts_prior(path, files, about, wanted=(options.prior or about.prior) == "oxts")
    else:
        prior = prior_file(path, about, options)
        T_prior = None if prior is None else of_scans(read_T_map_lidar(prior, path), files, prior)
    bad_points = BadPoints(str(path))

    def read_scan(i: int, sensor: Sensor) -> Scan:
        rows = read_bin(files[i])
        where, stamp_ns = str(files[i]), int(stamps_ns[i])
        return clean_scan(where, i, stamp_ns, rows[:, :3], sensor=sensor, bad_points=bad_points, intensity=rows[:, 3])

    return make_drive(path, about, options, stamps_ns=stamps_ns, T_map_lidar_prior=T_prior, read_scan=read_scan)


def _oxts_prior(path: Path, files: list[Path], about: DriveFile, *, wanted: bool) -> F64 | None:
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
    packets = scan_files(folder, ".txt")
    rows = np.concatenate([read_numbers(f, 30) for f in packets])
    origin = None if about.origin is None else np.array(about.origin)
    if origin is not None and origin.shape != (3,):
        raise MapvoteError(f"{path / 'drive.toml'}: origin must be latitude, longitude, altitude")
    return of_scans(from_oxts(rows, geometry.inverse(T_lidar_imu), origin), files, folder)
