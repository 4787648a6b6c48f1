"""Every format, listed once: how it is recognised, read and written. A new one is a file of its own and a line here."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from mapvote.core.types import Drive
from mapvote.formats.drives.datasets import (
    BOREAS,
    MULRAN,
    NEWER_COLLEGE,
    OXFORD_LIDARS,
    Dataset,
    is_nuscenes,
    open_kitti_raw,
    open_nuscenes,
    open_oxford,
)
from mapvote.formats.drives.options import DriveOptions
from mapvote.formats.drives.rosbag import is_rosbag, open_rosbag
from mapvote.formats.drives.scan_folder import (
    cloud_scans,
    open_cloud_scans,
    open_kitti,
    open_pcd_scans,
    pcd_scans,
)
from mapvote.formats.maps.autoware import (
    is_autoware,
    is_autoware_default,
    stream_autoware,
    stream_autoware_default,
    write_autoware,
)
from mapvote.formats.maps.cloud import Cloud, CloudPieces
from mapvote.formats.maps.las import stream_las, write_las
from mapvote.formats.maps.pcd import is_pcd_tiles, stream_pcd, stream_pcd_tiles, write_pcd
from mapvote.formats.maps.ply_e57 import stream_e57, stream_ply, write_ply


@dataclass(frozen=True, slots=True)
class DriveFormat:
    """A layout of recorded drives."""

    recognised: Callable[[Path], object]
    """True, or what was found, by what lies at the path; opens no scan."""
    open: Callable[[Path, DriveOptions], Drive]


@dataclass(frozen=True, slots=True)
class MapFormat:
    """A format that holds a map's points."""

    recognised: Callable[[Path], bool]
    stream: Callable[[Path], Iterator[Cloud]]
    """Piece by piece, where the format allows it: for maps larger than memory."""


@dataclass(frozen=True, slots=True)
class MapWriter:
    """What ``mapvote export`` writes under a suffix."""

    name: str
    write: Callable[[Path, CloudPieces], None]
    """Whole or not at all."""
    classes: bool = False
    """Whether the format has a place for ASPRS classes."""


def _file(*suffixes: str) -> Callable[[Path], bool]:
    return lambda path: path.is_file() and path.suffix.lower() in suffixes


def _holds(*folders: str) -> Callable[[Path], bool]:
    return lambda path: any((path / folder).is_dir() for folder in folders)


DRIVES: dict[str, DriveFormat | Dataset] = {
    "KITTI drive folder": DriveFormat(_holds("velodyne"), open_kitti),
    "KITTI raw or KITTI-360 recording": DriveFormat(_holds("velodyne_points/data"), open_kitti_raw),
    "nuScenes": DriveFormat(is_nuscenes, open_nuscenes),
    "Boreas sequence": BOREAS,
    "MulRan sequence": MULRAN,
    "Newer College experiment": NEWER_COLLEGE,
    "Oxford RobotCar traversal": DriveFormat(_holds(*OXFORD_LIDARS), open_oxford),
    "ROS bag": DriveFormat(is_rosbag, open_rosbag),
    "folder of PCD scans": DriveFormat(pcd_scans, open_pcd_scans),
    "folder of PLY, LAS, npy or bin scans": DriveFormat(cloud_scans, open_cloud_scans),
}
"""In the order in which they are tried."""

MAPS: dict[str, MapFormat] = {
    "Autoware tile folder": MapFormat(is_autoware, stream_autoware),
    "Autoware default folder": MapFormat(is_autoware_default, stream_autoware_default),
    "PCD file": MapFormat(_file(".pcd"), stream_pcd),
    "folder of PCD tiles X_Y.pcd": MapFormat(is_pcd_tiles, stream_pcd_tiles),
    "LAS or LAZ file": MapFormat(_file(".las", ".laz"), stream_las),
    "PLY file": MapFormat(_file(".ply"), stream_ply),
    "E57 file": MapFormat(_file(".e57"), stream_e57),
}
"""Maps that are only points, in the order in which they are tried."""

WRITERS: dict[str, MapWriter] = {
    ".pcd": MapWriter("PCD file", write_pcd),
    ".las": MapWriter("LAS file", write_las, classes=True),
    ".laz": MapWriter("LAZ file", write_las, classes=True),
    ".ply": MapWriter("PLY file", write_ply),
    "": MapWriter("Autoware tile folder", write_autoware),
}
"""By the suffix of the path; a folder has none."""
