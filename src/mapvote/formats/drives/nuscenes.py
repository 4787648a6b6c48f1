"""nuScenes: samples and sweeps of LIDAR_TOP, poses and calibration from its tables (Caesar et al. 2020).

A scene is a drive; of several in one folder one is chosen with --topic scene-0061. Its LiDAR looks along y; points and
mount are turned so that x is forward.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import scipy
from numpy.typing import NDArray

from mapvote.core.types import F64, Drive, MapvoteError
from mapvote.formats.clean import log
from mapvote.formats.drives.bin_layout import NUSCENES, BinLayout
from mapvote.formats.drives.numbered import number_of
from mapvote.formats.drives.options import DriveOptions, read_drive_file
from mapvote.formats.drives.scan_folder import ScanFolder, open_scan_folder
from mapvote.formats.drives.trajectory import Trajectory

_FOLDERS = ("samples/LIDAR_TOP", "sweeps/LIDAR_TOP")
_FORWARD = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""R_nuscenes_lidar: their y is our x."""
Table = dict[str, dict[str, Any]]


def is_nuscenes(path: Path) -> bool:
    return any((path / folder).is_dir() for folder in _FOLDERS) or (path.is_dir() and any(path.glob("*.pcd.bin")))


def open_nuscenes(path: Path, options: DriveOptions) -> Drive:
    """One scene of a dataset, or a folder of .pcd.bin scans without tables. MapvoteError lists the scenes to choose."""
    about = read_drive_file(path)
    tables = next((f for f in sorted(path.glob("v1.0-*")) if (f / "sample_data.json").is_file()), None)
    layout = BinLayout(NUSCENES)

    def read(file: Path) -> NDArray[np.void]:
        table = layout.read(file).copy()
        table["x"], table["y"] = table["y"].copy(), -table["x"]
        return table

    if tables is None:
        folders = [path / folder for folder in _FOLDERS] if not any(path.glob("*.pcd.bin")) else [path]
        files = sorted((f for folder in folders for f in folder.glob("*.pcd.bin")), key=number_of_name)
        if not files:
            raise MapvoteError(f"{path}: no *.pcd.bin scans in {', '.join(_FOLDERS)}")
        log.warning("%s: no tables v1.0-*, so no poses: only the scans are read", path)
        stamps = np.array([number_of_name(f) * 1000 for f in files], dtype=np.int64)
        return open_scan_folder(path, about, options, ScanFolder(files, stamps, read))
    rows = _scene(path, tables, options.topic or about.topic)
    files = [path / row["filename"] for row in rows]
    stamps = np.array([row["timestamp"] * 1000 for row in rows], dtype=np.int64)
    poses, mounts = _read(tables / "ego_pose.json"), _read(tables / "calibrated_sensor.json")
    T_base_lidar = _pose(mounts[rows[0]["calibrated_sensor_token"]])
    T_base_lidar[:3, :3] = T_base_lidar[:3, :3] @ _FORWARD
    T_map_base = np.stack([_pose(poses[row["ego_pose_token"]]) for row in rows])

    def prior() -> Trajectory | F64 | None:
        return T_map_base @ T_base_lidar

    folder = ScanFolder(files, stamps, read, prior, T_base_lidar=T_base_lidar)
    return open_scan_folder(path, about, options, folder)


def number_of_name(file: Path) -> int:
    """Microseconds in a name such as n015-2018-07-24__LIDAR_TOP__1532402927647951.pcd.bin."""
    return int(number_of(Path(file.name.removesuffix(".pcd.bin").rpartition("__")[2])))


def _scene(path: Path, tables: Path, wanted: str | None) -> list[dict[str, Any]]:
    """The rows of sample_data.json of one scene's LIDAR_TOP whose files are there, by time."""
    scenes = {row["name"]: row["token"] for row in _read(tables / "scene.json").values()}
    if wanted is None and len(scenes) == 1:
        wanted = next(iter(scenes))
    if wanted not in scenes:
        raise MapvoteError(f"{path}: choose a scene with --topic: {', '.join(sorted(scenes)) or 'there is none'}")
    samples = _read(tables / "sample.json")
    rows = [
        row
        for row in _read(tables / "sample_data.json").values()
        if "LIDAR_TOP" in row["filename"] and samples[row["sample_token"]]["scene_token"] == scenes[wanted]
    ]
    there = sorted((row for row in rows if (path / row["filename"]).is_file()), key=lambda row: row["timestamp"])
    if not there:
        raise MapvoteError(f"{path}: {wanted} has {len(rows)} scans in its tables, but none of their files is here")
    if len(there) < len(rows):
        log.warning("%s: %d of %d scans of %s are not here", path, len(rows) - len(there), len(rows), wanted)
    return there


def _read(file: Path) -> Table:
    try:
        return {row["token"]: row for row in msgspec.json.decode(file.read_bytes())}
    except (OSError, msgspec.DecodeError, KeyError, TypeError) as error:
        raise MapvoteError(f"{file}: not a table of nuScenes ({error}); unpack the metadata again") from error


def _pose(row: dict[str, Any]) -> F64:
    T = np.eye(4)
    T[:3, :3] = scipy.spatial.transform.Rotation.from_quat(row["rotation"], scalar_first=True).as_matrix()
    T[:3, 3] = row["translation"]
    return T
