"""Drives as folders of PCD files, one a scan, with the text files of a KITTI drive folder beside them.

A VIEWPOINT that changes from scan to scan is the pose of the sensor, and serves as the prior. Some tools store the
points in the map frame then: recognised, and taken back into the sensor's frame.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import scipy
from numpy.typing import NDArray

from mapvote.core import geometry
from mapvote.core.types import F64, Drive
from mapvote.formats.clean import log
from mapvote.formats.drives.numbered import read_stamps, scan_files
from mapvote.formats.drives.options import DriveOptions, read_drive_file
from mapvote.formats.drives.poses import check_rigid
from mapvote.formats.drives.scan_folder import ScanFolder, open_scan_folder
from mapvote.formats.drives.trajectory import Trajectory
from mapvote.formats.maps.autoware import is_autoware
from mapvote.formats.maps.cloud import xyz
from mapvote.formats.maps.pcd import read_pcd_table


def pcd_folder(path: Path) -> Path | None:
    """Where the scans of a PCD drive lie: ``path``/pcd or ``path`` itself; None if it is no such drive."""
    if not path.is_dir() or is_autoware(path):
        return None
    return next((folder for folder in (path / "pcd", path) if any(folder.glob("*.pcd"))), None)


def is_pcd_drive(path: Path) -> bool:
    return pcd_folder(path) is not None


def open_pcd_drive(path: Path, options: DriveOptions) -> Drive:
    """The drive in ``path``; scans are read one by one. MapvoteError says what is missing or does not fit."""
    about = read_drive_file(path)
    files = scan_files(pcd_folder(path) or path, ".pcd")
    stamps_ns = read_stamps(path, files, about, options)
    viewpoints = _viewpoints(files)
    in_map_frame = viewpoints is not None and _points_lie_around(viewpoints, files)
    if in_map_frame:
        log.warning("%s: points lie in the map frame; taken back to the sensor by each file's VIEWPOINT", path)
    index = {file: i for i, file in enumerate(files)}

    def read(file: Path) -> NDArray[np.void]:
        table, _ = read_pcd_table(file)
        return (
            _to_lidar(str(file), table, viewpoints[index[file]]) if viewpoints is not None and in_map_frame else table
        )

    def prior() -> Trajectory | F64 | None:
        if viewpoints is not None:
            log.warning("%s: the PCD files' VIEWPOINT is taken as prior; --prior none refuses it", path)
        return viewpoints

    return open_scan_folder(path, about, options, ScanFolder(files, stamps_ns, read, prior))


def _viewpoints(files: list[Path]) -> F64 | None:
    """(n, 4, 4) of the files' VIEWPOINTs; None if they are all the same, and so say nothing."""
    rows = np.array([_viewpoint_of(f) for f in files])
    if (rows == rows[0]).all():
        return None
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3, 3] = rows[:, :3]
    T[:, :3, :3] = scipy.spatial.transform.Rotation.from_quat(rows[:, 3:], scalar_first=True).as_matrix()
    check_rigid(T, f"{files[0].parent} (VIEWPOINT)")
    return T


def _viewpoint_of(file: Path) -> F64:
    """tx ty tz qw qx qy qz from the header alone; no point is read."""
    with file.open("rb") as stream:
        for line in stream:
            if line.startswith(b"VIEWPOINT"):
                values = np.array([float(word) for word in line.split()[1:]])
                if len(values) == 7 and np.linalg.norm(values[3:]) > 0.5:
                    return values
            if line.startswith(b"DATA"):
                break
    return np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])


def _points_lie_around(viewpoints: F64, files: list[Path]) -> bool:
    """Whether points lie around the viewpoint, not around the origin, in the scan taken farthest from the origin."""
    far = int(np.argmax(np.linalg.norm(viewpoints[:, :3, 3], axis=1)))
    table, _ = read_pcd_table(files[far])
    points = xyz(str(files[far]), table).astype(np.float64)
    centre = viewpoints[far, :3, 3]
    to_origin = np.nanmedian(np.linalg.norm(points, axis=1))
    return bool(np.linalg.norm(centre) > 10.0 and np.nanmedian(np.linalg.norm(points - centre, axis=1)) < to_origin)


def _to_lidar(where: str, table: np.ndarray, T_map_lidar: F64) -> np.ndarray:
    """The table with x, y, z in the sensor's frame instead of the map's."""
    points = geometry.transform(geometry.inverse(T_map_lidar), xyz(where, table))
    out = table.copy()
    for column, axis in enumerate("xyz"):
        out[axis] = points[:, column]
    return out
