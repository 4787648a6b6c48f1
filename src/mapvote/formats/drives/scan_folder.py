"""Folders of numbered scan files, one a scan, and the text files beside them: which line belongs to which scan.

Every such layout opens through :func:`open_scan_folder`; a new one only locates the files.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapvote.core.sensors import Sensor
from mapvote.core.types import F64, I64, Drive, MapvoteError, Scan
from mapvote.formats.clean import BadPoints, stamps_from_rate
from mapvote.formats.drives.options import DriveFile, DriveOptions, make_drive, map_frame, mount_of
from mapvote.formats.drives.point_fields import scan_from_fields
from mapvote.formats.drives.trajectory import Trajectory, has_times, read_T_map_lidar, read_trajectory
from mapvote.formats.extras import read_text
from mapvote.formats.geo.frame import MapFrame

_LATEST_NS = 230 * 366 * 86_400 * 10**9


def scan_files(folder: Path, suffix: str) -> list[Path]:
    """The files ``folder``/*``suffix`` in the order of the last number in their names; MapvoteError if none."""
    files = (
        [f for f in folder.iterdir() if f.suffix == suffix and not f.name.startswith(".")] if folder.is_dir() else []
    )
    if not files:
        raise MapvoteError(f"{folder}: no scans (*{suffix}) here; a drive needs at least one")
    return sorted(files, key=lambda f: (number_of(f), f.name))


def number_of(file: Path) -> float:
    """The last number in a file's name, e.g. 12 of 000012.bin or 1316.5 of cloud_1316.5.pcd; -1 without one."""
    numbers = re.findall(r"\d+(?:\.\d+)?", file.stem)
    return float(numbers[-1]) if numbers else -1.0


def lines_of_scans(n_lines: int, files: list[Path], table: Path) -> I64:
    """Which line of ``table`` belongs to each scan: one each in order, or by the number in the scan's name.

    KITTI's recordings lack some scans but no line. MapvoteError if the counts cannot be matched.
    """
    if n_lines == len(files):
        return np.arange(n_lines, dtype=np.int64)
    numbers = np.array([number_of(f) for f in files])
    if n_lines > len(files) and len(set(numbers)) == len(files) and numbers.min() >= 0 and numbers.max() < n_lines:
        return numbers.astype(np.int64)
    raise MapvoteError(
        f"{table}: {n_lines} lines for {len(files)} scans ({files[0].name} to {files[-1].name}); it must have one line "
        f"a scan, in order"
    )


def read_times_ns(file: Path) -> I64:
    """(n,) nanoseconds from a file of seconds, or of KITTI's date and time, one a line; exact to the last digit."""
    out = []
    for number, line in enumerate(read_text(file).splitlines(), 1):
        text = line.strip()
        if not text:
            continue
        try:
            if ":" in text:
                whole, _, fraction = text.partition(".")
                moment = datetime.fromisoformat(whole).replace(tzinfo=UTC)
                out.append(int(moment.timestamp()) * 10**9 + int(fraction.ljust(9, "0")[:9]))
            else:
                out.append(int((Decimal(text) * 10**9).to_integral_value()))
        except (InvalidOperation, ValueError, OverflowError) as error:
            raise MapvoteError(f"{file}:{number}: not a time in seconds: {text!r}") from error
    if any(abs(ns) > _LATEST_NS for ns in out):
        raise MapvoteError(f"{file}: times after the year 2200: they are milli-, micro- or nanoseconds? Write seconds")
    return np.array(out, dtype=np.int64)


def read_stamps(folder: Path, files: list[Path], about: DriveFile, options: DriveOptions) -> I64:
    """(n,) stamps: from times.txt, else evenly at the rate given, else from names like 1317042145.964.pcd.

    MapvoteError if there is none of them.
    """
    table = folder / "times.txt"
    if table.is_file():
        times_ns = read_times_ns(table)
        return about.start_ns + times_ns[lines_of_scans(len(times_ns), files, table)]
    rate_hz = options.rate_hz or about.rate_hz
    if rate_hz is None and all(number_of(f) > 1e8 for f in files):
        return np.array([_stamp_in_name_ns(f) for f in files], dtype=np.int64)
    if rate_hz is None:
        raise MapvoteError(f"{table}: missing; write one line of seconds a scan, or give --rate HZ (10 for KITTI)")
    return stamps_from_rate(len(files), rate_hz, about.start_ns)


def _stamp_in_name_ns(file: Path) -> int:
    """A file named by its time since 1970: seconds, or a whole number of milli-, micro- or nanoseconds."""
    number = Decimal(re.findall(r"\d+(?:\.\d+)?", file.stem)[-1])
    power = next(p for p in (0, 3, 6, 9) if number < Decimal(10) ** (10 + p) or p == 9)
    return int(number * 10 ** (9 - power))


def prior_file(folder: Path, about: DriveFile, options: DriveOptions) -> Path | None:
    """The file that the prior comes from: the caller's, else drive.toml's, else prior.txt if it exists."""
    wanted = options.prior or about.prior
    if wanted is None:
        return folder / "prior.txt" if (folder / "prior.txt").is_file() else None
    if wanted.lower() == "none":
        return None
    for file in (Path(wanted), folder / wanted):
        if file.is_file():
            return file
    raise MapvoteError(f"{wanted}: no such prior, neither here nor in {folder}; give a file of 3 x 4 rows, or none")


def of_scans(poses: F64, files: list[Path], table: Path) -> F64:
    """Poses (m, 4, 4) of a file, one for each scan."""
    return poses[lines_of_scans(len(poses), files, table)]


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
