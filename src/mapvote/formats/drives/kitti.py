"""Drive folders in KITTI's layout (docs/decisions/data.md): velodyne/NNNNNN.bin, times.txt, prior.txt, drive.toml.

KITTI odometry's sequences are read as they come; their poses are camera poses and are converted with calib.txt.
"""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import tomli_w

from mapvote.core.sensors import Sensor
from mapvote.core.types import F32, F64, I64, Drive, MapvoteError, Scan
from mapvote.formats.clean import BadPoints, clean_scan, spinning_time_s
from mapvote.formats.drives.numbered import of_scans, prior_file, read_stamps, scan_files
from mapvote.formats.drives.options import DriveOptions, make_drive, read_drive_file
from mapvote.formats.drives.poses import camera_to_lidar, read_poses, read_T_camera_lidar, travels_along


def is_kitti_folder(path: Path) -> bool:
    return (path / "velodyne").is_dir()


def open_kitti(path: Path, options: DriveOptions) -> Drive:
    """The drive in ``path``; its scans are read one by one. MapvoteError says what is missing or does not fit."""
    about = read_drive_file(path)
    files = scan_files(path / "velodyne", ".bin")
    stamps_ns = read_stamps(path, files, about, options)
    prior = prior_file(path, about, options)
    T_prior = None if prior is None else of_scans(read_T_map_lidar(prior, path), files, prior)
    bad_points = BadPoints(str(path))

    def read_scan(i: int, sensor: Sensor) -> Scan:
        rows = read_bin(files[i])
        return clean_scan(
            str(files[i]),
            i,
            int(stamps_ns[i]),
            rows[:, :3],
            sensor=sensor,
            bad_points=bad_points,
            intensity=rows[:, 3],
            time_s=None if about.motion_compensated else spinning_time_s(rows, sensor.rate_hz),
        )

    return make_drive(path, about, options, stamps_ns=stamps_ns, T_map_lidar_prior=T_prior, read_scan=read_scan)


def read_bin(file: Path) -> F32:
    """(n, 4) float32 x, y, z, intensity of a .bin file as it stands; MapvoteError if it is cut off or missing."""
    try:
        data = file.read_bytes()
    except OSError as error:
        raise MapvoteError(f"{file}: {error.strerror}; the drive changed while it was read") from error
    if len(data) % 16:
        raise MapvoteError(
            f"{file}: {len(data)} bytes are not a multiple of 16 (float32 x, y, z, intensity): the scan is cut off; "
            f"copy it again, or leave it out with --scans"
        )
    return np.frombuffer(data, dtype="<f4").reshape(-1, 4)


def read_T_map_lidar(file: Path, folder: Path) -> F64:
    """Poses (n, 4, 4) of a file of rows as T_map_lidar. Camera poses are recognised by their motion along z.

    With ``folder``/calib.txt (KITTI odometry) they are converted, the map being the first LiDAR frame; without it
    they are a MapvoteError.
    """
    poses = read_poses(file)
    calib = folder / "calib.txt"
    axis = travels_along(poses)
    if axis == "+z" or (calib.is_file() and axis == "" and file.name != "prior.txt"):
        if not calib.is_file():
            raise MapvoteError(
                f"{file}: these are camera poses (the vehicle moves along z, not x); put KITTI's calib.txt into "
                f"{folder} to have them converted, or write T_map_lidar rows"
            )
        return camera_to_lidar(poses, read_T_camera_lidar(calib))
    return poses


@dataclass(frozen=True)
class DriveWriter:
    """Writes one drive folder: scans in any order (also from several processes), then :meth:`close`.

    The folder ``path`` appears whole on ``close``; until then everything lies in a sibling that starts with a dot.
    """

    path: Path
    vehicle: str
    sensor: Sensor
    start_ns: int
    prior_sigma_m: float = 1.0
    prior_sigma_deg: float = 1.0
    T_base_lidar: F64 = field(default_factory=lambda: np.eye(4))
    motion_compensated: bool = True
    """False: the loader sets Scan.time_s by the spinning-sensor rule."""

    @property
    def _partial(self) -> Path:
        return self.path.with_name(f".{self.path.name}.partial")

    def open(self) -> DriveWriter:
        """Make the hidden folder, empty. MapvoteError if ``path`` exists already."""
        if self.path.exists():
            raise MapvoteError(f"{self.path}: exists already; remove it or choose another folder")
        shutil.rmtree(self._partial, ignore_errors=True)
        (self._partial / "velodyne").mkdir(parents=True)
        return self

    def write_scan(self, index: int, points: F32, intensity: F32 | None = None) -> None:
        """``points`` (n, 3) in the lidar frame, ``intensity`` (n,) in [0, 1] (0 where None)."""
        rows = np.zeros((len(points), 4), dtype="<f4")
        rows[:, :3] = points
        if intensity is not None:
            rows[:, 3] = intensity
        rows.tofile(self._partial / "velodyne" / f"{index:06d}.bin")

    def close(self, stamps_ns: I64, T_map_lidar_prior: F64 | None = None) -> None:
        """Write ``stamps_ns`` (n,) relative to ``start_ns``, priors (n, 4, 4) and drive.toml; the folder appears."""
        written = len(list((self._partial / "velodyne").iterdir()))
        if written != len(stamps_ns):
            raise MapvoteError(f"{self.path}: {written} scans written, but {len(stamps_ns)} stamps")
        write_times(self._partial / "times.txt", stamps_ns - self.start_ns)
        if T_map_lidar_prior is not None:
            write_poses(self._partial / "prior.txt", T_map_lidar_prior)
        about = {
            "vehicle": self.vehicle,
            "sensor": self.sensor.name,
            "rate_hz": self.sensor.rate_hz,
            "start_ns": self.start_ns,
            "prior_sigma_m": self.prior_sigma_m,
            "prior_sigma_deg": self.prior_sigma_deg,
            "T_base_lidar": self.T_base_lidar[:3].ravel().tolist(),
            "motion_compensated": self.motion_compensated,
        }
        (self._partial / "drive.toml").write_text(tomli_w.dumps(about))
        os.replace(self._partial, self.path)


def write_times(path: Path, times_ns: I64) -> None:
    """times.txt: one line of seconds a scan, with nanoseconds kept exactly."""
    path.write_text("".join(f"{ns // 1_000_000_000}.{ns % 1_000_000_000:09d}\n" for ns in times_ns.tolist()))


def write_poses(path: Path, T_map_lidar: F64) -> None:
    """(n, 4, 4) as KITTI's rows of 12 numbers, the upper 3 x 4, to a hundredth of a micrometre."""
    with path.open("w") as file:
        np.savetxt(file, T_map_lidar[:, :3].reshape(-1, 12), fmt="%.8f")
