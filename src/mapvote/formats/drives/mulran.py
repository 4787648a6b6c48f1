"""MulRan: Ouster/NANOSECONDS.bin of four columns, global_pose.csv (Kim et al. 2020)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mapvote.core import geometry
from mapvote.core.types import F64, Drive
from mapvote.formats.clean import log
from mapvote.formats.drives.bin_layout import BinLayout
from mapvote.formats.drives.numbered import number_of, scan_files
from mapvote.formats.drives.options import DriveOptions, read_drive_file
from mapvote.formats.drives.poses import check_rigid, read_numbers
from mapvote.formats.drives.scan_folder import ScanFolder, open_scan_folder
from mapvote.formats.drives.trajectory import Trajectory, sorted_trajectory
from mapvote.formats.extras import read_text
from mapvote.formats.geo.frame import MapFrame

T_BASE_LIDAR = geometry.from_xyz_rpy(1.7042, -0.021, 1.8047, *np.deg2rad([0.0001, 0.0003, 179.6654]))
"""The dataset's calib_base2ouster.txt."""


def is_mulran(path: Path) -> bool:
    return (path / "Ouster").is_dir()


def open_mulran(path: Path, options: DriveOptions) -> Drive:
    """One sequence; its global poses (UTM of zone 52, of the vehicle) are the prior."""
    about = read_drive_file(path)
    files = scan_files(path / "Ouster", ".bin")
    stamps_ns = np.array([int(f.stem) if f.stem.isdigit() else int(number_of(f)) for f in files], dtype=np.int64)
    table = path / "global_pose.csv"

    def prior() -> Trajectory | F64 | None:
        if not table.is_file():
            log.warning("%s: missing, so there is no prior", table)
            return None
        rows = read_numbers(table, 13)
        times = [int(float(w)) if not w.isdigit() else int(w) for w in _first_words(table)]
        T = np.tile(np.eye(4), (len(rows), 1, 1))
        T[:, :3] = rows[:, 1:].reshape(-1, 3, 4)
        check_rigid(T, str(table))
        frame = MapFrame("EPSG:32652") if np.abs(T[0, :2, 3]).max() > 1e5 else MapFrame()
        return sorted_trajectory(np.array(times, dtype=np.int64), T, of_vehicle=True, frame=frame)

    folder = ScanFolder(files, stamps_ns, BinLayout().read, prior, T_base_lidar=T_BASE_LIDAR)
    return open_scan_folder(path, about, options, folder)


def _first_words(table: Path) -> list[str]:
    """The first column as text: float64 does not hold nanoseconds since 1970."""
    return [line.split(",")[0].strip() for line in read_text(table).splitlines() if line.strip()]
