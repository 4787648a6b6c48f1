"""Folders of numbered scan files, one a scan, and their times; KITTI's layout (docs/decisions/data.md), which is
written here too.

Every such layout opens through :func:`open_scan_folder`; a new one only locates the files. Some files say, or nearly
say, what they hold: bin and npy, PLY, LAS, LAZ, PCD. Bare numbers have columns: KITTI has four float32, nuScenes five.
A VIEWPOINT of PCD files that changes from scan to scan is the pose of the sensor, and serves as the prior. Some tools
store the points in the map frame then: they are taken back into the sensor's frame.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
import tomli_w
from numpy.typing import NDArray

from mapvote.core import geometry
from mapvote.core.sensors import Sensor
from mapvote.core.times import has_date
from mapvote.core.types import F32, F64, I64, Drive, MapvoteError, Scan
from mapvote.formats.drives.options import DriveOptions, make_drive, step_of
from mapvote.formats.drives.point_fields import PointReader, log, tell_without_points
from mapvote.formats.drives.scan_names import in_natural_order, stamps_of_names_ns
from mapvote.formats.drives.trajectory import Trajectory, check_rigid, date_ns, of_scans, prior_of
from mapvote.formats.listing import clouds_beside, file_if_any, files_like
from mapvote.formats.maps.autoware import is_autoware
from mapvote.formats.maps.cloud import table_of, xyz
from mapvote.formats.maps.field_names import known_fields
from mapvote.formats.maps.las import stream_las
from mapvote.formats.maps.marked_points import without_marked
from mapvote.formats.maps.pcd import is_pcd_tiles, read_pcd_table, read_viewpoint
from mapvote.formats.maps.ply import stream_ply_tables
from mapvote.formats.reading import read_text, read_whole


def scan_files(folder: Path, suffix: str) -> list[Path]:
    """The files ``folder``/*``suffix`` in the natural order of their names; MapvoteError if none."""
    files = files_like(folder, f"*{suffix}")
    if not files:
        raise MapvoteError(f"{folder}: no scans (*{suffix}) here; a drive needs at least one")
    return in_natural_order(files)


def read_times_ns(file: Path) -> I64:
    """(n,) nanoseconds from a file of seconds, or of KITTI's date and time, one a line; exact to the last digit."""
    out = []
    for number, line in enumerate(read_text(file).splitlines(), 1):
        text = line.strip()
        if not text:
            continue
        if ":" in text:
            out.append(date_ns(text, f"{file}:{number}"))
            continue
        try:
            out.append(int((Decimal(text) * 10**9).to_integral_value()))
        except (InvalidOperation, ValueError, OverflowError) as error:
            raise MapvoteError(f"{file}:{number}: not a time in seconds: {text!r}") from error
    year_2200_ns = 230 * 366 * 86_400 * 10**9
    if any(abs(ns) > year_2200_ns for ns in out):
        raise MapvoteError(f"{file}: times after the year 2200: they are milli-, micro- or nanoseconds? Write seconds")
    return np.array(out, dtype=np.int64)


def read_stamps(folder: Path, files: list[Path], options: DriveOptions) -> I64:
    """(n,) stamps: from times.txt, else evenly at the rate given, else from names such as 1317042145.964.pcd.

    MapvoteError if there is none of them.
    """
    table = file_if_any(folder, "times.txt")
    if table is not None:
        times_ns = of_scans(read_times_ns(table), files, table)
        if len(times_ns) and has_date(int(times_ns[0])) and has_date(options.start_ns):
            problem = f"{table}: its times count from 1970 already, and drive.toml adds start_ns = {options.start_ns}"
            raise MapvoteError(f"{problem}: leave it out")
        return options.start_ns + times_ns
    stamps_ns = None if options.rate_hz is not None else stamps_of_names_ns(files)
    if stamps_ns is not None:
        return stamps_ns
    if options.rate_hz is None:
        raise MapvoteError(
            f"{folder / 'times.txt'}: missing; write one line of seconds per scan, or give --rate HZ (10 for KITTI)"
        )
    return options.start_ns + np.round(np.arange(len(files)) * (1e9 / options.rate_hz)).astype(np.int64)


@dataclass(frozen=True, slots=True)
class ScanFolder:
    """Files of one drive, and the properties that its layout states beside drive.toml."""

    files: list[Path]
    stamps_ns: I64
    """(n,) of ``files``."""
    read_table: Callable[[Path], NDArray[np.void]]
    """A scan's points as a structured array (n,) with x, y, z and, where the file has them, intensity, ring, time."""
    prior: Callable[[], Trajectory | F64 | None] = lambda: None
    """The layout's own prior, where the caller names no other: a trajectory, or a pose (n, 4, 4) of every scan."""
    prior_name: str | None = None
    """By which the caller may ask for it."""
    T_base_lidar: F64 | None = None
    """The layout's own mount."""
    zero_is_no_return: bool = True


def _tell_unread(files: Sequence[Path]) -> None:
    """A message on scans of another format beside the ``files`` that are read."""
    room = files[0].parent
    taken = files[0].suffix.lower()
    for suffix in (".pcd", *_SUFFIXES):
        others = [] if suffix == taken else files_like(room, f"*{suffix}")
        others = [file for file in others if file not in files]
        if others:
            problem = "%s: %d files *%s lie beside the *%s that are read; they are left out"
            log.warning(problem, room, len(others), suffix, taken)
    unread = clouds_beside(room, files, taken.lstrip("."))
    if unread:
        log.warning("%s: %d scans are compressed or folders: left out (%s); unpack them", room, len(unread), unread[0])


def _with_points(path: Path, folder: ScanFolder) -> tuple[I64, tuple[str, ...]]:
    """((m,) the numbers of the files that hold points, or that cannot be read; a sentence on the others).

    A driver that starts before its sensor, and a recorder that is stopped, leave files without a point.
    MapvoteError if no file holds one.
    """

    def is_empty(file: Path) -> bool:
        size = file.stat().st_size if file.is_file() else SMALL_FILE_BYTES
        if size >= SMALL_FILE_BYTES:
            return False
        with suppress(MapvoteError):  # a damaged file is reported when it is read as a scan
            return size == 0 or len(folder.read_table(file)) == 0
        return False

    empty = np.array([is_empty(file) for file in folder.files], dtype=np.bool_)
    if not empty.any():
        return np.arange(len(folder.files)), ()
    names = [folder.files[i].name for i in np.flatnonzero(empty)]
    return np.flatnonzero(~empty), (tell_without_points(str(path), len(folder.files), names),)


def open_scan_folder(path: Path, options: DriveOptions, folder: ScanFolder) -> Drive:
    """The drive of a folder; scans are read one by one, those without a point are left out. MapvoteError says what is
    missing or does not fit."""
    _tell_unread(folder.files)
    own = folder.prior, folder.prior_name, folder.T_base_lidar
    prior = prior_of(path, options, folder.files, folder.stamps_ns, *own)
    used, left_out = _with_points(path, folder)
    stamps_ns = folder.stamps_ns[used]
    reader = PointReader(str(path), options.time_rules, step_of(folder.stamps_ns), folder.zero_is_no_return)

    def read_scan(i: int, sensor: Sensor) -> Scan:
        file = folder.files[used[i]]
        return reader.scan(str(file), i, int(stamps_ns[i]), folder.read_table(file), sensor)

    drive = make_drive(
        path,
        options,
        stamps_ns=stamps_ns,
        T_map_lidar_prior=None if prior.T_map_lidar is None else prior.T_map_lidar[used],
        read_scan=read_scan,
        frame=prior.frame,
        T_base_lidar=folder.T_base_lidar,
        prior_sigmas=None if prior.sigmas is None else prior.sigmas[used],
    )
    return replace(drive, left_out=left_out)


SMALL_FILE_BYTES = 4_096
"""Smaller files may be headers without points; larger ones are not looked at before they are read."""
KITTI = ("x", "y", "z", "intensity")
NUSCENES = (*KITTI, "ring")
_SUFFIXES = (".ply", ".las", ".laz", ".npy", ".bin")


@dataclass(frozen=True, slots=True)
class BinLayout:
    """Columns of one type, row by row."""

    columns: tuple[str, ...] = KITTI
    dtype: str = "<f4"

    def read(self, file: Path) -> NDArray[np.void]:
        """A .bin file as it stands, (n,); MapvoteError if it is cut off or missing."""
        data = read_bytes(file)
        record = np.dtype([(name, self.dtype) for name in self.columns])
        size = record.itemsize
        if len(data) % size:
            columns = ", ".join(self.columns)
            raise MapvoteError(
                f"{file}: {len(data)} bytes are not a multiple of {size} ({np.dtype(self.dtype).name} {columns}): "
                f"the scan is cut off or has other columns; copy it again, leave it out with --scans, or name --columns"
            )
        return np.frombuffer(data, dtype=record)


def read_bytes(file: Path) -> bytes:
    """The bytes of a scan; MapvoteError if it is gone."""
    try:
        return read_whole(file)
    except OSError as error:
        raise MapvoteError(f"{file}: {error.strerror}; the drive changed while it was read") from error


def layout_of(files: Sequence[Path], options: DriveOptions) -> BinLayout:
    """The user's columns, else four (KITTI), or five if the sizes and the fifth column fit (nuScenes)."""
    if options.columns is not None or options.dtype is not None:
        return _said(options.columns or ",".join(KITTI), options.dtype or "float32")
    for file in files[:3]:
        data = read_bytes(file)
        if len(data) % 20 == 0 and _has_rings(data):
            log.warning("%s: five columns, the fifth a ring: read as nuScenes' x, y, z, intensity, ring", file)
            return BinLayout(NUSCENES)
    return BinLayout()


def _has_rings(data: bytes) -> bool:
    """Whether the fifth of five float32 columns holds small whole numbers, more than one of them."""
    ring = np.frombuffer(data, dtype="<f4").reshape(-1, 5)[:, 4]
    with np.errstate(invalid="ignore"):
        whole = (ring >= 0) & (ring < 256) & (ring == np.floor(ring))
    if len(data) % 16 == 0:  # as four columns the last one may look like intensities: all within [0, 1]
        last = np.frombuffer(data, dtype="<f4").reshape(-1, 4)[:, 3]
        if ((last >= 0) & (last <= 1)).all():
            return False
    return bool(whole.all()) and len(np.unique(ring)) > 1


def _said(columns: str, dtype: str) -> BinLayout:
    names = tuple(name.strip() for name in columns.split(","))
    try:
        kind = np.dtype(dtype).newbyteorder("<") if np.dtype(dtype).byteorder != ">" else np.dtype(dtype)
    except TypeError as error:
        raise MapvoteError(f"--dtype {dtype!r}: no number type; for example float32, float64, int16") from error
    if len(set(names)) != len(names) or "" in names or not {"x", "y", "z"} <= set(names) or kind.kind not in "iuf":
        raise MapvoteError(
            f"--columns {columns!r}: name every column once, x, y and z among them; --dtype a number type"
        )
    return BinLayout(names, kind.str)


def open_kitti(path: Path, options: DriveOptions) -> Drive:
    """The drive in ``path``; KITTI odometry's sequences as they come, their camera poses converted with calib.txt."""
    files = scan_files(path / "velodyne", ".bin")
    read = layout_of(files, options).read
    stamps_ns = read_stamps(path, files, options)
    return open_scan_folder(path, options, ScanFolder(files, stamps_ns, read, zero_is_no_return=False))


def cloud_scans(path: Path) -> tuple[Path, str] | None:
    """(folder, suffix) of two or more scans of one kind; a single file is a map, not a drive."""
    for name in ("", "scans", "lidar", "points"):
        for suffix in _SUFFIXES:
            files = files_like(path / name, f"*{suffix}")
            if len(files) >= 2:
                return files[0].parent, suffix
    return None


def open_cloud_scans(path: Path, options: DriveOptions) -> Drive:
    """The drive of which :func:`cloud_scans` knows where it lies."""
    folder_and_suffix = cloud_scans(path)
    assert folder_and_suffix is not None
    files = scan_files(*folder_and_suffix)
    readers: dict[str, Callable[[Path], NDArray[np.void]]] = {
        ".ply": lambda file: np.concatenate(list(stream_ply_tables(file))),
        ".las": _read_las,
        ".laz": _read_las,
        ".npy": lambda file: _read_npy(file, options.columns),
    }
    read = readers.get(folder_and_suffix[1]) or layout_of(files, options).read
    return open_scan_folder(path, options, ScanFolder(files, read_stamps(path, files, options), read))


def _read_las(file: Path) -> NDArray[np.void]:
    """The points (n,) of a LAS or LAZ file that it does not mark as none, with every number that it holds of them."""
    tables = []
    for piece in without_marked(file, stream_las(file, extra=True)):
        fields = [(name, column.dtype) for name, column in piece.fields.items()]
        tables.append(table_of(piece, [*((axis, piece.points.dtype) for axis in "xyz"), *fields]))
    return np.concatenate(tables)


def _read_npy(file: Path, columns: str | None) -> NDArray[np.void]:
    """An array (n, k) or a structured one; MapvoteError if it is neither."""
    try:
        array = np.load(file, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise MapvoteError(f"{file}: not a whole .npy file of numbers ({error}); copy it again") from error
    if array.dtype.names:
        return np.ravel(array)
    names = tuple(columns.split(",")) if columns else NUSCENES if array.ndim == 2 and array.shape[1] == 5 else KITTI
    if array.ndim != 2 or array.dtype.kind not in "iuf" or not (3 <= array.shape[1] <= 64):
        raise MapvoteError(f"{file}: an array {array.shape} of {array.dtype}; a scan is (n, 3 or more) numbers")
    if array.shape[1] > len(names):
        raise MapvoteError(f"{file}: {array.shape[1]} columns; name them with --columns x,y,z,...")
    table = np.empty(len(array), dtype=[(name, array.dtype) for name in names[: array.shape[1]]])
    for i, name in enumerate(table.dtype.names or ()):
        table[name] = array[:, i]
    return table


def pcd_scans(path: Path) -> Path | None:
    """Where the scans of a PCD drive lie: ``path``/pcd or ``path`` itself; None if it is no such drive, but a map."""
    if not path.is_dir() or is_autoware(path) or is_pcd_tiles(path):
        return None
    return next((folder for folder in (path / "pcd", path) if files_like(folder, "*.pcd")), None)


def open_pcd_scans(path: Path, options: DriveOptions) -> Drive:
    """The drive in ``path``, with the VIEWPOINTs as its prior where they say something."""
    files = scan_files(pcd_scans(path) or path, ".pcd")
    stamps_ns = read_stamps(path, files, options)
    viewpoints = _viewpoints(files)
    in_map_frame = viewpoints is not None and _points_lie_around(viewpoints, files)
    if in_map_frame:
        log.warning("%s: points lie in the map frame; taken back to the sensor by each file's VIEWPOINT", path)
    index = {file: i for i, file in enumerate(files)}

    def read(file: Path) -> NDArray[np.void]:
        table = read_pcd_table(file)
        if viewpoints is not None and in_map_frame:
            table = table.copy()
            points = geometry.transform(geometry.inverse(viewpoints[index[file]]), xyz(str(file), table))
            names = known_fields(table.dtype.names or ())
            for axis, column in zip("xyz", points.T, strict=True):
                table[names[axis]] = column
        return table

    def prior() -> Trajectory | F64 | None:
        if viewpoints is not None:
            log.warning("%s: the PCD files' VIEWPOINT is taken as prior; --prior none refuses it", path)
        return viewpoints

    return open_scan_folder(path, options, ScanFolder(files, stamps_ns, read, prior))


def _viewpoints(files: list[Path]) -> F64 | None:
    """(n, 4, 4) of the files' VIEWPOINTs; None if they are all the same, and so say nothing. The identity where there
    is none, or the header is broken (which the reader reports)."""
    rows = np.tile([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], (len(files), 1))
    for row, file in zip(rows, files, strict=True):
        with suppress(MapvoteError):
            viewpoint = read_viewpoint(file)
            row[:] = viewpoint if np.linalg.norm(viewpoint[3:]) > 0.5 else row
    if (rows == rows[0]).all():
        return None
    T = geometry.poses_at(rows[:, :3], geometry.rotations_of(rows[:, [4, 5, 6, 3]]))
    check_rigid(T, f"{files[0].parent} (VIEWPOINT)")
    return T


def _points_lie_around(viewpoints: F64, files: list[Path]) -> bool:
    """Whether points lie around the viewpoint, not around the origin, in the scan taken farthest from the origin."""
    far = int(np.argmax(np.linalg.norm(viewpoints[:, :3, 3], axis=1)))
    points = xyz(str(files[far]), read_pcd_table(files[far])).astype(np.float64)
    centre = viewpoints[far, :3, 3]
    to_origin = np.nanmedian(np.linalg.norm(points, axis=1))
    return bool(np.linalg.norm(centre) > 10.0 and np.nanmedian(np.linalg.norm(points - centre, axis=1)) < to_origin)


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
    """False: points have times, or these follow from their azimuths."""
    with_times: bool = False
    """Whether each scan has a time for every point, a fifth column."""

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

    def write_scan(self, index: int, points: F32, intensity: F32 | None = None, time_s: F64 | None = None) -> None:
        """``points`` (n, 3) in the lidar frame, ``intensity`` (n,) in [0, 1] (0 where None), ``time_s`` (n,) from the
        stamp, for a drive ``with_times``."""
        rows = np.zeros((len(points), 5 if self.with_times else 4), dtype="<f4")
        rows[:, :3] = points
        if self.with_times:
            rows[:, 4] = time_s
        if intensity is not None:
            rows[:, 3] = intensity
        rows.tofile(self._partial / "velodyne" / f"{index:06d}.bin")

    def close(self, stamps_ns: I64, T_map_lidar_prior: F64 | None = None) -> None:
        """Write ``stamps_ns`` (n,) relative to ``start_ns``, priors (n, 4, 4) and drive.toml; the folder appears."""
        written = len(list((self._partial / "velodyne").iterdir()))
        if written != len(stamps_ns):
            raise MapvoteError(f"{self.path}: {written} scans written, but {len(stamps_ns)} stamps")
        times = (f"{ns // 10**9}.{ns % 10**9:09d}\n" for ns in (stamps_ns - self.start_ns).tolist())
        (self._partial / "times.txt").write_text("".join(times))
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
        if self.with_times:
            about |= {"columns": ",".join((*KITTI, "time")), "time_field": "time", "time_unit": "s"}
        (self._partial / "drive.toml").write_text(tomli_w.dumps(about))
        os.replace(self._partial, self.path)


def write_poses(path: Path, T_map_lidar: F64) -> None:
    """(n, 4, 4) as KITTI's rows of 12 numbers, the upper 3 x 4, to a hundredth of a micrometre."""
    with path.open("w") as file:
        np.savetxt(file, T_map_lidar[:, :3].reshape(-1, 12), fmt="%.8f")
