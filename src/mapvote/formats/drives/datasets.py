"""Public datasets as their authors lay them out (docs/formats.md lists their files): KITTI raw (Geiger et al. 2013),
KITTI-360 (Liao et al. 2022), nuScenes (Caesar et al. 2020), Boreas (Burnett et al. 2023), MulRan (Kim et al. 2020),
Newer College (Ramezani et al. 2020), Oxford (Radar) RobotCar (Barnes et al. 2020).

KITTI-360's world is local metres with z up. nuScenes' LiDAR looks along y: points and mount are turned so that x is
forward. Oxford's frames have x forward, y right and z down: points are turned so that y is left and z up.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from mapvote.core import geometry
from mapvote.core.types import F64, I64, Drive, MapvoteError
from mapvote.formats.drives.options import DriveOptions, map_frame
from mapvote.formats.drives.point_fields import log
from mapvote.formats.drives.scan_folder import (
    KITTI,
    NUSCENES,
    BinLayout,
    ScanFolder,
    layout_of,
    open_scan_folder,
    read_bytes,
    read_times_ns,
    scan_files,
)
from mapvote.formats.drives.scan_names import numbers_of, stamp_in_name_ns
from mapvote.formats.drives.trajectory import (
    Trajectory,
    exact_ns,
    motions_of_rpy,
    needed,
    of_scans,
    read_calib,
    read_columns,
    read_numbers,
    read_trajectory,
    rigid_motions,
    sorted_trajectory,
)
from mapvote.formats.geo.frame import MapFrame, poses_from_gnss, utm_of
from mapvote.formats.listing import below, entry, files_like
from mapvote.formats.maps.pcd import read_pcd_table
from mapvote.formats.reading import read_text, read_whole

_LIDAR_TOP = ("samples/LIDAR_TOP", "sweeps/LIDAR_TOP")
MULRAN_MOUNT = geometry.from_xyz_rpy(1.7042, -0.021, 1.8047, *np.deg2rad([0.0001, 0.0003, 179.6654]))
"""The dataset's calib_base2ouster.txt."""
NEWER_COLLEGE_MOUNT = geometry.from_xyz_rpy(-0.084, -0.025, 0.050, yaw=2.0 * math.atan2(0.924, 0.383))
"""The camera that carries the poses to the Ouster (Ramezani et al. 2020)."""
OXFORD_LIDARS = ("velodyne_left", "velodyne_right")
_OXFORD_AXES = np.diag([1.0, -1.0, -1.0, 1.0])


def open_kitti_raw(path: Path, options: DriveOptions) -> Drive:
    """The recording in ``path``. Its oxts are the prior, where calib_imu_to_velo.txt is there or one folder up; of
    KITTI-360 its poses.
    """
    files = scan_files(path / "velodyne_points" / "data", ".bin")
    table = entry(path, "velodyne_points/timestamps.txt")
    if not table.is_file():
        raise MapvoteError(f"{table}: missing; unpack the whole recording")
    stamps_ns: I64 = of_scans(read_times_ns(table), files, table)

    sequence = path.resolve()
    poses = sequence.parent.parent / "data_poses" / sequence.name / "poses.txt"

    def prior() -> Trajectory | F64 | None:
        if options.prior is None and poses.is_file():
            return _kitti_360_poses(poses, files, stamps_ns)
        return _oxts_prior(path, files, stamps_ns, options)

    folder = ScanFolder(files, stamps_ns, layout_of(files, options).read, prior, "oxts", zero_is_no_return=False)
    return open_scan_folder(path, options, folder)


def _oxts_prior(path: Path, files: list[Path], stamps_ns: I64, options: DriveOptions) -> Trajectory | None:
    folder = path / "oxts" / "data"
    calib = next((f for d in (path, path.parent) if (f := entry(d, "calib_imu_to_velo.txt")).is_file()), None)
    if calib is None or not folder.is_dir():
        message = f"{path}: no prior: {'oxts/data' if calib else 'calib_imu_to_velo.txt'} is missing"
        if options.prior == "oxts":
            raise MapvoteError(f"{message}; put it there, or --prior none")
        log.warning("%s", message)
        return None
    numbers = read_calib(calib)
    if "R" not in numbers or "T" not in numbers or numbers["R"].size != 9 or numbers["T"].size != 3:
        raise MapvoteError(f"{calib}: no lines R: (9 numbers) and T: (3 numbers)")
    T_lidar_imu = rigid_motions(np.column_stack([numbers["R"].reshape(3, 3), numbers["T"]]), str(calib))[0]
    rows = np.concatenate([read_numbers(f, 30) for f in scan_files(folder, ".txt")])
    T_map_imu, frame = poses_from_gnss(rows[:, [1, 0, 2]], rows[:, 3:6], map_frame(options))
    T_map_lidar = of_scans(T_map_imu @ geometry.inverse(T_lidar_imu), files, folder)
    return Trajectory(stamps_ns, T_map_lidar, of_vehicle=False, frame=frame)


def _kitti_360_poses(file: Path, files: list[Path], stamps_ns: I64) -> Trajectory:
    """The poses of the scans that have one, by the numbers in the scans' names; between them they are interpolated.

    Some frames at the start of a sequence have no pose: MapvoteError says which scans to choose.
    """
    rows = read_numbers(file, 13)
    T_world_imu = rigid_motions(rows[:, 1:], str(file))
    folder = file.parents[2] / "calibration"  # from the IMU to the LiDAR through camera 0
    calib = read_calib(entry(folder, "calib_cam_to_pose.txt"))
    velo = read_numbers(entry(folder, "calib_cam_to_velo.txt"), 12).ravel()
    if "image_00" not in calib or calib["image_00"].size != 12 or velo.size != 12:
        raise MapvoteError(f"{folder}: calib_cam_to_pose.txt (image_00) and calib_cam_to_velo.txt need 12 numbers each")
    T_imu_camera, T_lidar_camera = rigid_motions(np.stack([calib["image_00"], velo]), str(folder))
    numbers = numbers_of(files)
    first = np.searchsorted(numbers, rows[:, 0])
    has_pose = (first < len(numbers)) & (numbers[np.minimum(first, len(numbers) - 1)] == rows[:, 0])
    if not has_pose.any():
        raise MapvoteError(f"{file}: no pose for any of the scans {files[0].name} to {files[-1].name}; --prior none")
    T = T_world_imu[has_pose] @ (T_imu_camera @ geometry.inverse(T_lidar_camera))
    return sorted_trajectory(stamps_ns[first[has_pose]], T, of_vehicle=False, frame=MapFrame())


def is_nuscenes(path: Path) -> bool:
    return any((path / folder).is_dir() for folder in _LIDAR_TOP) or bool(files_like(path, "*.pcd.bin"))


def open_nuscenes(path: Path, options: DriveOptions) -> Drive:
    """One scene of a dataset, or a folder of .pcd.bin scans without tables. MapvoteError lists the scenes to choose."""
    tables = next((f for f in sorted(path.glob("v1.0-*")) if (f / "sample_data.json").is_file()), None)
    layout = BinLayout(NUSCENES)

    def read(file: Path) -> NDArray[np.void]:
        table = layout.read(file).copy()
        table["x"], table["y"] = table["y"].copy(), -table["x"]
        return table

    if tables is None:
        folders = [path / folder for folder in _LIDAR_TOP] if not files_like(path, "*.pcd.bin") else [path]
        files = sorted((f for folder in folders for f in files_like(folder, "*.pcd.bin")), key=stamp_in_name_ns)
        if not files:
            raise MapvoteError(f"{path}: no *.pcd.bin scans in {', '.join(_LIDAR_TOP)}")
        log.warning("%s: no tables v1.0-*, so no poses: only the scans are read", path)
        stamps = np.array([stamp_in_name_ns(f) for f in files], dtype=np.int64)
        return open_scan_folder(path, options, ScanFolder(files, stamps, read))
    rows = _scene(path, tables, options.topic)
    files = [path / row.filename for row in rows]
    stamps = np.array([row.timestamp * 1000 for row in rows], dtype=np.int64)
    T_base_lidar = _nuscenes_poses(tables / "calibrated_sensor.json", [rows[0].calibrated_sensor_token])[0]
    R_nuscenes_lidar = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # their y is our x
    T_base_lidar[:3, :3] = T_base_lidar[:3, :3] @ R_nuscenes_lidar
    T_map_base = _nuscenes_poses(tables / "ego_pose.json", [row.ego_pose_token for row in rows])
    folder = ScanFolder(files, stamps, read, lambda: T_map_base @ T_base_lidar, T_base_lidar=T_base_lidar)
    return open_scan_folder(path, options, folder)


class _Named(msgspec.Struct):
    """A row of nuScenes' scene.json."""

    token: str
    name: str


class _Sample(msgspec.Struct):
    """A row of sample.json."""

    token: str
    scene_token: str


class _Recorded(msgspec.Struct):
    """A row of sample_data.json: one scan or picture."""

    token: str
    sample_token: str
    ego_pose_token: str
    calibrated_sensor_token: str
    timestamp: Annotated[int, msgspec.Meta(ge=0, le=1 << 52)]
    """Microseconds since 1970."""
    filename: str


class _Posed(msgspec.Struct):
    """A row of ego_pose.json or calibrated_sensor.json."""

    token: str
    translation: tuple[float, float, float]
    rotation: tuple[float, float, float, float]
    """Quaternion w, x, y, z."""


def _scene(path: Path, tables: Path, wanted: str | None) -> list[_Recorded]:
    """The rows of sample_data.json of one scene's LIDAR_TOP whose files are there, by time."""
    scenes = {row.name: row.token for row in _nuscenes_table(tables / "scene.json", _SCENES)}
    if wanted is None and len(scenes) == 1:
        wanted = next(iter(scenes))
    if wanted not in scenes:
        raise MapvoteError(f"{path}: choose a scene with --topic: {', '.join(sorted(scenes)) or 'there is none'}")
    samples = {r.token for r in _nuscenes_table(tables / "sample.json", _SAMPLES) if r.scene_token == scenes[wanted]}
    table = tables / "sample_data.json"
    recorded = _nuscenes_table(table, _RECORDED)
    rows = [row for row in recorded if "LIDAR_TOP" in row.filename and row.sample_token in samples]
    there = sorted((row for row in rows if below(path, row.filename, table).is_file()), key=lambda row: row.timestamp)
    if not there:
        raise MapvoteError(f"{path}: {wanted} has {len(rows)} scans in its tables, but none of their files is here")
    if len(there) < len(rows):
        log.warning("%s: %d of %d scans of %s are not here", path, len(rows) - len(there), len(rows), wanted)
    return there


_SCENES = msgspec.json.Decoder(list[_Named])
_SAMPLES = msgspec.json.Decoder(list[_Sample])
_RECORDED = msgspec.json.Decoder(list[_Recorded])
_POSED = msgspec.json.Decoder(list[_Posed])
_Row = TypeVar("_Row")


def _nuscenes_table(file: Path, rows: msgspec.json.Decoder[list[_Row]]) -> list[_Row]:
    try:
        return rows.decode(read_whole(file))
    except (OSError, msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise MapvoteError(f"{file}: not a table of nuScenes ({error}); unpack the metadata again") from error


def _nuscenes_poses(file: Path, tokens: list[str]) -> F64:
    """(n, 4, 4) the poses of these tokens; MapvoteError if the table lacks one, or one is no rigid motion."""
    rows = {row.token: row for row in _nuscenes_table(file, _POSED)}
    lost = next((token for token in tokens if token not in rows), None)
    if lost is not None:
        raise MapvoteError(f"{file}: has no row {lost[:80]!r}, which sample_data.json names; unpack the metadata again")
    quaternions = np.array([rows[token].rotation for token in tokens])
    translations = np.array([rows[token].translation for token in tokens])
    norms = np.linalg.norm(quaternions, axis=1)
    if not (np.isfinite(translations).all() and np.isfinite(norms).all() and (norms > 1e-6).all()):
        raise MapvoteError(f"{file}: holds a pose that is no rigid motion; unpack the metadata again")
    return geometry.poses_at(translations, geometry.rotations_of(quaternions[:, [1, 2, 3, 0]]))


@dataclass(frozen=True, slots=True)
class Dataset:
    """A dataset whose scans are named by their stamps, with a table of poses."""

    scans: tuple[str, ...]
    """Patterns of their paths, of which one is used."""
    read: Callable[[Path], NDArray[np.void]]
    poses: str
    """The table. Without it there is no prior, with a warning."""
    read_poses: Callable[[Path], Trajectory]
    T_base_lidar: F64 | None = None
    stamp_ns: Callable[[Path], int] = stamp_in_name_ns
    beside: str = "."
    """A folder that distinguishes it from others."""

    def recognised(self, path: Path) -> bool:
        return (path / self.beside).is_dir() and any(files_like(path, pattern) for pattern in self.scans)

    def open(self, path: Path, options: DriveOptions) -> Drive:
        """The drive in ``path``. MapvoteError says what is missing or does not fit."""
        files = sorted((file for pattern in self.scans for file in files_like(path, pattern)), key=self.stamp_ns)
        stamps_ns = np.array([self.stamp_ns(file) for file in files], dtype=np.int64)
        table = entry(path, self.poses)

        def prior() -> Trajectory | None:
            if table.is_file():
                return self.read_poses(table)
            log.warning("%s: missing, so there is no prior", table)
            return None

        folder = ScanFolder(files, stamps_ns, self.read, prior, T_base_lidar=self.T_base_lidar)
        return open_scan_folder(path, options, folder)


def _boreas_poses(file: Path) -> Trajectory:
    """GPSTime (microseconds), easting, northing, altitude, velocities, roll, pitch, heading (radians).

    Boreas' rotations are those of its development kit: R_enu_lidar is the inverse of the usual roll, pitch, yaw.
    """
    times_ns, columns = read_columns(file)
    T = motions_of_rpy(needed(file, columns, "x", "y", "z", "roll", "pitch", "heading"))
    T[:, :3, :3] = T[:, :3, :3].swapaxes(1, 2)
    return sorted_trajectory(times_ns, T, of_vehicle=False, frame=MapFrame())


def _mulran_poses(table: Path) -> Trajectory:
    """T_map_base of rows of nanoseconds and 3 x 4 matrices, in UTM of zone 52 where the coordinates are so large."""
    T = rigid_motions(read_numbers(table, 13)[:, 1:], str(table))
    times_ns = exact_ns(table, [line.split(",")[0] for line in read_text(table).splitlines() if line.strip()])
    frame = MapFrame("EPSG:32652") if len(T) and np.abs(T[0, :2, 3]).max() > 1e5 else MapFrame()
    return sorted_trajectory(times_ns, T, of_vehicle=True, frame=frame)


def _newer_college_stamp_ns(file: Path) -> int:
    words = file.stem.split("_")
    if len(words) < 3 or not (words[1].isdigit() and words[2].isdigit()):
        raise MapvoteError(f"{file}: its name is not cloud_SECONDS_NANOSECONDS.pcd")
    return int(words[1]) * 10**9 + int(words[2])


def _oxford_rows(file: Path) -> NDArray[np.void]:
    """Four rows of float32 (x, y, z, intensity), one after the other."""
    data = read_bytes(file)
    if len(data) % 16:
        raise MapvoteError(f"{file}: {len(data)} bytes are no four rows of float32: the scan is cut off; copy it again")
    rows = np.frombuffer(data, dtype="<f4").reshape(4, -1)
    table = np.empty(rows.shape[1], dtype=[(n, "<f4") for n in ("x", "y", "z", "intensity")])
    table["x"] = rows[0]
    table["y"] = -rows[1]
    table["z"] = -rows[2]
    table["intensity"] = rows[3]
    return table


def _oxford_poses(file: Path) -> Trajectory:
    """T_map_base in UTM of ins.csv: microseconds; northing, easting, down (m); roll, pitch, yaw from north (rad)."""
    times_ns, columns = read_columns(file)
    T_ned = motions_of_rpy(needed(file, columns, "y", "x", "down", "roll", "pitch", "yaw"))
    longitude, latitude = needed(file, columns, "longitude", "latitude")[0].tolist()
    T_map_ned = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])
    T_map_base = T_map_ned @ T_ned @ _OXFORD_AXES
    return sorted_trajectory(times_ns, T_map_base, of_vehicle=True, frame=MapFrame(utm_of(longitude, latitude)))


def open_oxford(path: Path, options: DriveOptions) -> Drive:
    """One LiDAR of a traversal, the left one unless --topic velodyne_right; the INS is the prior."""
    there = [name for name in OXFORD_LIDARS if (path / name).is_dir()]
    name = options.topic or there[0]
    if name not in there:
        raise MapvoteError(f"{path}: no {name}; --topic chooses one of {', '.join(there)}")
    mount = entry(path, f"extrinsics/{name}.txt")
    T_base_lidar = None
    if mount.is_file():
        T_base_lidar = _OXFORD_AXES @ motions_of_rpy(read_numbers(mount, 6))[0] @ _OXFORD_AXES
    elif options.mount is None and options.T_base_lidar is None:
        log.warning("%s: missing, so the LiDAR is taken to sit at the INS; give --mount", mount)
    return Dataset((f"{name}/*.bin",), _oxford_rows, "gps/ins.csv", _oxford_poses, T_base_lidar).open(path, options)


DATASETS = {
    "Boreas sequence": Dataset(  # test sequences keep their poses secret; the times of points count from the scan's
        ("lidar/*.bin",),
        BinLayout((*KITTI, "laser_number", "time")).read,
        "applanix/lidar_poses.csv",
        _boreas_poses,
        beside="applanix",
    ),
    "MulRan sequence": Dataset(("Ouster/*.bin",), BinLayout().read, "global_pose.csv", _mulran_poses, MULRAN_MOUNT),
    "Newer College experiment": Dataset(
        ("raw_format/ouster_scan/cloud_*_*.pcd", "ouster_scan/cloud_*_*.pcd"),
        read_pcd_table,
        "ground_truth/registered_poses.csv",
        lambda file: replace(read_trajectory(file), of_vehicle=True),
        NEWER_COLLEGE_MOUNT,
        _newer_college_stamp_ns,
    ),
}
