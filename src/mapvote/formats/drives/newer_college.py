"""Newer College: raw_format/ouster_scan/cloud_SECONDS_NANOSECONDS.pcd, ground_truth/registered_poses.csv."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapvote.core.geometry import from_xyz_rpy
from mapvote.core.types import F64, Drive, MapvoteError
from mapvote.formats.clean import log
from mapvote.formats.drives.options import DriveOptions, read_drive_file
from mapvote.formats.drives.scan_folder import ScanFolder, open_scan_folder
from mapvote.formats.drives.trajectory import Trajectory, read_trajectory
from mapvote.formats.maps.pcd import read_pcd_table

_FOLDERS = ("raw_format/ouster_scan", "ouster_scan")
T_BASE_LIDAR = from_xyz_rpy(-0.084, -0.025, 0.050, yaw=2.0 * math.atan2(0.924, 0.383))
"""The camera that carries the poses to the Ouster (Ramezani et al. 2020)."""


def _scans(path: Path) -> Path | None:
    return next((path / f for f in _FOLDERS if (path / f).is_dir() and any((path / f).glob("cloud_*_*.pcd"))), None)


def is_newer_college(path: Path) -> bool:
    return _scans(path) is not None


def open_newer_college(path: Path, options: DriveOptions) -> Drive:
    """One experiment; its registered poses are the prior."""
    about = read_drive_file(path)
    files = sorted((_scans(path) or path).glob("cloud_*_*.pcd"), key=_stamp_ns)
    stamps_ns = np.array([_stamp_ns(f) for f in files], dtype=np.int64)
    table = path / "ground_truth" / "registered_poses.csv"

    def read(file: Path) -> NDArray[np.void]:
        return read_pcd_table(file)[0]

    def prior() -> Trajectory | F64 | None:
        if not table.is_file():
            log.warning("%s: missing, so there is no prior", table)
            return None
        found = read_trajectory(table)
        return Trajectory(found.times_ns, found.T_map, of_vehicle=True, frame=found.frame)

    return open_scan_folder(path, about, options, ScanFolder(files, stamps_ns, read, prior, T_base_lidar=T_BASE_LIDAR))


def _stamp_ns(file: Path) -> int:
    words = file.stem.split("_")
    if len(words) < 3 or not (words[1].isdigit() and words[2].isdigit()):
        raise MapvoteError(f"{file}: its name is not cloud_SECONDS_NANOSECONDS.pcd")
    return int(words[1]) * 10**9 + int(words[2])
