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
from mapvote.core.types import F32, F64, I64, Drive, MapvoteError
from mapvote.formats.drives.options import DriveOptions
from mapvote.formats.drives.scan_folder import ScanFolder, layout_of, open_scan_folder, read_stamps, scan_files


def is_kitti_folder(path: Path) -> bool:
    return (path / "velodyne").is_dir()


def open_kitti(path: Path, options: DriveOptions) -> Drive:
    """The drive in ``path``; its scans are read one by one. MapvoteError says what is missing or does not fit."""
    files = scan_files(path / "velodyne", ".bin")
    layout = layout_of(files, options.columns, options.dtype)
    folder = ScanFolder(
        files,
        read_stamps(path, files, options),
        layout.read,
        zero_is_no_return=False,
        spinning=True,
    )
    return open_scan_folder(path, options, folder)


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
