"""Boreas: lidar/MICROSECONDS.bin of six columns, applanix/lidar_poses.csv (Burnett et al. 2023)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mapvote.core import geometry
from mapvote.core.types import F64, Drive, MapvoteError
from mapvote.formats.clean import log
from mapvote.formats.drives.bin_layout import BinLayout
from mapvote.formats.drives.numbered import number_of, scan_files
from mapvote.formats.drives.options import DriveOptions, read_drive_file
from mapvote.formats.drives.scan_folder import ScanFolder, open_scan_folder
from mapvote.formats.drives.trajectory import Trajectory, sorted_trajectory
from mapvote.formats.geo.frame import MapFrame

COLUMNS = ("x", "y", "z", "intensity", "laser_number", "time")


def is_boreas(path: Path) -> bool:
    return (path / "lidar").is_dir() and (path / "applanix").is_dir()


def open_boreas(path: Path, options: DriveOptions) -> Drive:
    """One sequence; its post-processed poses are the prior. The times of points count from the scan's."""
    about = read_drive_file(path)
    files = scan_files(path / "lidar", ".bin")
    stamps_ns = np.array([int(number_of(f)) * 1000 for f in files], dtype=np.int64)
    table = path / "applanix" / "lidar_poses.csv"

    def prior() -> Trajectory | F64 | None:
        if table.is_file():
            return read_lidar_poses(table)
        log.warning("%s: missing (test sequences keep it secret), so there is no prior", table)
        return None

    return open_scan_folder(path, about, options, ScanFolder(files, stamps_ns, BinLayout(COLUMNS).read, prior))


def read_lidar_poses(file: Path) -> Trajectory:
    """GPSTime (microseconds), easting, northing, altitude, velocities, roll, pitch, heading (radians).

    Boreas' rotations are those of its development kit: R_enu_lidar is the inverse of the usual roll, pitch, yaw.
    """
    with file.open() as stream:
        header, text = stream.readline(), stream.read()
    if "easting" not in header.lower():
        raise MapvoteError(f"{file}: no header with GPSTime, easting, northing, altitude ...; copy it again")
    rows = np.array([[float(v) for v in line.split(",")[:10]] for line in text.splitlines() if line.strip()])
    if rows.ndim != 2 or rows.shape[1] < 10:
        raise MapvoteError(f"{file}: rows need ten columns or more; copy it again")
    stamps = np.array([int(line.split(",")[0]) for line in text.splitlines() if line.strip()], dtype=np.int64) * 1000
    T = np.stack([geometry.from_xyz_rpy(0.0, 0.0, 0.0, *(float(v) for v in row[7:10])) for row in rows])
    T[:, :3, :3] = T[:, :3, :3].swapaxes(1, 2)
    T[:, :3, 3] = rows[:, 1:4]
    return sorted_trajectory(stamps, T, of_vehicle=False, frame=MapFrame())
