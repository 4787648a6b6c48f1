"""Oxford (Radar) RobotCar: velodyne_left/MICROSECONDS.bin, four rows of float32; gps/ins.csv (Barnes et al. 2020).

Their frames have x forward, y right and z down; points are turned so that y is left and z up. The mount comes from
extrinsics/velodyne_left.txt of their SDK, if it lies beside the drive, or from --mount.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapvote.core import geometry
from mapvote.core.types import F64, Drive, MapvoteError
from mapvote.formats.clean import log
from mapvote.formats.drives.bin_layout import read_bytes
from mapvote.formats.drives.numbered import number_of, scan_files
from mapvote.formats.drives.options import DriveOptions, read_drive_file
from mapvote.formats.drives.poses import read_numbers
from mapvote.formats.drives.scan_folder import ScanFolder, open_scan_folder
from mapvote.formats.drives.trajectory import Trajectory, sorted_trajectory
from mapvote.formats.extras import read_text
from mapvote.formats.geo.frame import MapFrame, utm_of

_LIDARS = ("velodyne_left", "velodyne_right")
_TURNED = np.diag([1.0, -1.0, -1.0, 1.0])
_NORTH_EAST_DOWN = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])


def is_oxford(path: Path) -> bool:
    return any((path / name).is_dir() for name in _LIDARS)


def open_oxford(path: Path, options: DriveOptions) -> Drive:
    """One LiDAR of a traversal, the left one unless --topic velodyne_right; the INS is the prior."""
    about = read_drive_file(path)
    there = [name for name in _LIDARS if (path / name).is_dir()]
    name = options.topic or about.topic or there[0]
    if name not in there:
        raise MapvoteError(f"{path}: no {name}; --topic chooses one of {', '.join(there)}")
    files = scan_files(path / name, ".bin")
    stamps_ns = np.array([int(number_of(f)) * 1000 for f in files], dtype=np.int64)
    table, mount = path / "gps" / "ins.csv", path / "extrinsics" / f"{name}.txt"
    T_base_lidar = np.eye(4)
    if mount.is_file():
        T_base_lidar = _TURNED @ geometry.from_xyz_rpy(*(float(v) for v in read_numbers(mount, 6)[0])) @ _TURNED
    elif options.mount is None and about.T_base_lidar is None:
        log.warning("%s: missing, so the LiDAR is taken to sit at the INS; give --mount", mount)

    def prior() -> Trajectory | F64 | None:
        if not table.is_file():
            log.warning("%s: missing, so there is no prior", table)
            return None
        return read_ins(table)

    return open_scan_folder(path, about, options, ScanFolder(files, stamps_ns, _read, prior, T_base_lidar=T_base_lidar))


def _read(file: Path) -> NDArray[np.void]:
    """Four rows of float32 (x, y, z, intensity), one after the other."""
    data = read_bytes(file)
    if len(data) % 16:
        raise MapvoteError(f"{file}: {len(data)} bytes are no four rows of float32: the scan is cut off; copy it again")
    rows = np.frombuffer(data, dtype="<f4").reshape(4, -1)
    table = np.empty(rows.shape[1], dtype=[(n, "<f4") for n in ("x", "y", "z", "intensity")])
    table["x"], table["y"], table["z"], table["intensity"] = rows[0], -rows[1], -rows[2], rows[3]
    return table


def read_ins(file: Path) -> Trajectory:
    """T_map_base in UTM of ins.csv: microseconds; northing, easting, down (m); roll, pitch, yaw from north (rad)."""
    lines = [line.split(",") for line in read_text(file).splitlines() if line.strip()]
    names = [name.strip() for name in lines[0]]
    wanted = ("northing", "easting", "down", "roll", "pitch", "yaw", "latitude", "longitude")
    missing = [name for name in ("timestamp", *wanted) if name not in names]
    if missing or len(lines) < 2:
        raise MapvoteError(f"{file}: no rows, or no column {', '.join(missing)}")
    try:
        rows = np.array([[float(line[names.index(name)]) for name in wanted] for line in lines[1:]])
        times = np.array([int(line[names.index("timestamp")]) for line in lines[1:]], dtype=np.int64) * 1000
    except (ValueError, IndexError) as error:
        raise MapvoteError(f"{file}: a row is not whole ({error}); copy it again") from error
    T_ned = np.stack([geometry.from_xyz_rpy(*(float(v) for v in row[:6])) for row in rows])
    frame = MapFrame(utm_of(float(rows[0, 7]), float(rows[0, 6])))
    return sorted_trajectory(times, _NORTH_EAST_DOWN @ T_ned @ _TURNED, of_vehicle=True, frame=frame)
