"""Folders of scan files, one a scan: what every such layout shares, so that a new one only says where things lie."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapvote.core.sensors import Sensor
from mapvote.core.types import F64, I64, Drive, MapvoteError, Scan
from mapvote.formats.clean import BadPoints
from mapvote.formats.drives.numbered import of_scans, prior_file
from mapvote.formats.drives.options import DriveFile, DriveOptions, make_drive, map_frame, mount_of
from mapvote.formats.drives.point_fields import scan_from_fields
from mapvote.formats.drives.poses import read_T_map_lidar
from mapvote.formats.drives.trajectory import Trajectory, has_times, read_trajectory
from mapvote.formats.geo.frame import MapFrame


@dataclass(frozen=True, slots=True)
class ScanFolder:
    """One drive's files and what is known of them besides drive.toml."""

    files: list[Path]
    stamps_ns: I64
    """(n,) of ``files``."""
    read_table: Callable[[Path], NDArray[np.void]]
    """A scan's points as a structured array (n,) with x, y, z and, where the file has them, intensity, ring, time."""
    prior: Callable[[], Trajectory | F64 | None] = lambda: None
    """The layout's own prior, where the caller names no other: a trajectory, or a pose (n, 4, 4) of every scan."""
    T_base_lidar: F64 | None = None
    """The layout's own mount."""
    zero_is_no_return: bool = True
    spinning: bool = False
    """Points without times get them from their azimuth, unless drive.toml says motion_compensated."""


def open_scan_folder(path: Path, about: DriveFile, options: DriveOptions, folder: ScanFolder) -> Drive:
    """The drive of a folder; scans are read one by one. MapvoteError says what is missing or does not fit."""
    bad_points = BadPoints(str(path))
    T_prior, frame = prior_of(path, about, options, folder)

    def read_scan(i: int, sensor: Sensor) -> Scan:
        file = folder.files[i]
        return scan_from_fields(
            str(file),
            i,
            int(folder.stamps_ns[i]),
            folder.read_table(file),
            sensor=sensor,
            bad_points=bad_points,
            zero_is_no_return=folder.zero_is_no_return,
            spinning=folder.spinning and not about.motion_compensated,
        )

    return make_drive(
        path,
        about,
        options,
        stamps_ns=folder.stamps_ns,
        T_map_lidar_prior=T_prior,
        read_scan=read_scan,
        frame=frame,
        T_base_lidar=folder.T_base_lidar,
    )


def prior_of(path: Path, about: DriveFile, options: DriveOptions, folder: ScanFolder) -> tuple[F64 | None, MapFrame]:
    """(T_map_lidar of every scan (n, 4, 4), the frame they are in): the caller's file, else the layout's own."""
    T_base_lidar = mount_of(about, options, folder.T_base_lidar, str(path))
    file = prior_file(path, about, options)
    wanted = options.prior or about.prior
    own = None if wanted is not None and wanted.lower() == "none" else folder.prior() if file is None else None
    if file is not None:
        if not has_times(file):
            return of_scans(read_T_map_lidar(file, path), folder.files, file), MapFrame()
        own = read_trajectory(file, map_frame(about, options))
    if own is None:
        return None, MapFrame()
    if not isinstance(own, Trajectory):
        if len(own) != len(folder.files):
            raise MapvoteError(f"{path}: {len(own)} poses for {len(folder.files)} scans; one a scan, in order")
        return own, MapFrame()
    T = own.at(folder.stamps_ns, str(file or path))
    return (T @ T_base_lidar if own.of_vehicle else T), own.frame
