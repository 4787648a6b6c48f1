"""Folders of PLY, LAS, LAZ, npy, npz or bin files, one scan each, beside the text files of a KITTI drive."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapvote.core.types import Drive, MapvoteError
from mapvote.formats.drives.bin_layout import KITTI, NUSCENES, layout_of
from mapvote.formats.drives.numbered import read_stamps, scan_files
from mapvote.formats.drives.options import DriveOptions, read_drive_file
from mapvote.formats.drives.scan_folder import ScanFolder, open_scan_folder
from mapvote.formats.maps.cloud import Cloud
from mapvote.formats.maps.las import read_las
from mapvote.formats.maps.ply import read_ply

SUFFIXES = (".ply", ".las", ".laz", ".npy", ".bin")
FOLDERS = ("", "scans", "lidar", "points")


def _folder_of(path: Path) -> tuple[Path, str] | None:
    """(folder, suffix) of two or more scans of one kind; a single file is a map, not a drive."""
    for name in FOLDERS:
        for suffix in SUFFIXES:
            if path.is_dir() and len([*(path / name).glob(f"*{suffix}")][:2]) == 2:
                return path / name, suffix
    return None


def is_cloud_scans(path: Path) -> bool:
    return _folder_of(path) is not None


def open_cloud_scans(path: Path, options: DriveOptions) -> Drive:
    """The drive in ``path``; scans are read one by one. MapvoteError says what is missing or does not fit."""
    about = read_drive_file(path)
    found = _folder_of(path)
    if found is None:
        raise MapvoteError(f"{path}: no scans ({', '.join(SUFFIXES)}) in it")
    files = scan_files(*found)
    columns = options.columns or about.columns
    readers: dict[str, Callable[[Path], NDArray[np.void]]] = {
        ".ply": lambda file: _table(read_ply(file)),
        ".las": lambda file: _table(read_las(file)),
        ".laz": lambda file: _table(read_las(file)),
        ".npy": lambda file: _read_npy(file, columns),
    }
    read = readers.get(found[1]) or layout_of(files, columns, options.dtype or about.dtype).read
    return open_scan_folder(path, about, options, ScanFolder(files, read_stamps(path, files, about, options), read))


def _table(cloud: Cloud) -> NDArray[np.void]:
    columns = {axis: cloud.points[:, i] for i, axis in enumerate("xyz")} | dict(cloud.fields)
    table = np.empty(len(cloud.points), dtype=[(name, column.dtype) for name, column in columns.items()])
    for name, column in columns.items():
        table[name] = column
    return table


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
